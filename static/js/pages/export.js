// Validate and export: the history against GPS, the rows of the paper's Table 2, and everything to take home.

import { get, post, projectPath, sentence } from "../lib/api.js";
import { fill, find, h } from "../lib/dom.js";
import { centimetres, fixed, millimetres, milliseconds, plural, seconds, size } from "../lib/format.js";
import { icon } from "../lib/icons.js";
import { latest } from "../lib/latest.js";
import { setView, viewText } from "../lib/view-state.js";
import { busyOver } from "../components/busy.js";
import { fromBefore } from "../components/earlier-note.js";
import { stepUrl } from "../components/header.js";
import { AXES, fetchHistory, fetchResults } from "../components/histories.js";
import { isRunning, jobCard } from "../components/job-card.js";
import { whenMeasured } from "../components/measured.js";
import { note } from "../components/notes.js";
import { openPage } from "../components/page.js";
import { Plot } from "../components/plot.js";
import { segmented } from "../components/segmented.js";
import { toast, toastError } from "../components/toast.js";

/** @typedef {import("../components/histories.js").History} History */
/** @typedef {import("../components/histories.js").ResultFile} ResultFile */
/** @typedef {import("../components/histories.js").Results} Results */
/** @typedef {{time_s: number[], dx_m: (number | null)[], dy_m: (number | null)[]}} Curve */
/** @typedef {"peak_positive" | "peak_negative" | "residual"} Quantity */
/** @typedef {{quantity: Quantity, axis: "x" | "y", video_m: number, gps_m: number, error_m: number, error_percent: number | null, video_at_gps_m?: number | null, error_at_gps_m?: number | null}} TableRow */
/** @typedef {{validation: Validation | null, history: History | null, problem: string}} Curves of a target */
/** @typedef {{gps: Curve | null, video: Curve, error: Curve | null, lag_s: number | null, lag_sigma_s?: number | null, rms_m: {x: number, y: number} | null, table: TableRow[], message: string, is_coarse?: boolean, spacing?: string}} Validation */

/** @type {{name: Quantity, title: string}[]} */
const QUANTITIES = [
  { name: "peak_positive", title: "Peak, positive" },
  { name: "peak_negative", title: "Peak, negative" },
  { name: "residual", title: "Residual" },
];
/** @type {{test: RegExp, words: string}[]} */
const FILE_WORDS = [
  { test: /\.csv$/, words: "Displacement history, a row per frame" },
  { test: /^summary\.json$/, words: "Peaks, residual, fits, settings" },
  { test: /^report\.html$/, words: "Report to read and print" },
  { test: /^orthoimage\.tif$/, words: "Orthoimage, georeferenced" },
];

const page = await openPage("export");
let results = await whenMeasured(
  page,
  "Track the video first; the result is then compared with GPS and exported from here.",
);

let axis = viewText("axis") === "y" ? "y" : "x";
let target = results.targets.find((name) => name === viewText("target")) ?? results.targets[0] ?? "";
/** @type {Validation | null} */
let validation = null;
/** @type {History | null} */
let history = null;
let problem = "";

// the page
const axisChoice = segmented({
  label: "Axis",
  choices: AXES.map(({ value, name }) => ({ value, name })),
  value: axis,
  onChange: chooseAxis,
});
const targetChoice = segmented({
  label: "Target",
  choices: results.targets.map((name) => ({ value: name, name })),
  value: target,
  onChange: chooseTarget,
});
targetChoice.element.hidden = results.targets.length < 2;
const beforeBox = h("div", { role: "status", hidden: true });
const overlayBox = h("div", { class: "export-overlay" });
const errorBox = h("div", { class: "export-error" });
const tableBox = h("section", { class: "card export-table", "aria-label": "Peaks and residual" });
const gpsBox = h("section", { class: "section", "aria-label": "GPS" });
const fileBox = h("section", { class: "section", "aria-label": "Files" });
const archiveBox = h("section", { class: "section", "aria-label": "Project archive" });
fill(
  find("#main"),
  h(
    "div",
    { class: "stage" },
    h(
      "div",
      { class: "stage-bar" },
      h("h1", {}, "Validate and export"),
      targetChoice.element,
      h("span", { class: "spring" }),
      axisChoice.element,
    ),
    h("div", { class: "stage-body export-stage" }, beforeBox, overlayBox, errorBox, tableBox),
  ),
  h("aside", { class: "side", "aria-label": "Validation and files" }, gpsBox, fileBox, archiveBox),
);
const overlay = new Plot(overlayBox, { title: "Displacement", unit: "m", link: "export", drag: "view" });
const errorPlot = new Plot(errorBox, { title: "Video less GPS", unit: "m", link: "export", drag: "view" });
const reportJob = jobCard();
const reload = latest(askResults, showResults, toastError);
const loadCurves = latest(askCurves, showCurves, toastError);

