// The page: seven steps from a scan to a report, the scene in the middle, the numbers beside it.
import { button, make, spoken } from "../src/dom.js";
import { drop, get, getBinary, Newest, post, put } from "./api.js";
import { Axis } from "./axis.js";
import { inWords } from "./carm.js";
import { AlongChart, pulseChart, residualChart, SectionChart } from "./charts.js";
import { Deploying } from "./deploy.js";
import { chartButton } from "./exporting.js";
import { Films } from "./films.js";
import { Flowing } from "./flowing.js";
import { Imaging } from "./imaging.js";
import { sacMarks } from "./labels.js";
import { Neck } from "./neck.js";
import { bandWords, changeSheet, neckWords, placeWords, plainSheet, qualitySheet, rankedSheet, sureSheet } from "./numbers.js";
import { panels, placeOf, spokenRole } from "./panels.js";
import { Picture } from "./picture.js";
import { Ranking } from "./ranking.js";
import { redraw } from "./redraw.js";
import { startPage } from "./start.js";
import { listenForTips } from "./tips.js";
import { implantWith, Names, placedAt } from "./treatments.js";
import { Trimming } from "./trimming.js";
import { Portrait } from "./portrait.js";

export const STEPS = [
  ["image", "Image"],
  ["vessel", "Vessel"],
  ["sac", "Sac and parent"],
  ["device", "Treatment"],
  ["deploy", "Deploy"],
  ["flow", "Flow"],
  ["report", "Report"],
];
const SIGNS = { todo: "", running: "", done: "✓", stale: "↻", failed: "!" };
const WORDS = { todo: "not done yet", running: "at work", done: "done", stale: "out of date: something before it has changed", failed: "needs your attention" };

class Page {
  constructor(root) {
    this.root = root;
    this.complain = this.complain.bind(this);
    this.toasts = make("div", { className: "toasts", role: "status", ariaLive: "polite" });
    this.root.append(this.toasts);
    listenForTips(document.body);
    this.colour = "wall_gap";
    this.memory = {};
    this.changes = Promise.resolve();
    this.isFollowing = false; // along the steps of the job that runs
    this.isWhole = false;
    addEventListener("keydown", (event) => this.key(event));
    this.begin();
  }

  async begin() {
    this.catalogue = await get("/api/catalogue").catch(this.complain) || [];
    this.fields = {};
    get("/api/openapi.json").then(({ components }) => this.show({ fields: components.schemas.FlowChoice.properties })).catch(() => {}); // without limits the server still checks
    this.names = new Names(this.catalogue, () => this.view?.choices.treatments || []);
    if (!location.hash) {
      const { opened } = await get("/api/cases").catch(() => ({})); // the list of cases asks again
      if (opened) history.replaceState(null, "", `#${opened}`);
    }
    addEventListener("hashchange", () => this.route()); // not before the devices have their names
    this.route();
  }

  /** The address says which case and which step. */
  route() {
    const [id, step] = decodeURIComponent(location.hash.slice(1)).split("/");
    if (!id) return this.showStart();
    if (this.view?.id === id) return this.go(step, null);
    this.openCase(id, step);
  }

  showStart() {
    this.close();
    this.frame?.remove();
    this.frame = make("div", { className: "page" }, [
      make("header", {}, [this.brand(), make("div", { className: "spring" }), this.badge()]),
      startPage((id) => (location.hash = id), this.complain),
    ]);
    this.root.prepend(this.frame);
    document.title = "vstent";
  }

  brand() {
    return button("vstent", () => (location.hash = ""), { className: "brand", title: "All cases" });
  }

  badge() {
    return make("span", { className: "badge", title: "Not cleared for diagnosis or treatment" }, ["Research use only"]);
  }

  close() {
    this.events?.close();
    this.flowing?.end();
    this.view = null;
    this.isFollowing = false;
    this.anatomyKey = this.flowKey = this.scanKey = this.inputKey = this.inputViews = this.proposed = undefined;
    this.anatomy = null;
    this.scan = this.imaging = null;
    this.measures = {};
    this.moment = this.times = this.flowPanes = this.sheets = this.pulse = undefined;
  }

  async openCase(id, step) {
    this.close();
    this.path = `/api/cases/${encodeURIComponent(id)}`;
    const opening = (this.opening = Symbol(id));
    let view;
    try {
      view = await get(this.path);
      if (this.opening !== opening) return; // another one was opened meanwhile
    } catch (problem) {
      this.complain(problem);
      location.hash = "";
      return;
    }
    this.build();
    this.step = STEPS.some(([name]) => name === step) ? step : this.proposedStep(view);
    history.replaceState(null, "", `#${id}/${this.step}`);
    this.take(view);
    this.events = new EventSource(`${this.path}/events`);
    this.events.onmessage = ({ data }) => this.take(JSON.parse(data));
    this.events.onerror = () => {
      this.frame?.classList.add("lost");
      get(this.path).catch(() => {}); // a server with another key answers so, one that is gone does not
    };
    this.events.onopen = () => this.frame?.classList.remove("lost");
  }

