// The picture: one canvas, panes with a locked camera, buttons for layers and views, marks that lie on the scene.
import { Raycaster, Vector2, Vector3 } from "three";
import { button, make } from "../src/dom.js";
import { annotate, colourBar, makePane, sizeOf } from "../src/furniture.js";
import { Stage } from "../src/stage.js";
import { anglesOf, axesOf, fromWords, inWords } from "./carm.js";
import { ask } from "./dialogs.js";
import { copied, saveButton } from "./exporting.js";
import { askRange } from "./ranges.js";
import { keeping, redraw } from "./redraw.js";

const VIEWS = { profile: ["Profile", "The neck in profile"], whole: ["Whole", "The whole vessel"], neck: ["Neck", "From the sac onto the neck"], frontal: ["Front", "From the front"], lateral: ["Left", "From the left"] };
const NARROW = 900;
const EMPTY = { scales: [], layers: [], views: [], fade: 2 };

export class Picture {
  constructor(page) {
    this.page = page;
    this.canvas = make("canvas", { className: "viewer-canvas", ariaHidden: "true" });
    this.grid = make("div", { className: "viewer-panes" });
    this.marks = make("div", { className: "marks" });
    this.bars = make("div", { className: "picture-bars" });
    this.toolbar = make("div", { className: "picture-tools" });
    this.area = make(
      "div",
      { className: "viewer-area", tabIndex: 0, role: "application", ariaLabel: "3-D view. Arrow keys turn, plus and minus zoom, 1 to 4 are views." },
      [this.canvas, this.grid, this.marks],
    );
    this.element = make("div", { className: "picture" }, [this.area, this.toolbar, this.bars]);
    this.save = saveButton({
      name: "3-D view",
      element: this.element,
      shape: (wide) => this.area.clientHeight / this.area.clientWidth + this.foot / wide,
      lay: () => this.layout(),
      rasters: (scale) => this.photographed(scale),
      words: () => this.written(),
    });
    this.carm = make("input", { type: "text", className: "chip carm", size: 13, title: "Direction of the view as C-arm angles: type others", ariaLabel: "C-arm angles of the view", onChange: () => this.turnArm() });
    this.views = [];
    this.panes = [];
    this.switches = [];
    this.shown = new Set();
    this.drawnMarks = [];
    this.moved = null;
    this.clicked = null;
    this.ranges = [];
    try {
      this.stage = new Stage(this.canvas, EMPTY, new ArrayBuffer(0));
    } catch (problem) {
      this.area.replaceChildren(
        make("p", { className: "viewer-sorry", role: "status" }, ["The 3-D view needs WebGL, which this browser does not offer here."]),
      );
      return;
    }
    this.stage.orbit.listen(this.area, () => this.paneSize()[1]);
    for (const name of ["pointerdown", "wheel", "keydown"])
      this.area.addEventListener(name, (event) => event.target.closest("button") || (this.lastLook = null), { passive: true });
    this.stage.drawn = () => this.afterDrawing();
    this.area.addEventListener("keydown", (event) => this.key(event));
    this.area.addEventListener("pointermove", (event) => event.buttons === 0 && this.moved?.(event));
    this.listenForClicks();
    new ResizeObserver(() => this.layout()).observe(this.area);
    this.setPanes([{ id: "one", title: "" }]);
  }

  listenForClicks() {
    let down = null;
    this.area.addEventListener("pointerdown", (event) => (down = [event.clientX, event.clientY]));
    this.area.addEventListener("pointerup", (event) => {
      if (!down || !this.clicked || event.target.closest("button")) return;
      if (Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 4) this.clicked(this.pick(event));
    });
  }

  /** Add layers; a layer of the same name in the same pane is replaced. */
  put({ manifest, buffer }) {
    if (!this.stage) return;
    this.stage.put(manifest, buffer);
    if (manifest.fade) this.stage.shared.fade = manifest.fade;
    if ("is_oriented" in manifest) this.stage.isOriented = manifest.is_oriented;
    this.renderTools(); // a layer that there was not before is offered
    this.apply();
  }

  /** Whether a pane has the wall of an artery that has yielded to its devices. */
  isMoved(pane) {
    return this.stage?.layers.some((layer) => layer.id === "lumen" && layer.pane === pane);
  }

  /** Take away what has moved in a pane with its devices, so that it shows the artery as scanned. */
  dropMoved(pane, more = []) {
    this.stage?.drop((layer) => layer.pane === pane && ["lumen", "neck", "axis", ...more].includes(layer.id));
  }

  /** Offer the views of what is shown, a scan or a vessel; the other one than before is looked at anew. */
  setViews(what, views, id) {
    this.views = views || [];
    if (what === this.seen || !this.views.length) return;
    this.seen = what;
    this.look(id, false);
  }