page.events.on("results", () => void reload(null));
page.events.on("online", () => void reload(null));
page.store.on("change", ({ origin }) => origin === "undo" && void reload(null));
page.events.on("job", onJob);
page.keys([
  { keys: "A", group: "Validate", label: "East or north", run: () => chooseAxis(axis === "x" ? "y" : "x") },
  {
    keys: "D",
    group: "Export",
    label: "Download the displacement history",
    run: () => find("a[data-main]", HTMLAnchorElement).click(),
    when: () => document.querySelector("a[data-main]") !== null,
  },
  { keys: "Wheel", group: "Plots", label: "Zoom in time; a drag pans, a double click shows all" },
]);
showArchive();
void reload(null);

function askResults() {
  return fetchResults(page.id).finally(busyOver(overlayBox, "Reading the results…"));
}

/** What the files say comes first; the curves follow, since the engine may have to solve for them. @param {Results} newest */
function showResults(newest) {
  results = newest;
  showAll();
  void loadCurves(target);
}

/** Whether only the result from before a change can be shown: nothing has been measured as the project stands now. */
function isFromBefore() {
  return results.stale && !results.measured.includes(page.store.project.method);
}

/** @param {string} of a target @returns {Promise<Curves>} */
async function askCurves(of) {
  const { inputs, drift } = page.store.project;
  const done = busyOver(overlayBox, "Solving for the curves…");
  const corner_hz = drift.filter === "high-pass" ? drift.corner_hz : null;
  const method = isFromBefore() ? results.summary?.method : undefined;
  /** @type {Curves} */
  const found = { validation: null, history: null, problem: "" };
  const noted = (/** @type {unknown} */ error) => ((found.problem ||= sentence(error)), null);
  if (inputs.gps !== null && !isFromBefore())
    found.validation = await get(projectPath(page.id, "validation", { target: of, corner_hz })).catch(noted);
  if (found.validation === null) found.history = await fetchHistory(page.id, of, method).catch(noted);
  done();
  return found;
}

/** @param {Curves} newest */
function showCurves(newest) {
  ({ validation, history, problem } = newest);
  showAll();
}

function showAll() {
  showBefore();
  draw();
  showGps();
  showTable();
  showFiles();
}

/** What is shown is the project's, or it says so. */
function showBefore() {
  const nothing = validation === null && history === null && problem !== "";
  const before = isFromBefore() || Boolean(history?.is_earlier);
  beforeBox.hidden = !nothing && !before;
  fill(beforeBox, beforeBox.hidden ? null : fromBefore(page, nothing ? problem : undefined));
}

function draw() {
  const key = axis === "x" ? "dx_m" : "dy_m";
  const title = AXES.find((entry) => entry.value === axis)?.title ?? "";
  find(".plot-title", HTMLElement, overlayBox).textContent = title;
  const gps = validation?.gps;
  errorBox.hidden = !gps || !validation?.error;
  if (validation && gps) {
    const [time, video, reference] = joined(validation.video, gps, key);
    overlay.setTraces(
      [
        { label: "Video", colour: "--series-1", width: 1.6 },
        { label: "GPS", colour: "--series-2", dash: [5, 3], width: 1.6 },
      ],
      /** @type {any} */ ([time, video, reference]),
    );
    const { error } = validation;
    if (error) errorPlot.setTraces([{ label: "Error", colour: "--series-4" }], [error.time_s, error[key]]);
    overlay.setStatuses([]);
    const domain = /** @type {[number, number]} */ ([time[0], time.at(-1) ?? 1]);
    overlay.setDomain(domain);
    errorPlot.setDomain(domain);
  } else if (history) {
    overlay.setTraces(
      [
        { label: "P1", colour: "--series-1" },
        { label: "P2", colour: "--series-3", dash: [6, 4] },
      ],
      [history.time_s, history[`p1_${key}`], history[`p2_${key}`]],
    );
    overlay.setDomain(null);
    overlay.setStatuses(history.status);
  } else overlay.setTraces([], [[]]);
}