  proposedStep(view) {
    if (view.job) return STEPS.find(([name]) => view.steps[name] === "running")?.[0] || "image";
    const open = STEPS.find(([name]) => view.steps[name] !== "done");
    return open ? open[0] : "report";
  }

  // -- what does not change while a case is open ------------------------------------------------------------------

  build() {
    this.frame?.remove();
    this.picture = new Picture(this);
    this.ranking = new Ranking(this);
    this.along = new AlongChart();
    this.section = new SectionChart();
    this.flowing = new Flowing(this);
    this.deploying = new Deploying(this);
    this.neck = new Neck(this);
    this.portrait = new Portrait(this);
    this.films = new Films(this);
    this.trimming = new Trimming(this);
    this.along.chosen = (mm) => this.deploying.look(mm);
    this.imaging = new Imaging(this);
    this.moments = new Newest(() => {}, this.complain);
    this.stepper = make("nav", { className: "stepper", ariaLabel: "Steps" });
    this.undoButton = button("↶", () => this.stepBack("undo"), { className: "icon", title: "Undo (Ctrl+Z)", ariaLabel: "Undo" });
    this.redoButton = button("↷", () => this.stepBack("redo"), { className: "icon", title: "Redo (Ctrl+Shift+Z)", ariaLabel: "Redo" });
    this.caseName = make("h1", { className: "case-name" });
    this.panel = make("section", { className: "panel", ariaLabel: "Step" });
    this.work = make("section", { className: "work", ariaLabel: "At work" });
    this.strip = make("section", { className: "strip", ariaLabel: "Details" });
    this.numbers = make("section", { className: "numbers", ariaLabel: "Numbers" });
    this.frame = make("div", { className: "page" }, [
      make("header", {}, [this.brand(), this.caseName, this.stepper, make("div", { className: "spring" }), this.undoButton, this.redoButton, this.badge()]),
      make("main", { className: "desk" }, [
        make("aside", { className: "left", ariaLabel: "Settings" }, [this.panel, this.work]),
        make("div", { className: "middle" }, [this.imaging.box, this.picture.element, this.films.element, this.strip]),
        make("aside", { className: "right", ariaLabel: "Results" }, [this.numbers]),
      ]),
    ]);
    this.root.prepend(this.frame);
    this.picture.layout();
  }

  // -- the state that the server tells ------------------------------------------------------------------------------

  take(view) {
    const before = this.view;
    // Answers and events overtake each other: one sent later describes what is newer.
    if (before?.id === view.id && (view.revision < before.revision || (view.revision === before.revision && view.sent_s < before.sent_s))) return;
    this.view = view;
    document.title = `${view.name} · vstent`;
    this.caseName.textContent = view.name;
    if (before?.id !== view.id || JSON.stringify(before.choices.ranges) !== JSON.stringify(view.choices.ranges)) this.picture.setRanges(view.choices.ranges);
    this.undoButton.disabled = !view.can_undo;
    this.redoButton.disabled = !view.can_redo;
    this.renderSteps();
    this.renderWork();
    if (before?.job && !view.job) {
      this.flowKey = undefined; // what it has found is to be fetched
      this.films.forget();
    }
    if (view.job && view.steps[this.step] === "running") this.isFollowing = true;
    if (this.isFollowing && view.job) this.follow(view);
    if (this.isFollowing && before?.job && !view.job) this.finished(before);
    this.load();
    const shape = JSON.stringify([view.choices, view.steps, view.failed, view.has_report, view.has_ranking, view.has_angiogram, !view.job, this.step, view.anatomy]);
    if (shape === this.shape) {
      if (this.step === "flow" || (this.step === "device" && view.job?.kind === "rank")) this.renderStrip();
      return;
    }
    this.shape = shape;
    this.imaging.follow(view);
    this.render();
    if (this.proposed && JSON.stringify(before.choices.flow) !== JSON.stringify(view.choices.flow)) this.propose().catch(this.complain);
  }

  /** Ask for what is proposed, and what the flow costs, with the present choices. */
  async propose() {
    this.show({ proposed: await get(`${this.path}/proposed`) });
  }

  /** Go along with a job through its steps; the state in which a short one runs may never have come. */
  follow(view) {
    const running = STEPS.find(([name]) => view.steps[name] === "running")?.[0];
    if (["vessel", "sac", "flow"].includes(running)) this.goForward(running);
  }

