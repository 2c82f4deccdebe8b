// Drift: how much the camera's own motion is left in the history, and what a filter would take away with it.

import { get, post, projectPath, sentence } from "../lib/api.js";
import { fill, find, h } from "../lib/dom.js";
import { fixed, millimetres } from "../lib/format.js";
import { latest } from "../lib/latest.js";
import { told } from "../lib/problems.js";
import { setView, viewText } from "../lib/view-state.js";
import { busyOver } from "../components/busy.js";
import { FAINT_AFTER_MS, delayedSign } from "../components/delayed-sign.js";
import { earlierNote } from "../components/earlier-note.js";
import { AXES, fetchHistory, fetchResults } from "../components/histories.js";
import { INTERVALS, intervalFields } from "../components/interval-fields.js";
import { whenMeasured } from "../components/measured.js";
import { note } from "../components/notes.js";
import { numberField } from "../components/number-field.js";
import { openPage } from "../components/page.js";
import { Plot } from "../components/plot.js";
import { segmented } from "../components/segmented.js";
import { Solver } from "../components/solver.js";
import { toastError } from "../components/toast.js";

/** @typedef {import("../components/histories.js").History} History */
/** @typedef {import("../components/histories.js").Results} Results */
/** @typedef {import("../components/interval-fields.js").IntervalName} IntervalName */
/** @typedef {{dx: (number | null)[], dy: (number | null)[]}} Pair */
/** @typedef {{dx: number, dy: number}} Rms */
/** @typedef {{time_s: number[], status: string[], raw: Pair, filtered: Pair, filtered_pre_event_rms_m: Rms | null, geometric_pre_event_rms_m: Rms | null, warnings: string[], is_earlier: boolean}} DriftAnswer */
/** @typedef {{rms_m: Rms, least_m: Rms}} Knee what remains there, and the least that a higher corner leaves */
/** @typedef {{corners_hz: number[], rms_m: Pair, knee_hz: number | null, knee: Knee | null}} Sweep */
/** @typedef {{frequency_hz: number[], dx_m: number[], dy_m: number[]}} Spectrum */

const LOWEST_HZ = 0.05;
const HIGHEST_HZ = 0.5;
const CORNER_STEP_HZ = 0.005;
const TOLD_AFTER_MS = 600;

const page = await openPage("drift");
const { store } = page;
let results = await whenMeasured(
  page,
  "Track the video first; the drift left in its history can then be looked at here.",
  { byMethod: true },
);

let axis = viewText("axis") === "y" ? "y" : "x";
let point = viewText("point") === "p2" ? "p2" : "p1";
let target = results.targets.find((name) => name === viewText("target")) ?? results.targets[0] ?? "";
let corner_hz = store.project.drift.corner_hz;
/** @type {History | null} */
let geometric = null;
/** @type {DriftAnswer | null} */
let answer = null;
/** @type {Sweep | null} */
let sweep = null;

// the page
const mainArea = h("div", { class: "drift-main" });
const lowerArea = h("div", { class: "drift-lower" });
const axisChoice = segmented({
  label: "Axis",
  choices: AXES.map(({ value, name }) => ({ value, name })),
  value: axis,
  onChange: chooseAxis,
});
const pointChoice = segmented({
  label: "Point",
  choices: [
    { value: "p1", name: "P1" },
    { value: "p2", name: "P2" },
  ],
  value: point,
  onChange: choosePoint,
});
const targetChoice = segmented({
  label: "Target",
  choices: results.targets.map((name) => ({ value: name, name })),
  value: target,
  onChange: chooseTarget,
});
targetChoice.element.hidden = results.targets.length < 2;
const filterSwitch = h("input", { type: "checkbox", onchange: () => chooseFilter(filterSwitch.checked) });
const slider = h("input", {
  type: "range",
  id: "corner",
  min: LOWEST_HZ,
  max: HIGHEST_HZ,
  step: CORNER_STEP_HZ,
  oninput: () => moveCorner(Number(slider.value)),
  onchange: () => saveCorner(),
});
const cornerField = numberField({
  label: "Corner frequency",
  unit: "Hz",
  value: corner_hz,
  decimals: 3,
  step: 0.005,
  min: 0.001,
  max: 5,
  bare: true,
  onChange: (value) => typeCorner(value),
});
const orderField = numberField({
  label: "Order",
  unit: "",
  value: store.project.drift.order,
  decimals: 0,
  step: 2,
  min: 1,
  max: 20,
  bare: true,
  onChange: (value) => saveOrder(value ?? 10),
});
const kneeButton = h("button", {
  type: "button",
  class: "button small",
  hidden: true,
  onclick: () => typeCorner(sweep?.knee_hz ?? null),
});
const kneeWords = h("p", { class: "small soft" });
const figures = h("div", { class: "figures" });
const warnings = h("div", { class: "warnings", role: "status", "aria-live": "polite" });
const intervalBox = h("div");
const solving = h("span", { class: "badge accent", role: "status", hidden: true }, "Solving again…");
const earlier = earlierNote(page);
fill(find("#main"), stageElement(), sideElement());

