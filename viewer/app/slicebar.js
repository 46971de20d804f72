// The bar over the slices: tools, window presets, slab, outlines, and what is under the pointer.
import { button, make } from "../src/dom.js";
import { copied, saveButton } from "./exporting.js";
import { redraw } from "./redraw.js";
import { LINES, SEED } from "./sliceview.js";

const TOOLS = [
  ["cross", "Cross-hair", "Click or drag: the other slices and the 3-D view follow (key C)"],
  ["window", "Window", "Drag: width to the right, level upwards; the right mouse button does it with every tool (key W)"],
  ["ruler", "Ruler", "Drag from one point to another (key M); Escape removes the last one"],
  ["seed", "Seed", "Click in the artery to choose the vessel (key S)"],
  ["crop", "Crop", "Drag an edge of the box: the vessel is sought inside it (key B)"],
];
/** Windows of a CT by name: width and level in HU. */
const CT = { "CT angiography": [700, 300], Brain: [80, 40], "Soft tissue": [350, 50], Bone: [2000, 500] };
const SLABS = [[0, "Single slice"], [5, "MIP 5 mm"], [10, "MIP 10 mm"], [20, "MIP 20 mm"], [1000, "MIP, whole scan"]];
/** Width of a picture, about 120 mm on paper, from which its slices lie beside each other. */
const ROW_PX = 580;
const minus = (x, digits) => x.toFixed(digits).replace("-", "−");

export class SliceBar {
  constructor(slices) {
    this.slices = slices;
    this.tools = make("div", { className: "tabs slice-tools", role: "group", ariaLabel: "Tool on the slices" });
    this.extra = make("span", { className: "slice-extra" });
    const select = (ariaLabel, options, onChange, title = "") => make("select", { ariaLabel, title, onChange }, options.map(([value, words]) => make("option", { value }, [words])));
    this.presets = select("Window and level", [], () => this.choose(this.presets.value));
    this.slab = select("Slab", SLABS, () => slices.setSlab(Number(this.slab.value)));
    const hint = "This scan is oblique: anatomical planes, interpolated, or the slices of the file";
    this.along = select("Direction of the slices", [["patient", "Patient axes"], ["file", "File axes"]], () => slices.stand(this.along.value === "patient"), hint);
    this.words = make("span", { className: "slice-window" });
    this.invert = make("button", { type: "button", title: "Dark vessels on a bright ground", ariaPressed: "false", onClick: () => slices.setWindow({ isInverted: !slices.window.isInverted }) }, ["Invert"]);
    const reset = make("button", { type: "button", title: "Window, zoom and slab as at first", onClick: () => this.reset() }, ["Reset"]);
    this.chips = make("div", { className: "slice-chips", role: "group", ariaLabel: "Outlines on the slices" });
    this.reading = make("output", { className: "slice-reading" });
    this.element = make("div", { className: "slice-bar" }, [
      make("div", { className: "slice-row" }, [this.tools, this.extra, this.presets, this.words, this.invert, this.along, this.slab, reset, this.save()]),
      make("div", { className: "slice-row" }, [this.chips, this.reading]),
    ]);
  }

  /** The button that saves the slices that are shown, beside or, in a narrow picture, above each other. */
  save() {
    const { slices } = this;
    const isRow = (wide) => wide >= ROW_PX;
    return saveButton({
      name: "slices",
      get element() {
        return slices.imaging.box;
      },
      ground: "#10171b",
      shape: (wide) => {
        const { visible } = slices;
        slices.imaging.box.style.setProperty("--along", isRow(wide) ? "row" : "column");
        return visible.length === 1 ? visible[0].box[1] / visible[0].box[0] : isRow(wide) ? 0.4 : 2.2;
      },
      lay: () => slices.paint(),
      words: () => slices.visible.flatMap(({ area, label }) => [...area.querySelectorAll("span"), label]),
      rasters: (scale) =>
        slices.visible.map((view) => {
          view.paint(scale);
          return [copied(view.canvas), view.area.getBoundingClientRect()];
        }),
    }, "Save");
  }