  finished(before) {
    this.isFollowing = false;
    const step = { anatomy: "sac", flow: "flow" }[before.job.kind];
    if (["done", "failed"].includes(this.view.steps[step])) this.goForward(step);
  }

  /** Turn to a step that lies ahead. */
  goForward(step) {
    const place = (wanted) => STEPS.findIndex(([name]) => name === wanted);
    if (place(step) > place(this.step)) this.go(step, "replace");
  }

  /** Fetch what has changed for the picture. */
  load() {
    const { view } = this;
    const grid = JSON.stringify([view.id, view.choices.shape, view.choices.spacing_mm]);
    if (view.is_scan && !view.wants_grid && this.step === "image" && this.scanKey !== grid) {
      this.scanKey = grid;
      this.imaging.load(grid).catch(this.complain);
    }
    if (view.has_anatomy && this.anatomyKey !== view.anatomy) this.loadAnatomy();
    const read = JSON.stringify([view.choices.units, view.choices.frame]);
    if (view.has_input && !view.is_scan && !view.has_anatomy && this.inputKey !== read) this.loadInput(read);
    const flow = view.has_flow ? `${view.anatomy} ${view.results}` : undefined;
    if (view.has_flow && this.flowKey !== flow && ["flow", "report"].includes(this.step)) {
      this.flowKey = flow;
      this.loadFlow();
    }
  }

  /** Show a surface as it was read, while the vessel in it is sought. */
  async loadInput(read) {
    this.inputKey = read;
    try {
      const answer = await getBinary(`${this.path}/input/surface`);
      if (this.anatomy) return;
      this.picture.put(answer);
      this.inputViews = answer.manifest.views;
      this.render();
    } catch {
      // what is wrong with the file is said by the step that fails
    }
  }

  /** Turn the slices to the middle of the neck, once one is known. */
  lookAtNeck() {
    const neck = this.anatomy?.neck;
    if (neck?.length) this.imaging.slices?.look(this.axis.at((neck[0] + neck[1]) / 2));
  }

  async loadAnatomy() {
    this.anatomyKey = this.view.anatomy;
    try {
      const answer = await getBinary(`${this.path}/anatomy`);
      this.anatomy = answer.manifest;
      this.continuedMarks = undefined;
      this.picture.stage?.drop(({ id }) => id === "input" || id.startsWith("opening ") || ["lumen", "landing", "continued", "sac", "neck", "wires", "contour"].includes(id));
      this.picture.put(answer);
      this.neck.given = null; // its curve is drawn anew over the one found
      this.axis = new Axis(answer.manifest.axis, this.picture);
      this.deploying.setAxis(this.axis);
      this.trimming.set(this.axis, answer.manifest.neck);
      this.along.set({ axis: answer.manifest.axis, neck: answer.manifest.neck });
      this.section.neck = answer.manifest.neck;
      this.lookAtNeck();
      this.imaging.follow(this.view);
      this.measures = {};
      this.render(); // the picture does not wait for the numbers
      this.sheets = await get(`${this.path}/numbers`);
      await this.propose();
      this.portrait.take(this.anatomyKey);
    } catch (problem) {
      this.complain(problem);
    }
  }

  async loadFlow() {
    try {
      const [answer, sheets] = await Promise.all([getBinary(`${this.path}/flow${this.moment === undefined ? "" : `?moment=${this.moment}`}`), get(`${this.path}/numbers`)]);
      this.sheets = sheets;
      this.flowPanes = answer.manifest.panes;
      this.times = answer.manifest.times_s;
      for (const pane of this.flowPanes) if (this.picture.isMoved(pane)) this.picture.dropMoved(pane, ["wires", "contour"]);
      this.picture.put(answer);
      this.render();
    } catch (problem) {
      this.complain(problem);
    }
  }

  /** Move the slice of the flow. */
  askSlice() {
    const moment = this.moment === undefined ? "" : `&moment=${this.moment}`;
    this.slices ??= new Newest((answer) => this.picture.put(answer), this.complain);
    this.slices.ask(() => getBinary(`${this.path}/flow?cut_mm=${this.memory.cut}${moment}`));
  }

  // -- what is drawn anew when something has changed ----------------------------------------------------------------

  renderSteps() {
    redraw(
      this.stepper,
      ...STEPS.map(([name, title], i) => {
        const status = this.view.steps[name];
        const words = [make("span", { className: "sign" }, [SIGNS[status] || (status === "running" ? "" : String(i + 1))]), make("span", {}, [title])];
        const properties = { className: `step ${status}`, title: `${title}: ${WORDS[status]}`, ariaCurrent: name === this.step ? "step" : "false", data: { key: name } };
        return make("button", { type: "button", ...properties, onClick: () => this.go(name) }, words);
      }),
    );
  }