/**
 * Two records on one time axis. Where only the other one has a value: undefined, which the plot bridges;
 * where one was not measured: null, which is a gap.
 * @param {Curve} a
 * @param {Curve} b
 * @param {"dx_m" | "dy_m"} key
 */
function joined(a, b, key) {
  const points = [
    ...a.time_s.map((time, i) => ({ time, a: a[key][i], b: /** @type {number | null | undefined} */ (undefined) })),
    ...b.time_s.map((time, i) => ({ time, a: undefined, b: b[key][i] })),
  ];
  points.sort((one, other) => one.time - other.time);
  return [points.map((entry) => entry.time), points.map((entry) => entry.a), points.map((entry) => entry.b)];
}

function showGps() {
  const given = page.store.project.inputs.gps !== null;
  const compared = validation ?? results.summary?.targets?.[target]?.gps ?? null;
  const figure = (/** @type {string} */ value, /** @type {string} */ name) =>
    h("div", {}, h("span", { class: "value" }, value), h("span", { class: "name" }, name));
  fill(
    gpsBox,
    h(
      "header",
      {},
      h("h2", {}, "Against GPS"),
      compared && validation === null && results.stale ? h("span", { class: "badge warn" }, "from before the change") : null,
    ),
    given
      ? null
      : note(
          "info",
          "No GPS record is given, so there is nothing to compare with. Peaks and residual below come from the video alone.",
        ),
    given
      ? null
      : h(
          "div",
          { class: "toolbar" },
          h("a", { class: "button small", href: stepUrl(page.id, "inputs") }, "Add a GPS record"),
        ),
    problem ? note("warn", problem) : null,
    compared?.message ? note("warn", compared.message) : null,
    compared &&
      h(
        "div",
        { class: "figures" },
        figure(millimetres(compared.rms_m?.x, 1), "RMS error, east"),
        figure(millimetres(compared.rms_m?.y, 1), "RMS error, north"),
        figure(lagWords(compared.lag_s), "clock lag, applied"),
      ),
    compared && h("p", { class: "small soft" }, lagSentence(compared)),
    compared?.spacing && h("p", { class: "small soft" }, compared.spacing),
  );
}

/** @param {number | null} lag_s */
function lagWords(lag_s) {
  return `${lag_s !== null && lag_s > 0 ? "+" : ""}${seconds(lag_s, 3)}`;
}

/** @param {Validation} given */
function lagSentence({ lag_s, lag_sigma_s }) {
  if (lag_s === null || !lag_sigma_s) return "The clock lag could not be told.";
  const direction = lag_s > 0 ? "behind" : "ahead of";
  return `The GPS clock runs ${direction} the video by ${seconds(Math.abs(lag_s), 3)} (±\u202f${milliseconds(lag_sigma_s)}), found from the motion itself.`;
}

function showTable() {
  const rows = validation?.table ?? rowsOf(results.summary?.targets?.[target]?.gps);
  fill(
    tableBox,
    h(
      "header",
      {},
      h("h2", {}, rows.length ? "Peaks and residual, video and GPS" : "Peaks and residual"),
      results.stale && validation === null ? h("span", { class: "badge warn" }, "from before the change") : null,
      h("span", { class: "badge" }, target),
    ),
    unseenNote(),
    rows.length ? comparisonTable(rows) : summaryTable(),
  );
}

/** A peak in a frame that was not measured is in no table. */
function unseenNote() {
  const { event } = page.store.project.intervals_s;
  const time_s = validation?.video.time_s ?? history?.time_s ?? [];
  const moved = validation?.video.dx_m ?? history?.p1_dx_m ?? [];
  const isShaken = (/** @type {number} */ time) => event === null || (time >= event[0] && time <= event[1]);
  const unseen = time_s.filter((time, i) => moved[i] === null && isShaken(time)).length;
  if (unseen === 0) return null;
  const where = event === null ? "" : " of the event";
  return note("warn", `${plural(unseen, "frame")}${where} excluded or lost: the true peak may lie among them.`);
}

/**
 * Rows of the comparison as the summary keeps them.
 * @param {any} gps of a target in summary.json
 * @returns {TableRow[]}
 */
function rowsOf(gps) {
  if (!gps) return [];
  return QUANTITIES.flatMap(({ name }) =>
    AXES.flatMap(({ value }) => {
      const row = gps[`${name}_m`]?.[value];
      return row
        ? [
            {
              quantity: name,
              axis: value,
              video_m: row.video,
              gps_m: row.gps,
              error_m: row.error,
              error_percent: row.error_percent,
            },
          ]
        : [];
    }),
  );
}

