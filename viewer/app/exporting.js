// A view as a file of a chosen size: PNG, or SVG with text, bars and charts as vectors and the 3-D view in it as a raster.
import { make, svg } from "../src/dom.js";
import { cancelButton, shown } from "./dialogs.js";
import { traced } from "./tracing.js";

/** Widths in mm that journals ask for. */
const WIDTHS = [85, 120, 170];
const RESOLUTIONS = [150, 300, 600];
const MM_PER_INCH = 25.4;
const MOST_PIXELS = 8192;
/** Text of 12 pixels on the page is so high on paper, in points; journals ask for 6 to 8. */
const LETTER_PT = 7;
const PX_PER_MM = (12 / LETTER_PT) * (72 / MM_PER_INCH);
const XLINK = "http://www.w3.org/1999/xlink";

/** What was chosen last, for the next picture. */
const chosen = { width: 170, dpi: 300, format: "PNG" };

/**
 * A button that saves a view.
 * @param source {name, element, lay(): fit into the size that the element has now, words(): elements that are written as
 *   vectors, rasters(scale): [[canvas, box]] with `scale` pixels per pixel of the page, ground: colour behind all, shape(wide): height for a width of one, where it is so many pixels wide}
 */
export function saveButton(source, words = "Save picture") {
  const save = () => choose().then((isSure) => isSure && offer(source));
  return make("button", { type: "button", className: "chip save", title: "Save as PNG or SVG", ariaLabel: `${words}: ${source.name}`, onClick: save }, [words === "Save picture" ? words : "⤓"]);
}

/** A small button that saves the drawings in an element; `lay()` draws them for its size. */
export function chartButton(name, element, lay) {
  return saveButton({ name, element, lay, words: () => [...element.querySelectorAll("svg, dl")] }, "Save");
}

/** Ask for size and format; the promise holds whether to save. */
async function choose() {
  const field = (label, input) => make("label", {}, [make("span", {}, [label]), input]);
  const select = (key, values, words) =>
    make("select", { data: { key } }, values.map((value) => make("option", { value, selected: value === chosen[key] }, [words(value)])));
  const width = make("input", { type: "number", min: 20, max: 400, step: "any", required: true, value: chosen.width });
  width.setAttribute("list", "save-widths");
  const widths = make("datalist", { id: "save-widths" }, WIDTHS.map((mm) => make("option", { value: mm })));
  const [format, dpi] = [select("format", ["PNG", "SVG"], (word) => word), select("dpi", RESOLUTIONS, (value) => `${value} dpi`)];
  const form = make("form", { method: "dialog", className: "save-form" }, [
    make("h2", { id: "save-title" }, ["Save picture"]),
    field("Format", format),
    field("Width, mm", width),
    widths,
    field("Resolution", dpi),
    make("p", { className: "hint" }, [`Journals ask for 85 mm (one column) to 170 mm (two). Letters are about ${LETTER_PT} pt high at every width. In SVG text, bars and charts are vectors; the 3-D view is a picture of this resolution.`]),
    make("div", { className: "ask-buttons" }, [cancelButton(), make("button", { type: "submit", className: "primary", value: "yes" }, ["Save"])]),
  ]);
  const isSure = await shown(form, "save-title");
  if (isSure) Object.assign(chosen, { width: Number(width.value), dpi: Number(dpi.value), format: format.value });
  return isSure;
}