  /** Turn to a step; the address follows, as an entry of the history where a user has turned there. */
  go(step, entry = "push") {
    if (!step || !STEPS.some(([name]) => name === step)) return;
    if (VIEW[step] !== VIEW[this.step]) this.picture.look(VIEW[step]);
    this.step = step;
    if (entry !== "replace") this.isFollowing = false;
    const address = `#${this.view.id}/${step}`;
    if (entry && address !== location.hash) history[`${entry}State`](null, "", address);
    this.shape = null;
    this.renderSteps();
    this.load();
    this.render();
  }

  /** Change what is seen, and not what is chosen. */
  show(changes) {
    Object.assign(this, changes);
    this.render();
  }

  render() {
    if (!this.view) return;
    this.frame.dataset.step = this.step;
    const at = this.panel.querySelector(".catalogue")?.scrollTop;
    redraw(this.panel, ...panels[this.step](this));
    if (at) this.panel.querySelector(".catalogue")?.scrollTo(0, at);
    this.renderScene();
    this.renderStrip();
    this.renderNumbers();
  }

  /** The treatment in view; none where none is chosen. */
  get treatment() {
    const { treatments } = this.view.choices;
    return treatments.find(({ name }) => name === this.active) ?? treatments[0];
  }

  /** The implant of it that is described and moved. */
  get implant() {
    const implants = this.treatment?.implants;
    return implants?.find(({ id }) => id === this.activeImplant) ?? implants?.[0];
  }

  renderScene() {
    const isScan = this.step === "image" && this.view.is_scan && this.imaging.slices;
    this.imaging.box.hidden = !isScan;
    this.frame.classList.toggle("with-slices", Boolean(isScan));
    const layers = LAYERS[this.step](this);
    this.picture.setViews(...(isScan ? ["scan", this.imaging.views] : this.anatomy ? ["vessel", this.anatomy.views] : ["input", this.inputViews]), VIEW[this.step]);
    this.frame.classList.toggle("comparing", this.isComparing);
    this.picture.setPanes(this.panes());
    this.picture.setLayers(layers, (this.memory[this.step] ??= {}));
    this.flowing.isWatched = this.step === "deploy";
    this.flowing.prepare(this.expectedFlow());
    this.picture.element.hidden = this.isFilm;
    this.films.element.hidden = !this.isFilm;
    if (this.isFilm && !this.films.hasFilm) this.films.ask();
    this.picture.clicked = isScan ? (point) => this.imaging.clicked(point) : this.step === "sac" ? (point) => point && this.setSeed(point) : null;
    this.picture.moved = null;
    this.picture.setMarks(isScan ? this.imaging.marks : this.anatomy ? this.marks() : []);
    if (this.anatomy && this.step === "deploy") this.renderDeploy();
  }

  /** The flow that a live preview would begin with, named by what it depends on; null where none is near. */
  expectedFlow() {
    const { anatomy, choices, job } = this.view;
    const isNear = ["device", "deploy"].includes(this.step) && this.anatomy?.neck.length && !job;
    return isNear ? JSON.stringify([anatomy, choices.flow]) : null;
  }

  /** What lies on the scene in this step. They are laid once: a handle that is in hand must not be taken away between. */
  marks() {
    if (this.step === "vessel") {
      this.trimming.show(this.view.choices);
      return [...this.openingMarks(), ...this.trimming.handles];
    }
    if (this.step === "sac") {
      const { curve_mm, handles } = this.anatomy.drawn;
      this.neck.set(this.view.choices.neck_mm ?? curve_mm, handles);
      const choose = (opening) => opening.role !== "inlet" && this.choose({ outlet_mm: placeOf(opening) });
      const outlets = this.openingMarks(choose, "Click to let the parent artery lead here", "opening name");
      return [...this.neck.handles, ...outlets, ...this.sacMarks(), ...this.assumedMarks];
    }
    if (this.step === "device" && !this.isComparing) return [...this.sacMarks(), ...this.assumedMarks];
    return this.step === "deploy" && this.treatment && !this.asksForAneurysm ? [...this.deploying.handles, this.deploying.cursorMark, ...this.assumedMarks] : [];
  }

  /** Names of the rings with which the artery is continued beyond its ends. */
  get assumedMarks() {
    const [first, last] = this.anatomy.own_mm;
    const ends = [first, this.axis.length + last].filter((mm) => mm > 0.1 && mm < 2 * this.axis.length - 0.1);
    const words = () => make("span", { className: "opening scene-label", title: "The artery ends here: its continuation, with a constant diameter, is assumed" }, [make("b", {}, ["Assumed"])]);
    return (this.continuedMarks ??= ends.map((mm) => ({ element: words(), isLabel: true, point: () => this.picture.shown.has("continued") && this.axis.at(mm / 2) })));
  }

