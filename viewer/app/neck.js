// The neck: handles on its curve that are pulled along the wall, with the area that it then has.
import { Newest, postBinary } from "./api.js";
import { label, makeHandle } from "./handles.js";

const STEP_PX = 4;

export class Neck {
  constructor(page) {
    this.page = page;
    this.curve = [];
    this.handles = [];
    this.moves = new Newest((answer) => this.take(answer), page.complain);
  }

  /** Begin with a curve of points [[x, y, z], ...] and so many handles. */
  set(curve, count) {
    const given = JSON.stringify([this.page.path, curve]);
    if (this.isPulled || given === this.given) return;
    this.given = given;
    this.curve = curve;
    this.count = count;
    this.handles = curve.length ? Array.from({ length: count }, (_, i) => this.handle(i)) : [];
    // This curve, not `this.curve`: an answer still under way is about to put another one there.
    if (curve.length) this.moves.ask(() => this.ask({ curve_mm: curve }));
  }

  ask(more) {
    return postBinary(`${this.page.path}/neck`, { curve_mm: this.curve, ...more });
  }

  /** Where a handle lies. */
  at(i) {
    return this.curve[Math.round((i * this.curve.length) / this.count)];
  }

  handle(i) {
    const element = makeHandle("small", `Point ${i + 1} of the neck`, {
      pulled: (event) => this.pull(i, this.page.picture.where(event)),
      nudged: ([right, up]) => {
        const [x, y] = this.page.picture.onScreen(this.at(i));
        this.pull(i, [x + STEP_PX * right, y - STEP_PX * up]);
      },
      released: () => this.release(),
    });
    return { element, point: () => this.at(i) };
  }

  /** Bring a handle to where the wall is seen at a pixel, on the side of the vessel that it is on. */
  pull(i, place) {
    const to = this.page.picture.onWall(place, "lumen", this.at(i));
    if (!to) return;
    this.isPulled = true;
    this.moves.ask(() => this.ask({ handle: i, to_mm: to }));
  }

  take({ manifest, buffer }) {
    this.curve = manifest.neck.curve_mm;
    this.page.picture.put({ manifest, buffer });
    this.handles.forEach(({ element }) => label(element, `${manifest.neck.area_mm2.toFixed(1)} mm²`));
    this.page.toldNeck(manifest.neck);
  }

  release() {
    if (!this.isPulled) return;
    const settle = () => {
      if (this.moves.isBusy) return setTimeout(settle, 15);
      this.isPulled = false;
      this.page.choose({ neck_mm: this.curve.map((point) => point.map((x) => Number(x.toFixed(3)))) });
    };
    settle();
  }
}
