// The step Image: the slices of a scan beside its surface, and what of them is seen in 3-D.
import { make, svg } from "../src/dom.js";
import { get, getBinary, Newest } from "./api.js";
import { Slices } from "./slices.js";
import { toMm } from "./voxels.js";

/** Corners of a box that its twelve edges join. */
const EDGES = [0, 1, 2, 3, 4, 5, 6, 7].flatMap((a) => [1, 2, 4].filter((bit) => !(a & bit)).map((bit) => [a, a | bit]));

export class Imaging {
  /** @param page the page; it is asked for the case's path, view, anatomy and picture */
  constructor(page) {
    this.page = page;
    this.slices = null;
    this.box = make("div", { className: "slices", hidden: true });
    this.surfaces = new Newest(
      (answer) => {
        page.picture.put({ ...answer, manifest: { ...answer.manifest, is_oriented: page.scan.is_oriented } });
        if (this.views?.length) return;
        this.views = answer.manifest.views;
        page.renderScene();
      },
      page.complain,
    );
    this.lines = svg("svg", { class: "cross-mark", width: 1, height: 1, "aria-hidden": "true" });
    this.cross = { element: this.lines, point: () => this.drawCross() };
    this.seed = { element: make("span", { className: "seed-mark" }, [make("i"), "Seed"]), point: () => page.view?.choices.at_mm };
  }

  /** Fetch the scan; the slices are shown at once, the proposed threshold follows. */
  async load(grid) {
    const { page } = this;
    this.key = grid;
    this.views = null;
    const scan = await get(`${page.path}/image`);
    if (this.key !== grid) return;
    page.scan = scan;
    this.slices = new Slices(this);
    this.box.replaceChildren(...this.slices.elements);
    this.slices.show(scan);
    this.follow(page.view);
    page.lookAtNeck();
    page.render();
    await this.propose(grid);
  }

  /** Fetch the threshold that a study would use, and show what is chosen or proposed. */
  async propose(grid) {
    const { page } = this;
    const { threshold, crop_mm } = page.view.choices;
    this.cropKey = JSON.stringify(crop_mm);
    if (threshold !== null) this.showThreshold(threshold);
    const { proposed_threshold } = await get(`${page.path}/image/threshold`);
    if (this.key !== grid || !page.scan) return;
    page.scan.proposed_threshold = proposed_threshold;
    if (page.view.choices.threshold === null) this.showThreshold(proposed_threshold);
    page.render();
  }

  /** Show what was chosen, here or in another window. */
  follow(view) {
    if (!this.slices) return;
    const { at_mm, crop_mm, treatments } = view.choices;
    this.slices.setSeed(at_mm);
    this.slices.bar.renderChips();
    this.slices.setCrop(crop_mm);
    const treatment = view.steps.deploy === "done" ? treatments[0] : null;
    this.slices.hasSac = Boolean(this.page.anatomy?.neck.length);
    this.slices.setFound(view.has_anatomy ? view.anatomy : null, treatment ?? null);
    const crop = JSON.stringify(crop_mm);
    if (this.cropKey !== undefined && crop !== this.cropKey) {
      this.page.scan.proposed_threshold = undefined;
      this.propose(this.key).catch(this.page.complain);
    }
  }

  /** The live surface and the outline at a threshold. */
  showThreshold(threshold) {
    this.slices?.setThreshold(threshold);
    this.surfaces.ask(() => getBinary(`${this.page.path}/image/surface?threshold=${threshold}`));
  }

  redraw() {
    this.page.picture.stage?.redraw();
  }

  /** A point of the surface was clicked: the slices turn to it, or it becomes the seed. */
  clicked(point) {
    if (!point) return;
    if (this.slices.tool === "seed") this.page.setSeed(point);
    else this.slices.look(point, true);
  }

  get marks() {
    return [this.cross, ...(this.page.view.choices.at_mm ? [this.seed] : [])];
  }

  /** Lines along the three slices through the cross-hair, and the crop box, as seen now. */
  drawCross() {
    const { picture, scan } = this.page;
    if (!this.slices || !scan || !picture.stage || !picture.seen) return null; // the camera has no place yet
    const { cross, isCropped, tool, cropBox, views, scan: grid } = this.slices;
    const center = this.slices.crossMm;
    const [x, y] = picture.onScreen(center);
    const seen = (index, affine = grid.affine_mm) => {
      const [u, v] = picture.onScreen(toMm(affine, index));
      return [u - x, v - y];
    };
    // What lies in the plane of the eye is seen nowhere.
    const line = ([[a, b], [c, d]], attributes) => ([a, b, c, d].every(Number.isFinite) ? svg("line", { x1: a, y1: b, x2: c, y2: d, ...attributes }) : svg("g"));
    const along = [0, 1, 2].map((axis) => {
      const ends = [0, grid.shape[axis] - 1].map((place) => seen(cross.map((other, i) => (i === axis ? place : other))));
      return line(ends, { stroke: views[axis].laid.colour, "stroke-width": 1.6, opacity: 0.75 });
    });
    const corners = Array.from({ length: 8 }, (_, c) => seen([0, 1, 2].map((axis) => cropBox[(c >> axis) & 1][axis]), scan.affine_mm));
    const box = isCropped || tool === "crop" ? EDGES.map(([a, b]) => line([corners[a], corners[b]], { stroke: "#16262e", "stroke-width": 1.2, "stroke-dasharray": "4 3" })) : [];
    this.lines.replaceChildren(...box, ...along, svg("circle", { r: 4, fill: "none", stroke: "#16262e", "stroke-width": 1.6 }));
    return center;
  }
}
