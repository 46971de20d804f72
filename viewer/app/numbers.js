// Numbers: each with its unit, its definition at rest of the pointer, before, after and change.
import { make } from "../src/dom.js";

function term({ name, meaning, source }) {
  const title = meaning ? meaning + (source ? ` (${source})` : "") : "";
  return make("span", { className: title ? "term defined" : "term", title, tabIndex: title ? 0 : -1 }, [name]);
}

/** Whether a value says that a device does not span the neck. */
const isMissed = ({ key }, value) => key === "neck_covered_fraction" && !value.startsWith("100");

/** Numbers with one value, or one per sheet side by side, with the titles of the sheets where there are several. */
export function plainSheet(sheets, isWhole, hasHead = sheets.length > 1) {
  const rows = sheets[0].rows.filter((row) => isWhole || row.is_first);
  const head = hasHead ? [make("div", { className: "row head" }, [make("span"), ...sheets.map(({ title }) => make("b", {}, [title]))])] : [];
  const lines = rows.map((row) => {
    const values = sheets.map((sheet) => sheet.rows.find(({ key }) => key === row.key)?.cells[0] ?? "–");
    return make("div", { className: "row" }, [term(row), ...values.map((value) => make("b", { className: isMissed(row, value) ? "bad" : "" }, [value]))]);
  });
  return make("div", { className: `sheet columns-${sheets.length}` }, [...head, ...lines]);
}

/** Grades of the flows, each with its reasons and with what was computed. */
export function qualitySheet({ qualities }) {
  const one = ({ title, grade, mark, reasons, computation }) =>
    make("li", { className: grade.replace(" ", "-") }, [
      make("b", {}, [`${mark} ${title}: ${grade}`]),
      reasons ? ` (${reasons})` : "",
      make("small", {}, [computation]),
    ]);
  return make("ul", { className: "qualities", ariaLabel: "Grades of the flows" }, qualities.map(one));
}

/** Numbers before, after and change: a card each. */
export function changeSheet(sheet, isWhole, named) {
  const rows = sheet.rows.filter((row) => isWhole || row.is_first);
  return make(
    "div",
    { className: "cards" },
    rows.map((row) => {
      const columns = [cell("Before", "without a device", row.cells[0], "")];
      sheet.names.forEach((name, i) => columns.push(cell(named(name), sheet.devices[i], row.cells[1 + 2 * i], row.cells[2 + 2 * i], row.senses[i])));
      return make("div", { className: row.key.startsWith("neck_inflow_in_") ? "card beside" : "card" }, [term(row), make("div", { className: "card-cells" }, columns)]);
    }),
  );
}

function cell(words, title, value, change, sense = "") {
  // The unit goes below its number where there is no room beside it.
  const [digits, ...unit] = value.split("\u202f");
  const parts = [make("small", { title }, [words]), make("b", {}, [digits, ...(unit.length ? [" ", make("span", { className: "unit" }, [unit.join("\u202f")])] : [])])];
  if (change) parts.push(make("em", { className: sense }, [change]));
  return make("div", {}, parts);
}

/** Treatments by their score, the best first, with the reasons. */
export function rankedSheet(ranked, named) {
  const row = ({ treatment, score, is_suitable, reason }, i) =>
    make("li", { className: is_suitable ? "good" : "fair" }, [make("b", {}, [`${i + 1}. ${named(treatment)}: ${is_suitable ? `${(100 * score).toFixed(0)} of 100` : reason.startsWith("Not ranked") ? "not ranked" : "ruled out"}`]), make("small", {}, [reason])]);
  return [make("h2", {}, ["Treatments ranked"]), make("ul", { className: "qualities" }, ranked.map(row))];
}

/** Two numbers with their unit said once. */
function span(low, high) {
  const [digits, unit] = low.split("\u202f");
  if (low === high) return low;
  return unit && high.endsWith(unit) ? `${digits} to ${high}` : `${low} to ${high}`;
}

