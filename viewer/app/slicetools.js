// What pointer, wheel and keys do on a slice.

const STEP = 1.25;
const WINDOW_PX = 400;
const KEYS = { c: "cross", w: "window", m: "ruler", s: "seed", b: "crop" };

export class Handling {
  constructor(view, slices) {
    this.view = view;
    this.slices = slices;
    this.hand = null;
    this.rolled = 0;
    const { area } = view;
    area.addEventListener("pointerdown", (event) => this.take(event));
    area.addEventListener("pointermove", (event) => this.move(event));
    area.addEventListener("pointerup", (event) => this.leave(event));
    area.addEventListener("pointercancel", () => (this.hand = null, slices.isPulled = false));
    area.addEventListener("pointerleave", () => slices.scan && slices.point(null));
    area.addEventListener("contextmenu", (event) => event.preventDefault());
    area.addEventListener("dblclick", () => slices.tool === "cross" && slices.maximise(view));
    area.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    area.addEventListener("keydown", (event) => this.key(event));
  }

  /** What a press begins: the tool; the right button always the window, the middle one and Shift move the picture. */
  kind(event) {
    if (event.button === 2) return "window";
    if (event.button === 1 || event.shiftKey) return "pan";
    return this.slices.tool;
  }

  take(event) {
    if (!this.slices.scan) return;
    const place = this.view.where(event);
    this.view.area.setPointerCapture(event.pointerId);
    if (event.button === 1) event.preventDefault();
    this.hand = { kind: this.kind(event), place, begin: place, from: this.view.indexAt(place), edges: [] };
    if (this.hand.kind === "cross") this.cross(place);
    else if (this.hand.kind === "crop") this.hand.edges = this.view.cropEdge(place);
  }

  move(event) {
    if (!this.slices.scan) return;
    const place = this.view.where(event);
    this.slices.point(this.view, this.view.indexAt(place));
    if (!this.hand) return this.hover(place);
    const [dx, dy] = [place[0] - this.hand.place[0], place[1] - this.hand.place[1]];
    this.hand.place = place;
    this[this.hand.kind]?.(place, dx, dy);
  }

  leave() {
    const { hand } = this;
    this.hand = null;
    if (!hand) return;
    const isClick = Math.hypot(hand.place[0] - hand.begin[0], hand.place[1] - hand.begin[1]) < 4;
    if (hand.kind === "seed" && isClick) this.slices.plant(this.view, this.view.indexAt(hand.place));
    // The bar grows by the ruler's length: during the drag it would move the slices under the pointer.
    if (hand.kind === "ruler" && hand.isBegun) this.slices.bar.renderTools();
    if (hand.kind === "crop" && hand.edges.length) this.slices.letCropGo();
  }

  hover(place) {
    const edges = this.slices.tool === "crop" ? this.view.cropEdge(place) : [];
    this.view.area.style.cursor = edges.length === 2 ? "move" : edges.length ? (edges[0].isAcross ? "ew-resize" : "ns-resize") : "";
  }

  cross(place) {
    this.slices.isTurned = true;
    this.slices.put(this.view.indexAt(place));
  }

  window(_, dx, dy) {
    const { scan, window } = this.slices;
    const step = (scan.range[1] - scan.range[0]) / WINDOW_PX;
    this.slices.setWindow({ width: Math.max(window.width + dx * step, 4 * step), level: window.level - dy * step });
  }

  pan(_, dx, dy) {
    this.view.pan(dx, dy);
  }

  ruler(place) {
    const { begin, from, isBegun } = this.hand;
    if (!isBegun && Math.hypot(place[0] - begin[0], place[1] - begin[1]) < 3) return;
    this.hand.isBegun = true;
    this.slices.measure(this.view, [from, this.view.indexAt(place)], !isBegun);
  }

  crop(place) {
    const index = this.view.indexAt(place);
    for (const { axis, end } of this.hand.edges) this.slices.pullCrop(axis, end, index[axis]);
  }

  wheel(event) {
    event.preventDefault();
    if (!this.slices.scan) return;
    if (event.ctrlKey || event.metaKey) return this.slices.zoomBy(Math.exp(-event.deltaY * 0.0015), this.view, this.view.where(event));
    // A touchpad sends many small steps, a wheel few large ones.
    this.rolled += event.deltaMode ? Math.sign(event.deltaY) : event.deltaY / 60;
    const steps = Math.trunc(this.rolled);
    if (!steps) return;
    this.rolled = 0;
    this.slices.turn(this.view, this.view.index + Math.max(-8, Math.min(8, steps)));
    this.slices.point(this.view, this.view.indexAt(this.view.where(event)));
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || !this.slices.scan) return;
    const { view, slices } = this;
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const act = {
      PageUp: () => slices.turn(view, view.index + 1),
      PageDown: () => slices.turn(view, view.index - 1),
      Home: () => slices.turn(view, 0),
      End: () => slices.turn(view, Infinity),
      "+": () => slices.zoomBy(STEP, view),
      "-": () => slices.zoomBy(1 / STEP, view),
      0: () => slices.resetView(),
      Enter: () => slices.plant(view, slices.cross),
      Escape: () => slices.clearRulers(1),
    }[event.key === "=" ? "+" : event.key];
    if (arrows[event.key]) this.nudge(arrows[event.key], event.shiftKey ? 5 : 1);
    else if (act) act();
    else if (KEYS[event.key] && !(KEYS[event.key] === "crop" && slices.isUpright)) slices.setTool(KEYS[event.key]);
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  /** Move the cross-hair by voxels to the right and down. */
  nudge(steps, count) {
    const cross = [...this.slices.cross];
    [this.view.laid.right, this.view.laid.down].forEach(({ axis, sign }, i) => (cross[axis] = Math.round(cross[axis]) + sign * steps[i] * count));
    this.slices.isTurned = true;
    this.slices.put(cross);
  }
}
