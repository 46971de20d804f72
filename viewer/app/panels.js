// The left side: what each step is, what can be chosen in it, and its one main button.
import { button, make } from "../src/dom.js";
import { bandWords, placeWords } from "./numbers.js";
import { isOfDevice, isPlaced, JOINS, joined, signOf, withDevice } from "./treatments.js";

const MOST_IMPLANTS = 3;
const DENSITY = 0.25; // packing density of coils where none is chosen

/** Position of an opening, in the form of a study's settings. */
export const placeOf = ({ center_mm }) => center_mm.map((x) => Number(x.toFixed(2)));

/** What an opening is called: Inlet, Inlet 2, Outlet 1. */
export const spokenRole = (role) => role[0].toUpperCase() + role.slice(1).replace("_", " ");

const title = (words, text) => [make("h2", {}, [words]), make("p", { className: "lead" }, [text])];

/** A button that stands in a sentence. */
const link = (words, act) => button(words, act, { className: "link" });

/** What keeps a step from being done: its failure, a change since it was done; and the button that finds the vessel. */
function state(page) {
  const { failed, steps, job, has_anatomy, has_flow, wants_grid } = page.view;
  const isLost = ["flow", "report"].includes(page.step) && !has_flow;
  const words = isLost ? "The stored flow is missing, or of another version of vstent: run the flow again." : page.step === "image" ? "You have changed a setting since this vessel was found." : "You have changed an earlier step. What you see was computed before the change.";
  const isCurrent = ["image", "vessel", "sac"].every((step) => steps[step] === "done");
  const isFound = ["image", "vessel", "sac"].includes(page.step) && !job && !isCurrent && !wants_grid && !page.asksForAneurysm;
  return [
    ...(failed[page.step] && !page.asksForAneurysm ? [make("p", { className: "note failed", role: "alert" }, [failed[page.step]])] : []),
    ...(steps[page.step] === "stale" && !["device", "deploy"].includes(page.step) ? [make("p", { className: "note stale" }, [words])] : []),
    ...(isFound ? [main(has_anatomy ? "Find the vessel again" : "Find the vessel", () => page.start("anatomy"))] : []),
  ];
}

/** The question where no aneurysm was found, in place of what a step offers. */
function question(page) {
  const none = async () => {
    await page.choose({ without_aneurysm: true });
    page.start("anatomy");
  };
  const isHere = page.step === "sac";
  return make("div", { className: "note failed question", role: "alert" }, [
    make("h3", {}, ["No aneurysm found"]),
    make("p", {}, [isHere ? "Click on the vessel where it is, or go back to the image." : "No device is proposed or deployed until you have said where it is."]),
    ...(isHere ? [button("← Image", () => page.go("image"), { className: "wide" }), button("There is none: use the artery as it is", none, { className: "wide" })] : [button("Show where it is", () => page.go("sac"), { className: "wide" })]),
  ]);
}

/** A word where the vessel itself is out of date. */
function earlier(page) {
  const stale = ["image", "vessel", "sac"].find((step) => page.view.steps[step] === "stale");
  if (!stale || page.view.job) return [];
  return [make("p", { className: "note stale" }, ["The vessel shown is of an earlier choice. ", link("Find it again", () => page.start("anatomy"))])];
}

/** Further settings of the study that the case was opened from. */
function unseen(page) {
  const { unseen } = page.view;
  return unseen.length ? [make("p", { className: "note" }, [`As in the study that this case was opened from: ${unseen.join(", ")}.`])] : [];
}

const main = (words, act, disabled = false) => button(words, act, { className: "primary wide", disabled });

/** The way to another step: filled where nothing else is to be done first. */
const next = (page, step, words) => button(words, () => page.go(step), { className: "wide next" });

/** An input or a list with its label and unit; `key` finds it again when it is drawn anew. */
function field(key, label, unit, input, className = "field") {
  input.id = `field-${key}`;
  input.dataset.key = key;
  return make("label", { className, htmlFor: input.id }, [make("span", {}, label), input, make("small", {}, [unit])]);
}

function number(key, label, unit, value, changed, { placeholder = "", step = "any", min = "", usual = "proposed" } = {}) {
  const input = make("input", { type: "number", value: value ?? "", placeholder, step, min, onChange: () => changed(input.value === "" ? null : Number(input.value)) });
  const mark = value === null || value === undefined ? [make("em", { className: "proposed" }, [usual])] : [];
  return field(key, [label, ...mark], unit, input);
}

/** A proposed value, to be seen where none is chosen. */
const proposal = (value, digits) => value?.toFixed(digits) ?? "";

function words(key, label, unit, values, placeholder, changed) {
  const input = make("input", { type: "text", value: values?.join(" ") ?? "", placeholder, onChange: () => changed(input.value) });
  return field(key, [label], unit, input, "field three");
}

function select(key, label, value, options, changed) {
  const items = options.map(([id, words]) => make("option", { value: id, selected: String(id) === String(value) }, [words]));
  const box = make("select", { onChange: () => changed(box.value) }, items);
  return field(key, [label], "", box);
}

