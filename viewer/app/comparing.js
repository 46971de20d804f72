// Sizes side by side: those ticked in the ranking are deployed, each in a pane, on one colour scale, with their numbers.
import { make } from "../src/dom.js";
import { Newest, postBinary } from "./api.js";
import { withDevice } from "./treatments.js";

export const MOST = 4;

export class Comparing {
  /** @param page the page @param changed called when a row was ticked */
  constructor(page, changed) {
    this.page = page;
    this.changed = changed;
    this.rows = [];
    this.isOn = false;
    this.shown = [];
    const fail = (problem) => {
      this.isOn = false;
      page.complain(problem);
      page.render();
    };
    this.asked = new Newest((answer) => this.take(answer), fail);
  }

  keyOf({ device, label_diameter_mm, label_length_mm, shift_mm }) {
    return [device, label_diameter_mm, label_length_mm, shift_mm].join(" ");
  }

  tick(row, words) {
    const key = this.keyOf(row);
    const isTicked = this.rows.some((one) => this.keyOf(one) === key);
    const onChange = () => {
      this.rows = box.checked ? [...this.rows, row] : this.rows.filter((one) => this.keyOf(one) !== key);
      if (this.isOn && this.rows.length) this.ask();
      else if (this.isOn) this.turn(false);
      this.changed();
    };
    const box = make("input", { type: "checkbox", checked: isTicked, disabled: !isTicked && this.rows.length >= MOST, ariaLabel: `Compare ${words}`, data: { key: `compare ${key}` }, onChange });
    return box;
  }

  button() {
    const words = this.isOn ? "End comparison" : this.rows.length ? `Compare ${this.rows.length} side by side` : `Tick up to ${MOST} sizes to compare`;
    return make("button", { type: "button", className: `compare-button ${this.rows.length && !this.isOn ? "primary" : ""}`, disabled: !this.rows.length && !this.isOn, onClick: () => this.turn(!this.isOn) }, [words]);
  }

  turn(isOn) {
    this.isOn = isOn;
    if (isOn) this.ask();
    else {
      this.shown = [];
      this.page.picture.stage?.drop(({ pane }) => pane.startsWith("compared "));
    }
    this.changed();
    this.page.render();
  }

  ask() {
    const treatments = this.rows.map(({ device, label_diameter_mm, label_length_mm }) => withDevice(device, { diameter_mm: label_diameter_mm, length_mm: label_length_mm }));
    const { colour } = this.page;
    this.asked.ask(() => postBinary(`${this.page.path}/comparison`, { treatments, colour }));
  }

  take(answer) {
    if (!this.isOn) return;
    this.page.picture.stage?.drop(({ pane }) => pane.startsWith("compared "));
    this.page.picture.put(answer);
    this.shown = answer.manifest.compared;
    this.page.render();
  }

  /** Whether there is something to see. */
  get isSeen() {
    return this.isOn && this.shown.length > 0;
  }

  panes() {
    const value = ([measures], key) => measures.rows.find((row) => row.key === key)?.cells[0];
    return this.shown.map(({ pane, title, measures }) => {
      const said = [["length", "deployed_length_mm"], ["coverage of the neck", "neck_metal_coverage_fraction"], ["gap", "max_wall_gap_mm"]];
      const note = said.filter(([, key]) => value(measures, key)).map(([word, key]) => `${word} ${value(measures, key)}`).join(", ");
      return { id: pane, title, note };
    });
  }

  sheets() {
    return this.shown.flatMap(({ measures }) => measures);
  }
}