  setPanes(panes) {
    if (!this.stage || JSON.stringify(panes) === JSON.stringify(this.panes.map(({ id, title, note }) => ({ id, title, note })))) return;
    const solo = (id) => {
      this.solo = this.solo === id ? null : id;
      this.layout();
    };
    this.panes = panes.map((pane) => makePane(pane, solo));
    if (panes.length === 1) this.panes[0].button.remove();
    if (!this.panes.some(({ id }) => id === this.solo)) this.solo = null;
    this.grid.replaceChildren(...this.panes.map(({ element }) => element));
    this.layout();
  }

  /** Offer these layers: [{id, title, on}]; what was switched before stays so. */
  setLayers(layers, memory) {
    this.switches = layers;
    this.memory = memory;
    this.shown = new Set(layers.filter(({ id, on }) => memory[id] ?? on).flatMap(({ id, also = [] }) => [id, ...also]));
    this.renderTools();
    this.apply();
  }

  renderTools() {
    const layers = this.switches
      .filter(({ title, id, also = [] }) => title && this.layersSeen((name) => name === id || also.includes(name)).length)
      .map(({ id, title, also = [] }) => {
        const turn = () => {
          const on = !this.shown.has(id);
          this.memory[id] = on;
          for (const one of [id, ...also]) this.shown[on ? "add" : "delete"](one);
          chip.setAttribute("aria-pressed", String(on));
          this.apply();
        };
        const chip = button(title, turn, { className: "chip", ariaPressed: String(this.shown.has(id)) });
        return chip;
      });
    const isOriented = this.stage?.isOriented !== false; // without it no side of the patient is known
    const views = this.views.map(({ id }, i) => isOriented || !["frontal", "lateral"].includes(id) ? button(VIEWS[id][0], () => this.look(id), { className: "chip view", title: `${VIEWS[id][1]} (key ${i + 1})` }) : "");
    const own = this.stage && this.views.length ? [...this.savedViews.map((view) => this.keptChip(view)), this.keepChip(), ...(isOriented ? [this.carm] : [])] : [];
    const save = this.stage ? [this.save] : [];
    redraw(this.toolbar, make("div", { className: "chips" }, layers), make("div", { className: "chips" }, [...views, ...own, ...save]));
    this.makeRoom();
  }

  get savedViews() {
    return this.page.view?.choices.views ?? [];
  }

  saveViews(views) {
    this.page.choose({ views });
  }

  /** A view that was saved: it is looked at again, or forgotten. */
  keptChip({ name, axes, center_mm, distance_mm }) {
    const look = () => {
      this.lastLook = null;
      this.stage.orbit.go({ axes, center: center_mm, distance: distance_mm });
    };
    const forget = () => this.saveViews(this.savedViews.filter((view) => view.name !== name));
    return make("span", { className: "kept-view" }, [
      button(name, look, { className: "chip view", title: "Saved view" }),
      button("×", forget, { className: "chip", title: "Forget this view", ariaLabel: `Forget the view ${name}` }),
    ]);
  }

  /** The button that saves the view as it is, under a name. */
  keepChip() {
    const keep = async () => {
      const { axes, center, distance } = this.stage.orbit.stand;
      const kept = this.savedViews;
      const name = await ask({ title: "Save this view", words: ["It is kept with the case, and offered beside the other views."], field: "Name", value: `View ${kept.length + 1}`, button: "Save view" });
      if (name) this.saveViews([...kept.filter((view) => view.name !== name), { name: name.slice(0, 40), axes, center_mm: center, distance_mm: distance }]);
    };
    return button("+", keep, { className: "chip", title: "Save this view under a name", ariaLabel: "Save this view" });
  }

  /** Turn to the C-arm angles that were typed. */
  turnArm() {
    try {
      const { center, distance } = this.stage.orbit.stand;
      this.stage.orbit.go({ axes: axesOf(fromWords(this.carm.value)), center, distance });
      this.lastLook = null;
    } catch (problem) {
      this.page.complain(problem);
    }
    this.carm.blur();
    this.stage.redraw();
  }

  /** Titles stand below the buttons, which may need a second line. */
  makeRoom() {
    this.grid.style.setProperty("--tools", `${this.toolbar.offsetHeight + 16}px`);
  }

  apply() {
    if (!this.stage) return;
    this.stage.show([...this.shown]);
    const scales = this.scalesShown();
    redraw(this.bars, ...scales.map((scale) => colourBar(scale, [this.rangeButton(scale)])));
    this.bars.hidden = !scales.length;
  }