/** Buttons of which one is pressed: [id, words] each. */
function tabs(label, shown, options, show, className = "tabs") {
  return make("div", { className, role: "group", ariaLabel: label }, options.map(([id, words]) => button(words, () => show(id), { ariaPressed: String(id === shown) })));
}

/** Notes on the vessel, folded. */
function notes(page) {
  const all = page.anatomy?.notes || [];
  const list = make("ul", { className: "notes" }, all.map((note) => make("li", {}, [note])));
  return all.length ? [make("details", {}, [make("summary", {}, ["Notes: found, assumed or repaired"]), list])] : [];
}

/** The points that are given under a key: none, one, or several. */
function points(page, key) {
  const given = page.view.choices[key] ?? [];
  return typeof given[0] === "number" ? [given] : given;
}

/** What was given by hand, with a button that leaves it to be proposed. */
function given(page, key, words) {
  return make("div", { className: "given" }, [make("span", {}, [words]), link("Propose again", () => page.choose({ [key]: null }))]);
}

function point(page, key, label) {
  const places = points(page, key).map((place) => place.map((x) => x.toFixed(1)).join(", "));
  return places.length ? [given(page, key, `${label}: ${places.join("; ")} mm`)] : [];
}

/** The least value of a setting of the flow, as the server states it. */
const leastOf = ({ fields }, key) => fields[key]?.minimum ?? fields[key]?.exclusiveMinimum;

/** What is known of how much devices straighten arteries; others are stated on the command line. */
const STRAIGHTENINGS = [["off", "rigid"], ["immediate", "straightened at implantation"], ["six_months", "straightened after six months"]];
/** How an outlet condition is called where its name in the settings does not say it. */
const OUTLETS = { murray: "split by r³ (Murray)" };

