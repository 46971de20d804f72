// Films of the contrast agent before and after, in step: a slider, curves, and a C-arm that is turned by hand.
import { integers } from "../src/decode.js";
import { button, make } from "../src/dom.js";
import { inWords, REACH } from "./carm.js";
import { curvesChart } from "./charts.js";
import { chartButton, copied, saveButton } from "./exporting.js";
import { getBinary, Newest } from "./api.js";

const DEGREES_PER_PX = 0.4;
const NAMED = [["", "Working"], ["AP", "Frontal"], ["LAO 90", "Lateral"]];

/** Where the picture of a canvas lies that keeps its shape in a box of another one. */
function contained(canvas) {
  const { x, y, width, height } = canvas.getBoundingClientRect();
  const scale = Math.min(width / canvas.width, height / canvas.height);
  const [w, h] = [scale * canvas.width, scale * canvas.height];
  return { x: x + (width - w) / 2, y: y + (height - h) / 2, width: w, height: h };
}

export class Films {
  constructor(page) {
    this.page = page;
    this.moment = 0;
    this.hasWires = false;
    this.direction = "";
    this.panes = make("div", { className: "film-panes" });
    this.element = make("div", { className: "films", hidden: true, tabIndex: 0, role: "application", ariaLabel: "Films. Drag to turn the C-arm, arrow keys turn it by 5 degrees." }, [this.panes]);
    this.slider = make("input", { type: "range", min: 0, max: 0, step: 1, value: 0, ariaLabel: "Time of the film", onInput: () => this.look(Number(this.slider.value)) });
    this.play = make("button", { type: "button", onClick: () => this.turn(!this.playing) }, ["▶ Play"]);
    this.clock = make("b", { className: "film-clock" });
    this.chart = make("div", { className: "chart-box" });
    const save = saveButton({
      name: "angiogram",
      element: this.element,
      ground: "#d1d1d1",
      words: () => [...this.panes.querySelectorAll("figcaption")],
      rasters: () => this.canvases.map((canvas) => [copied(canvas), contained(canvas)]),
    });
    this.saveChart = chartButton("contrast over time", this.chart, () => this.draw());
    this.strip = [make("div", { className: "film-time" }, [this.play, this.slider, this.clock, save]), this.chart];
    this.newest = new Newest((answer) => this.take(answer), page.complain);
    this.listen();
    new ResizeObserver(() => this.draw()).observe(this.chart);
  }

  title(name) {
    return name === "bare" ? "Before" : this.page.names.treatment(name);
  }

  get hasFilm() {
    return Boolean(this.times?.length);
  }

  forget() {
    this.turn(false);
    this.times = this.frames = this.angles = undefined;
    this.panes.replaceChildren();
  }

  /** Fetch the films along a direction in words; empty: the working projection. */
  ask(direction = this.direction, moment = null) {
    this.direction = direction;
    const query = new URLSearchParams({ wires: this.hasWires });
    if (direction) query.set("view", direction);
    if (moment !== null) query.set("moment", moment);
    this.newest.ask(() => getBinary(`${this.page.path}/angiogram?${query}`));
  }

  take({ manifest, buffer }) {
    if (this.grabbed && manifest.moment === null) return;
    this.angles = this.grabbed ? this.angles : manifest.angles_deg;
    this.times = manifest.times_s;
    this.curves = manifest.curves ?? this.curves;
    this.size = [manifest.columns, manifest.rows];
    this.only = manifest.moment;
    this.frames = manifest.panes.map(({ id, frames }) => [id, integers(buffer, frames)]);
    this.slider.max = this.times.length - 1;
    this.moment = Math.min(this.moment, this.times.length - 1);
    this.layout();
    this.look(this.moment);
    if (this.page.view) this.page.renderFilms();
  }

  layout() {
    const [width, height] = this.size;
    const names = this.frames.map(([id]) => id).join();
    if (this.names !== names || !this.panes.children.length) {
      this.names = names;
      this.canvases = this.frames.map(() => make("canvas", { className: "film-canvas" }));
      this.labels = this.frames.map(() => make("span"));
      const figure = ([id], k) => make("figure", { className: "film-pane" }, [make("figcaption", {}, [make("strong", {}, [this.title(id)]), this.labels[k]]), this.canvases[k]]);
      this.panes.replaceChildren(...this.frames.map(figure));
    }
    for (const canvas of this.canvases) [canvas.width, canvas.height] = [width, height];
  }