const history = new Plot(mainArea, { title: "Displacement", unit: "m", drag: "select" });
const sweepPlot = new Plot(lowerArea, {
  title: "RMS before the event",
  unit: "m",
  xUnit: "Hz",
  drag: "seek",
  zeroY: true,
  seekStep: CORNER_STEP_HZ,
});
const spectrumPlot = new Plot(lowerArea, {
  title: "Spectrum",
  unit: "m",
  xUnit: "Hz",
  drag: "view",
  logX: true,
  logY: true,
});
const filtering = h("span", { class: "badge accent", role: "status", hidden: true }, "Solving…");
solving.before(filtering);
const faintSign = delayedSign(FAINT_AFTER_MS, setFaint);
const filteringSign = delayedSign(TOLD_AFTER_MS, (on) => (filtering.hidden = !on || !solving.hidden));
const fields = intervalFields(intervalBox, saveInterval, end_s);
const load = latest(askResults, showResults, showProblem);
const refilter = latest(askFilter, showAnswer, showProblem);
const resweep = latest(askSweep, showSweep, (error) => showSweepProblem(error));
const respectrum = latest(askSpectra, showSpectra, () => undefined);
const solver = new Solver(page, {
  isFresh: () => results.ready && !results.stale,
  onBusy: (busy) => {
    solving.hidden = !busy;
    if (busy) filtering.hidden = true; // one word for both
  },
  reload,
});

history.on("select", ({ from, to }) => saveInterval("pre_event", [from, to]));
history.on("interval", ({ key, from, to, done }) => moveInterval(/** @type {IntervalName} */ (key), [from, to], done));
sweepPlot.on("seek", ({ x }) =>
  typeCorner(Math.min(Math.max(Math.round(x / CORNER_STEP_HZ) * CORNER_STEP_HZ, LOWEST_HZ), HIGHEST_HZ)),
);
store.on("change", onProject);
page.events.on("results", () => void reload());
page.events.on("online", () => void reload());
page.keys([
  {
    keys: "ArrowLeft / [",
    group: "Drift",
    label: "Lower the corner frequency",
    run: () => typeCorner(corner_hz - CORNER_STEP_HZ),
  },
  {
    keys: "ArrowRight / ]",
    group: "Drift",
    label: "Raise the corner frequency",
    run: () => typeCorner(corner_hz + CORNER_STEP_HZ),
  },
  {
    keys: "K",
    group: "Drift",
    label: "Take the knee as corner frequency",
    run: () => typeCorner(sweep?.knee_hz ?? null),
    when: () => sweep?.knee_hz != null,
  },
  {
    keys: "F",
    group: "Drift",
    label: "Filter on or off",
    run: () => chooseFilter(store.project.drift.filter === "none"),
  },
  { keys: "A", group: "Drift", label: "East or north", run: () => chooseAxis(axis === "x" ? "y" : "x") },
  { keys: "P", group: "Drift", label: "P1 or P2", run: () => choosePoint(point === "p1" ? "p2" : "p1") },
  {
    keys: "Drag",
    group: "Plots",
    label: "On the displacement: the pre-event interval; on the RMS: the corner frequency",
  },
  { keys: "Wheel", group: "Plots", label: "Zoom; Alt+drag pans, a double click shows all" },
]);
onProject();
const nothing = h("p", { hidden: true });
mainArea.append(h("div", { class: "stage-empty", role: "status" }, nothing));
const opened = busyOver(mainArea, "Solving…");
await reload();

function stageElement() {
  return h(
    "div",
    { class: "stage" },
    h(
      "div",
      { class: "stage-bar" },
      h("h1", {}, "Drift"),
      targetChoice.element,
      pointChoice.element,
      h("span", { class: "spring" }),
      solving,
      axisChoice.element,
    ),
    earlier.element,
    h("div", { class: "stage-body drift-stage" }, mainArea, lowerArea),
  );
}