  /** Whether no aneurysm was found, and the user has not said where it is or that there is none. */
  get asksForAneurysm() {
    return Boolean(this.anatomy && this.view.failed.sac?.startsWith("No aneurysm was found"));
  }

  sacMarks() {
    return sacMarks(this.anatomy, this.picture, (center) => this.setSeed(center));
  }

  get isComparing() {
    return this.step === "device" && this.ranking.comparing.isSeen;
  }

  panes() {
    if (this.isComparing) return this.ranking.comparing.panes();
    return this.step === "flow" || this.step === "report" ? this.flowPanesShown() : [{ id: this.treatment?.name || "one", title: "" }];
  }

  flowPanesShown() {
    const names = this.flowPanes?.length ? this.flowPanes : ["bare"];
    const sheet = this.sheets?.flow?.[0];
    const row = sheet?.rows.find(({ key }) => key === "neck_inflow_mL_s");
    return names.map((name) => {
      const i = sheet?.names.indexOf(name) ?? -1;
      const said = i < 0 ? row?.cells[0] : `${row?.cells[1 + 2 * i]} (${row?.cells[2 + 2 * i]})`;
      const isYielded = this.picture.isMoved(name); // the numbers of the table are those in the artery as scanned
      const note = isYielded ? "Artery straightened" : row && (i >= 0 || name === "bare") ? `${row.name} ${said}` : "";
      return { id: name, title: name === "bare" ? "Before (no device)" : this.names.treatment(name), note };
    });
  }

  openingMarks(chosen = ({ role, center_mm }) => role !== "inlet" && this.choose({ inlet_mm: placeOf({ center_mm }) }), hint = "Click to let blood enter here", className = "opening") {
    return this.anatomy.openings.map((opening) => {
      const { role, center_mm, area_mm2, diameter_mm, colour } = opening;
      const element = make("button", { type: "button", className, title: role.startsWith("inlet") ? "Blood enters here" : hint, onClick: () => chosen(opening) }, [
        make("i", { style: { background: `rgb(${colour})` } }),
        make("b", {}, [spokenRole(role)]),
        make("span", {}, [`${area_mm2.toFixed(1)} mm² · ⌀ ${diameter_mm.toFixed(1)} mm`]),
      ]);
      return { element, isLabel: true, point: () => center_mm };
    });
  }

  get neckPlace() {
    return this.neckDrawn ? neckWords(this.neckDrawn, this.anatomy.drawn) : [];
  }

  toldNeck(neck) {
    this.neckDrawn = neck;
    this.panel.querySelector(".place")?.replaceChildren(...this.neckPlace);
  }

  renderDeploy() {
    const { treatment, implant } = this;
    if (!treatment || this.asksForAneurysm) return;
    this.picture.moved = (event) => this.deploying.look(this.deploying.line.under(event, null));
    const key = JSON.stringify([treatment, implant.id, this.colour, this.view.anatomy, this.view.choices.straightening, this.view.job?.kind === "place"]);
    if (this.shownTreatment !== key || !(this.measures[treatment.name] || this.undeployed || this.deploying.whole.isBusy)) {
      this.shownTreatment = key;
      this.deploying.show(treatment.name, implant.id);
    }
  }

  renderStrip() {
    const parts = {
      device: () => (this.view.has_ranking || this.view.job?.kind === "rank" ? [this.ranking.element()] : []),
      deploy: () => [this.along.element, this.section.element],
      flow: () => this.flowStrip(),
    }[this.step]?.() || [];
    this.frame.classList.toggle("with-strip", parts.length > 0);
    if (parts.length && ["deploy", "device"].includes(this.step) && this.strip.firstChild === parts[0]) return;
    redraw(this.strip, ...parts);
  }

  /** Whether the films are shown in place of the 3-D picture. */
  get isFilm() {
    return this.step === "flow" && this.memory.mode === "angiogram" && this.view.has_angiogram && !this.view.job;
  }

  /** The films have changed: their direction, and the strip where they were not there before. */
  renderFilms() {
    const field = this.panel.querySelector("#field-carm");
    if (field && document.activeElement !== field) field.value = inWords(this.films.angles);
    if (this.isFilm && this.strip.firstChild !== this.films.strip[0]) this.renderStrip();
  }

  flowStrip() {
    const { job } = this.view;
    if (this.isFilm && this.films.hasFilm) return this.films.strip;
    if (job?.kind !== "flow" || !job.residuals.length) return [];
    const box = make("div", { className: "residual" }, [residualChart(job.residuals)]);
    box.append(chartButton("convergence", box));
    return [box];
  }

