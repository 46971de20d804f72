// One slice on a canvas: the grey values with everything that lies on them, turned as a radiologist expects it.
import { make, svg } from "../src/dom.js";
import { isoline, joined, laid } from "./voxels.js";

const SIDES = ["left", "right", "top", "bottom"];
const NEAR_PX = 9;
const SHEER_MM = 4;
export const SEED = "#ffe14d";
/** What is drawn of the surfaces: colour and dashes, so that none is known by its colour alone. */
export const LINES = {
  threshold: { title: "Threshold", colour: "#f0a028", dash: [1.5, 2.5], width: 1.4 },
  lumen: { title: "Lumen", colour: "#4cc9f0", dash: [], width: 1.5 },
  parent: { title: "Parent artery", colour: "#e9d8a6", dash: [7, 3], width: 1.6 },
  sac: { title: "Sac", colour: "#ff6b6b", dash: [], width: 2.4 },
  neck: { title: "Neck", colour: "#f15bb5", dash: [3, 2], width: 2.6 },
  wires: { title: "Device", colour: "#ffffff", dash: [], width: 1 },
};

export class SliceView {
  /** @param axis of the voxels that the slice is across @param host the slices together: what is shown of what, and the tools */
  constructor(axis, host) {
    this.axis = axis;
    this.host = host;
    this.buffer = document.createElement("canvas");
    this.canvas = make("canvas", { className: "slice-canvas" });
    this.slider = make("input", { type: "range", min: 0, value: 0, onInput: () => host.turn(this, Number(this.slider.value)) });
    this.label = make("span", { className: "slice-label" });
    this.letters = SIDES.map((side) => make("span", { className: `slice-side at-${side}` }));
    this.grow = make("button", { type: "button", className: "slice-grow", onClick: () => host.maximise(this) }, [
      svg("svg", { width: 14, height: 14, viewBox: "0 0 14 14", "aria-hidden": "true" }, [svg("path", { d: "M1 5V1h4M9 1h4v4M13 9v4H9M5 13H1V9", fill: "none", stroke: "currentColor", "stroke-width": 1.7 })]),
    ]);
    this.length = make("span", { className: "slice-length" });
    this.area = make("div", { className: "slice-area", tabIndex: 0, role: "group" }, [this.canvas, ...this.letters, this.length]);
    this.element = make("div", { className: "slice" }, [this.area, this.label, this.grow, this.slider]);
    this.plane = null;
    this.outlines = null;
    new ResizeObserver(() => this.paint()).observe(this.area);
  }

  /** Begin with a scan. */
  show(scan) {
    this.scan = scan;
    this.laid = laid(scan, this.axis);
    const { title, letters } = this.laid;
    this.slider.ariaLabel = `${title} slice`;
    this.grow.title = `${title} slice alone`;
    this.grow.ariaLabel = `${title} slice alone`;
    this.area.ariaLabel = `${title}: arrow keys move the cross-hair, Page Up and Page Down change the slice, plus and minus zoom, Enter sets the seed`;
    this.letters.forEach((element, i) => (element.textContent = letters[i]));
    this.slider.max = scan.shape[this.axis] - 1;
    // The canvases stand in the order sagittal, coronal, axial, however the voxels are stored.
    this.element.style.order = this.laid.world - 3;
    this.plane = this.outlines = null;
    this.fit();
  }

  /** Axes of the volume that a slice's columns and rows run along. */
  get axes() {
    return [0, 1, 2].filter((axis) => axis !== this.axis);
  }

  get index() {
    return Math.round(this.host.cross[this.axis]);
  }

  // -- from voxels to pixels ----------------------------------------------------------------------------------------

  /** Width and height in mm. */
  get size() {
    return [this.laid.right, this.laid.down].map(({ axis }) => this.scan.shape[axis] * this.scan.spacing_mm[axis]);
  }

  /** The whole slice in the middle of its box. */
  fit() {
    this.middle = this.size.map((mm) => mm / 2);
  }

  get box() {
    return [Math.max(this.area.clientWidth, 1), Math.max(this.area.clientHeight, 1)];
  }

  /** Pixels of the page for a mm with which the whole slice fits in its box. */
  get fitting() {
    const [width, height] = this.box;
    const [w, h] = this.size;
    return Math.min(width / w, height / h);
  }