export const panels = {
  image(page) {
    const parts = [...title("Image", page.view.is_scan ? "Voxels brighter than the threshold are the lumen." : "This case began with a surface, so there is no scan to show.")];
    if (page.view.wants_grid || page.view.choices.spacing_mm) parts.push(...grid(page));
    if (page.view.is_scan && page.scan) parts.push(...threshold(page));
    if (!page.view.is_scan) {
      parts.push(select("units", "Length unit", page.view.choices.units ?? "", [["", "derived from the size"], ["mm", "mm"], ["cm", "cm"], ["m", "m"]], (unit) => page.choose({ units: unit || null })));
      parts.push(select("frame", "Frame of the file", page.view.choices.frame ?? "", [["", "as stated, else LPS"], ["lps", "LPS (DICOM)"], ["ras", "RAS (3D Slicer)"]], (frame) => page.choose({ frame: frame || null })));
    }
    parts.push(...point(page, "at_mm", "Seed"), ...state(page), ...notes(page));
    if (page.view.steps.image === "done") parts.push(next(page, "vessel", "Vessel →"));
    return parts;
  },

  vessel(page) {
    const parts = [...title("Vessel", `Blood enters through the inlet: click another opening to change it, tick those that bring blood as well.${page.anatomy?.neck.length ? " Drag the handles on the artery to keep less of it." : ""}`)];
    if (page.anatomy) parts.push(openings(page));
    if (page.anatomy?.neck.length) parts.push(...kept(page));
    parts.push(...point(page, "inlet_mm", "Inlet near"), ...state(page), ...notes(page));
    if (page.view.steps.vessel === "done") parts.push(next(page, "sac", "Sac and parent →"));
    return parts;
  },

  sac(page) {
    const lead = page.view.choices.without_aneurysm ? "A device opens against the parent artery (sand)." : "The sac (red) is taken off along its neck; the artery beneath it (sand) is what a device opens against. Drag the points on the neck to draw it anew; click a sac to choose it.";
    const parts = title("Sac and parent", page.asksForAneurysm ? "No device is proposed or deployed until you have said where the aneurysm is." : lead);
    if (page.asksForAneurysm) parts.push(question(page));
    if (page.view.choices.without_aneurysm) parts.push(make("div", { className: "given" }, [make("span", {}, ["The artery has no aneurysm."]), link("Ask again", () => page.choose({ without_aneurysm: false }))]));
    if (page.anatomy) parts.push(parentOutlet(page));
    if (page.anatomy?.drawn.curve_mm.length) parts.push(make("div", { className: "place" }, page.neckPlace), ...(page.view.choices.neck_mm ? [given(page, "neck_mm", "The neck was drawn by hand.")] : []));
    parts.push(...point(page, "at_mm", "Seed"), ...state(page), ...notes(page));
    if (page.view.steps.sac === "done") parts.push(next(page, "device", "Treatment →"));
    return parts;
  },

  device(page) {
    const { job, choices, has_ranking } = page.view;
    if (page.asksForAneurysm) return [...title("Treatment", "Which devices and sizes suit this artery."), question(page)];
    const chosen = choices.treatments;
    const parts = [...title("Treatment", "Choose up to three treatments to compare: one device, or several."), ...earlier(page)];
    const designOf = (treatment) => isOfDevice(treatment) && page.catalogue.find(({ key }) => key === treatment.name);
    const rows = (treatment) => (designOf(treatment) ? deviceRows(page, designOf(treatment), treatment) : treatmentRows(page, treatment));
    if (chosen.length) parts.push(make("div", { className: "devices chosen" }, chosen.flatMap(rows)));
    parts.push(...catalogueParts(page));
    const isRanked = chosen.some(({ implants }) => implants.some(({ device }) => page.names.isStent(device)));
    parts.push(...state(page), ...(isRanked ? flowsOfRanking(page) : []));
    if (!job) parts.push(button(has_ranking ? "Rank all sizes again" : "Rank all sizes", () => page.start("rank"), { className: "wide", disabled: !page.view.has_anatomy || !isRanked }));
    if (chosen.length && !isRanked) parts.push(make("p", { className: "hint" }, ["Sizes of baskets and coils are not ranked."]));
    parts.push(next(page, "deploy", "Deploy →"));
    return parts;
  },

  deploy(page) {
    const { treatment, implant } = page;
    if (page.asksForAneurysm) return [...title("Deploy", "A device in the artery."), question(page)];
    const [isBasket, isCoils] = ["basket", "coils"].map((use) => implant && page.names.isFor(implant.device, use));
    const lead = isCoils ? "Coils enter the sac one after the other, and lie outside the stents. Placing them takes about a minute." : isBasket ? "Drag the lower end up into the sac or down. A basket that the sac compresses becomes taller, because the wires cannot stretch." : "Drag either end along the artery. The deployed length follows, because the wires cannot stretch.";
    const parts = [...title("Deploy", lead), ...earlier(page)];
    if (!treatment) return [...parts, make("p", { className: "note" }, ["Choose a treatment first."]), next(page, "device", "← Treatment")];
    const isHere = (told) => told?.treatment === treatment.name && told.implant === implant.id;
    parts.push(...shownTabs(page), ...(isCoils ? packing(page) : sizes(page)));
    if (page.missing === treatment.name && !page.view.job) parts.push(main("Place the coils", () => page.start("place"), !page.view.has_anatomy));
    const colour = "Colour of the wires";
    parts.push(
      make("div", { className: "place" }, page.undeployed ? [make("p", { className: "note failed", role: "alert" }, [page.undeployed])] : isHere(page.place) ? placeWords(page.place, isHere(page.bands) ? page.bands : null, page.anatomy.neck) : [make("p", { className: "hint", role: "status" }, ["The device is being deployed …"])]),
      select("straightening", "Artery", page.view.choices.straightening, STRAIGHTENINGS, (value) => page.choose({ straightening: value })),
      make("p", { className: "hint yielding" }, [isHere(page.place) ? (page.place.straightening ?? "") : ""]),
      make("div", { className: "bands" }, isHere(page.bands) ? bandWords(page.bands) : []),
      make("div", { className: "label" }, [colour]),
      tabs(colour, page.colour, [["wall_gap", "Wall gap"], ["coverage", "Coverage"], ["diameter", "Diameter"]], (id) => page.show({ colour: id })),
      button("▶ Play the expansion", () => page.playExpansion()),
    );
    if (page.anatomy?.neck?.length) parts.push(page.flowing.element);
    parts.push(make("p", { className: "advice" }, [page.advice && isHere(page.place) ? page.advice : ""]), ...state(page));
    parts.push(make("a", { className: "button wide", href: `${page.path}/plan.pdf`, target: "_blank", rel: "noopener" }, ["Plan to print (PDF)"]));
    parts.push(next(page, "flow", "Flow →"));
    return parts;
  },

  flow(page) {
    const { choices, job, steps } = page.view;
    const { flow } = choices;
    if (page.asksForAneurysm) return [...title("Blood flow", "The flow without a device, then with each."), question(page)];
    const parts = [...title("Blood flow", "The flow without a device, then with each. All pictures share one camera and one scale.")];
    parts.push(
      number("inflow", "Mean inflow", "mL/s", flow.inflow_mL_s, (value) => page.chooseFlow({ inflow_mL_s: value }), { min: leastOf(page, "inflow_mL_s"), placeholder: proposal(page.proposed?.inflow_mL_s, 2), usual: "assumed" }),
      ...inflowWords(page),
      number("cell", "Grid spacing", "mm", flow.cell_size_mm, (value) => page.chooseFlow({ cell_size_mm: value }), { min: leastOf(page, "cell_size_mm"), step: 0.01, placeholder: proposal(page.proposed?.cell_size_mm, 3) }),
      select("pulse", "Inlet", flow.is_pulsatile ? "1" : "", [["", "steady, at the mean"], ["1", "pulse of the carotid"]], (value) => page.chooseFlow({ is_pulsatile: Boolean(value) })),
      select("straightening", "Artery", page.view.choices.straightening, STRAIGHTENINGS, (value) => page.choose({ straightening: value })),
      select("outlets", "Outlets", flow.outlets, (page.fields.outlets?.enum ?? [flow.outlets]).map((word) => [word, OUTLETS[word] ?? word.replaceAll("_", " ")]), (value) => page.chooseFlow({ outlets: value })),
    );
    parts.push(page.pulseChart(), ...unseen(page), ...state(page));
    const isDone = steps.flow === "done";
    const run = () => page.start("flow");
    if (!job && !isDone && page.proposed?.cost) parts.push(make("p", { className: "hint" }, [page.proposed.cost]));
    if (!job && isDone) parts.push(button("Run again", run, { className: "wide", disabled: !page.treatment }));
    else if (!job) parts.push(main("Run the flow", run, !page.view.has_anatomy || !page.treatment));
    if (page.flowPanes?.length) parts.push(modes(page), ...depth(page), ...films(page));
    if (page.view.has_report && steps.report === "done") parts.push(next(page, "report", "Report →"));
    return parts;
  },

  report(page) {
    const parts = [...title("Report", "One file with a 3-D view, pictures, every metric with its definition, and the method. It needs no network.")];
    const { choices, has_flow, has_pdf, has_report, job, steps } = page.view;
    const file = (name, words, isMain) => make("a", { className: `button wide ${isMain ? "primary" : ""}`, href: `${page.path}/files/${name}`, target: "_blank", rel: "noopener" }, [words]);
    parts.push(...state(page));
    if (has_report) parts.push(file("report.html", "Open the report", true));
    if (has_pdf) parts.push(file("report.pdf", "Report to print (PDF)"));
    if (has_report) parts.push(file("metrics.json", "Metrics (JSON)"), file("run.json", "Settings and versions (JSON)"));
    if (has_flow) {
      const options = [["", "off"], ...[16, 32, 64].map((n) => [String(n), `${n} deployments`])];
      const asked = (count) => page.choose({ uncertainty_samples: count ? Number(count) : null });
      parts.push(select("sure", "Uncertainty", choices.uncertainty_samples ?? "", options, asked));
      parts.push(make("p", { className: "hint" }, ["Deploys every device many times with varied threshold, landing and device diameter. The report then shows a 95 % interval for each result and its main causes. Baskets are not varied, and of several devices only a stent with coils is."]));
      if (steps.report !== "done" && steps.flow === "done" && !job) parts.push(main("Write the report again", () => page.start("flow")));
    }
    if (steps.flow !== "done" && job?.kind !== "angiogram") {
      parts.push(make("p", { className: "note" }, ["The report is written when the flow has been computed."]), next(page, "flow", "← Flow"));
    }
    parts.push(make("p", { className: "hint" }, [`The files are in ${page.view.folder}.`]));
    return parts;
  },
};

