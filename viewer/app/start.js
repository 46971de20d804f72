// Where a case begins: drop a scan, open a case, or try the demo.
import { zipSync } from "../src/decode.js";
import { button, make } from "../src/dom.js";
import { drop as remove, get, post, put } from "./api.js";
import { ask } from "./dialogs.js";

const RETRY_MS = 3000;
const KINDS = "DICOM folder or ZIP · NIfTI · NRRD · MHA · RAW · STL · VTP · VTK · OBJ · PLY";

export function startPage(open, complain) {
  const said = make("p", { className: "drop-said", role: "status" });
  const first = make("input", { type: "checkbox", id: "look-first", checked: localStorage.lookFirst !== "no", onChange: () => (localStorage.lookFirst = first.checked ? "yes" : "no") });
  const bring = (files) => upload(files, said, first.checked).then(open).catch(complain);
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
      button("Choose files", () => file.click(), { className: "primary" }),
      button("Choose a DICOM folder", () => folder.click()),
      button("Try the demo", tryDemo),
    ]),
    make("label", { htmlFor: "look-first" }, [first, " Check the image first: the vessel of a scan is found when you say so"]),
    said,
    file,
    folder,
  ]);
  const over = (isOver) => (event) => {
    event.preventDefault();
    zone.classList.toggle("over", isOver);
  };
  zone.addEventListener("dragover", over(true));
  for (const name of ["dragleave", "drop"]) zone.addEventListener(name, over(false));
  zone.addEventListener("drop", async ({ dataTransfer }) => bring(await dropped(dataTransfer)));
  const list = make("div", { className: "recent" });
  const show = ({ cases }) => list.replaceChildren(...(cases.length ? [make("h2", {}, ["Open an earlier case"])] : []), ...cases.map((one) => recentCase(one, { open, show, complain })));
  const load = () =>
    get("/api/cases")
      .then(show)
      .catch((problem) => {
        complain(problem);
        setTimeout(() => list.isConnected && load(), RETRY_MS);
      });
  load();
  const privacy = "Files stay on this machine. Of DICOM files only the image is kept, without name, date and number of the patient.";
  return make("main", { className: "start" }, [zone, make("p", { className: "hint" }, [privacy]), list]);
}

const DATE = new Intl.DateTimeFormat(undefined, { dateStyle: "medium", timeStyle: "short" });

/** What a case has: work, a failure, steps that are up to date, or results of earlier choices. */
function progressWords(done, kept, job, failed) {
  const before = job ? "at work · " : failed.length ? `failed: ${failed.map((step) => TITLES[step]).join(", ")} · ` : "";
  const old = kept.filter((step) => !done.includes(step)).length;
  if (!done.length && !old) return `${before}no step done`;
  return `${before}${done.length} of 7 steps done${old ? `, ${old} out of date` : ""}`;
}

const TITLES = { image: "Image", vessel: "Vessel", sac: "Sac and parent", device: "Treatment", deploy: "Deploy", flow: "Flow", report: "Report" };

function recentCase({ id, name, done, kept, job, failed, changed_s, has_picture }, { open, show, complain }) {
  const picture = has_picture ? make("img", { src: `/api/cases/${encodeURIComponent(id)}/picture?${changed_s}`, alt: "", width: 320, height: 200 }) : make("i", { className: "no-picture" });
  const words = make("span", { className: failed.length && !job ? "bad" : "" }, [`${progressWords(done, kept, job, failed)} · ${DATE.format(new Date(1000 * changed_s))}`]);
  const rename = async () => {
    const given = await ask({ title: "Rename the case", words: [], field: "Name", value: name, button: "Rename" });
    if (given && given !== name) await put(`/api/cases/${encodeURIComponent(id)}/name`, { name: given.slice(0, 120) }).then(show).catch(complain);
  };
  const discard = async () => {
    const sentences = [`This deletes the folder of ${name} with its copy of the scan and all results. It cannot be undone.`];
    const isSure = await ask({ title: `Delete ${name}?`, words: sentences, button: "Delete", isDangerous: true });
    if (isSure) await remove(`/api/cases/${encodeURIComponent(id)}`).then(show).catch(complain);
  };
  return make("article", { className: "recent-card" }, [
    make("button", { type: "button", className: "recent-case", onClick: () => open(id) }, [picture, make("b", {}, [name]), words]),
    make("div", { className: "recent-tools" }, [
      button("Rename", rename, { className: "link", ariaLabel: `Rename ${name}` }),
      button("Delete", discard, { className: "link", ariaLabel: `Delete ${name}` }),
    ]),
  ]);
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

/** Files in parts of at most so many bytes, which are sent as one archive each. */
const PART_BYTES = 64 << 20;

function parts(files) {
  const found = [[]];
  let size = 0;
  for (const file of files) {
    if (size + file.size > PART_BYTES && found.at(-1).length) (found.push([]), (size = 0));
    found.at(-1).push(file);
    size += file.size;
  }
  return found;
}

/** Several files as an archive without compression. */
async function archive(files) {
  const entries = await Promise.all(files.map(async (file, i) => [`${i}/${file.name}`, new Uint8Array(await file.arrayBuffer())]));
  return new Blob([zipSync(Object.fromEntries(entries), { level: 0 })]);
}

async function upload(files, said, isLookedAtFirst) {
  if (!files.length) throw new Error("What you dropped contains no file.");
  said.textContent = "Reading …";
  const name = files.length > 1 ? "scan" : files[0].name.replace(/(\.[A-Za-z]+)+$/, "") || "case";
  const { id } = await post("/api/cases", { name });
  try {
    let count = 0;
    for (const part of parts(files)) {
      count += part.length;
      said.textContent = files.length > 1 ? `Reading ${count} of ${files.length} files …` : `Reading ${part[0].name} …`;
      const [name, body] = part.length > 1 ? ["part.zip", await archive(part)] : [part[0].name, part[0]];
      await put(`/api/cases/${id}/input?name=${encodeURIComponent(name)}`, body);
    }
    await post(`/api/cases/${id}/input/done?look_first=${isLookedAtFirst}`);
  } catch (problem) {
    await remove(`/api/cases/${id}`).catch(() => {}); // no case is left of files that cannot be read
    throw problem;
  }
  return id;
}