  /** Pixels of the page for a mm: the same for all slices. */
  get scale() {
    return this.host.zoom * Math.min(...this.host.visible.map(({ fitting }) => fitting));
  }

  /** Position in mm, to the right and down, of an index of the volume, and back. */
  inPlane(index) {
    return [this.laid.right, this.laid.down].map(({ axis, sign }) => {
      const [n, h] = [this.scan.shape[axis], this.scan.spacing_mm[axis]];
      return h * (sign > 0 ? index[axis] + 0.5 : n - 0.5 - index[axis]);
    });
  }

  /** Pixel of an index of the volume. */
  onPage(index) {
    return this.onPageAt(index, this.scale);
  }

  /** Pixel of an index of the volume with another number of pixels for a mm. */
  onPageAt(index, scale) {
    return this.inPlane(index).map((mm, i) => this.box[i] / 2 + (mm - this.middle[i]) * scale);
  }

  /** Index of the volume at a pixel, in the plane of the slice. */
  indexAt([x, y]) {
    const index = [...this.host.cross];
    index[this.axis] = this.index;
    [this.laid.right, this.laid.down].forEach(({ axis, sign }, i) => {
      const mm = this.middle[i] + ([x, y][i] - this.box[i] / 2) / this.scale;
      const place = mm / this.scan.spacing_mm[axis] - 0.5;
      index[axis] = sign > 0 ? place : this.scan.shape[axis] - 1 - place;
    });
    return index;
  }

  where(event) {
    const box = this.area.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  isInside(index) {
    return index.every((place, axis) => place >= -0.5 && place <= this.scan.shape[axis] - 0.5);
  }

  /** Intensity at an index, as the file states it; undefined outside and before the slice has come. */
  valueAt(index) {
    if (!this.plane || !this.isInside(index)) return undefined;
    if (!this.host.voxelAt(index).every((place, axis) => place > -0.5 && place < this.host.file.shape[axis] - 0.5)) return undefined;
    const [column, row] = this.axes.map((axis) => Math.min(Math.max(Math.round(index[axis]), 0), this.scan.shape[axis] - 1));
    return this.scan.ends[0] + this.scan.step * this.plane.values[row * this.plane.width + column];
  }

  // -- moving the picture ---------------------------------------------------------------------------------------------

  pan(right, down) {
    this.middle = [this.middle[0] - right / this.scale, this.middle[1] - down / this.scale];
    this.paint();
  }

  /** Zoom so that a pixel keeps its place. */
  keep(place, was) {
    this.middle = this.middle.map((mm, i) => mm + (place[i] - this.box[i] / 2) * (1 / was - 1 / this.scale));
  }

  /** The edge of the crop box, as [axis, end], under a pixel. */
  cropEdge(place) {
    const [low, high] = this.host.cropBox.map((corner) => this.onPage(corner));
    const found = [this.laid.right, this.laid.down].flatMap(({ axis }, i) => {
      const [a, b] = [low[i], high[i]];
      const [c, d] = [Math.min(low[1 - i], high[1 - i]), Math.max(low[1 - i], high[1 - i])];
      const isBeside = place[1 - i] > c - NEAR_PX && place[1 - i] < d + NEAR_PX;
      return [[a, 0], [b, 1]].map(([at, end]) => ({ axis, end, away: isBeside ? Math.abs(place[i] - at) : Infinity, isAcross: i === 0 }));
    });
    return found.filter(({ away }) => away < NEAR_PX).sort((a, b) => a.away - b.away).filter(({ axis }, i, all) => i === 0 || axis !== all[0].axis).slice(0, 2);
  }

  // -- painting -------------------------------------------------------------------------------------------------------

  take(plane) {
    this.plane = plane;
    this.lines = null;
    const { width, height, values } = plane;
    this.image = new ImageData(width, height);
    this.pixels = new Uint32Array(this.image.data.buffer);
    this.values = values;
    this.buffer.width = width;
    this.buffer.height = height;
    this.grey();
  }

  /** Grey values through the window. */
  grey() {
    if (!this.plane) return;
    const { greys } = this.host;
    const { pixels, values } = this;
    for (let i = 0; i < values.length; i++) pixels[i] = greys[values[i]];
    this.buffer.getContext("2d").putImageData(this.image, 0, 0);
    this.paint();
  }

  /** Paint with so many pixels of the canvas for one of the page. */
  paint(ratio = Math.min(devicePixelRatio, 2)) {
    if (!this.plane || !this.scan) return;
    const [width, height] = this.box;
    // The size is set only where it changes: setting it clears the canvas and is slow.
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
    }
    const context = this.canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = "#10171b";
    context.fillRect(0, 0, width, height);
    const matrix = this.matrix();
    context.save();
    context.transform(matrix.a, matrix.b, matrix.c, matrix.d, matrix.e, matrix.f);
    context.imageSmoothingEnabled = this.scale * Math.min(...this.scan.spacing_mm) < 8;
    context.drawImage(this.buffer, 0, 0);
    context.restore();
    this.paintCrop(context);
    this.paintLines(context, matrix);
    this.paintCross(context);
    this.paintSeed(context);
    this.paintRulers(context);
    this.sayLength();
  }