/** How many of the best sizes get a flow when they are ranked. */
function flowsOfRanking(page) {
  if (!page.anatomy?.neck?.length) return [];
  const options = [["", "no size"], ...[2, 4, 6, 12].map((n) => [String(n), `the best ${n} sizes`])];
  const hint = "The best size of each device is among them. The changes of neck inflow, sac velocity and wall shear stress join the table. Finished flows are kept: a cancelled ranking goes on when it is started again.";
  return [
    select("rank-flows", "Flow of", page.view.choices.ranking_flows ?? "", options, (count) => page.choose({ ranking_flows: count ? Number(count) : null })),
    ...(page.view.choices.ranking_flows ? [make("p", { className: "hint" }, [hint])] : []),
  ];
}

/** How many and how large the voxels are, where the file has no header that tells. */
function grid(page) {
  const { shape, spacing_mm } = page.view.choices;
  const chosen = (key, isFine) => (words) => {
    const given = words.split(/[\s,;×x]+/).filter(Boolean).map(Number);
    const three = given.length === 1 ? [given[0], given[0], given[0]] : given;
    if (three.length === 3 && three.every(isFine)) page.choose({ [key]: three });
    else page.tell("Give three numbers, or one for all three.", "problem");
  };
  return [
    make("p", { className: "hint" }, ["This file has no header. Give the number and the spacing of its voxels along x, y and z; x runs fastest."]),
    words("shape", "Voxels", "", shape, "256 256 256", chosen("shape", (n) => Number.isInteger(n) && n > 0)),
    words("spacing_mm", "Spacing", "mm", spacing_mm, "0.3 0.3 0.3", chosen("spacing_mm", (mm) => mm > 0)),
  ];
}

