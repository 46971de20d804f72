// On paper nothing can be opened: what is folded is printed open, and folded again.
{
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = [...document.querySelectorAll("details:not([open])")];
    opened.forEach((details) => (details.open = true));
  });
  addEventListener("afterprint", () => opened.forEach((details) => (details.open = false)));
}
{
  const text = (id) => document.getElementById(id).textContent;
  VstentViewer.mount(document.getElementById("viewer"), JSON.parse(text("scene-manifest")), text("scene-bytes"));
}
