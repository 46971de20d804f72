// The sizing table: all sizes deployed and ranked, with reasons; sorted, filtered and compared; a click chooses one.
import { button, make } from "../src/dom.js";
import { get } from "./api.js";
import { Comparing } from "./comparing.js";
import { redraw } from "./redraw.js";
import { isOfDevice, withDevice } from "./treatments.js";

const percent = (v) => `${(100 * v).toFixed(0)} %`;
const change = (v) => `${v > 0 ? "+" : v < 0 ? "−" : ""}${Math.abs(100 * v).toFixed(0)} %`;
const mm = (digits) => (v) => `${v.toFixed(digits)} mm`;
const FORMATS = {
  deployed_length_mm: mm(1), landing_length_mm: mm(1), neck_metal_coverage_fraction: percent, apposed_fraction: percent, max_wall_gap_mm: mm(2),
  jailed_branches_count: (v) => v.toFixed(0), neck_inflow_change_fraction: change, sac_velocity_change_fraction: change, sac_wss_change_fraction: change,
  flow_uncertainty_fraction: (v) => `${(100 * v).toFixed(1)} %`, flow_grade: (v) => v,
};
const FIRST = [
  ["rank", "No.", "Place in the ranking, by score. Ruled-out sizes come last."],
  ["device", "Device", "Name in the catalogue."],
  ["label_diameter_mm", "Size, mm", "Label diameter × label length."],
  ["score", "Score", "Weighted mean of the criteria, 0 to 100; the last column says what lowers it."],
];
const LAST = ["reason", "Why", "What lowers the score most, or why the size is ruled out."];
const COSTS = "Largest deductions from 100: ";
const MOST_ROWS = 200;
/** Whether a size fits into the artery. */
const isDeployed = (row) => row.deployed_length_mm !== undefined;

export class Ranking {
  constructor(page) {
    this.page = page;
    this.sort = ["rank", 1];
    this.isBest = this.isSuitable = false;
    this.device = "";
    this.found = null;
    this.key = null;
    this.comparing = new Comparing(page, () => this.draw());
    this.box = make("div", { className: "ranking" });
  }

  /** The table, fetched anew where it may have changed. */
  element() {
    const { view } = this.page;
    const key = JSON.stringify([view.id, view.anatomy, view.has_ranking, view.job?.kind === "rank" ? view.job.finished.length : "", view.steps.device]);
    if (key === this.key) this.draw();
    else {
      this.key = key;
      if (!this.found) this.box.replaceChildren(make("p", { className: "hint" }, ["Ranking …"]));
      get(`${this.page.path}/ranking`).then((found) => this.change({ found })).catch(this.page.complain);
    }
    return this.box;
  }

  /** Draw with another order or other filters. */
  change(changes) {
    Object.assign(this, changes);
    this.draw();
  }

  draw() {
    if (!this.found) return;
    const { rows, is_current } = this.found;
    if (!rows.length) return this.box.replaceChildren(make("p", { className: "hint" }, ["The sizes are being deployed …"]));
    const scroll = this.box.querySelector(".ranking-scroll");
    const at = scroll ? [scroll.scrollLeft, scroll.scrollTop] : [0, 0];
    const shown = this.shown();
    const suits = rows.filter((row) => row.is_suitable).length;
    const head = make("div", { className: "ranking-head" }, [
      make("b", {}, ["Sizes"]),
      make("span", {}, [`${rows.filter(isDeployed).length} of ${rows.length} deployed, ${suits} suitable, ${shown.length} shown`]),
      ...(is_current ? [] : [make("span", { className: "note stale" }, ["of an earlier choice: rank again"])]),
      ...this.filters(),
      this.comparing.button(),
    ]);
    const body = shown.slice(0, MOST_ROWS).map((row) => this.line(row));
    const table = make("table", {}, [make("thead", {}, [make("tr", {}, [make("th", { scope: "col" }, ["Compare"]), ...this.columns().map((column) => this.heading(column))])]), make("tbody", {}, body)]);
    const said = this.columns().map(([, title, meaning]) => make("div", {}, [make("dt", {}, [title]), make("dd", {}, [meaning])]));
    const explained = make("details", { className: "explained" }, [make("summary", {}, ["What the columns mean"]), make("dl", {}, said)]);
    const next = make("div", { className: "ranking-scroll", tabIndex: 0, role: "region", ariaLabel: "Ranking of all sizes" }, [table, explained]);
    redraw(this.box, head, next);
    [next.scrollLeft, next.scrollTop] = at;
  }