function threshold(page) {
  const { scan, view } = page;
  const value = view.choices.threshold ?? scan.proposed_threshold;
  const size = `${scan.shape.join(" × ")} voxels of ${scan.spacing_mm.map((x) => x.toFixed(2)).join(" × ")} mm.`;
  const [low, high] = scan.range;
  if (value === undefined) return [make("p", { className: "hint", role: "status" }, ["The threshold is being proposed …"]), make("p", { className: "hint" }, [size])];
  const shown = make("b", {}, [value.toFixed(0)]);
  const onInput = () => {
    shown.textContent = Number(slider.value).toFixed(0);
    page.imaging.showThreshold(Number(slider.value));
  };
  // Keys change it step by step: it is chosen when they rest.
  let timer;
  const onChange = () => {
    clearTimeout(timer);
    timer = setTimeout(() => page.choose({ threshold: Number(slider.value) }), 250);
  };
  const slider = make("input", { type: "range", min: low, max: high, step: (high - low) / 500, value, id: "field-threshold", data: { key: "threshold" }, onInput, onChange });
  const parts = [make("label", { className: "slider", htmlFor: "field-threshold" }, [make("span", {}, ["Threshold ", shown]), slider])];
  if (view.choices.threshold !== null && scan.proposed_threshold !== undefined) {
    const reset = () => {
      page.choose({ threshold: null });
      page.imaging.showThreshold(scan.proposed_threshold);
    };
    parts.push(link(`Back to the proposed ${scan.proposed_threshold.toFixed(0)}`, reset));
  }
  parts.push(make("p", { className: "hint" }, [size]));
  const keys = [["Wheel", "next slice"], ["Ctrl + wheel", "zoom"], ["Shift + drag", "move the picture"], ["Right button", "window and level"], ["Double click", "one slice alone"]];
  parts.push(make("dl", { className: "keys" }, keys.flatMap(([key, what]) => [make("dt", {}, [key]), make("dd", {}, [what])])));
  return parts;
}

function openings(page) {
  const entered = inlets(page);
  const rows = page.anatomy.openings.flatMap((opening) => {
    const { role, area_mm2, diameter_mm, colour } = opening;
    const isFirst = opening === entered[0];
    const onChange = () => {
      const others = entered.filter((one) => one !== opening);
      page.choose({ inlet_mm: (box.checked ? [...others, opening] : others).map(placeOf) });
    };
    const box = make("input", { type: "checkbox", checked: entered.includes(opening), disabled: isFirst, title: "Blood enters here", ariaLabel: `${spokenRole(role)}: blood enters here`, data: { key: `brings-${role}` }, onChange });
    const row = make("button", { type: "button", className: `opening-row ${isFirst ? "inlet" : ""}`, onClick: () => !isFirst && page.choose({ inlet_mm: placeOf(opening) }) }, [
      make("i", { className: "dot", style: { background: `rgb(${colour})` } }),
      make("span", {}, [spokenRole(role)]),
      make("b", {}, [`${area_mm2.toFixed(1)} mm²`]),
      make("small", {}, [`⌀ ${diameter_mm.toFixed(1)} mm`]),
    ]);
    return [row, make("label", { className: "brings" }, [box])];
  });
  return make("div", { className: "openings" }, rows);
}

/** The openings through which blood is to enter, first that of the parent artery: as they are given, or were found. */
function inlets(page) {
  const { openings } = page.anatomy;
  const given = points(page, "inlet_mm").map((point) => nearest(openings, point));
  return given.length ? given : openings.filter(({ role }) => role.startsWith("inlet"));
}

const nearest = (openings, point) => openings.map((one) => [Math.hypot(...one.center_mm.map((x, i) => x - point[i])), one]).sort(([a], [b]) => a - b)[0]?.[1];

/** How much of the vessel is kept beside the sac. */
function kept(page) {
  const { upstream_mm, downstream_mm } = page.view.choices;
  const most = { upstream_mm: 35, downstream_mm: 25 }; // what a study keeps, if the artery is that long
  const length = (key, words, value) => number(key, words, "mm", value, (mm) => page.choose({ [key]: mm }), { min: 1, placeholder: proposal(Math.min(most[key], page.trimming.most(key)), 1) });
  return [length("upstream_mm", "Before sac", upstream_mm), length("downstream_mm", "Beyond sac", downstream_mm), make("p", { className: "hint" }, ["Lengths of vessel that are kept; every branch is cut as far beyond the sac."])];
}

/** The outlet to which the parent artery leads: as it was given, or found. */
function parentOutlet(page) {
  const { openings, axis } = page.anatomy;
  const given = page.view.choices.outlet_mm;
  const ends = openings.filter(({ role }) => role !== "inlet");
  const found = nearest(ends, axis.points.slice(-3))?.role;
  const outlets = ends.map(({ role, diameter_mm }) => [role, `${role.replace("_", " ")} (⌀ ${diameter_mm.toFixed(1)} mm)`]);
  const chosen = (role) => {
    const opening = openings.find((one) => one.role === role);
    page.choose({ outlet_mm: opening ? placeOf(opening) : null });
  };
  const proposed = found && !given ? `${found.replace("_", " ")} (proposed)` : "proposed";
  return select("outlet", "Parent leads to", (given && nearest(ends, given)?.role) || "", [["", proposed], ...outlets], chosen);
}

/** Tick or untick a treatment. */
function treatmentTick(page, key, treatment, isChosen) {
  const onChange = () => {
    const others = (treatments) => treatments.filter(({ name }) => name !== treatment.name);
    page.choose(({ treatments }) => ({ treatments: box.checked ? [...others(treatments), treatment] : others(treatments) }));
  };
  const box = make("input", { type: "checkbox", checked: isChosen, disabled: !isChosen && page.view.choices.treatments.length >= 3, data: { key: `device-${key}` }, onChange });
  return box;
}

