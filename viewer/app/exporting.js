// The picture as a file: PNG of a chosen width and resolution, with titles, length bar and colour bars, for a paper.
import { make } from "../src/dom.js";

const WIDTHS = [[85, "85 mm (one column)"], [120, "120 mm"], [170, "170 mm (two columns)"]];
const RESOLUTIONS = [150, 300, 600];
const MM_PER_INCH = 25.4;
const MOST_PIXELS = 8192;
const [INK, PAPER] = ["#16262e", "#ffffff"];

export class Exporting {
  constructor(picture) {
    this.picture = picture;
    this.width = 170;
    this.resolution = 300;
    const choice = (label, values, key) => {
      const box = make("select", {}, values.map(([value, words]) => make("option", { value, selected: value === this[key] }, [words])));
      box.addEventListener("change", () => (this[key] = Number(box.value)));
      return make("label", {}, [make("span", {}, [label]), box]);
    };
    const save = make("button", { type: "button", className: "primary", onClick: () => this.save() }, ["Save PNG"]);
    const form = make("div", { className: "export-form" }, [
      choice("Width", WIDTHS, "width"),
      choice("Resolution", RESOLUTIONS.map((dpi) => [dpi, `${dpi} dpi`]), "resolution"),
      save,
    ]);
    this.element = make("details", { className: "export" }, [make("summary", { className: "chip" }, ["Save picture"]), form]);
  }

  save() {
    const bytes = this.png();
    const link = make("a", { download: "vstent.png", href: URL.createObjectURL(new Blob([bytes], { type: "image/png" })) });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    this.element.open = false;
  }

  /** Bytes of the picture as it is seen, in the chosen size. */
  png() {
    const { picture } = this;
    const [wide, high] = [picture.area.clientWidth, picture.area.clientHeight];
    const scale = Math.min((this.width / MM_PER_INCH) * this.resolution, MOST_PIXELS) / wide;
    const scales = picture.scalesShown();
    const foot = scales.length ? 58 : 0;
    const canvas = make("canvas", { width: Math.round(wide * scale), height: Math.round((high + foot) * scale) });
    const paint = canvas.getContext("2d");
    paint.fillStyle = PAPER;
    paint.fillRect(0, 0, canvas.width, canvas.height);
    picture.stage.photograph(scale, (scene) => paint.drawImage(scene, 0, 0, canvas.width, Math.round(high * scale)));
    paint.scale(scale, scale);
    for (const pane of picture.visiblePanes()) annotated(paint, pane);
    scales.forEach((one, i) => bar(paint, one, (wide / scales.length) * (i + 0.5), high + 8, Math.min(260, wide / scales.length - 30)));
    const bytes = Uint8Array.from(atob(canvas.toDataURL("image/png").split(",")[1]), (c) => c.charCodeAt(0));
    return withResolution(bytes, (canvas.width / this.width) * 1000);
  }
}

/** Title and length bar of a pane, where they are on the screen. */
function annotated(paint, { element, title, note, length }) {
  const [x, y, width, height] = [element.offsetLeft, element.offsetTop, element.offsetWidth, element.offsetHeight];
  paint.fillStyle = INK;
  paint.textAlign = "left";
  paint.textBaseline = "top";
  paint.font = "600 15px system-ui, sans-serif";
  if (title) paint.fillText(title, x + 14, y + 12, width - 28);
  paint.font = "12px system-ui, sans-serif";
  if (note) paint.fillText(note, x + 14, y + 33, width - 28);
  const long = parseFloat(length.style.width);
  paint.fillRect(x + 14, y + height - 16, long, 2.5);
  paint.textAlign = "center";
  paint.textBaseline = "bottom";
  paint.fillText(length.textContent, x + 14 + long / 2, y + height - 18);
  paint.strokeStyle = "#d7dfe3";
  paint.lineWidth = 1;
  if (x > 0 || y > 0) paint.strokeRect(x, y, width, height);
}

/** A colour bar around x with its title and three numbers. */
function bar(paint, scale, x, y, width) {
  const texels = scale.texture.image.data;
  const ramp = paint.createLinearGradient(x - width / 2, 0, x + width / 2, 0);
  for (let i = 0; i <= 16; i++) {
    const k = 4 * Math.min(16 * i, 255);
    ramp.addColorStop(i / 16, `rgb(${texels.slice(k, k + 3)})`);
  }
  paint.fillStyle = ramp;
  paint.fillRect(x - width / 2, y + 18, width, 10);
  paint.fillStyle = INK;
  paint.textBaseline = "top";
  paint.textAlign = "center";
  paint.font = "12px system-ui, sans-serif";
  paint.fillText(`${scale.title}${scale.unit ? `, ${scale.unit}` : ""}`, x, y);
  [scale.low, (scale.low + scale.high) / 2, scale.high].forEach((value, i) => {
    paint.textAlign = ["left", "center", "right"][i];
    paint.fillText(String(Number(value.toPrecision(3))), x + (i / 2 - 0.5) * width, y + 31);
  });
}

/** A PNG with its pixels per metre, so that it has its size in a document (chunk pHYs after the header). */
export function withResolution(bytes, perMetre) {
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