  renderWork() {
    const { job } = this.view;
    this.work.hidden = !job;
    if (!job) return this.work.replaceChildren();
    const bar = make("i", { style: { width: `${Math.max(2, 100 * job.fraction)}%` } });
    const words = make("div", { className: "work-words" }, [make("b", {}, [job.stage ? this.stageWords(job.stage) : "Starting"]), make("span", {}, [progressWords(job) || "…"])]);
    const stop = button("Cancel", () => drop(`${this.path}/jobs`).catch(this.complain));
    const done = job.finished.map(({ stage }) => this.stageWords(stage));
    const said = make("p", { className: "hint" }, [done.length ? `Done: ${done.join(", ")}.` : "The work continues when this tab is closed."]);
    redraw(this.work, words, make("div", { className: "bar", role: "progressbar", ariaLabel: "Progress of the work", ariaValueNow: String(Math.round(100 * job.fraction)) }, [bar]), stop, said);
  }

  renderNumbers() {
    const turn = () => ((this.isWhole = !this.isWhole), this.renderNumbers());
    const head = (title) => make("div", { className: "numbers-head" }, [make("h2", {}, [title]), button(this.isWhole ? "Fewer" : "All", turn, { className: "link", data: { key: `whole ${title}` } })]);
    const parts = [];
    const flow = this.sheets?.flow?.[0];
    if (["flow", "report"].includes(this.step) && flow) {
      const stale = this.view.steps.flow === "stale" ? [make("p", { className: "note stale" }, ["These numbers are of an earlier flow: run the step Flow again."])] : [];
      const both = [changeSheet(flow, this.isWhole, (name) => this.names.treatment(name)), qualitySheet(flow)];
      parts.push(head("Before and after"), ...stale, ...(flow.qualities.some(({ grade }) => grade === "not usable") ? both.reverse() : both));
      if (this.sheets.ranking?.length) parts.push(...rankedSheet(this.sheets.ranking, (name) => this.names.treatment(name)));
    }
    if (this.isComparing) parts.push(head("Compared"), plainSheet(this.ranking.comparing.sheets(), this.isWhole));
    else if (["device", "deploy"].includes(this.step)) {
      const isFirst = (one) => one === this.treatment && this.names.isFor(one.implants[0].device, "basket"); // others differ in their rows
      const sheets = [...this.view.choices.treatments].sort((a, b) => isFirst(b) - isFirst(a)).flatMap(({ name }) => this.measures[name] || []);
      const [alike, others] = [true, false].map((isAlike) => sheets.filter(({ rows }) => (rows[0].key === sheets[0].rows[0].key) === isAlike));
      if (sheets.length) parts.push(head("Deployed"), plainSheet(alike, this.isWhole, sheets.length > 1));
      for (const sheet of others.filter(({ rows }) => this.isWhole || rows.some((row) => row.is_first))) parts.push(make("h3", {}, [sheet.title]), plainSheet([sheet], this.isWhole));
    }
    if (this.step === "report") for (const varied of this.sheets?.uncertainty || []) parts.push(...sureSheet(varied));
    if (this.sheets?.anatomy?.length && !(flow && ["flow", "report"].includes(this.step))) parts.push(head("Anatomy"), plainSheet(this.sheets.anatomy, this.isWhole));
    if (!parts.length) parts.push(make("h2", {}, ["Numbers"]), make("p", { className: "hint" }, ["Metrics appear here when a step is finished, each with its unit and definition."]));
    else parts.push(make("p", { className: "hint" }, ["Rest on a name, or touch it, to see its definition."]));
    redraw(this.numbers, ...parts);
  }

  toldTreatment(manifest, isWhole) {
    this.place = manifest;
    if (isWhole) {
      const [low, high] = (manifest.length_band_mm ?? []).map((mm) => mm.toFixed(1));
      const meaning = "Range for an uncertainty of the artery's diameters alone; the band beside the deployed length includes the device's numbers.";
      const range = { key: "length_range", name: "Deployed length, for the artery's diameters", meaning, source: "", cells: [`${low} to ${high}\u202fmm`], is_first: false };
      this.measures[manifest.treatment] = manifest.measures.map((sheet) => ({ ...sheet, rows: low && (sheet.title === manifest.title || manifest.measures.length === 1) ? [...sheet.rows, range] : sheet.rows }));
      this.advice = manifest.advice;
      const missing = manifest.is_placed ? null : manifest.treatment; // whose coils are not placed yet
      const isNew = missing !== this.missing || manifest.size !== this.size;
      [this.missing, this.size] = [missing, manifest.size];
      if (isNew) this.render();
      this.renderNumbers();
      this.portrait.take(`${manifest.treatment} ${JSON.stringify(manifest.ends_mm)}`);
      this.panel.querySelector(".advice")?.replaceChildren(spoken(manifest.advice));
      const [first, last] = this.anatomy.neck.length ? this.anatomy.neck : (manifest.ends_mm ?? []);
      if (this.deploying.cursor === undefined) this.deploying.look((first + last) / 2);
      else this.deploying.look(this.deploying.cursor);
    }
    this.panel.querySelector(".place")?.replaceChildren(...placeWords(manifest, this.bands, this.anatomy.neck));
    this.panel.querySelector(".yielding")?.replaceChildren(manifest.straightening ?? "");
  }