/** What devices are for, as the catalogue names it, and the heading above them. */
const USES = { "flow diverter": "Flow diverters", "stent for coils": "Stents for coils", basket: "Baskets for the sac", coils: "Coils for the sac" };

/** The devices that are not chosen yet, by what they are for, and a box that searches them by name, maker and use. */
function catalogueParts(page) {
  const isChosen = ({ key }) => page.view.choices.treatments.some((treatment) => treatment.name === key && isOfDevice(treatment));
  const found = (design, use) => design.use === use && !isChosen(design) && `${design.name} ${design.maker} ${use}`.toLowerCase().includes((page.memory.find ?? "").toLowerCase());
  const groups = Object.entries(USES).map(([use, words]) => [words, page.catalogue.filter((design) => found(design, use))]).filter(([, designs]) => designs.length);
  const rows = groups.flatMap(([words, designs]) => [make("h3", {}, [words]), ...designs.flatMap((design) => deviceRows(page, design))]);
  const find = make("input", { type: "search", className: "find", value: page.memory.find ?? "", placeholder: "Search devices", ariaLabel: "Search devices", data: { key: "find" }, onInput: () => ((page.memory.find = find.value), page.render()) });
  return [find, make("div", { className: "devices catalogue", tabIndex: 0, role: "region", ariaLabel: "Devices" }, rows.length ? rows : [make("p", { className: "hint" }, ["No device has this in its name, maker or use."])])];
}

const percent = (fraction) => `${Number((100 * (fraction ?? DENSITY)).toFixed(1))} %`;
const coilWords = ([loops_mm, length_mm]) => `${loops_mm} mm × ${length_mm / 10} cm`;

/** The size of an implant, in words: of coils their packing density, or the sizes of those that are given. */
function sizeWords(page, { device, diameter_mm, length_mm, density_fraction, coils, seed }) {
  if (!page.names.isFor(device, "coils")) return diameter_mm ? `${diameter_mm} × ${length_mm} mm` : "proposed";
  return [coils?.length ? coils.map(coilWords).join(", ") : percent(density_fraction), ...(seed ? [`seed ${seed}`] : [])].join(", ");
}

/** Put other implants in place of those that a treatment has when it is the turn of this choice. */
function rebuild(page, treatment, change, sign = signOf(treatment)) {
  const build = ({ implants }) => joined(change(implants), sign);
  const built = build(treatment);
  const isThere = page.view.choices.treatments.some(({ name }) => name === built.name && name !== treatment.name);
  if (isThere) page.tell(`${page.names.treatment(built.name)} is already in the list.`);
  else page.choose(({ treatments }) => ({ treatments: treatments.map((one) => (one.name === treatment.name ? build(one) : one)) }));
  page.render();
}

/** Whether devices of a treatment can be added, moved and removed. */
const canBuild = (page, treatment) => signOf(treatment) && treatment.implants.every(({ device }) => page.names.isStent(device));

/** The outlets of the artery by name. */
const outletsOf = (page) => (page.anatomy?.openings ?? []).map(({ role }) => role).filter((role) => role.startsWith("outlet"));

/** How the stents of a treatment are joined, where the artery divides. */
function joining(page, treatment) {
  const { implants } = treatment;
  const outlets = outletsOf(page);
  if (!canBuild(page, treatment) || implants.length < 2 || outlets.length < implants.length) return [];
  const change = (sign) => {
    const isApart = sign !== "|" || new Set(implants.map(({ placing }) => placing.path)).size === implants.length;
    rebuild(page, treatment, (now) => (isApart ? now : now.map((implant, i) => ({ ...implant, placing: { path: outlets[i] } }))), sign);
  };
  return [select(`join-${treatment.name}`, "Deployed", signOf(treatment), Object.entries(JOINS).map(([sign, [words]]) => [sign, words]), change)];
}

/** A list of the devices that can be added to a treatment: stents, and at last coils. */
function adding(page, treatment) {
  const { implants } = treatment;
  if (!canBuild(page, treatment) || implants.length >= MOST_IMPLANTS) return [];
  const options = page.catalogue.filter(({ use }) => use !== "basket" && (use !== "coils" || signOf(treatment) === "+")).map(({ key, name }) => make("option", { value: key }, [name]));
  const add = () => rebuild(page, treatment, (now) => [...now, ...withDevice(box.value).implants.map((implant) => ({ ...implant, placing: {} }))]);
  // By arrow keys and letters each device on the way is selected: then Enter adds.
  const onKeyDown = ({ key }) => {
    box.dataset.isKeyed = "yes";
    if (key === "Enter" && box.value) add();
  };
  const words = `Add a device to ${page.names.treatment(treatment.name)}`;
  const first = make("option", { value: "" }, ["+ Add a device"]);
  const handlers = { onChange: () => box.dataset.isKeyed || add(), onKeyDown, onPointerDown: () => delete box.dataset.isKeyed };
  const box = make("select", { className: "inside", title: "By keys: select, then Enter", ariaLabel: words, data: { key: `inside-${treatment.name}` }, ...handlers }, [first, ...options]);
  return [make("div", { className: "implant" }, [box])];
}