  columns() {
    const more = (this.found.columns || []).map(({ key, title, meaning }) => [key, title, meaning]);
    return [...FIRST, ...more, LAST];
  }

  /** The rows that are wanted, in their order. */
  shown() {
    const seen = new Set();
    const kept = this.found.rows.filter((row) => {
      if (this.device && row.device !== this.device) return false;
      if (this.isSuitable && !row.is_suitable) return false;
      if (!this.isBest) return true;
      const isFirst = !seen.has(row.device);
      seen.add(row.device);
      return isFirst;
    });
    const [key, way] = this.sort;
    const value = (row) => (key === "label_diameter_mm" ? row.label_diameter_mm + row.label_length_mm / 1e4 : row[key]);
    return kept.sort((a, b) => {
      const [x, y] = [value(a), value(b)];
      if (x === undefined || y === undefined) return (x === undefined) - (y === undefined); // without a value last
      return way * (typeof x === "string" ? x.localeCompare(y) : x - y) || a.rank - b.rank;
    });
  }

  filters() {
    const tick = (name, words) => {
      const box = make("input", { type: "checkbox", checked: this[name], data: { key: name }, onChange: () => this.change({ [name]: box.checked }) });
      return make("label", { className: "ranking-filter" }, [box, words]);
    };
    const options = [["", "all devices"], ...Object.entries(this.found.names)].map(([key, name]) => make("option", { value: key, selected: key === this.device }, [name]));
    const select = make("select", { ariaLabel: "Device", data: { key: "filter" }, onChange: () => this.change({ device: select.value }) }, options);
    return [select, tick("isBest", "best of each device"), tick("isSuitable", "suitable only")];
  }

  heading([key, title, meaning]) {
    const [sorted, way] = this.sort;
    const sign = sorted === key ? (way > 0 ? " ↑" : " ↓") : "";
    const sort = () => this.change({ sort: [key, sorted === key ? -way : key === "score" ? -1 : 1] });
    const ariaSort = sorted === key ? (way > 0 ? "ascending" : "descending") : "none";
    return make("th", { scope: "col", ariaSort }, [button(title + sign, sort, { title: `${meaning} Click to sort.`, data: { key } })]);
  }

  line(row) {
    const { page } = this;
    const ofDevice = (treatment) => treatment.name === row.device && isOfDevice(treatment);
    const chosen = page.view.choices.treatments.find(ofDevice)?.implants[0];
    const isChosen = chosen && chosen.diameter_mm === row.label_diameter_mm && chosen.length_mm === row.label_length_mm;
    const score = make("i", { className: "score", style: { width: `${48 * row.score}px` } });
    const name = this.found.names[row.device];
    const size = `${row.label_diameter_mm.toFixed(2)} × ${row.label_length_mm}`;
    const cells = [
      make("td", { className: "compare" }, [this.comparing.tick(row, `${name} ${size}`)]),
      make("td", { className: "rank" }, [String(row.rank)]),
      make("td", {}, [name, ...(row.is_proposed ? [" ", make("small", { title: "A run proposes this size of the device." }, ["proposed"])] : [])]),
      make("td", {}, [make("button", { type: "button", className: "link", title: "Choose this size and see it deployed" }, [size])]),
      make("td", { className: "score-cell", title: `${(100 * row.score).toFixed(0)} of 100` }, [score, make("span", {}, [row.is_suitable ? (100 * row.score).toFixed(0) : "out"])]),
      ...(this.found.columns || []).map(({ key }) => make("td", {}, [row[key] === undefined ? "–" : FORMATS[key](row[key])])),
      make("td", { className: "reason" }, [row.is_suitable ? row.reason.replace(COSTS, "") : `Ruled out: ${row.reason[0].toLowerCase()}${row.reason.slice(1)}`]),
    ];
    const sized = withDevice(row.device, { diameter_mm: row.label_diameter_mm, length_mm: row.label_length_mm });
    const put = ({ treatments }) => ({ treatments: treatments.some(ofDevice) ? treatments.map((one) => (ofDevice(one) ? sized : one)) : [...treatments, sized] });
    const choose = () => page.choose(put).then(() => page.goTo(row.device));
    const element = make("tr", { className: `${row.is_suitable ? "" : "unsuitable"} ${isChosen ? "chosen" : ""}` }, cells);
    element.addEventListener("click", (event) => event.target.closest("input, label") || choose());
    return element;
  }
}