function sideElement() {
  return h(
    "aside",
    { class: "side", "aria-label": "Filter and intervals" },
    h(
      "section",
      { class: "section" },
      h("header", {}, h("h2", {}, "High-pass filter"), h("label", { class: "switch" }, filterSwitch, "Apply")),
      h(
        "p",
        { class: "small soft" },
        "Curves and sweep show what the filter makes of the uncorrected displacement. Only when applied is it written to the result, where it filters what the project's method measured.",
      ),
      h(
        "div",
        { class: "corner-row" },
        h("label", { class: "label", for: "corner" }, "Corner frequency"),
        cornerField.element,
      ),
      slider,
      h(
        "div",
        { class: "toolbar" },
        kneeButton,
        h("span", { class: "spring" }),
        h("span", { class: "label" }, "Order"),
        h("div", { class: "order-field" }, orderField.element),
      ),
      kneeWords,
      figures,
      warnings,
    ),
    h(
      "section",
      { class: "section" },
      h("header", {}, h("h2", {}, "Intervals")),
      h(
        "p",
        { class: "small soft" },
        "Drag across the plot where the building stands still before the event; pull the handles, or type.",
      ),
      intervalBox,
    ),
  );
}

/** Everything that depends on results. */
function reload() {
  return load(target);
}

/** @param {string} of a target @returns {Promise<{newest: Results, curve: History | null}>} */
async function askResults(of) {
  const newest = await fetchResults(page.id);
  const hasCurve = newest.methods.includes("geometric");
  return { newest, curve: hasCurve ? await fetchHistory(page.id, of, "geometric", true).catch(() => null) : null };
}

/** @param {{newest: Results, curve: History | null}} answered */
function showResults({ newest, curve }) {
  results = newest;
  geometric = curve;
  earlier.show(results, { method: store.project.method, isEarlier: answer?.is_earlier ?? false });
  ask();
}

/** Ask for all that depends on target, point, intervals and corner. */
function ask() {
  filterAnew();
  const rest = store.project.intervals_s.pre_event;
  if (rest === null) return showNoInterval();
  if (sweep === null) kneeWords.textContent = "Looking for the knee…";
  resweep(rest);
  respectrum(rest);
}

/** Until the answer is there, the figures, the curve and the words of the last one are not for this corner. */
function filterAnew() {
  if (answer !== null) {
    faintSign.begin();
    filteringSign.begin();
  }
  refilter(corner_hz);
}

/** @param {boolean} faint */
function setFaint(faint) {
  history.setFaint("Filtered", faint);
  for (const element of [figures, warnings]) element.classList.toggle("awaited", faint);
}

/** @param {number} corner @returns {Promise<DriftAnswer>} */
function askFilter(corner) {
  const { drift, intervals_s } = store.project;
  return post(projectPath(page.id, "drift"), {
    target,
    point,
    corner_hz: corner,
    order: drift.order,
    interval: intervals_s.pre_event,
  });
}

/** @param {[number, number]} rest @returns {Promise<Sweep>} */
function askSweep([start, end]) {
  return get(projectPath(page.id, "drift/sweep", { target, point, start, end, order: store.project.drift.order }));
}

/** @param {[number, number]} rest @returns {Promise<{before: Spectrum, during: Spectrum | null}>} */
async function askSpectra([start, end]) {
  const { event } = store.project.intervals_s;
  const spectrum = (/** @type {number} */ from, /** @type {number} */ to) =>
    get(projectPath(page.id, "drift/spectrum", { target, point, start: from, end: to }));
  const [before, during] = await Promise.all([
    spectrum(start, end),
    event ? spectrum(...event).catch(() => null) : null,
  ]);
  return { before, during };
}

/** @param {DriftAnswer} newest */
function showAnswer(newest) {
  answer = newest;
  opened();
  earlier.show(results, { method: store.project.method, isEarlier: newest.is_earlier });
  const isBare = showNothing(newest.status);
  faintSign.end();
  filteringSign.end();
  drawHistory();
  showFigures();
  fill(
    warnings,
    isBare ? null : newest.warnings.map((words) => note("warn", told(words).words)),
    isBare || newest.warnings.length ? null : note("info", "No warning for this corner frequency."),
  );
}

/** @param {unknown} error */
function showProblem(error) {
  opened();
  filteringSign.end();
  if (answer === null) tellNothing(sentence(error));
  else toastError(error);
}

/** @param {string} words why there is no curve; none where there is one */
function tellNothing(words) {
  nothing.hidden = words === "";
  nothing.textContent = words;
}

/** Say why there is no curve, where there is none. @param {string[]} statuses @returns {boolean} whether there is none */
function showNothing(statuses) {
  const isBare = !statuses.some((status) => status === "ok" || status === "weak");
  const excluded = statuses.every((status) => status === "excluded");
  const why = excluded
    ? "Every frame is excluded, so there is nothing to draw. Take some back on the Review page."
    : "No frame could be measured, so there is nothing to draw. The Review page shows what was found in each.";
  tellNothing(isBare ? why : "");
  return isBare;
}