  /** From column and row, counted at the corners of the voxels, to pixels of the page. */
  matrix() {
    const first = [0, 0, 0].map(() => -0.5);
    const [x, y] = this.onPage(first);
    const step = (axis) => {
      const next = [...first];
      next[axis] += 1;
      const [u, v] = this.onPage(next);
      return [u - x, v - y];
    };
    const [[a, b], [c, d]] = this.axes.map(step);
    return new DOMMatrix([a, b, c, d, x, y]);
  }

  paintLines(context, matrix) {
    const { on, threshold, slab } = this.host;
    if (on.threshold && threshold !== null && !slab) {
      this.lines ??= {};
      if (this.lines.level !== threshold) {
        const level = (threshold - this.scan.ends[0]) / this.scan.step;
        this.lines = { level: threshold, path: pathOf(isoline(this.plane, level)) };
      }
      this.stroke(context, this.lines.path, matrix, LINES.threshold);
    }
    if (slab || this.outlines?.index !== this.index) return; // outlines are of one plane
    for (const name of ["lumen", "parent", "sac", "neck"]) if (on[name] && this.outlines[name]) this.stroke(context, this.outlines[name], matrix, LINES[name]);
    if (on.wires && this.outlines.wires) this.paintWires(context, matrix);
  }

  stroke(context, path, matrix, { colour, dash, width }) {
    const placed = new Path2D();
    placed.addPath(path, matrix);
    context.lineCap = "round";
    context.setLineDash([]);
    context.strokeStyle = "rgb(0 0 0 / 45%)";
    context.lineWidth = width + 1.6;
    context.stroke(placed);
    context.setLineDash(dash);
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.stroke(placed);
    context.setLineDash([]);
  }

  /** Wires as discs of their true diameter, and never less than can be seen. */
  paintWires(context, matrix) {
    const { wires } = this.outlines;
    for (let i = 0; i < wires.length; i += 3) {
      const { x, y } = matrix.transformPoint({ x: wires[i] + 0.5, y: wires[i + 1] + 0.5 });
      context.beginPath();
      context.arc(x, y, Math.max(0.5 * wires[i + 2] * this.scale, 1.7), 0, 2 * Math.PI);
      context.fillStyle = "#ffffff";
      context.strokeStyle = "#12303a";
      context.lineWidth = 1;
      context.fill();
      context.stroke();
    }
  }

  /** The other two planes, with a gap where they meet. */
  paintCross(context) {
    const [x, y] = this.onPage(this.host.cross);
    const [width, height] = this.box;
    const gap = 9;
    context.lineWidth = 1;
    const line = (axis, ...points) => {
      context.strokeStyle = this.host.colourOf(axis);
      context.globalAlpha = 0.8;
      context.beginPath();
      for (const [a, b, c, d] of points) (context.moveTo(a, b), context.lineTo(c, d));
      context.stroke();
    };
    line(this.laid.right.axis, [x, 0, x, y - gap], [x, y + gap, x, height]);
    line(this.laid.down.axis, [0, y, x - gap, y], [x + gap, y, width, y]);
    context.globalAlpha = 1;
  }

