// Three linked slices of a scan: one cross-hair, one window, one zoom; tools for window and level, ruler, seed and crop box.
import { make } from "../src/dom.js";
import { integers, numbers } from "../src/decode.js";
import { getBinary, Newest, postBinary } from "./api.js";
import { SliceBar } from "./slicebar.js";
import { pathOf, SliceView } from "./sliceview.js";
import { Handling } from "./slicetools.js";
import { toIndex, toMm } from "./voxels.js";

const KEPT = 90;
const AHEAD = 2;

export class Slices {
  /** @param imaging the step in which they are shown */
  constructor(imaging) {
    this.imaging = imaging;
    this.page = imaging.page;
    this.threshold = null;
    this.on = { threshold: true, lumen: true, parent: false, sac: true, neck: true, wires: true };
    this.tool = "cross";
    this.zoom = 1;
    this.slab = 0;
    this.rulers = [];
    this.seed = null;
    this.crop = null;
    this.cross = [0, 0, 0];
    this.pointer = null;
    this.greys = new Uint32Array(65536);
    this.kept = new Map();
    this.views = [0, 1, 2].map((axis) => new SliceView(axis, this));
    this.lines = this.views.map(() => new Newest((answer) => answer && this.arrived(answer), this.page.complain));
    this.outlineLines = this.views.map(() => new Newest((answer) => answer && this.outlined(answer), this.page.complain));
    this.views.forEach((view) => new Handling(view, this));
    this.bar = new SliceBar(this);
    this.elements = [this.bar.element, ...this.views.map(({ element }) => element)];
  }

  /** Begin with a scan: its middle slices. */
  show(scan) {
    this.file = scan;
    this.isTurned = false;
    this.isUpright = Boolean(scan.upright);
    this.scan = this.isUpright ? { ...scan, ...scan.upright } : scan;
    this.resetWindow();
    for (const view of this.views) view.show(this.scan);
    this.bar.show(this.scan);
    this.put(this.scan.shape.map((n) => Math.floor(n / 2)));
  }

  /** Lay the slices along the axes of the patient, or along those of the file. */
  stand(isUpright) {
    const [point, tool] = [this.crossMm, this.tool];
    this.isUpright = isUpright;
    this.scan = isUpright ? { ...this.file, ...this.file.upright } : this.file;
    this.rulers = [];
    for (const view of this.views) view.show(this.scan);
    this.setSeed(this.seedMm);
    this.put(toIndex(this.scan.affine_mm, point));
    this.setTool(isUpright && tool === "crop" ? "cross" : tool);
  }

  /** Show the slices through a point of the world, unless somebody has turned to others. */
  look(point, isForced = false) {
    if (this.scan && (isForced || !this.isTurned)) this.put(toIndex(this.scan.affine_mm, point));
    if (isForced) this.isTurned = true;
  }

  /** Put the cross-hair at an index of the volume. */
  put(index) {
    this.cross = index.map((place, axis) => Math.min(Math.max(place, 0), this.scan.shape[axis] - 1));
    for (const view of this.views) this.load(view);
    this.bar.say();
    this.imaging.redraw();
  }

  get crossMm() {
    return toMm(this.scan.affine_mm, this.cross);
  }

  /** A slice was chosen. */
  turn(view, index) {
    this.isTurned = true;
    const cross = [...this.cross];
    cross[view.axis] = Math.min(Math.max(index, 0), this.scan.shape[view.axis] - 1);
    this.put(cross);
  }

  colourOf(axis) {
    return this.views[axis].laid.colour;
  }

  /** The slices that are shown: all, or one alone. */
  get visible() {
    const alone = this.views.filter(({ element }) => element.classList.contains("alone"));
    return alone.length ? alone : this.views;
  }

  paint() {
    for (const view of this.views) view.paint();
  }

  // -- what the server sends ------------------------------------------------------------------------------------------

  /** Slices on each side that a slab of mm includes. */
  slabOf(view) {
    return Math.round(this.slab / 2 / this.scan.spacing_mm[view.axis]);
  }

  load(view) {
    const { index } = view;
    view.slider.value = index;
    view.label.textContent = `${view.laid.title} ${index + 1} / ${this.scan.shape[view.axis]}${this.slab ? ` · MIP ${this.slabName}` : ""}`;
    view.label.style.setProperty("--plane", view.laid.colour);
    const key = this.keyOf(view, index);
    const plane = this.kept.get(key);
    if (plane && view.plane !== plane) view.take(plane);
    else view.paint();
    this.lines[view.axis].ask(() => this.fetch(view, index, true));
    this.loadOutlines(view);
  }

  get slabName() {
    return this.slab > 500 ? "of all" : `${this.slab} mm`;
  }

