// Three orthogonal slices of a scan: window and level, the mask's outline, a click for the seed.
import { make } from "../src/dom.js";
import { numbers } from "../src/decode.js";
import { getBinary, Newest } from "./api.js";

const TITLES = ["Sagittal", "Coronal", "Axial"];

export class Slices {
  constructor(path, seeded, failed) {
    this.path = path;
    this.seeded = seeded;
    this.buffer = document.createElement("canvas");
    this.threshold = null;
    this.window = null;
    this.views = [0, 1, 2].map((axis) => this.view(axis, failed));
    this.elements = this.views.map(({ element }) => element);
  }

  view(axis, failed) {
    const canvas = make("canvas", { className: "slice-canvas" });
    const slider = make("input", { type: "range", min: 0, value: 0, ariaLabel: `${TITLES[axis]} slice` });
    const label = make("span", { className: "slice-label" }, [TITLES[axis]]);
    const element = make("div", { className: "slice" }, [canvas, label, slider]);
    const view = { axis, canvas, slider, label, element, plane: null };
    view.line = new Newest(({ manifest, buffer }) => {
      view.plane = { width: manifest.width, height: manifest.height, values: numbers(buffer, manifest.values) };
      this.paint(view);
    }, failed);
    slider.addEventListener("input", () => this.load(view));
    element.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        slider.value = Number(slider.value) + Math.sign(event.deltaY);
        this.load(view);
      },
      { passive: false },
    );
    this.listen(view);
    return view;
  }

  /** Drag changes window and level; a click sets the seed. */
  listen(view) {
    let last = null;
    let moved = 0;
    view.canvas.addEventListener("pointerdown", (event) => {
      view.canvas.setPointerCapture(event.pointerId);
      last = event;
      moved = 0;
    });
    view.canvas.addEventListener("pointermove", (event) => {
      if (!last || !this.scan) return;
      moved += Math.abs(event.clientX - last.clientX) + Math.abs(event.clientY - last.clientY);
      const step = (this.scan.range[1] - this.scan.range[0]) / 400;
      this.window = {
        width: Math.max(this.window.width + (event.clientX - last.clientX) * step, 4 * step),
        level: this.window.level - (event.clientY - last.clientY) * step,
      };
      last = event;
      this.views.forEach((one) => this.paint(one));
    });
    view.canvas.addEventListener("pointerup", (event) => {
      if (last && moved < 4 && view.plane) this.seeded(this.toMm(view, event), this.valueAt(view, event) >= this.threshold);
      last = null;
    });
  }

  /** Begin with the slices through a point of the world, or the middle ones. */
  show(scan, point) {
    this.scan = scan;
    const middle = point ? indexOf(scan.affine_mm, point) : scan.shape.map((n) => Math.floor(n / 2));
    const [low, high] = scan.range;
    this.window = { width: (high - low) * 0.9, level: low + (high - low) * 0.5 };
    for (const view of this.views) {
      view.slider.max = scan.shape[view.axis] - 1;
      view.slider.value = Math.round(middle[view.axis]);
      this.load(view);
    }
  }

  load(view) {
    const index = Number(view.slider.value);
    view.label.textContent = `${TITLES[view.axis]} ${index + 1} / ${this.scan.shape[view.axis]}`;
    view.line.ask(() => getBinary(`${this.path}/image/slice?axis=${view.axis}&index=${index}`));
  }

  setThreshold(threshold) {
    this.threshold = threshold;
    this.views.forEach((view) => this.paint(view));
  }

  /** Axes of the volume that a slice's columns and rows run along. */
  axes(view) {
    return [0, 1, 2].filter((axis) => axis !== view.axis);
  }

  paint(view) {
    if (!view.plane) return;
    const { width, height, values } = view.plane;
    const image = new ImageData(width, height);
    const low = this.window.level - this.window.width / 2;
    const scale = 255 / this.window.width;
    const wall = this.threshold ?? Infinity;
    for (let i = 0; i < values.length; i++) {
      const value = values[i];
      const x = i % width;
      const isIn = value >= wall;
      const isRim =
        isIn && ((x > 0 && values[i - 1] < wall) || (x < width - 1 && values[i + 1] < wall) || values[i - width] < wall || values[i + width] < wall);
      const grey = (value - low) * scale;
      const colour = isRim ? [240, 160, 40] : [grey, grey, grey];
      image.data.set([...colour, 255], 4 * i);
    }
    // Voxels need not be cubes: the canvas has the shape of what they show.
    const [across, down] = this.axes(view).map((axis) => this.scan.spacing_mm[axis]);
    const unit = Math.min(across, down);
    this.buffer.width = width;
    this.buffer.height = height;
    this.buffer.getContext("2d").putImageData(image, 0, 0);
    view.canvas.width = Math.round((width * across) / unit);
    view.canvas.height = Math.round((height * down) / unit);
    view.canvas.getContext("2d").drawImage(this.buffer, 0, 0, view.canvas.width, view.canvas.height);
    // Feet are at the bottom: the third axis of most scans points to the head.
    view.canvas.style.transform = view.axis < 2 ? "scaleY(-1)" : "";
  }

  /** Column and row under a pointer: the canvas is as large as its box, the picture in it keeps its shape. */
  place(view, event) {
    const box = view.canvas.getBoundingClientRect();
    const { width, height } = view.plane;
    const [across, down] = this.axes(view).map((axis) => this.scan.spacing_mm[axis]);
    const scale = Math.min(box.width / (width * across), box.height / (height * down));
    const [x, y] = [event.clientX - box.left - box.width / 2, event.clientY - box.top - box.height / 2];
    const up = view.axis < 2 ? -1 : 1;
    return [x / (scale * across) + (width - 1) / 2, (up * y) / (scale * down) + (height - 1) / 2];
  }

  valueAt(view, event) {
    const [column, row] = this.place(view, event).map(Math.round);
    return view.plane.values[row * view.plane.width + column] ?? -Infinity;
  }

  toMm(view, event) {
    const place = this.place(view, event);
    const index = [0, 0, 0];
    index[view.axis] = Number(view.slider.value);
    this.axes(view).forEach((axis, i) => (index[axis] = place[i]));
    const a = this.scan.affine_mm;
    return [0, 1, 2].map((row) => a[4 * row] * index[0] + a[4 * row + 1] * index[1] + a[4 * row + 2] * index[2] + a[4 * row + 3]);
  }
}

/** Voxel index of a point: the affine's inverse by Cramer's rule. */
function indexOf(a, point) {
  const [x, y, z] = [point[0] - a[3], point[1] - a[7], point[2] - a[11]];
  const det = (u, v, w) => u[0] * (v[1] * w[2] - v[2] * w[1]) - v[0] * (u[1] * w[2] - u[2] * w[1]) + w[0] * (u[1] * v[2] - u[2] * v[1]);
  const [i, j, k] = [0, 1, 2].map((column) => [a[column], a[4 + column], a[8 + column]]);
  const b = [x, y, z];
  const whole = det(i, j, k);
  return [det(b, j, k) / whole, det(i, b, k) / whole, det(i, j, b) / whole];
}
