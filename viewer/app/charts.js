// Small charts in SVG: the artery along its axis with the device in it, a section, a residual, a pulse.
import { make, svg } from "../src/dom.js";
import { chartButton } from "./exporting.js";

const round = (x) => Math.round(10 * x) / 10;

function path(points) {
  return points.map(([x, y], i) => `${i ? "L" : "M"}${round(x)} ${round(y)}`).join("");
}

function text(x, y, words, attributes = {}) {
  return svg("text", { x, y, ...attributes }, [words]);
}

/** A line across a chart at a height, with its number on the left. */
const level = (y, left, right, words, kind = "grid") => [svg("line", { x1: left, x2: right, y1: y, y2: y, class: kind }), text(left - 6, y + 4, words, { class: "tick end" })];

/** Lines at round values and their numbers on an axis. */
function ticks(low, high, count) {
  const raw = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= raw) || raw;
  const found = [];
  for (let v = Math.ceil(low / step) * step; v <= high + 1e-9; v += step) found.push(Number(v.toPrecision(6)));
  return found;
}

/** The artery's diameter along its parent axis, the neck, the device between its ends with their bands, a cursor. */
export class AlongChart {
  constructor() {
    this.svg = svg("svg", { class: "chart", role: "img", "aria-label": "Diameter along the parent artery" });
    this.element = make("div", { className: "chart-box" }, [this.svg]);
    this.element.append(chartButton("diameter along the artery", this.element, () => this.draw()));
    this.chosen = () => {};
    this.element.addEventListener("pointermove", (event) => this.move(event));
    new ResizeObserver(() => this.draw()).observe(this.element);
  }

  set(data) {
    this.data = { ...this.data, ...data };
    this.draw();
  }

  move(event) {
    if (!this.x) return;
    const box = this.svg.getBoundingClientRect();
    this.chosen(this.x.back(event.clientX - box.left));
  }

  draw() {
    const { axis, neck, device, cursor } = this.data || {};
    const [width, height] = [this.element.clientWidth, this.element.clientHeight];
    if (!axis || width < 50 || height < 50) return;
    const [left, right, top, bottom] = [40, 12, 22, 26];
    const length = axis.abscissa.at(-1);
    const most = 1.15 * Math.max(...axis.diameter, ...(device ? device.profile.map(([, d]) => d) : []));
    const x = (mm) => left + ((width - left - right) * mm) / length;
    x.back = (px) => Math.min(Math.max(((px - left) / (width - left - right)) * length, 0), length);
    this.x = x;
    const y = (mm) => height - bottom - ((height - top - bottom) * mm) / most;
    const parts = ticks(0, most, 3).flatMap((v) => level(y(v), left, width - right, String(v)));
    const [first, last] = neck?.length ? neck : [0, 0]; // distances count from both ends of the neck, else from the inlet
    const tick = (mm, v) => parts.push(text(x(mm), height - 9, String(v), { class: "tick middle" }));
    for (const v of ticks(0, Math.max(first, length - last), Math.max(4, width / 90))) {
      if (v <= first && (v || !neck?.length)) tick(first - v, v);
      if (v && last + v <= length) tick(last + v, v);
    }
    parts.push(text(4, 13, "Diameter, mm", { class: "axis-title" }));
    parts.push(text(width - right, 13, `${width > 480 ? "along the parent artery, " : ""}mm from the ${neck?.length ? "neck" : "inlet"}`, { class: "axis-title end" }));
    if (neck?.length) parts.push(svg("rect", { x: x(neck[0]), width: x(neck[1]) - x(neck[0]), y: top, height: height - top - bottom, class: "neck-zone" }));
    parts.push(svg("path", { d: path(axis.abscissa.map((s, i) => [x(s), y(axis.diameter[i])])), class: "line artery" }));
    if (device) parts.push(...this.device(device, x, y, height - bottom));
    if (cursor !== undefined) parts.push(svg("line", { x1: x(cursor), x2: x(cursor), y1: top, y2: height - bottom, class: "cursor" }));
    if (neck?.length) parts.push(text((x(neck[0]) + x(neck[1])) / 2, top + 11, "neck", { class: "tick middle neck-word" }));
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.svg.replaceChildren(...parts);
  }

  device({ profile, ends, bands }, x, y, floor) {
    const upper = profile.map(([s, d]) => [x(s), y(d)]);
    const area = `${path(upper)}L${x(ends[1])} ${floor}L${x(ends[0])} ${floor}Z`;
    return [
      svg("path", { d: area, class: "device-area" }),
      svg("path", { d: path(upper), class: "line device" }),
      ...ends.map((end, i) => svg("line", { x1: x(end), x2: x(end), y1: y(profile[i ? profile.length - 1 : 0][1]), y2: floor, class: "line device" })),
      ...bands.map(([low, high]) => svg("rect", { x: x(low), width: Math.max(x(high) - x(low), 2), y: floor - 5, height: 5, class: "band" })),
    ];
  }
}