/** A band, and what causes most of it. */
const banded = (low, high, cause) => `${span(low, high)}${cause ? `, mostly from ${cause}` : ""}`;

/** Uncertainty of the results of a device: mean, 95 % interval and main causes. */
export function sureSheet({ title, words, rows }) {
  const cause = (shares) => shares.filter(([, share]) => share >= 0.05).map(([name, share]) => `${name} ${Math.round(100 * share)} %`).join(", ");
  const cards = rows.map((row) =>
    make("div", { className: "card" }, [
      make("span", { className: "term" }, [row.name]),
      make("div", { className: "card-cells" }, [cell("Mean", "", row.mean, ""), cell("95 % interval", "", span(row.low, row.high), "")]),
      make("p", { className: "hint" }, [cause(row.shares)]),
    ]),
  );
  return [make("h2", { className: "sure" }, [`Uncertainty: ${title}`]), make("p", { className: "hint" }, [words]), make("div", { className: "cards" }, cards)];
}

/** How far an end of a device, proximal (0) or distal (1), reaches beyond the neck; it is negative where it does not reach it. */
export const reachOf = (i, mm, neck) => (neck?.length ? (i ? mm - neck[1] : neck[0] - mm) : undefined);

/** The same in words; from the inlet without a neck. */
export function reachWords(i, mm, neck) {
  const reach = reachOf(i, mm, neck);
  return reach === undefined ? `${mm.toFixed(1)} mm from inlet` : `${Math.abs(reach).toFixed(1)} mm ${reach < 0 ? "short of" : "beyond"} neck`;
}

/** Where the lower end of a basket lies, in words. */
export const heightWords = (mm) => `${Math.abs(mm).toFixed(1)} mm ${mm < -0.05 ? "below" : "above"} neck`;

/** Where a device lies, in words; its length with its band, once there is one. */
export function placeWords({ length_mm, width_mm, ends_mm, is_basket, is_coils, neck }, bands, neckOfParent) {
  if (is_coils) return [];
  const [, , low, high, cause] = bands?.rows.find(([name]) => name === "Deployed length") || [];
  const reach = (name, i) => [name, reachWords(i, ends_mm[i], neck ?? neckOfParent), "", reachOf(i, ends_mm[i], neck ?? neckOfParent) < 0];
  const rows = is_basket
    ? [["Width × height", `${width_mm.toFixed(1)} × ${length_mm.toFixed(1)} mm`, ""], ["Lower end", heightWords(ends_mm[0]), ""]]
    : [["Deployed length", `${length_mm.toFixed(1)} mm`, low ? banded(low, high, cause) : ""], reach("Proximal end", 0), reach("Distal end", 1)];
  return rows.map(([name, value, range, isShort]) => make("div", { className: "row" }, [make("span", {}, [name]), make("b", { className: isShort ? "bad" : "" }, [value]), make("small", {}, [range])]));
}

/** How sure a device is: a sentence, and the band of each result with its largest cause. */
export function bandWords(sheet) {
  if (!sheet) return [];
  const rows = sheet.rows.map(([name, value, low, high, cause]) =>
    make("div", { className: "row" }, [make("span", {}, [name]), make("b", {}, [value]), make("small", {}, [banded(low, high, cause)])]),
  );
  const details = make("details", {}, [make("summary", {}, ["Bands from the ranges of the device's numbers"]), ...rows]);
  return [make("p", { className: "hint" }, [sheet.sentence]), ...(rows.length ? [details] : [])];
}

/** A neck as it is drawn, beside the one that was found. */
export function neckWords(neck, found) {
  const row = (name, value, was) => make("div", { className: "row" }, [make("span", {}, [name]), make("b", {}, [value]), make("small", {}, [value === was ? "" : `of the vessel shown: ${was}`])]);
  const [area, around] = [(x) => `${x.area_mm2.toFixed(1)} mm²`, (x) => `${x.perimeter_mm.toFixed(1)} mm`];
  return [row("Neck curve, projected area", area(neck), area(found)), row("Neck curve, length", around(neck), around(found))];
}
