// Trimming: how much of the artery is kept before the sac and beyond it, by handles on the parent axis.
import { label, makeHandle } from "./handles.js";

const STEP_MM = 0.5;
const LEAST_MM = 1;
/** Way along the artery from the sac to a cut. */
const WAY = { upstream_mm: -1, downstream_mm: 1 };

export class Trimming {
  constructor(page) {
    this.page = page;
    this.handles = [this.handle("upstream_mm", "proximal", "before"), this.handle("downstream_mm", "distal", "beyond")];
  }

  /** Take the parent axis and the span of the neck on it. */
  set(axis, neck) {
    this.axis = axis;
    this.middle = neck.length ? (neck[0] + neck[1]) / 2 : undefined;
  }

  /** Lie where it was chosen, or at the ends of the artery. */
  show(chosen) {
    if (this.middle === undefined || this.isPulled) return;
    this.kept = {};
    for (const { which, say } of this.handles) {
      this.kept[which] = Math.min(chosen[which] ?? Infinity, this.most(which));
      say();
    }
  }

  most(which) {
    return WAY[which] < 0 ? this.middle : this.axis.length - this.middle;
  }

  handle(which, kind, word) {
    const element = makeHandle(`${kind} cut`, `Cut ${word} the sac`, {
      pulled: (event) => this.keep(which, WAY[which] * (this.axis.under(event, this.place(which)) - this.middle)),
      nudged: ([right, up]) => this.keep(which, this.kept[which] + WAY[which] * STEP_MM * (right + up)),
      released: () => this.release(which),
    });
    const say = () => label(element, `${this.kept[which].toFixed(1)} mm ${word} the sac`);
    return { element, say, which, point: () => this.middle !== undefined && this.axis.at(this.place(which)) };
  }

  /** Abscissa of a cut. */
  place(which) {
    return this.middle + WAY[which] * this.kept[which];
  }

  keep(which, mm) {
    this.kept[which] = Math.min(Math.max(mm, LEAST_MM), this.most(which));
    this.isPulled = true;
    this.handles.forEach((handle) => handle.which === which && handle.say());
    this.page.picture.stage?.redraw();
  }

  release(which) {
    if (!this.isPulled) return;
    this.isPulled = false;
    this.page.choose({ [which]: Number(this.kept[which].toFixed(2)) });
  }
}