  /** The seed, pale where it lies in front of the slice or behind it. */
  paintSeed(context) {
    const { seed } = this.host;
    if (!seed) return;
    const away = Math.abs(seed[this.axis] - this.index) * this.scan.spacing_mm[this.axis];
    const isIn = Math.abs(seed[this.axis] - this.index) <= 0.75;
    if (!isIn && away > SHEER_MM) return;
    const [x, y] = this.onPage(seed);
    context.globalAlpha = isIn ? 1 : 0.5;
    context.setLineDash(isIn ? [] : [2, 2]);
    for (const [colour, width] of [["rgb(0 0 0 / 70%)", 4], [SEED, 2]]) {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.beginPath();
      context.arc(x, y, 7, 0, 2 * Math.PI);
      context.moveTo(x - 2, y);
      context.lineTo(x + 2, y);
      context.moveTo(x, y - 2);
      context.lineTo(x, y + 2);
      context.stroke();
    }
    context.setLineDash([]);
    context.globalAlpha = 1;
    word(context, isIn ? "Seed" : `Seed ${away.toFixed(1)} mm from this slice`, x + 11, y - 9, SEED);
  }

  paintRulers(context) {
    for (const { axis, index, ends, mm } of this.host.rulers) {
      if (axis !== this.axis || index !== this.index) continue;
      const [[x, y], [u, v]] = ends.map((end) => this.onPage(end));
      const length = Math.max(Math.hypot(u - x, v - y), 1e-6);
      const [dx, dy] = [(-(v - y) / length) * 5, ((u - x) / length) * 5];
      for (const [colour, width] of [["rgb(0 0 0 / 70%)", 4], ["#9bf0c0", 1.8]]) {
        context.strokeStyle = colour;
        context.lineWidth = width;
        context.beginPath();
        context.moveTo(x, y);
        context.lineTo(u, v);
        for (const [a, b] of [[x, y], [u, v]]) (context.moveTo(a - dx, b - dy), context.lineTo(a + dx, b + dy));
        context.stroke();
      }
      word(context, `${mm.toFixed(1)} mm`, Math.max(x, u) + 8, x > u ? y : v, "#9bf0c0");
    }
  }

  paintCrop(context) {
    // The box lies along the axes of the file.
    if (this.host.isUpright || (!this.host.isCropped && this.host.tool !== "crop")) return;
    const half = this.host.cropBox.map((corner, end) => corner.map((place) => place + (end ? 0.5 : -0.5)));
    const [[a, b], [c, d]] = half.map((corner) => this.onPage(corner));
    const [left, top, right, bottom] = [Math.min(a, c), Math.min(b, d), Math.max(a, c), Math.max(b, d)];
    const [width, height] = this.box;
    const isIn = this.index >= half[0][this.axis] && this.index <= half[1][this.axis];
    context.fillStyle = "rgb(16 23 27 / 62%)";
    context.beginPath();
    context.rect(0, 0, width, height);
    if (isIn) context.rect(left, top, right - left, bottom - top);
    context.fill("evenodd");
    context.strokeStyle = "#ffffff";
    context.setLineDash(isIn ? [] : [3, 4]);
    context.lineWidth = 1.3;
    context.strokeRect(left, top, right - left, bottom - top);
    context.setLineDash([]);
    if (this.host.tool !== "crop") return;
    context.fillStyle = "#ffffff";
    for (const [x, y] of [[left, (top + bottom) / 2], [right, (top + bottom) / 2], [(left + right) / 2, top], [(left + right) / 2, bottom]]) context.fillRect(x - 4, y - 4, 8, 8);
  }

  /** A bar of a round length. */
  sayLength() {
    const { scale } = this;
    const mm = [100, 50, 20, 10, 5, 2, 1, 0.5].find((length) => length * scale < 110) || 0.5;
    this.element.dataset.bar = `${mm} mm ${(mm * scale).toFixed(1)} px`;
    this.length.style.width = `${mm * scale}px`;
    this.length.textContent = `${mm} mm`;
  }
}

/** A path of segments x1, y1, x2, y2 between the middles of voxels. */
export function pathOf(segments) {
  const path = new Path2D();
  for (const line of joined(segments)) line.forEach(([x, y], i) => (i ? path.lineTo(x + 0.5, y + 0.5) : path.moveTo(x + 0.5, y + 0.5)));
  return path;
}

function word(context, text, x, y, colour) {
  context.font = "12px Inter, 'Segoe UI', system-ui, Arial, sans-serif";
  context.lineWidth = 3;
  context.strokeStyle = "rgb(0 0 0 / 75%)";
  context.lineJoin = "round";
  context.strokeText(text, x, y);
  context.fillStyle = colour;
  context.fillText(text, x, y);
}