/** Where the video ends: with its last frame's own duration. */
function end_s() {
  const [before, last] = answer?.time_s.slice(-2) ?? [];
  return last === undefined ? Infinity : 2 * last - before;
}

function drawHistory() {
  if (answer === null) return;
  const key = axis === "x" ? "dx" : "dy";
  const column = /** @type {"p1_dx_m"} */ (`${point}_${key}_m`);
  const traces = [
    { label: "Raw", colour: "--series-5", width: 1.2 },
    { label: "Filtered", colour: "--series-1", width: 1.6 },
  ];
  const columns = [answer.raw[key], answer.filtered[key]];
  if (geometric) {
    const label = geometric.is_earlier ? "Geometric, before the change" : "Geometric";
    traces.push({ label, colour: "--series-2", width: 1.6 });
    columns.push(geometric[column]);
  }
  history.setStatuses(answer.status);
  const names = (/** @type {{label: string}[]} */ of) => of.map(({ label }) => label).join();
  if (names(history.traces) === names(traces)) history.setData([answer.time_s, ...columns]);
  else history.setTraces(traces, [answer.time_s, ...columns]);
}

/** @param {Sweep} newest */
function showSweep(newest) {
  sweep = newest;
  const traces = [
    { label: "East", colour: "--series-1", points: true },
    { label: "North", colour: "--series-2", points: true, dash: [6, 3] },
  ];
  sweepPlot.setTraces(traces, [newest.corners_hz, newest.rms_m.dx, newest.rms_m.dy]);
  kneeButton.hidden = newest.knee_hz === null;
  if (newest.knee_hz !== null) kneeButton.textContent = `Take the knee, ${fixed(newest.knee_hz, 3)} Hz`;
  kneeWords.textContent = wordsOfKnee(newest.knee);
  kneeWords.hidden = false;
  markCorner();
}

/** What the knee is, in figures that the plot beside it shows too: on one axis the curve may fall on. @param {Knee | null} knee */
function wordsOfKnee(knee) {
  if (knee === null) return "The curve has no knee: no corner frequency stands out.";
  const east_north = (/** @type {Rms} */ { dx, dy }) => `${millimetres(dx)} east and ${millimetres(dy)} north`;
  return `At the knee, nine tenths of what can be filtered out are gone: ${east_north(knee.rms_m)} remain. Higher corners leave ${east_north(knee.least_m)} at best, and take more of a residual or a slow building.`;
}

/** @param {unknown} error */
function showSweepProblem(error) {
  sweep = null;
  kneeButton.hidden = true;
  kneeWords.hidden = false;
  kneeWords.textContent = sentence(error);
}

function showNoInterval() {
  showSweepProblem(
    new Error("Give the pre-event interval first: drag across the plot where the building stands still."),
  );
}

/** @param {{before: Spectrum, during: Spectrum | null}} spectra */
function showSpectra({ before, during }) {
  const key = axis === "x" ? "dx_m" : "dy_m";
  spectrumPlot.setTraces(
    [
      { label: "Pre-event", colour: "--series-3" },
      { label: "Event", colour: "--series-5", dash: [5, 3] },
    ],
    /** @type {any} */ (onOneAxis([before, during], key)),
  );
  markCorner();
}

/**
 * Two spectra on one frequency axis: each keeps its own frequencies, the other has no value there.
 * @param {(Spectrum | null)[]} spectra
 * @param {"dx_m" | "dy_m"} key
 */
function onOneAxis(spectra, key) {
  const points = spectra.flatMap((spectrum, which) =>
    (spectrum?.frequency_hz ?? []).map((hz, i) => ({ hz, which, value: spectrum?.[key][i] ?? 0 })),
  );
  const useful = points.filter(({ hz, value }) => hz > 0 && value > 0).sort((a, b) => a.hz - b.hz);
  // undefined is bridged, null would be a gap
  return [
    useful.map(({ hz }) => hz),
    ...spectra.map((_, which) => useful.map((entry) => (entry.which === which ? entry.value : undefined))),
  ];
}

