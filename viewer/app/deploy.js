// A device on the parent axis: handles at both ends that slide along it, the stent that follows, the cursor of the section.
import { make } from "../src/dom.js";
import { get, Newest, postBinary } from "./api.js";

const REACH_MM = 9;

export class Deploying {
  /** @param host {path, picture, along, section, colour(), choice(name), chosen(name, centerMm), told(name, manifest), failed} */
  constructor(host) {
    this.host = host;
    this.name = null;
    this.place = null;
    this.sketches = new Newest((answer) => this.sketched(answer), host.failed);
    this.whole = new Newest((answer) => this.deployed(answer), host.failed);
    this.sections = new Newest((answer) => host.section.show(answer), () => {});
    this.cursorMark = { element: make("i", { className: "cursor-mark" }), point: () => this.cursor !== undefined && this.at(this.cursor) };
    this.handles = ["proximal", "distal"].map((end, i) => this.handle(end, i));
  }

  /** Take the parent axis: {points, abscissa, diameter}. */
  setAxis(axis) {
    this.axis = axis;
    this.cursor = undefined;
  }

  at(mm) {
    const { abscissa, points } = this.axis;
    let i = abscissa.findIndex((s) => s >= mm);
    if (i < 0) i = abscissa.length - 1;
    return points.slice(3 * i, 3 * i + 3);
  }

  handle(end, i) {
    const element = make("button", { type: "button", className: `handle ${end}`, ariaLabel: `${end} end: drag, or arrow keys` }, [
      make("span", { className: "knob" }),
      make("span", { className: "handle-word" }),
    ]);
    let grabbed = false;
    element.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      element.setPointerCapture(event.pointerId);
      grabbed = true;
      element.classList.add("grabbed");
    });
    element.addEventListener("pointermove", (event) => {
      if (!grabbed) return;
      event.stopPropagation();
      this.slide(end, this.under(event, this.place.ends_mm[i]));
    });
    // However it ends: let go, cancelled by the system, or taken away.
    element.addEventListener("lostpointercapture", () => {
      grabbed = false;
      element.classList.remove("grabbed");
      this.release();
    });
    element.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -0.2, ArrowDown: -0.2, ArrowRight: 0.2, ArrowUp: 0.2, PageUp: 2, PageDown: -2 }[event.key];
      if (!step || !this.isHere) return;
      event.preventDefault();
      event.stopPropagation();
      this.slide(end, (this.wanted ?? this.place.ends_mm[i]) + step);
      clearTimeout(this.timer);
      this.timer = setTimeout(() => this.release(), 350);
    });
    return { end, element, point: () => this.isHere && this.at(this.place.ends_mm[i]) };
  }

  /** Abscissa whose picture is nearest to a pointer; nothing far along the artery, which may lie behind. */
  under(event, near) {
    const [x, y] = this.host.picture.where(event);
    const { abscissa, points } = this.axis;
    let [best, least] = [near, Infinity];
    for (let i = 0; i < abscissa.length; i++) {
      if (near !== null && Math.abs(abscissa[i] - near) > REACH_MM) continue;
      const [u, v] = this.host.picture.onScreen(points.slice(3 * i, 3 * i + 3));
      const distance = Math.hypot(u - x, v - y);
      if (distance < least) [best, least] = [abscissa[i], distance];
    }
    return near === null && least > 60 ? null : best;
  }

  slide(anchor, mm) {
    this.wanted = mm;
    this.isDragging = true;
    const [device, colour] = [this.host.choice(this.name), this.host.colour()];
    this.sketches.ask(() =>
      postBinary(`${this.host.path()}/sketch`, { device, anchor, abscissa_mm: mm, colour }),
    );
  }

  release() {
    this.wanted = undefined;
    if (!this.isDragging) return;
    this.isDragging = false;
    // The last sketch may still be under way: its place is the one to keep.
    const settle = () => (this.sketches.isBusy ? setTimeout(settle, 15) : this.host.chosen(this.name, this.place.center_mm));
    settle();
  }

  /** Whether the device in view is the one whose place is known. */
  get isHere() {
    return this.place?.device === this.name;
  }

  /** Show a device as it is chosen: deployed, with its numbers. */
  show(name) {
    if (name !== this.name) this.host.along.set({ device: null });
    this.name = name;
    const [device, colour] = [this.host.choice(name), this.host.colour()];
    if (!device) return;
    this.whole.ask(() => postBinary(`${this.host.path()}/deployment`, { device, colour }));
  }

  sketched(answer) {
    this.take(answer);
    this.host.told(this.name, answer.manifest, false);
  }

  deployed(answer) {
    if (this.isDragging) return;
    this.take(answer);
    this.host.told(this.name, answer.manifest, true);
  }

  take(answer) {
    this.place = answer.manifest;
    this.host.picture.put(answer);
    this.handles.forEach(({ element }, i) => {
      element.querySelector(".handle-word").textContent = `${this.place.ends_mm[i].toFixed(1)} mm`;
    });
    const { profile, ends_mm, ends_band_mm } = this.place;
    this.host.along.set({ device: { profile, ends: ends_mm, bands: ends_band_mm } });
    this.host.picture.stage?.redraw();
  }

  /** Put the section at an abscissa. */
  look(mm) {
    if (mm === null || !this.axis) return;
    this.cursor = mm;
    this.host.along.set({ cursor: mm });
    this.host.picture.stage?.redraw();
    const device = this.name && !this.isDragging ? `&device=${encodeURIComponent(this.name)}` : "";
    this.sections.ask(() => get(`${this.host.path()}/section?abscissa_mm=${mm.toFixed(3)}${device}`));
  }
}