/** The paper's Table 2: a row per axis. @param {TableRow[]} rows */
function comparisonTable(rows) {
  const cells = (/** @type {Quantity} */ quantity, /** @type {"x" | "y"} */ of) => {
    const row = rows.find((entry) => entry.quantity === quantity && entry.axis === of);
    if (row === undefined) return [h("td", { class: "number group faint", colspan: 3 }, "–")];
    const percent =
      row.error_percent === null
        ? null
        : h("span", { class: "faint" }, ` (${fixed(row.error_percent, row.error_percent < 100 ? 1 : 0)} %)`);
    return [
      h("td", { class: "number group" }, fixed(row.video_m * 100, 2)),
      h("td", { class: "number" }, fixed(row.gps_m * 100, 2)),
      h("td", { class: "number strong" }, fixed(row.error_m * 100, 2), percent),
    ];
  };
  return h(
    "table",
    { class: "table comparison" },
    h("caption", { class: "visually-hidden" }, "Peak and residual displacement from video and GPS, centimetres"),
    h(
      "thead",
      {},
      h(
        "tr",
        {},
        h("th", { rowspan: 2, scope: "col" }, "cm"),
        QUANTITIES.map(({ title }) => h("th", { colspan: 3, scope: "colgroup", class: "group centre" }, title)),
      ),
      h(
        "tr",
        {},
        QUANTITIES.flatMap(() =>
          ["Video", "GPS", "Error"].map((title, i) =>
            h("th", { scope: "col", class: `number ${i === 0 ? "group" : ""}` }, title),
          ),
        ),
      ),
    ),
    h(
      "tbody",
      {},
      AXES.flatMap((entry) => [
        h(
          "tr",
          {},
          h("th", { scope: "row" }, entry.name),
          QUANTITIES.flatMap(({ name }) => cells(name, entry.value)),
        ),
        validation?.is_coarse && instantRow(rows, entry),
      ]),
    ),
  );
}

/** Peaks at the instants of the GPS ones, where its samples straddle the video's. @param {TableRow[]} rows @param {typeof AXES[number]} axis */
function instantRow(rows, axis) {
  const cells = QUANTITIES.flatMap(({ name }) => {
    const row = rows.find((entry) => entry.quantity === name && entry.axis === axis.value);
    if (row?.video_at_gps_m == null || row.error_at_gps_m == null) return [h("td", { class: "group", colspan: 3 })];
    return [
      h("td", { class: "number group" }, fixed(row.video_at_gps_m * 100, 2)),
      h("td", { class: "number" }, fixed(row.gps_m * 100, 2)),
      h("td", { class: "number strong" }, fixed(row.error_at_gps_m * 100, 2)),
    ];
  });
  return h("tr", { class: "at-gps" }, h("th", { scope: "row", class: "soft" }, "at the GPS instant"), cells);
}

/** Without GPS: what the video alone tells, P1 and P2. */
function summaryTable() {
  const summary = results.summary?.targets?.[target];
  if (!summary) return h("p", { class: "soft" }, "The summary has no rows for this target.");
  const peak = (/** @type {any} */ entry) =>
    h(
      "td",
      { class: "number" },
      centimetres(entry?.value, 2),
      h("span", { class: "faint" }, entry ? ` at ${fixed(entry.time_s, 2)} s` : ""),
    );
  const rows = [
    ["P1", summary],
    ["P2", summary.p2],
  ]
    .filter(([, of]) => of)
    .flatMap(([name, of]) =>
      AXES.map((entry) =>
        h(
          "tr",
          {},
          h("th", { scope: "row" }, `${name}, ${entry.name}`),
          peak(of.peak_positive_m?.[entry.value]),
          peak(of.peak_negative_m?.[entry.value]),
          h("td", { class: "number" }, centimetres(of.residual_m?.[entry.value], 2)),
          h("td", { class: "number" }, millimetres(of.pre_event_rms_m?.[entry.value], 2)),
        ),
      ),
    );
  const head = ["", "Peak, positive", "Peak, negative", "Residual", "Pre-event RMS"].map((title, i) =>
    h("th", { scope: "col", class: i ? "number" : "" }, title),
  );
  return h("table", { class: "table comparison" }, h("thead", {}, h("tr", {}, head)), h("tbody", {}, rows));
}