/** A treatment of several devices, or one as the study that the case was opened from had it: its devices in order. */
function treatmentRows(page, treatment) {
  const { name, implants } = treatment;
  const isCoils = ({ device }) => page.names.isFor(device, "coils");
  const canChange = signOf(treatment) && implants.length > 1;
  const swapped = (i, j) => (now) => now.map((_, k) => now[k === i ? j : k === j ? i : k]);
  const act = (sign, words, id, changed) => button(sign, () => rebuild(page, treatment, changed), { className: "icon", title: `${words} ${page.names.implant(name, id)}`, ariaLabel: `${words} ${page.names.implant(name, id)}` });
  const row = ({ id, ...implant }, i) => {
    const acts = [
      ...(i && !isCoils(implant) ? [act("↑", "Deploy earlier:", id, swapped(i - 1, i))] : []),
      ...(i < implants.length - 1 && !isCoils(implants[i + 1]) ? [act("↓", "Deploy later:", id, swapped(i, i + 1))] : []),
      act("×", "Remove", id, (now) => now.filter((_, k) => k !== i)),
    ];
    return make("div", { className: "implant" }, [make("span", {}, [page.names.implant(name, id), " ", make("small", {}, [sizeWords(page, implant)])]), ...(canChange ? acts : [])]);
  };
  const head = make("label", { className: "device", title: `In files and commands: ${name}` }, [treatmentTick(page, name, treatment, true), make("span", {}, [make("b", {}, [page.names.treatment(name)])])]);
  return [head, ...implants.map(row), ...joining(page, treatment), ...adding(page, treatment)];
}

/** A device of the catalogue: with its size where a treatment is of this device alone, else with how many of its numbers are cited. */
function deviceRows(page, design, treatment) {
  const device = treatment?.implants[0];
  const sure = `${design.n_cited} of ${design.n_facts} numbers are cited from a source`;
  const isCoils = design.use === "coils";
  const size = device?.diameter_mm || isCoils ? sizeWords(page, device ?? { device: design.key }) : page.proposed?.sizes[design.key]?.replace(" x ", " × ") ?? "";
  const mark = device ? [size, ...(device.diameter_mm || isCoils ? [] : [make("small", {}, ["proposed"])])] : [make("small", { className: "cited" }, [`${design.n_cited}/${design.n_facts} cited`])];
  const row = make("label", { className: "device", title: `${design.maker}, ${design.sizes.length} sizes; ${sure}` }, [
    treatmentTick(page, design.key, treatment ?? withDevice(design.key), Boolean(treatment)),
    make("span", {}, [make("b", {}, [design.name]), make("small", {}, [design.maker])]),
    make("em", {}, mark),
  ]);
  return [row, ...(treatment ? adding(page, treatment) : [])];
}

/** The treatments, and the implants of the one in view where it has several. */
function shownTabs(page) {
  const { treatment, implant } = page;
  const names = page.view.choices.treatments.map(({ name }) => [name, page.names.treatment(name)]);
  const ids = treatment.implants.map(({ id }) => [id, page.names.implant(treatment.name, id)]);
  return [
    tabs("Treatment", treatment.name, names, (name) => page.show({ active: name })),
    ...(ids.length > 1 ? [tabs("Implant", implant.id, ids, (id) => page.show({ activeImplant: id }))] : []),
  ];
}

function sizes(page) {
  const { treatment, implant: device } = page;
  const design = page.catalogue.find(({ key }) => key === device.device);
  const isHere = page.place?.treatment === treatment.name && page.place.implant === device.id;
  const proposed = isHere ? page.place.size.match(/([\d.]+) x ([\d.]+)/) : null;
  const now = [device.diameter_mm ?? Number(proposed?.[1] ?? 0), device.length_mm ?? Number(proposed?.[2] ?? 0)];
  const options = design.sizes.map(([d, l]) => [`${d},${l}`, `${d.toFixed(2)} × ${l} mm`]);
  const value = device.diameter_mm ? now.join(",") : "";
  const words = proposed ? `${now[0].toFixed(2)} × ${now[1]} mm (proposed)` : "proposed";
  const change = (text) => {
    const [diameter_mm, length_mm] = text ? text.split(",").map(Number) : [null, null];
    page.changeImplant(treatment.name, device.id, { diameter_mm, length_mm });
  };
  const again = page.names.isFor(device.device, "basket") ? "Put it on the neck again" : "Center it on the neck again";
  const recenter = link(again, () => page.choose(page.moved(treatment.name, device.id, null)));
  return [select("size", "Size", value, [["", words], ...options], change), ...(page.names.isStent(device.device) ? paths(page) : []), ...(isPlaced(device) ? [recenter] : [])];
}

