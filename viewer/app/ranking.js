// The sizing table: all sizes of the chosen devices deployed and ranked, with reasons; a click chooses one.
import { make } from "../src/dom.js";
import { get } from "./api.js";

const COLUMNS = [
  ["deployed_length_mm", "Length", (v) => `${v.toFixed(1)} mm`],
  ["landing_length_mm", "Landing", (v) => `${v.toFixed(1)} mm`],
  ["neck_metal_coverage_fraction", "Coverage", (v) => `${(100 * v).toFixed(0)} %`],
  ["apposed_fraction", "Apposed", (v) => `${(100 * v).toFixed(0)} %`],
  ["max_wall_gap_mm", "Largest gap", (v) => `${v.toFixed(2)} mm`],
];

export function rankingTable(page) {
  const box = make("div", { className: "ranking" }, [make("p", { className: "hint" }, ["Ranking …"])]);
  get(`${page.path}/ranking`)
    .then((ranking) => box.replaceChildren(...table(page, ranking)))
    .catch((problem) => page.complain(problem));
  return box;
}

function table(page, { rows, names, is_current }) {
  if (!rows.length) return [make("p", { className: "hint" }, ["The sizes are being deployed …"])];
  const suits = rows.filter((row) => row.is_suitable).length;
  const words = `${rows.length} sizes deployed, ${suits} suitable. Click one to choose it.`;
  const head = make("div", { className: "ranking-head" }, [
    make("b", {}, ["Sizes, best first"]),
    make("span", {}, [words]),
    ...(is_current ? [] : [make("span", { className: "note stale" }, ["of an earlier choice: rank again"])]),
  ]);
  const titles = ["", "Device", "Size, mm", "Score", ...COLUMNS.map(([, title]) => title), "Why"];
  const body = rows.slice(0, 60).map((row) => line(page, row, names));
  return [
    head,
    make("div", { className: "ranking-scroll" }, [
      make("table", {}, [make("thead", {}, [make("tr", {}, titles.map((title) => make("th", { scope: "col" }, [title])))]), make("tbody", {}, body)]),
    ]),
  ];
}

function line(page, row, names) {
  const chosen = page.view.choices.devices.find(({ name }) => name === row.device);
  const isChosen = chosen && chosen.diameter_mm === row.label_diameter_mm && chosen.length_mm === row.label_length_mm;
  const score = make("i", { className: "score" });
  score.style.width = `${48 * row.score}px`;
  const cells = [
    make("td", { className: "rank" }, [String(row.rank)]),
    make("td", {}, [names[row.device]]),
    make("td", {}, [`${row.label_diameter_mm.toFixed(2)} × ${row.label_length_mm}`]),
    make("td", { className: "score-cell", title: `${(100 * row.score).toFixed(0)} of 100` }, [score, make("span", {}, [row.is_suitable ? (100 * row.score).toFixed(0) : "–"])]),
    ...COLUMNS.map(([key, , format]) => make("td", {}, [row[key] === undefined ? "–" : format(row[key])])),
    make("td", { className: "reason", title: row.reason }, [row.reason.replace("Costs it most: ", "")]),
  ];
  const choose = () => page.changeDevice(row.device, { diameter_mm: row.label_diameter_mm, length_mm: row.label_length_mm, center_mm: null }).then(() => page.goTo(row.device));
  const element = make("tr", { className: `${row.is_suitable ? "" : "unsuitable"} ${isChosen ? "chosen" : ""}`, tabIndex: 0, ariaSelected: String(Boolean(isChosen)) }, cells);
  element.addEventListener("click", choose);
  element.addEventListener("keydown", (event) => event.key === "Enter" && choose());
  return element;
}