function showFiles() {
  const files = [...results.files].sort((a, b) => rank(a) - rank(b));
  const report = files.some(({ name }) => name === "report.html");
  const make = h(
    "button",
    { type: "button", class: "button small", onclick: makeReport },
    icon("refresh", "small"),
    report ? "Remake" : "Make the report",
  );
  fill(
    fileBox,
    h("header", {}, h("h2", {}, "Files"), make),
    staleNote(),
    reportJob.element,
    h("ul", { class: "file-rows" }, files.filter((file) => !isFigure(file)).map(fileRow)),
    figureRows(files.filter(isFigure)),
  );
}

/** What is to be done about files older than the project: once all is measured, making them needs no video. */
function staleNote() {
  if (!results.stale) return null;
  const since = "The project has changed since these files were made";
  if (isFromBefore()) return note("warn", `${since}; measure it again on the Track page.`);
  const words = note("warn", `${since}.`);
  words.append(h("button", { type: "button", class: "button small", onclick: makeReport }, "Update them"));
  return words;
}

/** @param {ResultFile} file */
function isFigure({ name }) {
  return /\.(png|svg|pdf)$/.test(name);
}

/** @param {ResultFile[]} figures */
function figureRows(figures) {
  if (figures.length === 0) return null;
  return h(
    "details",
    { class: "more-files" },
    h("summary", {}, plural(figures.length, "figure")),
    h("ul", { class: "file-rows" }, figures.map(fileRow)),
  );
}

/** @param {ResultFile} file */
function rank({ name }) {
  if (name === `${target}.csv`) return -1;
  const at = FILE_WORDS.findIndex(({ test }) => test.test(name));
  return at < 0 ? FILE_WORDS.length : at;
}

/** @param {ResultFile} file */
function fileRow(file) {
  const url = `/api/${projectPath(page.id, `files/${file.name.split("/").map(encodeURIComponent).join("/")}`)}`;
  const main = file.name === `${target}.csv`;
  const words = FILE_WORDS.find(({ test }) => test.test(file.name))?.words ?? "";
  const open = file.name.endsWith(".html")
    ? h(
        "a",
        {
          class: "button quiet small icon-only",
          href: url,
          target: "_blank",
          rel: "noopener",
          "aria-label": `Open ${file.name}`,
          title: "Open",
        },
        icon("expand", "small"),
      )
    : null;
  return h(
    "li",
    {},
    icon("file"),
    h(
      "span",
      { class: "file-words" },
      h("span", { class: "file-name", title: file.name }, file.name.replace(/^figures\//, "")),
      words ? h("span", { class: "small faint" }, words) : null,
    ),
    h("span", { class: "number small faint" }, size(file.size)),
    open,
    h(
      "a",
      {
        class: `button small icon-only ${main ? "primary" : "quiet"}`,
        href: url,
        download: file.name,
        "aria-label": `Download ${file.name}`,
        title: `Download ${file.name}`,
        "data-main": main,
      },
      icon("download", "small"),
    ),
  );
}

function showArchive() {
  const inputs = h("input", { type: "checkbox", checked: true });
  const link = h("a", { class: "button", download: `${page.id}.zip` }, icon("archive"), "Download the project");
  const point = () => (link.href = `/api/${projectPath(page.id, "archive", { inputs: inputs.checked ? 1 : 0 })}`);
  inputs.addEventListener("change", point);
  point();
  fill(
    archiveBox,
    h("header", {}, h("h2", {}, "Whole project")),
    h(
      "p",
      { class: "small soft" },
      "One archive with every decision and result. Restore it on any computer from the list of projects.",
    ),
    h("label", { class: "check" }, inputs, "With video, cloud, lens and GPS"),
    h("div", { class: "toolbar" }, link),
  );
}

async function makeReport() {
  try {
    const { job } = await post(projectPath(page.id, "report"));
    onJob(job);
  } catch (error) {
    toastError(error);
  }
}

/** @param {import("../lib/types.js").Job} job */
function onJob(job) {
  if (job.kind !== "report") return;
  reportJob.show(job);
  if (isRunning(job)) return;
  if (job.state === "done") toast("Files and report are ready.", { tone: "good" });
  void reload(null);
}

/** @param {string} wanted */
function chooseAxis(wanted) {
  axis = wanted === "y" ? "y" : "x";
  axisChoice.set(axis);
  setView({ axis: axis === "x" ? null : axis });
  draw();
}

/** @param {string} wanted */
function chooseTarget(wanted) {
  target = wanted;
  setView({ target: wanted });
  showCurves({ validation: null, history: null, problem: "" });
  void loadCurves(target);
}