/** Where a place on the parent axis is, from the nearer end of the neck. */
function besideNeck(mm, [first, last]) {
  if (mm < first) return `${(first - mm).toFixed(1)} mm proximal`;
  return mm > last ? `${(mm - last).toFixed(1)} mm distal` : "within it";
}

/** What a plane across the artery cuts, to scale, with its diameters. */
export class SectionChart {
  constructor() {
    this.svg = svg("svg", { class: "section", viewBox: "-4 -4 8 8", role: "img", "aria-label": "Section across the artery" });
    this.words = make("dl", { className: "section-words" });
    this.element = make("div", { className: "section-box" }, [this.svg, this.words]);
    this.element.append(chartButton("section", this.element));
  }

  show(section) {
    const half = Math.max(3.6, 1.1 * section.artery_diameter_mm);
    this.svg.setAttribute("viewBox", `${-half} ${-half} ${2 * half} ${2 * half}`);
    const pieces = (flat) => {
      let d = "";
      for (let i = 0; i < flat.length; i += 4) d += `M${flat[i]} ${-flat[i + 1]}L${flat[i + 2]} ${-flat[i + 3]}`;
      return d;
    };
    const parts = ["lumen", "landing"].map((name) => svg("path", { d: pieces(section[name]), class: `cut ${name}` }));
    for (const ring of section.rings || []) {
      const points = [];
      for (let i = 0; i < ring.length; i += 2) points.push(`${ring[i]} ${-ring[i + 1]}`);
      parts.push(svg("path", { d: `M${points.join("L")}`, class: "cut device" }));
    }
    const bar = half > 5 ? 2 : 1;
    parts.push(svg("path", { d: `M${-0.92 * half} ${0.92 * half}h${bar}`, class: "cut scale" }));
    const label = text(-0.92 * half, 0.86 * half, `${bar} mm`, { class: "scale-word" });
    label.style.fontSize = `${0.09 * half}px`;
    this.svg.replaceChildren(...parts, label);
    this.say(section);
  }

  say(section) {
    const rows = [
      this.neck?.length ? ["From the neck", besideNeck(section.abscissa_mm, this.neck)] : ["From the inlet", `${section.abscissa_mm.toFixed(1)} mm`],
      ["Artery", `⌀ ${section.artery_diameter_mm.toFixed(2)} mm`],
    ];
    if ("device_diameter_mm" in section) {
      rows.push(["Device", `⌀ ${section.device_diameter_mm.toFixed(2)} mm`]);
      rows.push(["Free device", `⌀ ${section.free_diameter_mm.toFixed(2)} mm`]);
      rows.push(["Largest gap", `${section.max_gap_mm.toFixed(2)} mm`]);
    }
    this.words.replaceChildren(...rows.flatMap(([name, value]) => [make("dt", {}, [name]), make("dd", {}, [value])]));
  }
}