  keyOf(view, index) {
    return `${view.axis} ${index} ${this.slabOf(view)} ${this.isUpright}`;
  }

  /** A slice from memory or from the server; those beside it follow while nothing else is wanted. */
  async fetch(view, index, isFirst) {
    const key = this.keyOf(view, index);
    const { scan } = this;
    let plane = this.kept.get(key);
    if (!plane) {
      const { manifest, buffer } = await getBinary(`${this.page.path}/image/slice?axis=${view.axis}&index=${index}&slab=${this.slabOf(view)}&upright=${this.isUpright}`);
      plane = { width: manifest.width, height: manifest.height, values: integers(buffer, manifest.values) };
      if (scan !== this.scan) return null;
      this.keep(key, plane);
    }
    if (isFirst && !this.slab) this.fetchBeside(view, index);
    return { view, key, plane };
  }

  fetchBeside(view, index) {
    const beside = [];
    for (let step = 1; step <= AHEAD; step++) beside.push(index + step, index - step);
    const next = beside.find((one) => one >= 0 && one < this.scan.shape[view.axis] && !this.kept.has(this.keyOf(view, one)));
    const line = this.lines[view.axis];
    if (next !== undefined && !line.waiting) setTimeout(() => !line.waiting && view.index === index && line.ask(() => this.fetch(view, next, false).then(() => (this.fetchBeside(view, index), null))), 0);
  }

  keep(key, plane) {
    this.kept.set(key, plane);
    for (const old of this.kept.keys()) {
      if (this.kept.size <= KEPT) break;
      this.kept.delete(old);
    }
  }

  arrived({ view, key, plane }) {
    if (key !== this.keyOf(view, view.index) || view.plane === plane) return;
    view.take(plane);
    this.bar.say();
  }

  /** The anatomy that was found, and a treatment in it: their outlines are drawn from here on. */
  setFound(anatomy, treatment) {
    const found = anatomy ? [anatomy, JSON.stringify(treatment)].join(" ") : null;
    if (found === this.found) return;
    this.found = found;
    this.treatment = treatment;
    this.reloadOutlines();
    this.bar.renderChips();
  }

  get outlineKey() {
    return `${this.found} ${this.isUpright}`;
  }

  reloadOutlines() {
    for (const view of this.views) {
      view.outlines = null;
      if (this.scan) this.loadOutlines(view);
    }
  }

  loadOutlines(view) {
    if (!this.found) return;
    const [index, { outlineKey: found, treatment }] = [view.index, this];
    if (view.outlines?.index === index && view.outlines.found === found) return;
    const wanted = { axis: view.axis, index, treatment: this.on.wires ? treatment : null, upright: this.isUpright };
    this.outlineLines[view.axis].ask(async () => {
      if (index !== view.index) return null;
      return { view, index, found, answer: await postBinary(`${this.page.path}/image/outlines`, wanted) };
    });
  }

  outlined({ view, index, found, answer: { manifest, buffer } }) {
    if (found !== this.outlineKey || index !== view.index) return;
    const outlines = { index, found };
    for (const [name, block] of Object.entries(manifest.segments)) outlines[name] = pathOf(numbers(buffer, block));
    if (manifest.wires) outlines.wires = numbers(buffer, manifest.wires);
    view.element.dataset.outlines = Object.entries(manifest.segments).filter(([, { length }]) => length).map(([name]) => name).concat(outlines.wires?.length ? ["wires"] : []).join(" ");
    view.outlines = outlines;
    view.paint();
  }

  // -- grey values ----------------------------------------------------------------------------------------------------

  resetWindow() {
    const [low, high] = this.scan.range;
    this.setWindow({ level: low + (high - low) * 0.5, width: (high - low) * 0.9, isInverted: false });
  }

  /** Window and level: the grey of every stored integer, once for all slices. */
  setWindow(changes) {
    this.window = { ...this.window, ...changes };
    const { level, isInverted } = this.window;
    const { ends, step } = this.scan;
    const width = (this.window.width = Math.max(this.window.width, step));
    const count = Math.round((ends[1] - ends[0]) / step) + 1;
    for (let i = 0; i < count; i++) {
      const share = Math.min(Math.max((ends[0] + step * i - level) / width + 0.5, 0), 1);
      const grey = Math.round(255 * (isInverted ? 1 - share : share));
      this.greys[i] = 0xff000000 | (grey << 16) | (grey << 8) | grey;
    }
    for (const view of this.views) view.grey();
    this.bar?.sayWindow();
  }

  setThreshold(threshold) {
    this.threshold = threshold;
    this.paint();
    this.bar.renderChips();
  }

  setSlab(mm) {
    this.slab = mm;
    for (const view of this.views) this.load(view);
  }