function markCorner() {
  const atKnee = Math.abs(corner_hz - (sweep?.knee_hz ?? 0)) < CORNER_STEP_HZ / 2;
  const corner = {
    at: corner_hz,
    label: `${atKnee ? "corner at the knee," : "corner"} ${fixed(corner_hz, 3)} Hz`,
    colour: "--accent",
  };
  const knee =
    sweep?.knee_hz && !atKnee
      ? [{ at: sweep.knee_hz, label: `knee ${fixed(sweep.knee_hz, 3)} Hz`, colour: "--series-4" }]
      : [];
  sweepPlot.setVerticals([corner, ...knee]);
  sweepPlot.setPlayHead(corner_hz);
  spectrumPlot.setVerticals([corner]);
}

function showFigures() {
  const figure = (/** @type {number | null | undefined} */ value_m, /** @type {string} */ name) =>
    h("div", {}, h("span", { class: "value" }, millimetres(value_m, 1)), h("span", { class: "name" }, name));
  const key = axis === "x" ? "dx" : "dy";
  const after = answer?.filtered_pre_event_rms_m?.[key];
  const exact = answer?.geometric_pre_event_rms_m?.[key];
  fill(
    figures,
    after == null ? null : figure(after, "filtered, pre-event RMS"),
    exact == null ? null : figure(exact, "geometric"),
  );
}

/** Preview another corner; nothing is saved yet. @param {number} wanted_hz */
function moveCorner(wanted_hz) {
  corner_hz = wanted_hz;
  slider.value = String(wanted_hz);
  slider.setAttribute("aria-valuetext", `${fixed(wanted_hz, 3)} hertz`);
  cornerField.set(wanted_hz);
  markCorner();
  filterAnew();
}

/** @param {number | null} wanted_hz */
function typeCorner(wanted_hz) {
  if (wanted_hz === null) return;
  moveCorner(Math.max(0.005, Math.round(wanted_hz * 1000) / 1000));
  saveCorner();
}

function saveCorner() {
  const wanted = corner_hz;
  if (wanted === store.project.drift.corner_hz) return;
  save(
    "Corner frequency",
    (draft) => {
      draft.drift.corner_hz = wanted;
    },
    store.project.drift.filter !== "none",
  );
}

/** @param {number} order */
function saveOrder(order) {
  save(
    "Filter order",
    (draft) => {
      draft.drift.order = order;
    },
    store.project.drift.filter !== "none",
  );
}

/** @param {boolean} on */
function chooseFilter(on) {
  save(
    on ? "Apply the filter" : "Do not filter",
    (draft) => {
      draft.drift.filter = on ? "high-pass" : "none";
    },
    true,
  );
}

/** @param {IntervalName} name @param {[number, number] | null} interval */
function saveInterval(name, interval) {
  const rounded =
    interval && /** @type {[number, number]} */ (interval.map((value) => Math.round(value * 1000) / 1000));
  const words = INTERVALS.find((entry) => entry.name === name)?.label ?? name;
  save(
    `${words} interval`,
    (draft) => {
      draft.intervals_s[name] = rounded;
    },
    true,
  );
}

/** An end is being pulled: draw it, and save when it is let go. @param {IntervalName} name @param {[number, number]} interval @param {boolean} done */
function moveInterval(name, interval, done) {
  if (done) saveInterval(name, interval);
}

/** @param {string} label @param {import("../lib/store.js").Change} change @param {boolean} changesResult */
function save(label, change, changesResult) {
  const saved = changesResult
    ? solver.edit(label, change, { merge: true })
    : store.edit(label, change, { merge: true });
  void saved.then(ask);
}

function onProject() {
  const { drift, intervals_s } = store.project;
  filterSwitch.checked = drift.filter !== "none";
  orderField.set(drift.order);
  fields.show(intervals_s);
  if (document.activeElement !== slider && drift.corner_hz !== corner_hz) moveCorner(drift.corner_hz);
  cornerField.set(corner_hz);
  slider.value = String(corner_hz);
  history.setIntervals(
    INTERVALS.flatMap(({ name, label, colour }) => {
      const interval = intervals_s[name];
      return interval
        ? [{ key: name, label: label.toLowerCase(), from: interval[0], to: interval[1], colour, editable: true }]
        : [];
    }),
  );
}

/** @param {string} wanted */
function chooseAxis(wanted) {
  axis = wanted === "y" ? "y" : "x";
  axisChoice.set(axis);
  setView({ axis: axis === "x" ? null : axis });
  drawHistory();
  ask();
}

/** @param {string} wanted */
function choosePoint(wanted) {
  point = wanted === "p2" ? "p2" : "p1";
  pointChoice.set(point);
  setView({ point: point === "p1" ? null : point });
  ask();
}

/** @param {string} wanted */
function chooseTarget(wanted) {
  target = wanted;
  setView({ target: wanted });
  geometric = null;
  filterAnew();
  void reload();
}
