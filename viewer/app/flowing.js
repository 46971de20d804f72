// Live flow: a switch, numbers against the flow without a device, a chart of the last minute, streamlines in the picture.
import { make, svg } from "../src/dom.js";
import { drop, getBinary, post } from "./api.js";
import { chartButton } from "./exporting.js";

const EVERY_MS = 220;
const NAMES = { neck_inflow_mL_s: "Neck inflow", sac_velocity_m_s: "Mean sac velocity" };
const signed = (v) => `${v > 0 ? "+" : "−"}${Math.abs(v).toFixed(0)}`;

export class Flowing {
  constructor(page) {
    this.page = page;
    this.isOn = false;
    this.drawn = 0; // number of the streamlines that are in the picture
    this.box = make("input", { type: "checkbox", id: "live-flow", onChange: () => this.turn(this.box.checked) });
    this.state = make("p", { className: "hint", role: "status" });
    this.cards = make("div", { className: "live-cards" });
    this.chart = svg("svg", { class: "live-chart", viewBox: "0 0 240 64", role: "img", "aria-label": "Change of the neck inflow over the last minute" });
    const chart = make("div", { className: "live-chart-box" }, [this.chart]);
    chart.append(chartButton("live flow", chart));
    this.body = make("div", { className: "live-body", hidden: true }, [this.state, this.cards, chart]);
    this.element = make("div", { className: "live" }, [make("label", { htmlFor: "live-flow" }, [this.box, "Live blood flow (preview)"]), this.body]);
    document.addEventListener("visibilitychange", () => {
      this.watch();
      this.prepare(this.expected);
    });
  }

  /** Have the flow without a device computed in advance, once for each vessel and settings; `expected` names them, or is null. */
  prepare(expected) {
    this.expected = expected;
    if (document.hidden || expected === this.prepared) return;
    this.prepared = expected;
    if (expected && !this.isOn) post(`${this.page.path}/preview`).catch(() => {}); // it only saves time later
  }

  /** The case is left: its process ends. */
  end() {
    if (this.isOn) this.turn(false);
    if (this.prepared !== undefined) this.release();
    this.expected = null;
  }

  release() {
    drop(`${this.page.path}/preview`).catch(() => {});
  }

  turn(isOn) {
    this.isOn = isOn;
    this.box.checked = isOn;
    this.body.hidden = !isOn;
    if (!isOn) this.forget();
    else {
      this.say("Starting …");
      this.watch();
    }
    if (this.page.view) this.page.renderScene();
  }

  /** Whether the page looks at the flow: only then it is computed. */
  set isWatched(value) {
    this.watched = value;
    if (value) this.watch();
    else this.forget();
  }

  /** Take the streamlines out of the picture. */
  forget() {
    this.drawn = 0;
    this.page.picture.stage?.drop(({ id, pane }) => id === "streamlines" && pane === "");
  }

  async watch() {
    if (this.isAsking) return;
    this.isAsking = true;
    while (this.isOn && this.watched && !document.hidden) {
      const began = performance.now();
      try {
        this.take(await getBinary(`${this.page.path}/preview?seen=${this.drawn}`));
      } catch (problem) {
        this.fail(problem);
      }
      await new Promise((resolve) => setTimeout(resolve, Math.max(0, EVERY_MS - (performance.now() - began))));
    }
    this.isAsking = false;
    this.element.classList.toggle("stale", this.isOn);
  }

  fail(problem) {
    this.turn(false);
    this.release();
    this.page.complain(problem);
  }

  say(words) {
    this.state.textContent = words;
  }

  take({ manifest, buffer }) {
    if (!this.isOn || !this.watched) return;
    if (manifest.error) return this.fail(new Error(manifest.error));
    if (manifest.layers.length) this.page.picture.put({ manifest, buffer });
    this.drawn = manifest.drawn;
    const { fraction, is_stale, is_settled, values, reductions, history, error_points } = manifest;
    this.element.classList.toggle("stale", is_stale);
    if (!("neck_inflow_mL_s" in reductions)) return this.say(fraction < 1 ? `Computing the flow in the artery: ${Math.round(100 * fraction)} %` : "The flow develops: first numbers follow.");
    const moving = is_stale ? "The device has moved: new values follow." : is_settled ? "Steady." : "The flow is adapting to the device and is averaged: the bands shrink with time.";
    this.say(`${moving} Grid spacing ${values.grid_spacing_mm.toFixed(2)} mm; bands include the usual difference from the full computation.`);
    this.cards.replaceChildren(
      ...Object.entries(NAMES).map(([key, name]) =>
        make("div", { className: "card" }, [
          make("span", { className: "term" }, [`${name}, change`]),
          make("b", { className: key in error_points ? "" : "pending" }, [signed(reductions[key]), " %"]),
          make("small", {}, [key in error_points ? `${signed(Math.max(reductions[key] - error_points[key], -100))} to ${signed(reductions[key] + error_points[key])} %` : "not averaged yet"]),
        ]),
      ),
    );
    this.draw(history);
  }

  draw(history) {
    const low = Math.min(-10, ...history);
    const [x, y] = [(i) => 44 + (192 * i) / Math.max(history.length - 1, 1), (v) => 6 + (52 * v) / low];
    const line = history.map((v, i) => `${i ? "L" : "M"}${x(i).toFixed(1)} ${y(Math.min(v, 0)).toFixed(1)}`).join("");
    const word = (v) => svg("text", { x: 40, y: y(v) + 4, class: "tick end" }, [`${v.toFixed(0).replace("-", "−")} %`]);
    const parts = [0, low].map((v) => svg("line", { x1: 44, x2: 236, y1: y(v), y2: y(v), class: "grid" }));
    this.chart.replaceChildren(...parts, word(0), word(low), svg("path", { d: line, class: "line device" }));
  }
}