  /** The bands of the device that lies still; null while it is dragged. */
  toldBands(sheet) {
    this.bands = sheet;
    const bands = this.panel.querySelector(".bands");
    if (bands) redraw(bands, ...bandWords(sheet));
    const { place } = this;
    if (sheet && place?.treatment === sheet.treatment && place.implant === sheet.implant) this.panel.querySelector(".place")?.replaceChildren(...placeWords(place, sheet, this.anatomy.neck));
  }

  /** A stage of a job in words: ``flow silk``, ``deploy silk+silk_2 silk_2``. */
  stageWords(stage) {
    const [first, name, id] = stage.split(" ");
    const words = SPOKEN[first] || stage;
    if (!name || ["plan", "stored"].includes(first)) return words;
    return `${words} ${name === "bare" ? "before" : this.names.treatment(name)}${id ? `: ${this.names.implant(name, id)}` : ""}`;
  }

  /** The inlet's pulse, for the left side. */
  pulseChart() {
    const box = make("div", { className: "pulse" });
    const shown = (moment) => {
      this.moment = moment;
      draw();
      this.moments.ask(() => this.loadFlow());
    };
    const save = chartButton("inlet waveform", box);
    const rate = () => make("p", { className: "hint" }, [this.view.choices.flow.is_pulsatile ? `Heart rate ${(60 / this.pulse.time_s.at(-1)).toFixed(0)}/min.` : ""]);
    const draw = () => box.replaceChildren(save, rate(), pulseChart(this.pulse, this.view.choices.flow.is_pulsatile, this.times || [], this.moment, shown));
    if (this.pulse) draw();
    else get(`/api/waveform?case_id=${this.view.id}`).then((pulse) => ((this.pulse = pulse), draw())).catch(this.complain);
    return box;
  }

  // -- what a user does ---------------------------------------------------------------------------------------------

  /** Choose; `changes`, or a promise of them, are made on what is chosen when it is their turn: one after the other. */
  choose(changes) {
    this.changes = this.changes.then(async () => this.send(await changes)).catch(this.complain); // the next ones are made nevertheless
    return this.changes;
  }

  async send(changes) {
    const { revision, choices } = this.view;
    const more = typeof changes === "function" ? changes(choices) : changes;
    try {
      this.take(await put(`${this.path}/choices`, { revision, choices: { ...choices, ...more } }));
    } catch (problem) {
      this.complain(problem);
      if (problem.status === 409) this.take(await get(this.path));
      this.shape = null;
      this.render();
    }
  }

  changeImplant(name, id, changes) {
    return this.choose(implantWith(name, id, changes));
  }

  /** What the choices become when an implant is put to a place, or left to be proposed again (null). */
  moved(name, id, mm) {
    return (choices) => {
      const implant = choices.treatments.find((one) => one.name === name).implants.find((one) => one.id === id);
      return implantWith(name, id, placedAt(implant, mm, this.names.isFor(implant.device, "basket")))(choices);
    };
  }

  chooseFlow(changes) {
    return this.choose(({ flow }) => ({ flow: { ...flow, ...changes } }));
  }

  /** A size was chosen in the table: see it deployed. */
  goTo(name) {
    this.active = name;
    this.go("deploy");
  }

  /** The contour's way to the wall, as a short film. */
  playExpansion() {
    const { stage } = this.picture;
    if (!stage?.nFrames) return;
    const shown = new Set(this.picture.shown);
    const started = performance.now();
    const run = (this.film = Symbol("film"));
    this.picture.shown = new Set([...shown].filter((id) => id !== "wires").concat("contour"));
    this.picture.apply();
    const step = (now) => {
      if (this.film !== run) return;
      const moment = Math.min(1, Math.max(0, now - started) / 2200);
      stage.expand(moment);
      if (moment < 1) return requestAnimationFrame(step);
      setTimeout(() => this.film === run && this.renderScene(), 500);
    };
    requestAnimationFrame(step);
  }

  setSeed(point) {
    this.choose({ at_mm: point.map((x) => Number(x.toFixed(2))) });
    this.tell("Point set. Find the vessel again to use it.");
  }

  async start(kind) {
    await this.changes; // what was typed last comes first
    this.isFollowing = true;
    try {
      this.take(await post(`${this.path}/jobs/${kind}`));
    } catch (problem) {
      this.complain(problem);
    }
  }

