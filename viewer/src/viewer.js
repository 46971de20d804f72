// The viewer: mount(element, manifest, base64) draws a scene with its switches; report.html and the page both call it.
import { unpack } from "./decode.js";
import { button, make } from "./dom.js";
import { annotate, colourBar, gradient, makePane, sizeOf } from "./furniture.js";
import { Stage } from "./stage.js";

// What the page makes use of too: it is loaded beside this bundle, and three.js need not come twice.
export * from "./decode.js";
export * from "./dom.js";
export * from "./furniture.js";
export { Stage } from "./stage.js";
export { Raycaster, Vector2, Vector3 } from "three";

const MODES = [
  { id: "anatomy", title: "Anatomy", layers: ["lumen", "continued", "landing", "sac", "neck"] },
  { id: "device", title: "Device", layers: ["lumen", "continued", "wires", "contour", "neck"] },
  { id: "wires", title: "Wires", layers: ["lumen", "continued", "wires", "neck"] },
  { id: "flow", title: "Blood flow", layers: ["lumen", "streamlines", "neck"] },
  { id: "shear", title: "Wall shear stress", layers: ["shear", "neck"] },
  { id: "sac_shear", title: "Sac shear stress", layers: ["lumen", "sac_shear", "neck"] },
];

const LAYERS = [
  ["lumen", "Lumen (patient)"],
  ["landing", "Restored parent artery"],
  ["continued", "Continued artery (assumed)"],
  ["sac", "Sac"],
  ["neck", "Neck"],
  ["axis", "Parent axis"],
  ["centerlines", "Centerlines"],
  ["contour", "Device contour, by wall gap"],
  ["coverage", "Device contour, by metal coverage"],
  ["wires", "Wires"],
  ["streamlines", "Streamlines, by speed"],
  ["shear", "Wall shear stress"],
  ["sac_shear", "Wall shear stress of the sac"],
];

const VIEWS = { profile: "Profile", neck: "From the sac", frontal: "Frontal", lateral: "From the left" };

const KEYS = [
  ["drag, arrow keys", "turn"],
  ["shift + drag, shift + arrows", "move"],
  ["wheel, + and −", "zoom"],
  [", and .", "roll"],
  ["1 to 4", "views"],
  ["R", "start again"],
];

/** Draw a scene into `element`. Returns the stage, or null where the browser has no WebGL (it says so). */
export function mount(element, manifest, base64) {
  try {
    return new Viewer(element, manifest, unpack(base64)).stage;
  } catch (problem) {
    element.replaceChildren(
      make("p", { className: "viewer-sorry", role: "status" }, [
        "The 3-D view needs WebGL, which this browser does not offer here. The pictures below show the same case.",
      ]),
    );
    console.warn(`3-D view not drawn: ${problem.message}`);
    return null;
  }
}

class Viewer {
  constructor(element, manifest, buffer) {
    this.element = element;
    this.manifest = manifest;
    this.canvas = make("canvas", { className: "viewer-canvas", ariaHidden: "true" });
    this.stage = new Stage(this.canvas, manifest, buffer);
    this.present = new Set(manifest.layers.map((layer) => layer.id));
    this.modes = MODES.filter((mode) => mode.layers.filter((id) => this.present.has(id)).length > 1).filter(
      (mode) => !["device", "wires", "flow", "shear", "sac_shear"].includes(mode.id) || this.present.has(needed(mode.id)),
    );
    this.shown = new Set();
    this.solo = null;
    this.alike = false;
    this.moment = 1;
    this.build();
    this.stage.orbit.listen(this.area, () => this.paneSize()[1]);
    this.stage.isOriented = manifest.is_oriented;
    this.stage.drawn = () => this.annotate();
    new ResizeObserver(() => this.layout()).observe(this.area);
    this.layout();
    this.setMode(this.modes.find((mode) => mode.id === "wires") || this.modes[0]);
    this.look("profile", false);
  }

  build() {
    this.panes = this.manifest.panes.map((pane) => makePane(pane, (id) => this.turnSolo(id)));
    this.grid = make("div", { className: "viewer-panes" }, this.panes.map((pane) => pane.element));
    const words = `3-D view: ${this.manifest.panes.map((pane) => pane.title).join(", ")}. Arrow keys turn, plus and minus zoom.`;
    this.area = make("div", { className: "viewer-area", tabIndex: 0, role: "application", ariaLabel: words }, [
      this.canvas,
      this.grid,
    ]);
    this.area.addEventListener("keydown", (event) => this.key(event));
    this.bars = make("div", { className: "viewer-bars" });
    this.element.classList.add("viewer");
    this.element.replaceChildren(
      make("div", { className: "viewer-head" }, [this.modeButtons(), this.viewButtons(), this.help()]),
      make("div", { className: "viewer-body" }, [this.area, this.sidebar()]),
      make("div", { className: "viewer-foot" }, [this.bars, this.expansion()]),
    );
  }

  /** Show a pane alone, or all again. */
  turnSolo(id) {
    this.solo = this.solo === id ? null : id;
    this.layout();
  }

  modeButtons() {
    this.modeInputs = this.modes.map((mode) => ({ mode, button: button(mode.title, () => this.setMode(mode)) }));
    return group("Show", this.modeInputs.map((input) => input.button), "viewer-modes");
  }

  viewButtons() {
    return group("Look", this.manifest.views.map(({ id }, i) => button(VIEWS[id], () => this.look(id), { title: `Key ${i + 1}` })));
  }

