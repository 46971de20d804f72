// The range of a colour scale: typed, fitted to what is seen, or as computed.
import { button, make } from "../src/dom.js";
import { shown } from "./dialogs.js";

const short = (value) => Number(value.toPrecision(4));

/**
 * Ask for the range of a scale; `fit` is that of what is seen.
 * The promise holds {low, high}, null for the one that was computed, undefined for no change.
 */
export async function askRange({ title, unit, low, high, given }, fit) {
  const number = (value) => make("input", { type: "number", step: "any", required: true, value: short(value) });
  const [least, most] = [number(low), number(high)];
  const fill = (range) => ([least.value, most.value] = [short(range.low), short(range.high)]);
  const check = () => most.setCustomValidity(Number(least.value) < Number(most.value) ? "" : "The highest value must be above the lowest.");
  const form = make("form", { method: "dialog", className: "save-form" }, [
    make("h2", { id: "range-title" }, [title]),
    make("label", {}, [make("span", {}, [`Lowest, ${unit}`]), least]),
    make("label", {}, [make("span", {}, [`Highest, ${unit}`]), most]),
    make("p", { className: "hint" }, ["Values outside have the colour of the nearest end."]),
    make("div", { className: "ask-buttons" }, [
      ...(fit ? [button("Fit to view", () => (fill(fit), check()))] : []),
      button("As computed", () => (fill(given), check())),
      make("button", { type: "submit", className: "primary", value: "yes" }, ["Use"]),
    ]),
  ]);
  form.addEventListener("input", check);
  if (!(await shown(form, "range-title"))) return undefined;
  const range = { low: Number(least.value), high: Number(most.value) };
  return short(range.low) === short(given.low) && short(range.high) === short(given.high) ? null : range;
}