  async stepBack(which) {
    await this.changes;
    try {
      this.take(await post(`${this.path}/${which}`, { revision: this.view.revision }));
    } catch (problem) {
      if (problem.status === 409) this.take(await get(this.path));
      this.tell(problem.message);
    }
  }

  key(event) {
    if (!this.view || event.target.closest("input, select, textarea")) return;
    const isUndo = (event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z";
    if (isUndo) {
      event.preventDefault();
      this.stepBack(event.shiftKey ? "redo" : "undo");
    } else if (event.altKey && (event.key === "ArrowRight" || event.key === "ArrowLeft")) {
      event.preventDefault();
      const i = STEPS.findIndex(([name]) => name === this.step) + (event.key === "ArrowRight" ? 1 : -1);
      if (STEPS[i]) this.go(STEPS[i][0]);
    }
  }

  tell(sentence, kind = "") {
    const toast = make("div", { className: `toast ${kind}` }, [sentence]);
    this.toasts.append(toast);
    setTimeout(() => toast.remove(), kind ? 9000 : 5000);
  }

  complain(problem) {
    this.tell(problem.message || String(problem), "problem");
  }
}

/** A time that is estimated, no finer than it is known. */
function timeLeft(seconds) {
  if (seconds < 10) return "a few seconds left";
  return seconds < 90 ? `about ${10 * Math.round(seconds / 10)} s left` : `about ${Math.round(seconds / 60)} min left`;
}

/** What a job does, how far its flow is from convergence, and how long it will take. */
function progressWords({ detail, residual, seconds_left }) {
  const away = residual === null ? "" : `${(100 * residual).toFixed(1)} % from convergence`;
  return [detail, away, seconds_left === null ? "" : timeLeft(seconds_left)].filter(Boolean).join(", ");
}
const SPOKEN = {
  scan: "Scan", vessel: "Vessel", segment: "Wall", trace: "Centerlines", trim: "Trimming", restore: "Parent artery and sac", anatomy: "Anatomy", rank: "Sizes", rank_flow: "Flow of the best sizes",
  deploy: "Deploying", struts: "Wires of", plan: "Run time of the flow", stored: "Stored results", flow: "Flow,", vary: "Uncertainty of", measure: "Metrics", report: "Report", angiogram: "Angiogram,", film: "Films",
};

/** From where each step looks at first. */
const VIEW = { image: "whole", vessel: "whole", sac: "profile", device: "profile", deploy: "profile", flow: "profile", report: "profile" };
const LUMEN = { id: "lumen", title: "Lumen", on: true, also: ["continued"] };
const INPUT = { id: "input", title: "", on: true };
const NECK = { id: "neck", title: "Neck", on: true };
const LAYERS = {
  image: (page) =>
    page.view.is_scan && page.imaging.slices
      ? [{ id: "live", title: "Surface at the threshold", on: true }]
      : [INPUT, { ...LUMEN, title: "Vessel" }, { id: "landing", title: "Inside", on: false }],
  vessel: (page) => [
    ...(page.anatomy ? [] : [INPUT]),
    LUMEN,
    { id: "centerlines", title: "Centerlines", on: true },
    { id: "opening 0", title: "Openings", on: true, also: (page.anatomy?.openings || []).map((_, k) => `opening ${k}`) },
  ],
  sac: (page) => [...(page.anatomy ? [] : [INPUT]), LUMEN, { id: "landing", title: "Parent artery", on: true }, { id: "sac", title: "Sac", on: true }, NECK, { id: "axis", title: "Axis", on: false }],
  device: (page) =>
    page.isComparing
      ? [LUMEN, { id: "wires", title: "Wires", on: true }, { id: "contour", title: "Contour", on: false }, NECK]
      : [LUMEN, { id: "landing", title: "Parent artery", on: true }, { id: "sac", title: "Sac", on: true }, NECK],
  deploy: (page) => [
    LUMEN,
    { id: "wires", title: "Wires", on: true },
    ...(page.flowing.isOn ? [{ id: "streamlines", title: "Live flow", on: true }] : []),
    { id: "contour", title: "Contour", on: false },
    NECK,
    { id: "axis", title: "Axis", on: true },
    { id: "landing", title: "Parent artery", on: false },
  ],
  flow: (page) => {
    const mode = page.memory.mode || "streamlines";
    const modes = ["streamlines", "slice", "shear", "sac_shear"].map((id) => ({ id, on: mode === id }));
    return [{ ...LUMEN, on: mode !== "shear" }, ...modes, { id: "wires", title: "Wires", on: false }, NECK];
  },
  report: (page) => LAYERS.flow(page),
};

new Page(document.getElementById("app"));