  /** Color by these ranges, [{scale, low, high}], and every other scale as it was computed. */
  setRanges(ranges) {
    if (!this.stage || JSON.stringify(ranges) === JSON.stringify(this.ranges)) return;
    const gone = this.ranges.map(({ scale }) => [scale, null]);
    this.ranges = ranges;
    const given = new Map([...gone, ...ranges.map(({ scale, low, high }) => [scale, { low, high }])]);
    for (const [id, range] of given) this.stage.setRange(id, range);
    this.apply();
  }

  /** The button that changes the range of a scale. */
  rangeButton(scale) {
    const { stage } = this;
    const change = async () => {
      const fit = stage.extent((layer) => layer.scale === scale.id && this.shown.has(layer.id));
      const range = await askRange(scale, fit);
      if (range === undefined) return;
      const others = this.ranges.filter((one) => one.scale !== scale.id);
      this.setRanges(range ? [...others, { scale: scale.id, ...range }] : others);
      this.page.choose({ ranges: this.ranges });
    };
    return button(stage.ranges[scale.id] ? "range (own)" : "range", change, { className: "link range", title: "Change the range of these colours", ariaLabel: `Range of ${scale.title}` });
  }

  /** The layers of the panes whose names are wanted. */
  layersSeen(isWanted) {
    return this.stage?.layers.filter(({ id, pane }) => isWanted(id) && (pane === "" || this.panes.some((one) => one.id === pane))) ?? [];
  }

  /** The colour scales of what is seen. */
  scalesShown() {
    const used = new Set(this.layersSeen((id) => this.shown.has(id)).map(({ scale }) => scale));
    return Object.values(this.stage.scales).filter((scale) => used.has(scale.id));
  }

  /** The scene as a canvas with `scale` pixels per pixel of the page, and where it lies. */
  photographed(scale) {
    let canvas;
    this.stage.photograph(scale, (scene) => (canvas = copied(scene)));
    return [[canvas, this.area.getBoundingClientRect()]];
  }

  /** What stands on the scene and is no control: titles, length bars, compasses, labels and colour bars. */
  written() {
    const labels = this.drawnMarks.filter(({ isLabel }) => isLabel).map(({ element }) => element);
    const heads = this.visiblePanes().flatMap(({ element, length, compass }) => [element.querySelector(".viewer-title"), length, compass]);
    return [...heads, ...labels, this.bars];
  }

  /** Height of the strip below a saved picture that holds its colour bars, in pixels. */
  get foot() {
    return this.bars.hidden ? 0 : this.bars.offsetHeight + 12;
  }

  /** All panes, or the one that is shown alone. */
  visiblePanes() {
    return this.panes.filter(({ element }) => !element.hidden);
  }

  look(id, glide = true) {
    const view = this.views.find((one) => one.id === id);
    if (!view || !this.stage) return;
    const [width, height] = this.paneSize();
    this.lastLook = id;
    this.stage.orbit.look(view.axes, view.center, view.radius, width / height, glide);
  }

  paneSize() {
    return sizeOf(this.visiblePanes()[0]);
  }

  layout() {
    if (!this.stage || !this.panes.length) return;
    this.element.style.setProperty("--foot", `${this.foot}px`);
    const [width, height] = [this.area.clientWidth, this.area.clientHeight];
    for (const { id, element, button } of this.panes) {
      element.hidden = Boolean(this.solo) && this.solo !== id;
      button.setAttribute("aria-pressed", String(this.solo === id));
    }
    this.makeRoom();
    const count = this.visiblePanes().length;
    this.element.classList.toggle("three", count === 3 && width < NARROW);
    this.grid.classList.toggle("four", count === 4 || (count === 3 && width < NARROW));
    this.grid.classList.toggle("alone", count === 1);
    const places = this.visiblePanes().map(({ id, element }) => ({
      id,
      left: element.offsetLeft,
      bottom: height - element.offsetTop - element.offsetHeight,
      width: element.offsetWidth,
      height: element.offsetHeight,
    }));
    this.stage.arrange(places, width, height);
    // Until somebody turns it, the picture fits the room it has.
    if (this.lastLook) this.look(this.lastLook, false);
  }

  key(event) {
    const view = this.views[Number(event.key) - 1];
    if (view) this.look(view.id);
    else if (event.key === "r" || event.key === "R") this.look("profile");
  }

  afterDrawing() {
    annotate(this.panes, this.stage, this.paneSize()[1]);
    const isEmpty = !this.stage.layers.some(({ id }) => this.shown.has(id));
    for (const { length, compass } of this.panes) for (const one of [length, compass]) one.toggleAttribute("hidden", isEmpty);
    if (document.activeElement !== this.carm) this.carm.value = inWords(anglesOf(this.stage.orbit.stand.axes.slice(6)));
    this.placeMarks();
  }