  show(scan) {
    const isCt = scan.modality === "CT" || (scan.modality === "" && scan.ends[0] <= -500);
    this.windows = { Automatic: null, "Vessels": null, "Whole range": null, ...(isCt ? CT : {}) };
    this.presets.replaceChildren(make("option", { value: "" }, ["Window …"]), ...Object.keys(this.windows).map((name) => make("option", { value: name }, [name])));
    this.presets.value = "Automatic";
    this.along.hidden = !scan.upright;
    this.along.value = this.slices.isUpright ? "patient" : "file";
    this.renderTools();
    this.renderChips();
  }

  choose(name) {
    const { slices } = this;
    const { ends, quantiles } = slices.scan;
    if (name === "Automatic") slices.resetWindow();
    else if (name === "Whole range") slices.setWindow({ level: (ends[0] + ends[1]) / 2, width: ends[1] - ends[0] });
    else if (name === "Vessels") {
      const wall = slices.threshold ?? quantiles[3];
      slices.setWindow({ level: wall, width: 2 * Math.max(wall - quantiles[2], ends[1] / 100) });
    } else if (CT[name]) slices.setWindow({ width: CT[name][0], level: CT[name][1] });
    this.presets.value = name;
  }

  reset() {
    this.slab.value = "0";
    this.slices.setSlab(0);
    this.choose("Automatic");
    this.slices.resetView();
  }

  sayWindow() {
    const { level, width, isInverted } = this.slices.window;
    this.words.textContent = `W ${minus(width, width < 10 ? 2 : 0)} L ${minus(level, Math.abs(width) < 10 ? 2 : 0)}`;
    this.invert.setAttribute("aria-pressed", String(isInverted));
    this.presets.value = "";
  }

  renderTools() {
    const { slices } = this;
    const tool = ([id, title, hint]) => {
      const isOff = id === "crop" && slices.isUpright;
      const words = isOff ? "The crop box lies along the axes of the file: choose them for the slices first" : hint;
      return button(title, () => slices.setTool(id), { title: words, disabled: isOff, ariaPressed: String(slices.tool === id) });
    };
    redraw(this.tools, ...TOOLS.map(tool));
    const extra = [];
    if (slices.rulers.length) extra.push(`${slices.rulers.at(-1).mm.toFixed(1)} mm`, button("Remove rulers", () => slices.clearRulers(), { className: "link" }));
    if (slices.scan && slices.isCropped) extra.push(button("Whole scan", () => (slices.setCrop(null), slices.letCropGo()), { className: "link" }));
    redraw(this.extra, ...extra);
  }

  renderChips() {
    const { slices } = this;
    const found = Boolean(slices.found);
    const has = { threshold: slices.threshold !== null, lumen: found, parent: found, sac: found && slices.hasSac, neck: found && slices.hasSac, wires: found && Boolean(slices.treatment) };
    const chips = Object.entries(LINES)
      .filter(([name]) => has[name])
      .map(([name, { title, colour, dash, width }]) => {
        const borderTop = `${Math.round(width + 0.6)}px ${dash.length ? (dash[0] > 4 ? "dashed" : "dotted") : "solid"} ${colour}`;
        const swatch = make("i", { className: name === "wires" ? "swatch wires" : "swatch", style: { borderTop } });
        return make("button", { type: "button", className: "slice-chip", ariaPressed: String(slices.on[name]), onClick: () => slices.toggle(name) }, [swatch, title]);
      });
    if (slices.seed) {
      const dot = make("i", { className: "swatch seed", style: { borderColor: SEED } });
      chips.push(make("button", { type: "button", className: "slice-chip", title: "Turn the slices to the seed", onClick: () => slices.put(slices.seed) }, [dot, "Seed"]));
    }
    redraw(this.chips, ...chips);
  }

  /** Value and position under the pointer, or at the cross-hair. */
  say() {
    const { scan } = this.slices;
    if (!scan) return;
    const { index, mm, value, isPointer } = this.slices.reading;
    const at = (point) => point.map((x) => minus(x, 1)).join(", ");
    const places = scan.is_oriented ? `LPS ${at(mm)} · RAS ${at([-mm[0], -mm[1], mm[2]])} mm` : `x, y, z ${at(mm)} mm`;
    const shown = value === undefined ? "–" : minus(value, Number.isInteger(value) ? 0 : 2);
    this.reading.replaceChildren(make("b", {}, [`${this.slices.slab ? "Maximum" : "Value"} ${shown}`]), ` · ${places} · voxel ${index.join(", ")}`);
    this.reading.dataset.at = isPointer ? "pointer" : "cross";
  }
}