  setTool(tool) {
    this.tool = tool;
    for (const view of this.views) view.area.dataset.tool = tool;
    this.bar.renderTools();
    this.paint();
    this.imaging.redraw();
  }

  toggle(name) {
    this.on[name] = !this.on[name];
    this.bar.renderChips();
    if (name === "wires" && this.on.wires) this.reloadOutlines();
    this.paint();
  }

  // -- seed, ruler, crop box ------------------------------------------------------------------------------------------

  /** The seed that is chosen, in LPS mm, or null. */
  setSeed(point) {
    this.seedMm = point;
    this.seed = point && this.scan ? toIndex(this.scan.affine_mm, point) : null;
    this.paint();
  }

  /** Choose a seed: an index of the volume. */
  plant(view, index) {
    const isLumen = this.threshold === null || (view.valueAt(index) ?? -Infinity) >= this.threshold;
    if (isLumen) this.page.setSeed(toMm(this.scan.affine_mm, index));
    else this.page.tell("There is no lumen at that point: click a bright one.");
  }

  measure(view, ends, isNew) {
    const between = ends.map((end) => toMm(this.scan.affine_mm, end));
    const mm = Math.hypot(...[0, 1, 2].map((i) => between[1][i] - between[0][i]));
    if (isNew) this.rulers.push({});
    Object.assign(this.rulers.at(-1), { axis: view.axis, index: view.index, ends, mm });
    this.paint();
  }

  clearRulers(count = this.rulers.length) {
    this.rulers.splice(this.rulers.length - count, count);
    this.paint();
    this.bar.renderTools();
  }

  /** First and last voxel of the crop box. */
  get cropBox() {
    return this.crop ?? [[0, 0, 0], this.file.shape.map((n) => n - 1)];
  }

  get isCropped() {
    return this.crop !== null && this.crop.some((corner, end) => corner.some((place, axis) => place !== (end ? this.file.shape[axis] - 1 : 0)));
  }

  /** The box that is chosen, as opposite corners in LPS mm, or null. */
  setCrop(corners) {
    if (!this.scan || this.isPulled) return;
    const found = corners?.map((corner) => toIndex(this.file.affine_mm, corner).map(Math.round));
    this.crop = found ? [0, 1].map((end) => found[0].map((_, axis) => Math[end ? "max" : "min"](found[0][axis], found[1][axis]))) : null;
    this.bar.renderTools();
    this.paint();
    this.imaging.redraw();
  }

  /** Move one edge of the crop box. */
  pullCrop(axis, end, place) {
    const box = this.cropBox.map((corner) => [...corner]);
    const [least, most] = end ? [box[0][axis] + 7, this.scan.shape[axis] - 1] : [0, box[1][axis] - 7];
    box[end][axis] = Math.min(Math.max(Math.round(place), least), most);
    [this.crop, this.isPulled] = [box, true];
    this.paint();
    this.imaging.redraw();
  }

  letCropGo() {
    this.isPulled = false;
    this.bar.renderTools();
    const rounded = (corner) => toMm(this.file.affine_mm, corner).map((x) => Number(x.toFixed(3)));
    this.page.choose({ crop_mm: this.isCropped ? this.crop.map(rounded) : null });
  }

  // -- the views together ---------------------------------------------------------------------------------------------

  zoomBy(factor, view, place) {
    const was = this.views.map(({ scale }) => scale);
    this.zoom = Math.min(Math.max(this.zoom * factor, 0.5), 40);
    this.views.forEach((one, i) => one.keep(one === view && place ? place : one.onPageAt(this.cross, was[i]), was[i]));
    this.paint();
  }

  resetView() {
    this.zoom = 1;
    for (const view of this.views) view.fit();
    this.paint();
  }

  maximise(view) {
    const isAlone = view.element.classList.toggle("alone");
    for (const one of this.views) if (one !== view) one.element.classList.remove("alone");
    this.page.frame.classList.toggle("one-slice", isAlone);
  }

  /** Index in the file of an index of the slices. */
  voxelAt(index) {
    return this.isUpright ? toIndex(this.file.affine_mm, toMm(this.scan.affine_mm, index)) : index;
  }

  /** What is under the pointer, or at the cross-hair. */
  point(view, index) {
    this.pointer = view && view.isInside(index) ? { view, index } : null;
    this.bar.say();
  }

  /** Index, value and positions to read out. */
  get reading() {
    const view = this.pointer?.view ?? this.views.find(({ plane }) => plane) ?? this.views[0];
    const index = this.pointer?.index ?? this.cross;
    const mm = toMm(this.scan.affine_mm, index);
    return { index: this.voxelAt(index).map(Math.round), mm, value: view.valueAt(index), isPointer: Boolean(this.pointer) };
  }
}
