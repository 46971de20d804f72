// An implant on its axis: handles at its ends that slide along it, the device that follows, the cursor of the section.
import { make } from "../src/dom.js";
import { Newest, post, postBinary } from "./api.js";
import { Axis } from "./axis.js";
import { label, makeHandle } from "./handles.js";
import { heightWords, reachOf, reachWords } from "./numbers.js";

const STEP_MM = 0.2;
const REST_MS = 400; // the bands are asked for when the device has lain still for so long, so that a drag never waits for them

export class Deploying {
  /** @param page the page; its picture and its charts are built before */
  constructor(page) {
    this.page = page;
    this.name = this.id = null; // of the treatment, and of the implant in it
    this.place = null;
    this.sketches = new Newest((answer) => this.sketched(answer), page.complain);
    this.whole = new Newest((answer) => this.deployed(answer), ({ message }) => page.show({ undeployed: message })); // why no device is seen
    this.bands = new Newest((sheet) => !this.isDragging && page.toldBands(sheet), page.complain);
    this.gaps = new Newest((sheet) => sheet && !this.isDragging && page.toldBands(sheet), page.complain); // the bands with those of gaps
    this.sections = new Newest((answer) => page.section.show(answer), () => {});
    this.cursorMark = { element: make("i", { className: "cursor-mark" }), point: () => this.cursor !== undefined && this.line.at(this.cursor) };
    this.handles = ["proximal", "distal"].map((end, i) => this.handle(end, i));
  }

  /** Take the parent axis. */
  setAxis(axis) {
    this.axis = axis;
    this.cursor = undefined;
  }

  /** The parent axis as it is drawn: moved where the artery yields to the device in view. */
  get line() {
    return (this.isHere && !this.place.axis && this.moved) || this.axis;
  }

  handle(end, i) {
    const element = makeHandle(end, `${end} end`, {
      pulled: (event) => this.slide(end, this.way.under(event, this.place.ends_mm[i])),
      nudged: ([right, up]) => this.isHere && this.slide(end, (this.wanted ?? this.place.ends_mm[i]) + STEP_MM * (right + up)),
      released: () => this.release(),
    });
    return { end, element, point: () => this.isHere && !this.place.is_coils && !(i && this.place.is_basket) && this.way.at(this.place.ends_mm[i]) };
  }

  slide(anchor, mm) {
    this.wanted = mm;
    if (!this.isDragging) this.page.toldBands(null);
    this.atRestAs = null;
    this.isDragging = true;
    const wanted = { ...this.wantedNow(), colour: this.page.colour, anchor, abscissa_mm: mm };
    this.sketches.ask(() => postBinary(`${this.page.path}/sketch`, wanted));
  }

  release() {
    this.wanted = undefined;
    if (!this.isDragging) return;
    this.isDragging = false;
    const [name, id] = [this.name, this.id];
    this.page.choose(this.atRest().then((mm) => this.page.moved(name, id, Number(mm.toFixed(3)))));
  }

  /** The treatment in view as it is chosen, and the implant in it; nothing where it is not chosen any more. */
  wantedNow() {
    const treatment = this.page.view.choices.treatments.find(({ name }) => name === this.name);
    return treatment && { treatment, implant: this.id };
  }

  /** Where the device is let go: the last sketch may still be under way, and its place is the one to keep. */
  async atRest() {
    while (this.sketches.isBusy) await new Promise((resolve) => setTimeout(resolve, 15));
    return this.place.is_basket ? this.place.ends_mm[0] : this.place.center_mm;
  }

  /** Whether the implant in view is the one whose place is known. */
  get isHere() {
    return this.place?.treatment === this.name && this.place.implant === this.id;
  }

  /** Show an implant as it is chosen: its treatment deployed, with its numbers. */
  show(name, id) {
    if (name !== this.name || id !== this.id) this.page.along.set({ device: null });
    [this.name, this.id] = [name, id];
    const wanted = { ...this.wantedNow(), colour: this.page.colour };
    this.page.undeployed = "";
    this.whole.ask(() => postBinary(`${this.page.path}/deployment`, wanted));
  }

  sketched(answer) {
    this.take(answer);
    this.page.toldTreatment(answer.manifest, false);
  }

  deployed(answer) {
    if (this.isDragging) return;
    this.take(answer);
    this.page.toldTreatment(answer.manifest, true);
    const wanted = this.wantedNow();
    clearTimeout(this.rest);
    this.rest = setTimeout(() => {
      if (this.isDragging || !wanted) return;
      this.atRestAs = wanted;
      const gaps = async () => this.atRestAs === wanted && (await post(`${this.page.path}/bands?gaps=true`, wanted).then((sheet) => this.atRestAs === wanted && sheet));
      this.bands.ask(() => post(`${this.page.path}/bands`, wanted).then((sheet) => (this.gaps.ask(gaps), sheet)));
    }, REST_MS);
  }

  take(answer) {
    this.place = answer.manifest;
    const { axis: other = this.axis, moved_axis, treatment } = this.place;
    if (!moved_axis) this.page.picture.dropMoved(treatment);
    this.moved = moved_axis ? new Axis({ points: moved_axis, abscissa: other.abscissa }, this.page.picture) : null;
    this.page.picture.put(answer);
    if (this.place.is_coils) return this.page.along.set({ device: null });
    const { axis, is_basket, profile, ends_mm, ends_band_mm = [], neck = this.page.anatomy.neck } = this.place;
    this.way = axis ? new Axis(axis, this.page.picture) : this.axis;
    if (this.moved && !is_basket) this.way = this.moved;
    this.handles.forEach(({ element }, i) => {
      label(element, is_basket ? heightWords(ends_mm[0]) : reachWords(i, ends_mm[i], neck));
      element.classList.toggle("bad", !is_basket && reachOf(i, ends_mm[i], neck) < 0);
    });
    this.page.along.set({ device: axis ? null : { profile, ends: ends_mm, bands: ends_band_mm } });
    this.page.picture.stage?.redraw();
  }

  /** Put the section at an abscissa. */
  look(mm) {
    if (!Number.isFinite(mm) || !this.axis) return;
    this.cursor = mm;
    this.page.along.set({ cursor: mm });
    this.page.picture.stage?.redraw();
    const wanted = { ...(!this.isDragging && this.wantedNow()), abscissa_mm: Number(mm.toFixed(3)) };
    this.sections.ask(() => post(`${this.page.path}/section`, wanted));
  }
}