async function offer(source) {
  const sheet = taken(source);
  const blob = chosen.format === "SVG" ? vectors(sheet, `${chosen.width}mm`, `${(chosen.width * sheet.height) / sheet.width}mm`) : await pixels(sheet);
  const link = make("a", { download: `vstent ${source.name}.${chosen.format.toLowerCase()}`, href: URL.createObjectURL(blob) });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

/** A view laid out for the chosen width, and after that on the page as before: {width, height, scale, ground, rasters, parts}. */
function taken({ element, lay = () => {}, words, rasters = () => [], ground = "#ffffff", shape = () => element.offsetHeight / element.offsetWidth }) {
  const wide = Math.round(chosen.width * PX_PER_MM);
  const scale = Math.min((chosen.width / MM_PER_INCH) * chosen.dpi, MOST_PIXELS) / wide;
  const [before, high] = [element.style.cssText, Math.round(wide * shape(wide))];
  element.classList.add("saving");
  Object.assign(element.style, { width: `${wide}px`, height: `${high}px` });
  try {
    lay();
    const box = element.getBoundingClientRect();
    const found = rasters(scale).map(([canvas, place]) => ({ canvas, x: place.x - box.x, y: place.y - box.y, width: place.width, height: place.height }));
    return { width: box.width, height: box.height, scale, ground, rasters: found, parts: words().flatMap((one) => traced(one, [box.x, box.y])) };
  } finally {
    element.classList.remove("saving");
    element.style.cssText = before;
    lay();
  }
}

/** A copy of a canvas that may be drawn anew at once. */
export function copied(canvas) {
  const copy = make("canvas", { width: canvas.width, height: canvas.height });
  copy.getContext("2d").drawImage(canvas, 0, 0);
  return copy;
}

/** The file in SVG. */
function vectors({ width, height, ground, rasters, parts }, wide, high) {
  const images = rasters.map(({ canvas, ...place }) => {
    const image = svg("image", { ...place, preserveAspectRatio: "none" });
    image.setAttributeNS(XLINK, "xlink:href", canvas.toDataURL("image/png")); // every program reads this form
    return image;
  });
  const paper = ground ? [svg("rect", { width, height, fill: ground })] : [];
  const root = svg("svg", { width: wide, height: high, viewBox: `0 0 ${width} ${height}` }, [...paper, ...images, ...parts]);
  return new Blob([new XMLSerializer().serializeToString(root)], { type: "image/svg+xml" });
}

/** The file in PNG: the rasters, and over them the vectors. */
async function pixels(sheet) {
  const [wide, high] = [sheet.width, sheet.height].map((length) => Math.round(length * sheet.scale));
  const canvas = make("canvas", { width: wide, height: high });
  const context = canvas.getContext("2d");
  context.fillStyle = sheet.ground;
  context.fillRect(0, 0, wide, high);
  const { scale } = sheet;
  for (const one of sheet.rasters) context.drawImage(one.canvas, one.x * scale, one.y * scale, one.width * scale, one.height * scale);
  const image = new Image();
  image.src = URL.createObjectURL(vectors({ ...sheet, rasters: [], ground: "" }, wide, high));
  await image.decode();
  context.drawImage(image, 0, 0, wide, high);
  URL.revokeObjectURL(image.src);
  const bytes = Uint8Array.from(atob(canvas.toDataURL("image/png").split(",")[1]), (c) => c.charCodeAt(0));
  return new Blob([withResolution(bytes, (wide / chosen.width) * 1000)], { type: "image/png" });
}

/** A PNG with its pixels per metre, so that it has its size in a document (chunk pHYs after the header). */
function withResolution(bytes, perMetre) {
  const chunk = new Uint8Array(21);
  const view = new DataView(chunk.buffer);
  view.setUint32(0, 9);
  chunk.set([0x70, 0x48, 0x59, 0x73], 4);
  view.setUint32(8, Math.round(perMetre));
  view.setUint32(12, Math.round(perMetre));
  chunk[16] = 1;
  view.setUint32(17, checksum(chunk.subarray(4, 17)));
  const after = 33; // signature and header
  const found = new Uint8Array(bytes.length + chunk.length);
  found.set(bytes.subarray(0, after));
  found.set(chunk, after);
  found.set(bytes.subarray(after), after + chunk.length);
  return found;
}

function checksum(bytes) {
  let sum = 0xffffffff;
  for (const byte of bytes) {
    sum ^= byte;
    for (let k = 0; k < 8; k++) sum = sum & 1 ? (sum >>> 1) ^ 0xedb88320 : sum >>> 1;
  }
  return (sum ^ 0xffffffff) >>> 0;
}