  look(moment) {
    this.moment = moment;
    this.slider.value = moment;
    if (!this.frames) return;
    const [width, height] = this.size;
    const at = this.only === null ? moment * width * height : 0;
    this.frames.forEach(([, levels], k) => {
      const picture = new ImageData(width, height);
      for (let i = 0; i < width * height; i++) {
        picture.data.fill(levels[at + i], 4 * i, 4 * i + 3);
        picture.data[4 * i + 3] = 255;
      }
      this.canvases[k].getContext("2d").putImageData(picture, 0, 0);
      this.labels[k].textContent = inWords(this.angles);
    });
    this.clock.textContent = `${this.times[moment].toFixed(2)} s`;
    this.draw();
  }

  draw() {
    const [width, height] = [this.chart.clientWidth, this.chart.clientHeight];
    if (!this.curves?.length || width < 60 || height < 50) return;
    const chosen = (time) => this.look(this.times.reduce((best, t, k) => (Math.abs(t - time) < Math.abs(this.times[best] - time) ? k : best), 0));
    this.chart.replaceChildren(curvesChart(this.curves, this.times[this.moment], [width, height], (name) => this.title(name), chosen), this.saveChart);
  }

  /** Play, in real time. */
  turn(isOn) {
    this.playing = isOn;
    this.play.textContent = isOn ? "❚❚ Pause" : "▶ Play";
    if (!isOn || !this.hasFilm) return;
    const from = this.moment >= this.times.length - 1 ? 0 : this.moment;
    const began = performance.now() - 1000 * (this.times[from] - this.times[0]);
    const run = (this.run = Symbol("film"));
    const step = (now) => {
      if (this.run !== run || !this.playing || !this.hasFilm || this.element.hidden) return this.run === run && this.turn(false);
      const seconds = this.times[0] + Math.max(0, now - began) / 1000;
      const next = this.times.findIndex((t) => t > seconds);
      this.look(next < 0 ? this.times.length - 1 : Math.max(0, next - 1));
      if (next < 0) return this.turn(false);
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  /** A drag turns the arm: while it lasts, only the frame in view is drawn, with coarse pixels. */
  listen() {
    this.element.addEventListener("pointerdown", (event) => {
      if (!this.hasFilm) return;
      this.turn(false);
      this.grabbed = { from: [event.clientX, event.clientY], angles: this.angles };
      this.element.setPointerCapture(event.pointerId);
    });
    this.element.addEventListener("pointermove", (event) => {
      if (!this.grabbed) return;
      const { from, angles } = this.grabbed;
      const to = [angles[0] - DEGREES_PER_PX * (event.clientX - from[0]), angles[1] + DEGREES_PER_PX * (event.clientY - from[1])];
      this.aim(to, this.moment);
    });
    const done = () => {
      if (!this.grabbed) return;
      this.grabbed = null;
      this.ask(inWords(this.angles));
    };
    this.element.addEventListener("pointerup", done);
    this.element.addEventListener("pointercancel", done);
    this.element.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, 5], ArrowDown: [0, -5] }[event.key];
      if (!by || !this.hasFilm || event.altKey) return;
      event.preventDefault();
      this.aim([this.angles[0] + by[0], this.angles[1] + by[1]], null);
    });
  }

  aim(angles, moment) {
    this.angles = angles.map((angle, k) => Math.round(Math.min(Math.max(angle, -REACH[k]), REACH[k])));
    for (const label of this.labels ?? []) label.textContent = inWords(this.angles);
    this.ask(inWords(this.angles), moment);
  }

  /** What is chosen on the left side: the direction in words or by name, and the wires. */
  controls() {
    const now = this.hasFilm ? inWords(this.angles) : this.direction;
    const field = make("input", { type: "text", value: now, placeholder: "LAO 30 CRA 10", id: "field-carm", data: { key: "carm" }, onChange: () => this.ask(field.value) });
    const named = NAMED.map(([view, words]) => button(words, () => this.ask(view)));
    const onChange = () => {
      this.hasWires = wires.checked;
      this.ask(this.hasFilm ? inWords(this.angles) : this.direction);
    };
    const wires = make("input", { type: "checkbox", checked: this.hasWires, data: { key: "film-wires" }, onChange });
    return [
      make("label", { className: "field three", htmlFor: "field-carm" }, [make("span", {}, ["C-arm"]), field, make("small", {}, ["°"])]),
      make("div", { className: "tabs", role: "group", ariaLabel: "Direction" }, named),
      make("label", {}, [wires, " Wires of the device"]),
      make("p", { className: "hint" }, ["Drag a film to turn the C-arm. All films share one grey scale. Computed from the flow: noise and bone are not modeled."]),
    ];
  }
}