/** Convergence error of a flow at its checks, one after the other, on a logarithmic scale. */
export function residualChart(points, tolerance = 0.01) {
  const [width, height, left, bottom, top] = [360, 150, 44, 22, 22];
  const x = (f) => left + (width - left - 8) * f;
  const low = Math.log10(0.004);
  const y = (v) => top + ((height - top - bottom) * (0 - Math.log10(Math.min(Math.max(v, 0.004), 1)))) / (0 - low);
  const parts = [1, 0.1, 0.01].flatMap((v) => level(y(v), left, width - 8, `${100 * v} %`, v === tolerance ? "goal" : "grid"));
  parts.push(text(4, 13, "Convergence error", { class: "axis-title" }), text(width - 8, 13, "goal 1 %", { class: "axis-title end" }));
  parts.push(text(x(0), height - 6, "start", { class: "tick" }), text(x(1), height - 6, "now", { class: "tick end" }));
  if (points.length) {
    parts.push(svg("path", { d: path(points.map(([, v], i) => [x(i / Math.max(points.length - 1, 1)), y(v)])), class: "line device" }));
    parts.push(svg("circle", { cx: x(points.length > 1), cy: y(points.at(-1)[1]), r: 3.5, class: "dot" }));
  }
  return svg("svg", { class: "chart small", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": "Residual" }, parts);
}

/** The pulse at the inlet, and the time that is shown: a click on a moment shows it, one beside the curve the mean. */
export function pulseChart({ time_s, factor }, isPulsatile, times, moment, chosen) {
  const [width, height, left, bottom, top] = [258, 128, 24, 26, 22];
  const high = 1.1 * Math.max(...factor);
  const x = (t) => left + ((width - left - 8) * t) / time_s.at(-1);
  const y = (f) => height - bottom - ((height - top - bottom) * f) / high;
  const parts = [0, 1].flatMap((v) => level(y(v), left, width - 8, String(v), v ? "goal" : "grid"));
  const shown = moment !== undefined && times.length ? `shown: ${times[moment].toFixed(2)} s` : times.length ? "shown: the cycle's mean" : isPulsatile ? "pulsatile" : "steady, at the mean";
  parts.push(text(0, 12, "Inflow / mean", { class: "axis-title" }), text(width - 42, 12, shown, { class: "axis-title end" }));
  for (const t of ticks(0, time_s.at(-1), 4)) parts.push(text(x(t), height - 8, `${t} s`, { class: "tick middle" }));
  parts.push(svg("path", { d: path(time_s.map((t, i) => [x(t), y(factor[i])])), class: isPulsatile ? "line device" : "line artery" }));
  const at = (t) => factor[Math.round((t / time_s.at(-1)) * (factor.length - 1))];
  times.forEach((t, k) => {
    const dot = svg("circle", { cx: x(t), cy: y(at(t)), r: k === moment ? 6 : 4, class: k === moment ? "dot moment now" : "dot moment", tabindex: 0, role: "button", "aria-label": `Show ${t.toFixed(2)} s` });
    dot.addEventListener("keydown", (event) => event.key === "Enter" && choose(k));
    parts.push(dot);
  });
  if (moment !== undefined && times.length) parts.push(svg("line", { x1: x(times[moment]), x2: x(times[moment]), y1: top, y2: height - bottom, class: "cursor" }));
  const chart = svg("svg", { class: "chart small", viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": "Inlet waveform" }, parts);
  // A click takes the nearest moment; on the one shown it goes back to the mean.
  const choose = (k) => chosen(k === moment ? undefined : k);
  chart.addEventListener("click", (event) => {
    const box = chart.getBoundingClientRect();
    const away = times.map((t) => Math.abs(x(t) - ((event.clientX - box.left) * width) / box.width));
    if (away.length) choose(away.indexOf(Math.min(...away)));
  });
  return chart;
}

/** Amounts of contrast over time, one line per flow and region, with the time of the film; a click chooses a time. */
export function curvesChart(curves, now, [width, height], title, chosen) {
  const [left, right, bottom] = [46, 14, 24];
  const [lines, signs] = [[[]], [...curves].reverse().map(({ name, region }) => ({ name, words: `${region === "sac" ? "—" : "┄"} ${title(name)}, ${region}` }))];
  const long = (line) => line.reduce((sum, { words }) => sum + 6.6 * words.length + 10, 0);
  for (const sign of signs) (long([...lines.at(-1), sign]) < width - left - 60 || !lines.at(-1).length ? lines.at(-1) : lines[lines.push([]) - 1]).push(sign);
  const top = 11 + 13 * lines.length;
  const last = Math.max(...curves.map(({ time_s }) => time_s.at(-1)));
  const most = 1.08 * Math.max(1e-9, ...curves.flatMap(({ values }) => values));
  const x = (t) => left + ((width - left - right) * t) / last;
  const y = (v) => height - bottom - ((height - top - bottom) * v) / most;
  const parts = ticks(0, most, 3).flatMap((v) => level(y(v), left, width - right, String(v)));
  for (const t of ticks(0, last, Math.max(4, width / 110))) parts.push(text(x(t), height - 7, `${t} s`, { class: "tick middle" }));
  parts.push(text(4, 13, curves[0].unit, { class: "axis-title" }));
  const names = [...new Set(curves.map(({ name }) => name))];
  for (const { name, region, time_s, values } of curves) {
    const style = `line curve flow-${names.indexOf(name)} ${region}`;
    parts.push(svg("path", { d: path(time_s.map((t, i) => [x(t), y(values[i])])), class: style }));
  }
  lines.forEach((line, k) => line.forEach(({ name, words }, i) => parts.push(text(width - right - long(line.slice(0, i)) - (k ? 34 : 0), 13 + 13 * k, words, { class: `tick end flow-${names.indexOf(name)}` }))));
  parts.push(svg("line", { x1: x(now), x2: x(now), y1: top, y2: height - bottom, class: "cursor" }));
  const chart = svg("svg", { class: "chart", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": "Contrast over time" }, parts);
  chart.addEventListener("click", (event) => chosen(((event.clientX - chart.getBoundingClientRect().left - left) / (width - left - right)) * last));
  return chart;
}