/** How coils fill the sac: their packing density, or the coils that are given one by one; and the seed. */
function packing(page) {
  const { treatment, implant } = page;
  const { coils, density_fraction, seed } = implant;
  const design = page.catalogue.find(({ key }) => key === implant.device);
  const change = (changes) => page.changeImplant(treatment.name, implant.id, changes);
  const shown = make("b", {}, [percent(density_fraction)]);
  let timer;
  const onInput = () => (shown.textContent = `${slider.value} %`);
  const onChange = () => {
    clearTimeout(timer);
    timer = setTimeout(() => change({ density_fraction: slider.value / 100 }), 250);
  };
  const slider = make("input", { type: "range", min: 5, max: 40, step: 1, value: 100 * (density_fraction ?? DENSITY), id: "field-density", data: { key: "density" }, onInput, onChange });
  const density = make("label", { className: "slider", htmlFor: "field-density" }, [make("span", {}, ["Packing density ", shown]), slider]);
  const row = (size, i) => make("div", { className: "given" }, [make("span", {}, [`${i + 1}. ${coilWords(size)}`]), link("Remove", () => change({ coils: coils.filter((_, k) => k !== i) }))]);
  const sizesOf = design.sizes.map((size) => [size.join(","), coilWords(size)]);
  const add = (text) => change({ density_fraction: null, coils: [...coils, text.split(",").map(Number)] });
  return [
    ...(coils.length ? coils.map(row) : [density]),
    select("coil", coils.length ? "Then" : "Or coil by coil", "", [["", "+ Add a coil"], ...sizesOf], add),
    number("seed", "Seed", "", seed, (value) => change({ seed: value ?? 0 }), { min: 0, step: 1 }),
  ];
}

/** The path on which the stent in view lies, where the artery divides. */
function paths(page) {
  const { treatment, implant } = page;
  const outlets = outletsOf(page);
  if (outlets.length < 2) return [];
  const pairs = outlets.flatMap((one, i) => outlets.slice(i + 1).map((other) => [one, other]));
  const spoken = (role) => role.replace("_", " ");
  const { beside } = implant.placing; // the paths of stents side by side with it
  const ways = [["parent", "parent artery"], ...outlets.map((role) => [role, `inlet to ${spoken(role)}`]), ...pairs.map((pair) => [pair.join(">"), pair.map(spoken).join(" to ")])];
  const options = beside.length ? ways.filter(([role]) => outlets.includes(role) && !beside.includes(role)) : ways;
  const moved = (path) => (now) => now.map((one) => (one.id === implant.id ? { ...one, placing: { path } } : one));
  const change = (path) => (beside.length ? rebuild(page, treatment, moved(path)) : page.changeImplant(treatment.name, implant.id, { placing: { path } }));
  return [select("path", "Path", implant.placing.path, options, change)];
}

/** The angiogram: what is chosen for its films, or the button that computes it. */
function films(page) {
  const { has_angiogram, job, steps } = page.view;
  if (page.memory.mode !== "angiogram") return [];
  if (has_angiogram) return page.films.controls();
  if (job) return [];
  const isOff = steps.flow !== "done";
  return [
    make("p", { className: "hint" }, ["Contrast agent is carried through every flow, and filmed as on an angiography unit."]),
    main("Compute the angiogram", () => page.start("angiogram"), isOff),
  ];
}

/** The mean inflow in mL/min, and where it comes from if it is not given. */
function inflowWords({ proposed, view }) {
  const given = view.choices.flow.inflow_mL_s;
  const flow = given ?? proposed?.inflow_mL_s;
  return flow ? [make("p", { className: "hint" }, [`${(60 * flow).toFixed(0)} mL/min${given ? "" : `, ${proposed.inflow_source}`}`])] : [];
}

/** Where the slice lies, across the profile. */
function depth(page) {
  if (page.memory.mode !== "slice") return [];
  const value = page.memory.cut ?? 0;
  const words = make("b", {}, [`${value.toFixed(1)} mm`]);
  const onInput = () => {
    page.memory.cut = Number(slider.value);
    words.textContent = `${page.memory.cut.toFixed(1)} mm`.replace("-", "−");
    page.askSlice();
  };
  const slider = make("input", { type: "range", min: -6, max: 6, step: 0.2, value, id: "field-cut", data: { key: "cut" }, onInput });
  return [make("label", { className: "slider", htmlFor: "field-cut" }, [make("span", {}, [`Slice from the ${page.anatomy?.neck.length ? "sac" : "artery"}'s middle `, words]), slider])];
}

const MODES = [["streamlines", "Streamlines"], ["slice", "Slice"], ["shear", "Wall shear stress"], ["sac_shear", "Shear stress, sac"], ["angiogram", "Angiogram"]];

function modes(page) {
  const show = (id) => {
    page.memory.mode = id;
    page.memory.flow = {};
    page.render();
  };
  const modes = MODES.filter(([id]) => id !== "sac_shear" || page.anatomy?.neck.length);
  return tabs("Show", page.memory.mode || "streamlines", modes, show, "tabs modes");
}