  help() {
    const rows = KEYS.map(([key, what]) => make("div", {}, [make("kbd", {}, [key]), make("span", {}, [what])]));
    return make("details", { className: "viewer-help" }, [make("summary", {}, ["Keys"]), make("div", {}, rows)]);
  }

  sidebar() {
    this.boxes = new Map();
    const rows = LAYERS.filter(([id]) => this.present.has(id)).map(([id, title]) => {
      const box = make("input", { type: "checkbox", onChange: () => this.toggle(id, box.checked) });
      this.boxes.set(id, box);
      return make("label", {}, [box, this.swatch(id), make("span", {}, [title])]);
    });
    return make("fieldset", { className: "viewer-side" }, [make("legend", {}, ["Layers"]), ...rows]);
  }

  swatch(id) {
    const layer = this.manifest.layers.find((one) => one.id === id);
    const scale = this.stage.scales[layer.scale];
    return make("i", { className: "viewer-swatch", style: { background: scale ? gradient(scale) : `rgb(${layer.colour.map((c) => Math.round(255 * c))})` } });
  }

  expansion() {
    if (this.stage.nFrames < 2) return "";
    this.slider = make("input", { type: "range", min: 0, max: 1, step: 0.005, value: 1, ariaLabel: "Expansion of the device", onInput: () => this.setMoment(Number(this.slider.value)) });
    const play = button("▶ Expand", () => this.play(), { className: "viewer-play" });
    this.player = make("div", { className: "viewer-expansion" }, [play, make("span", {}, ["start"]), this.slider, make("span", {}, ["deployed"])]);
    return this.player;
  }

  play() {
    const started = performance.now();
    const run = (this.run = Symbol("run"));
    const step = (now) => {
      if (this.run !== run) return;
      const moment = Math.min(1, Math.max(0, now - started) / 2500);
      this.slider.value = moment;
      this.setMoment(moment, true);
      if (moment < 1) requestAnimationFrame(step);
    };
    if (!this.shown.has("contour")) this.setMode(this.modes.find((mode) => mode.id === "device"));
    requestAnimationFrame(step);
  }

  setMoment(moment, playing = false) {
    if (!playing) this.run = null;
    this.moment = moment;
    this.stage.expand(moment);
    this.apply();
  }

  setMode(mode) {
    this.mode = mode;
    this.shown = new Set(mode.layers.filter((id) => this.present.has(id)));
    this.apply();
  }

  toggle(id, on) {
    this.shown[on ? "add" : "delete"](id);
    this.mode = null;
    this.apply();
  }

  /** Bring switches, colour bars and picture to what is to be shown. */
  apply() {
    for (const { mode, button } of this.modeInputs) button.setAttribute("aria-pressed", String(mode === this.mode));
    for (const [id, box] of this.boxes) box.checked = this.shown.has(id);
    // Wires are woven on the deployed contour only: while it expands they do not exist.
    this.stage.show([...this.shown].filter((id) => id !== "wires" || this.moment === 1));
    // Where nothing differs between the panes, one of them is enough.
    const alike = this.manifest.layers.every((layer) => layer.pane === "" || !this.shown.has(layer.id));
    if (alike !== this.alike) {
      this.alike = alike;
      this.layout();
    }
    if (this.player) this.player.hidden = !this.shown.has("contour") && this.moment === 1 && !this.shown.has("wires");
    this.showBars();
  }

  showBars() {
    const used = new Set(this.manifest.layers.filter((layer) => this.shown.has(layer.id)).map((layer) => layer.scale));
    const scales = Object.values(this.stage.scales).filter((scale) => used.has(scale.id));
    this.bars.replaceChildren(...scales.map((scale) => colourBar(scale)));
  }

  look(id, glide = true) {
    const view = this.manifest.views.find((one) => one.id === id);
    const [width, height] = this.paneSize();
    this.stage.orbit.look(view.axes, view.center, view.radius, width / height, glide);
  }

  paneSize() {
    return sizeOf(this.panes.find(({ element }) => !element.hidden));
  }

  layout() {
    for (const pane of this.panes) {
      const alone = this.alike ? this.panes[0].id : this.solo;
      pane.element.hidden = alone !== null && alone !== pane.id;
      pane.button.setAttribute("aria-pressed", String(this.solo === pane.id));
      pane.button.hidden = this.alike || this.panes.length < 2;
      pane.head.hidden = this.alike && this.panes.length > 1;
    }
    const box = this.area.getBoundingClientRect();
    const [width, height] = [this.area.clientWidth, this.area.clientHeight];
    this.grid.classList.toggle("four", this.panes.filter(({ element }) => !element.hidden).length === 4);
    const places = this.panes
      .filter(({ element }) => !element.hidden)
      .map(({ id, element }) => {
        const r = element.getBoundingClientRect();
        const [left, top] = [r.left - box.left - this.area.clientLeft, r.top - box.top - this.area.clientTop];
        return { id, left, bottom: height - top - r.height, width: r.width, height: r.height };
      });
    this.stage.arrange(places, width, height);
  }

  key(event) {
    const view = this.manifest.views[Number(event.key) - 1];
    if (view) this.look(view.id);
    else if (event.key === "r" || event.key === "R") this.look("profile");
  }

  /** Length bar and compass of every pane, for the camera as it is. */
  annotate() {
    annotate(this.panes, this.stage, this.paneSize()[1]);
  }
}

const needed = (mode) => ({ device: "contour", wires: "wires", flow: "streamlines", shear: "shear", sac_shear: "sac_shear" })[mode];

function group(label, children, className = "") {
  return make("div", { className: `viewer-group ${className}`, role: "group", ariaLabel: label }, children);
}