  /** Lay elements on the scene: [{element, point: () => [x, y, z]}]; they follow the camera. */
  setMarks(marks) {
    this.drawnMarks = marks;
    const elements = marks.map(({ element }) => element);
    keeping(this.marks, () => {
      for (const gone of [...this.marks.children].filter((element) => !elements.includes(element))) gone.remove();
      // One that stays is not taken out even for a moment: in hand it would be let go.
      let next = this.marks.firstChild;
      for (const element of elements)
        if (element === next) next = next.nextSibling;
        else this.marks.insertBefore(element, next);
    });
    if (this.stage) this.placeMarks();
    this.stage?.redraw();
  }

  /** Marks lie on their points; labels keep inside the picture, beside the buttons above it, and off each other. */
  placeMarks() {
    this.drawnMarks.forEach((mark) => this.placeMark(mark));
    const [width, height, top] = [this.area.clientWidth, this.area.clientHeight, this.toolbar.offsetHeight + 28];
    const taken = [];
    const near = this.drawnMarks.filter(({ element }) => element.matches(".handle:not(.small, .cut)") && !element.hidden).sort((a, b) => a.at[0] - b.at[0]);
    if (near.length === 2 && near[1].at[0] - near[0].at[0] < 180 && Math.abs(near[1].at[1] - near[0].at[1]) < 28) near.forEach(({ element }, i) => element.classList.toggle("flipped", !i)); // words on either side
    for (const { element, at, isLabel } of this.drawnMarks) element.hidden ||= Boolean(isLabel) && (at[0] < 0 || at[0] > width || at[1] < 0 || at[1] > height);
    const labels = this.drawnMarks.filter(({ isLabel, element }) => isLabel && !element.hidden);
    for (const mark of labels.sort((a, b) => a.at[1] - b.at[1])) {
      const { offsetWidth: w, offsetHeight: h } = mark.element;
      const [x, y] = mark.at;
      const left = Math.min(Math.max(x + w + 14 > width ? x - w - 18 : x, 0), Math.max(width - w - 12, 0));
      let middle = Math.min(Math.max(y, top), height - h - 36); // above the length bar
      for (const other of taken) if (left < other.right && left + w > other.left && middle < other.bottom + h / 2 + 3) middle = other.bottom + h / 2 + 3;
      taken.push({ left, right: left + w, bottom: middle + h / 2 });
      mark.element.style.transform = `translate(${left}px, ${middle}px)`;
    }
  }

  placeMark(mark) {
    const point = mark.point();
    mark.element.hidden = !point;
    if (!point) return;
    const [x, y, depth] = (mark.at = this.onScreen(point));
    mark.element.style.setProperty("--nearness", Math.round(1e6 * (1 - depth)));
    mark.element.style.transform = `translate(${x}px, ${y}px)`;
    mark.element.classList.toggle("flipped", x > this.area.clientWidth - 180);
  }

  /** Pixel in the first visible pane where a point of the world is seen, and its depth from -1, near, to 1. */
  onScreen(point) {
    const { element } = this.visiblePanes()[0];
    const camera = this.stage.camera;
    camera.aspect = element.offsetWidth / Math.max(element.offsetHeight, 1);
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
    const seen = new Vector3(...point).project(camera);
    return [element.offsetLeft + (0.5 + seen.x / 2) * element.offsetWidth, element.offsetTop + (0.5 - seen.y / 2) * element.offsetHeight, seen.z];
  }

  /** Where a pointer is, in pixels of the picture. */
  where(event) {
    const box = this.area.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /** Point of the nearest visible surface under a pointer, or null. */
  pick(event) {
    const isShown = (layer) => layer.kind === "mesh" && this.shown.has(layer.id);
    return this.hits(this.where(event), isShown)[0] || null;
  }

  /** Point of a layer that is seen at a pixel, the one nearest to `point` of those in front of and behind each other. */
  onWall(place, id, point) {
    const away = (hit) => Math.hypot(...hit.map((x, i) => x - point[i]));
    return this.hits(place, (layer) => layer.id === id).sort((a, b) => away(a) - away(b))[0] || null;
  }

  /** Points where the sight through a pixel meets layers, the nearest first. */
  hits([x, y], isChosen) {
    const { element } = this.visiblePanes()[0];
    this.onScreen([0, 0, 0]);
    const place = new Vector2((2 * (x - element.offsetLeft)) / element.offsetWidth - 1, 1 - (2 * (y - element.offsetTop)) / element.offsetHeight);
    const caster = new Raycaster();
    caster.setFromCamera(place, this.stage.camera);
    const meshes = this.stage.layers.filter(isChosen).map(({ object }) => object);
    return caster.intersectObjects(meshes, true).map(({ point }) => point.toArray());
  }
}
