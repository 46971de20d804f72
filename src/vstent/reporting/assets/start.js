{
  const text = (id) => document.getElementById(id).textContent;
  VstentViewer.mount(document.getElementById("viewer"), JSON.parse(text("scene-manifest")), text("scene-bytes"));
}
