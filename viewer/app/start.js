// Where a case begins: drop a scan, open a case, or try the demo.
import { make } from "../src/dom.js";
import { get, post, put } from "./api.js";

const KINDS = "DICOM folder or ZIP · NIfTI · NRRD · MHA · RAW · STL · VTP · VTK · OBJ · PLY";

export function startPage(open, complain) {
  const said = make("p", { className: "drop-said", role: "status" });
  const bring = (files) => upload(files, said).then(open).catch(complain);
  const tryDemo = () => {
    said.textContent = "Making the demo's scan …";
    post("/api/demo").then(({ id }) => open(id)).catch(complain);
  };
  const file = make("input", { type: "file", multiple: true, hidden: true, onChange: () => bring([...file.files]) });
  const folder = make("input", { type: "file", hidden: true, onChange: () => bring([...folder.files]) });
  folder.webkitdirectory = true;
  const zone = make("div", { className: "drop", role: "group", ariaLabel: "Drop a scan" }, [
    make("div", { className: "drop-icon", ariaHidden: "true" }, ["⇣"]),
    make("h1", {}, ["Drop a scan or a vessel surface here"]),
    make("p", {}, [KINDS]),
    make("div", { className: "drop-buttons" }, [
      make("button", { type: "button", className: "primary", onClick: () => file.click() }, ["Choose files"]),
      make("button", { type: "button", onClick: () => folder.click() }, ["Choose a DICOM folder"]),
      make("button", { type: "button", onClick: tryDemo }, ["Try the demo"]),
    ]),
    said,
    file,
    folder,
  ]);
  zone.addEventListener("dragover", (event) => {
    event.preventDefault();
    zone.classList.add("over");
  });
  zone.addEventListener("dragleave", () => zone.classList.remove("over"));
  zone.addEventListener("drop", async (event) => {
    event.preventDefault();
    zone.classList.remove("over");
    bring(await dropped(event.dataTransfer));
  });
  const list = make("div", { className: "recent" });
  get("/api/cases").then(({ cases }) => list.replaceChildren(...recent(cases, open)));
  const privacy = "Files stay on this machine. Of DICOM files only the image is kept, without name, date and number of the patient.";
  return make("main", { className: "start" }, [zone, make("p", { className: "hint" }, [privacy]), list]);
}

function recent(cases, open) {
  if (!cases.length) return [];
  return [
    make("h2", {}, ["Open an earlier case"]),
    ...cases.slice(0, 12).map(({ id, name, done }) =>
      make("button", { type: "button", className: "recent-case", onClick: () => open(id) }, [
        make("b", {}, [name]),
        make("span", {}, [done.length ? `${done.length} of 7 steps done` : "no step done"]),
      ]),
    ),
  ];
}

/** All files of what was dropped, folders walked through. */
async function dropped(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.length) return [...transfer.files];
  const files = [];
  const walk = async (entry) => {
    if (entry.isFile) files.push(await new Promise((taken, failed) => entry.file(taken, failed)));
    else {
      const reader = entry.createReader();
      for (;;) {
        const some = await new Promise((taken, failed) => reader.readEntries(taken, failed));
        if (!some.length) break;
        for (const one of some) await walk(one);
      }
    }
  };
  for (const entry of entries) await walk(entry);
  return files.filter(({ name }) => !name.startsWith("."));
}

async function upload(files, said) {
  if (!files.length) throw new Error("What you dropped contains no file.");
  said.textContent = "Reading …";
  const name = files.length > 1 ? "scan" : files[0].name.replace(/(\.[A-Za-z]+)+$/, "") || "case";
  const { id } = await post("/api/cases", { name });
  for (const [i, file] of files.entries()) {
    said.textContent = files.length > 1 ? `Reading file ${i + 1} of ${files.length} …` : `Reading ${file.name} …`;
    await put(`/api/cases/${id}/input?name=${encodeURIComponent(file.name)}`, file);
  }
  await post(`/api/cases/${id}/input/done`);
  return id;
}
