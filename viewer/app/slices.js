// Three orthogonal slices of a scan, laid as a radiologist expects them: the patient's right on the left, the head on top;
// window and level, the mask's outline, a click for the seed.
import { make } from "../src/dom.js";
import { numbers } from "../src/decode.js";
import { getBinary, Newest } from "./api.js";

/** By the axis of the world (to the left, to the back, to the head) that a slice is across. */
const PLANES = [
  { title: "Sagittal", right: [1, 1], down: [2, -1], letters: ["A", "P", "S", "I"] },
  { title: "Coronal", right: [0, 1], down: [2, -1], letters: ["R", "L", "S", "I"] },
  { title: "Axial", right: [0, 1], down: [1, 1], letters: ["R", "L", "A", "P"] },
];
const SIDES = ["left", "right", "top", "bottom"];

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
    const slider = make("input", { type: "range", min: 0, value: 0 });
    const label = make("span", { className: "slice-label" });
    const letters = SIDES.map((side) => make("span", { className: `slice-side at-${side}` }));
    const element = make("div", { className: "slice" }, [canvas, label, ...letters, slider]);
    const view = { axis, canvas, slider, label, letters, element, plane: null };
    view.line = new Newest(({ manifest, buffer }) => {
      view.plane = { width: manifest.width, height: manifest.height, values: numbers(buffer, manifest.values) };
      this.paint(view);
    }, failed);
    slider.addEventListener("input", () => this.turn(view));
    element.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        slider.value = Number(slider.value) + Math.sign(event.deltaY);
        this.turn(view);
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

  /** Begin with a scan: its middle slices. */
  show(scan) {
    this.scan = scan;
    this.isTurned = false;
    const [low, high] = scan.range;
    this.window = { width: (high - low) * 0.9, level: low + (high - low) * 0.5 };
    const across = worldAxes(scan.affine_mm);
    for (const view of this.views) {
      view.laid = laid(across, scan.affine_mm, view.axis);
      const { title, letters } = view.laid;
      view.slider.ariaLabel = `${title} slice`;
      view.letters.forEach((element, i) => (element.textContent = scan.is_oriented ? letters[i] : ""));
      view.slider.max = scan.shape[view.axis] - 1;
      // The canvases stand in the order sagittal, coronal, axial, however the voxels are stored.
      view.element.style.order = across[view.axis] - 3;
    }
    this.go(scan.shape.map((n) => Math.floor(n / 2)));
  }

  /** Show the slices through a point of the world, unless somebody has turned to others. */
  look(point) {
    if (this.scan && !this.isTurned) this.go(indexOf(this.scan.affine_mm, point));
  }

  go(index) {
    for (const view of this.views) {
      view.slider.value = Math.round(index[view.axis]);
      this.load(view);
    }
  }

  turn(view) {
    this.isTurned = true;
    this.load(view);
  }

  load(view) {
    const index = Number(view.slider.value);
    view.label.textContent = `${view.laid.title} ${index + 1} / ${this.scan.shape[view.axis]}`;
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
    this.buffer.width = width;
    this.buffer.height = height;
    this.buffer.getContext("2d").putImageData(image, 0, 0);
    const [w, h] = this.size(view);
    view.canvas.width = w;
    view.canvas.height = h;
    const context = view.canvas.getContext("2d");
    const [a, c, e, b, d, f] = this.onCanvas(view);
    context.setTransform(a, b, c, d, e, f);
    context.drawImage(this.buffer, 0, 0);
  }

  /** Pixels of a canvas: voxels need not be cubes, it has the shape of what they show. */
  size(view) {
    const { right, down } = view.laid;
    const unit = Math.min(this.scan.spacing_mm[right.axis], this.scan.spacing_mm[down.axis]);
    return [right, down].map(({ axis }) => Math.round((this.scan.shape[axis] * this.scan.spacing_mm[axis]) / unit));
  }

  /** Rows [a, c, e], [b, d, f] of the map from column and row of the slice to pixels of its canvas. */
  onCanvas(view) {
    const { right, down } = view.laid;
    const [columns] = this.axes(view);
    return this.size(view).flatMap((pixels, i) => {
      const { axis, sign } = [right, down][i];
      const scale = (sign * pixels) / this.scan.shape[axis];
      const begin = sign < 0 ? pixels : 0;
      return axis === columns ? [scale, 0, begin] : [0, scale, begin];
    });
  }

  /** Column and row under a pointer: the canvas is as large as its box, the picture in it keeps its shape. */
  place(view, event) {
    const box = view.canvas.getBoundingClientRect();
    const [width, height] = this.size(view);
    const scale = Math.min(box.width / width, box.height / height);
    const x = (event.clientX - box.left - box.width / 2) / scale + width / 2;
    const y = (event.clientY - box.top - box.height / 2) / scale + height / 2;
    const [a, c, e, b, d, f] = this.onCanvas(view);
    const whole = a * d - b * c;
    // Voxels have their middles at whole numbers, pixels at halves.
    return [(d * (x - e) - c * (y - f)) / whole - 0.5, (a * (y - f) - b * (x - e)) / whole - 0.5];
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

/** Axis of the world that each axis of the voxels runs along, one each: the best of the six ways. */
function worldAxes(a) {
  const ways = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
  const along = (way) => way.reduce((sum, world, axis) => sum + Math.abs(a[4 * world + axis]) / Math.hypot(a[axis], a[4 + axis], a[8 + axis]), 0);
  return ways.reduce((best, way) => (along(way) > along(best) ? way : best));
}

/** How the slice across an axis of the voxels is laid: its plane, and the axes and directions to the right and down. */
function laid(across, affine, axis) {
  const plane = PLANES[across[axis]];
  const [right, down] = [plane.right, plane.down].map(([world, wanted]) => {
    const voxels = across.indexOf(world);
    return { axis: voxels, sign: wanted * (affine[4 * world + voxels] < 0 ? -1 : 1) };
  });
  return { ...plane, right, down };
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
