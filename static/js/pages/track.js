// Track: measure every frame, and watch the history grow.

import { get, post, projectPath, remove, sentence } from "../lib/api.js";
import { fill, find, h, refill } from "../lib/dom.js";
import { count, duration, fixed, millimetres, pixels, plural } from "../lib/format.js";
import { icon } from "../lib/icons.js";
import { told } from "../lib/problems.js";
import { setView, viewText } from "../lib/view-state.js";
import { busyOver } from "../components/busy.js";
import { stepUrl } from "../components/header.js";
import { filterBadge } from "../components/filter-badge.js";
import { AXES, fetchHistory, fetchResults, methodName, METHODS } from "../components/histories.js";
import { isRunning, stageWords } from "../components/job-card.js";
import { note } from "../components/notes.js";
import { openPage } from "../components/page.js";
import { problemNote } from "../components/problem-note.js";
import { Plot } from "../components/plot.js";
import { segmented } from "../components/segmented.js";
import { announce, toastError } from "../components/toast.js";

/** @typedef {import("../lib/types.js").Job} Job */
/** @typedef {[frame: number, time_s: number, dx_m: number | null, dy_m: number | null, status: string]} Row */
/** @typedef {{job: Job | null, resumable: boolean, frames_done: number, frames_total: number, message: string | null, first_values_after: number, preview: Record<string, Row[]>}} TrackState */

// The stage of a measurement that counts frames; the others are short.
const MEASURING = "measuring";

const page = await openPage("track");
const { store } = page;

/** @type {TrackState} */
let track = { job: null, resumable: false, frames_done: 0, frames_total: 0, message: null, first_values_after: 0, preview: {} };
/** Rows by target and frame: chunks may arrive in any order. @type {Map<string, Map<number, Row>>} */
const rows = new Map();
/** @type {import("../components/histories.js").Results | null} */
let results = null;
let target = viewText("target") ?? "";
let duration_s = 0;
let starting = false;
let drawing = 0;
/** How often a job began or ended, as far as known here: an answer asked for before the last time is out of date. */
let turns = 0;
/** Questions for the results: how many were asked, and which of them has been answered last. */
const questions = { asked: 0, answered: 0 };
/** A job has ended, and what it kept is not known yet. */
let reading = false;

const targetChoice = segmented({ label: "Target", choices: [], value: target, onChange: chooseTarget });
const live = h("span", { class: "badge accent", hidden: true }, "Growing as frames arrive");
const plotArea = h("div", { class: "plot-stack" });
const controls = h("section", { class: "section", "aria-label": "Measurement" });
const methods = h(
  "section",
  { class: "section" },
  h("header", {}),
  h("div", { class: "choices", role: "radiogroup", "aria-label": "Method" }),
);
const facts = h("section", { class: "section", "aria-label": "Result" });
const empty = h("div", { class: "stage-empty", hidden: true });
fill(
  find("#main"),
  h(
    "div",
    { class: "stage" },
    h("div", { class: "stage-bar" }, h("h1", {}, "Track"), targetChoice.element, h("span", { class: "spring" }), live),
    h("div", { class: "stage-body padded" }, plotArea, empty),
  ),
  h("aside", { class: "side", "aria-label": "Run" }, controls, methods, facts),
);
const plots = AXES.map(
  (axis) => new Plot(plotArea, { title: axis.title, unit: "m", link: "track", drag: "view", leastSpan: 0.02 }),
);
plots.forEach((plot, i) => plot.setTraces([{ label: "P1", colour: i === 0 ? "--series-1" : "--series-2" }], [[], []]));

page.keys([
  {
    keys: "R",
    group: "Track",
    label: "Start or resume",
    run: () => void start(false),
    when: canStart,
  },
  {
    keys: "Shift+R",
    group: "Track",
    label: "Measure again from the first frame",
    run: () => void start(true),
    when: canStart,
  },
  {
    keys: "C",
    group: "Track",
    label: "Cancel; what is measured is kept",
    run: () => void cancel(),
    when: () => isRunning(track.job),
  },
]);
store.on("change", show);
page.events.on("hello", () => void catchUp());
page.events.on("offline", show);
page.events.on("online", show);
page.events.on("job", onJob);
page.events.on("track", addRows);
page.events.on("results", () => void loadResults());
const opened = busyOver(find(".stage-body"), "Reading the results…");
await catchUp();
opened();
await loadDuration();

/** Ask for the whole state: at first, when a job has ended, and whenever the connection was lost. @returns {Promise<void>} */
async function catchUp() {
  const turn = turns;
  try {
    const [answer] = await Promise.all([get(projectPath(page.id, "track")), readResults()]);
    if (turn !== turns) return catchUp();
    track = answer;
    for (const [name, list] of Object.entries(track.preview ?? {})) for (const row of list) keep(name, row);
  } catch (error) {
    toastError(error);
  }
  reading = false;
  show();
  await loadHistory();
}

async function loadDuration() {
  const inputs = await get(projectPath(page.id, "inputs")).catch(() => null);
  duration_s = inputs?.video?.duration_s ?? 0;
  draw();
}

/** Take the results as they are now; an answer that comes after that to a later question is out of date. */
async function readResults() {
  const question = (questions.asked += 1);
  const answer = await fetchResults(page.id).catch(() => null);
  if (question < questions.answered) return;
  questions.answered = question;
  results = answer;
}

async function loadResults() {
  await readResults();
  await loadHistory();
  show();
}

/** Whether the video has been measured by the method chosen now: another one has a curve of its own. */
function isMeasured() {
  return results?.measured.includes(store.project.method) ?? false;
}

/** The finished history takes the place of what was drawn while it grew; until there is one, what was measured before. */
async function loadHistory() {
  if (!results?.ready || isGrowing()) return;
  const name = currentTarget();
  const method = isMeasured() ? store.project.method : results?.methods[0];
  if (!results?.targets.includes(name) && !isMeasured()) return;
  try {
    const history = await fetchHistory(page.id, name, method);
    if (isGrowing()) return;
    rows.set(
      name,
      new Map(
        history.frame.map((frame, i) => [
          frame,
          [frame, history.time_s[i], history.p1_dx_m[i], history.p1_dy_m[i], history.status[i]],
        ]),
      ),
    );
  } catch (error) {
    toastError(error);
  }
  draw();
}

/** @param {Job} job */
function onJob(job) {
  if (job.kind !== "track") return;
  const ended = isRunning(track.job) && !isRunning(job);
  if (ended || job.id !== track.job?.id) turns += 1;
  track = { ...track, job };
  if (ended) {
    reading = true;
    show();
    announce(job.state === "done" ? "The measurement is finished." : `The measurement stopped. ${told(job.message ?? "").words}`);
    return void catchUp(); // what was kept, and so what can be done next, is not known before
  }
  show();
}

/** @param {{target?: string, rows: Row[] | Record<string, Row[]>}} event */
function addRows(event) {
  const byTarget = Array.isArray(event.rows) ? { [event.target ?? currentTarget()]: event.rows } : event.rows;
  for (const [name, list] of Object.entries(byTarget)) for (const row of list) keep(name, row);
  if (drawing === 0) drawing = requestAnimationFrame(draw);
}

/** @param {string} name @param {Row} row */
function keep(name, row) {
  const known = rows.get(name) ?? new Map();
  rows.set(name, known.set(row[0], row));
}

/** Whether a history grows now, which nothing measured before may take the place of. */
function isGrowing() {
  return starting || isRunning(track.job);
}

function canStart() {
  return !isRunning(track.job) && !reading && !blocked();
}

/** @param {boolean} fresh measure again from the first frame */
async function start(fresh) {
  if (starting) return; // a double click
  starting = true;
  turns += 1;
  try {
    if (fresh || !track.resumable) rows.clear();
    await store.settled();
    const { job } = await post(projectPath(page.id, "track"), { fresh });
    track = { ...track, job, message: null };
    turns += 1;
  } catch (error) {
    toastError(error);
  }
  starting = false;
  show();
  void loadHistory(); // where nothing was started
}

async function cancel() {
  try {
    const { job } = await remove(projectPath(page.id, "track"));
    if (job?.id === track.job?.id && isRunning(track.job)) track = { ...track, job };
  } catch (error) {
    toastError(error);
  }
  show();
}

/** @param {string} name */
function chooseTarget(name) {
  target = name;
  setView({ target: name });
  void loadHistory();
  draw();
}

function targetNames() {
  return store.project.targets.map((entry) => entry.name);
}

function currentTarget() {
  return targetNames().includes(target) ? target : (targetNames()[0] ?? "");
}

function blocked() {
  return (store.state.problems ?? []).length > 0;
}

function show() {
  targetChoice.element.hidden = targetNames().length < 2;
  targetChoice.offer(targetNames().map((name) => ({ value: name, name })));
  targetChoice.set(currentTarget());
  live.hidden = !isRunning(track.job) || !page.events.online;
  showControls();
  showMethods();
  showFacts();
  draw();
}

/** Nothing, where frames are still missing: processes measure several parts of a clip at a time. @param {Row} row @returns {Row} */
function gapBefore([frame, time_s]) {
  return [frame - 1, time_s - 1e-3, null, null, "ok"];
}

function draw() {
  drawing = 0;
  const known = [...(rows.get(currentTarget()) ?? new Map()).values()].sort((a, b) => a[0] - b[0]);
  const list = known.flatMap((row, i) => (i > 0 && row[0] > known[i - 1][0] + 1 ? [gapBefore(row), row] : [row]));
  const domain = /** @type {[number, number]} */ ([0, Math.max(duration_s, list.at(-1)?.[1] ?? 0) || 1]);
  plots.forEach((plot, axis) => {
    plot.domain = domain;
    plot.statuses = list.map((row) => row[4] ?? "ok");
    plot.setData([list.map((row) => row[1]), list.map((row) => row[2 + axis])]);
  });
  const nothing = list.length === 0;
  const earlier = results?.ready && !isMeasured() && !track.resumable && !isRunning(track.job);
  plotArea.classList.toggle("faint", nothing || Boolean(earlier));
  empty.hidden = !nothing;
  const words = isRunning(track.job)
    ? `The first values appear after ${plural(track.first_values_after, "frame")}.`
    : "The displacement history appears here while the video is measured.";
  if (nothing) fill(empty, h("p", {}, words));
}

function showControls() {
  const { job } = track;
  if (isRunning(job)) return showRunning(/** @type {Job} */ (job));
  if (reading) return showReading();
  const problems = store.state.problems ?? [];
  const done = results?.ready && !results.stale && !track.resumable && isMeasured();
  const notes = [
    ...problems.map((problem) => problemNote("bad", problem, page)),
    problems.length === 0 && failure() ? problemNote("bad", failure(), page) : null,
    problems.length === 0 && track.resumable ? note("info", stoppedWords()) : null,
    problems.length === 0 && !track.resumable && results?.ready ? earlierNote() : null,
    done && job?.state !== "failed" ? note("good", doneWords()) : null,
    ...(done ? (results?.summary?.warnings ?? []) : []).map((/** @type {string} */ warning) => note("warn", told(warning).words)),
  ];
  refill(controls, h("header", {}, h("h2", {}, "Measurement")), notes, buttons(Boolean(done)));
}

/** A job has ended: what it kept, and so what can be done next, is being asked for. */
function showReading() {
  const words = track.job?.state === "done" ? "Reading the result…" : "Reading what was kept…";
  refill(controls, h("header", {}, h("h2", {}, "Measurement")), h("p", { class: "soft", role: "status" }, words));
}

/** Why the last measurement failed, as its job says or, after a restart, the step; empty where it did not. */
function failure() {
  const { status, message } = store.state.steps.track;
  if (track.job?.state === "failed") return track.job.message || "The measurement failed.";
  return status === "error" ? message : "";
}

/** What the curve shows while it is not the one of the project as it stands; null where it is. */
function earlierNote() {
  const of = methodName(results?.methods[0] ?? "").toLowerCase();
  if (!isMeasured())
    return note("info", `Not measured by this method yet. The faint curve is the one of the ${of} method.`);
  if (!results?.stale) return null;
  return note("warn", "The project has changed since these results were made: the figures and the files are older.");
}

/** @param {boolean} done */
function buttons(done) {
  const off = blocked();
  const first = track.resumable ? "Resume" : results?.stale && isMeasured() ? "Update results" : "Start";
  const go = h(
    "button",
    { type: "button", class: `button ${done ? "" : "primary"}`, disabled: off, onclick: () => void start(done) },
    icon(done ? "refresh" : "play"),
    done ? "Measure again" : first,
  );
  const again = h(
    "button",
    { type: "button", class: "button quiet", disabled: off, onclick: () => void start(true) },
    "Start from the first frame",
  );
  const onwards = h(
    "a",
    { class: "button primary", href: stepUrl(page.id, "review") },
    "Review the result",
    icon("arrow_right"),
  );
  return h("div", { class: "toolbar" }, done ? [onwards, go] : [go, track.resumable || results?.stale ? again : null]);
}

/** @param {Job} job */
function showRunning(job) {
  const share = job.total > 0 ? job.done / job.total : null;
  const stopping = job.message !== ""; // a running job says nothing else
  const { online } = page.events; // what is heard no more stands still, and is not told as going on
  const title = online ? stageWords(job) : "Connection lost";
  const bar = h("progress", { max: 1, "aria-label": "Progress", value: share, class: online ? null : "frozen" });
  const stop = h(
    "button",
    { type: "button", class: "button", disabled: !online || stopping, onclick: () => void cancel() },
    icon("close"),
    "Cancel",
  );
  refill(
    controls,
    h(
      "header",
      {},
      h("h2", {}, title),
      h("span", { class: "number soft" }, share === null ? "" : `${fixed(100 * share, 0)} %`),
    ),
    bar,
    job.stage === MEASURING ? measuringFigures(job) : null,
    h(
      "p",
      { class: "small faint" },
      stopping
        ? job.message
        : online
          ? "You may close this tab: the measurement goes on, and every frame is kept."
          : "Every frame measured so far is kept; once the server is back, the measurement goes on from there.",
    ),
    h("div", { class: "toolbar" }, stop),
  );
}

/** @param {Job} job */
function measuringFigures(job) {
  const { online } = page.events;
  const figure = (/** @type {string} */ value, /** @type {string} */ name) =>
    h("div", {}, h("span", { class: "value" }, value), h("span", { class: "name" }, name));
  return h(
    "div",
    { class: "figures" },
    figure(`${count(job.done)} / ${count(job.total)}`, "frames"),
    figure(online && job.rate_per_s ? fixed(job.rate_per_s, 1) : "–", "frames/s"),
    figure(online ? duration(job.seconds_left) : "–", "left"),
  );
}

function stoppedWords() {
  return `${count(track.frames_done)} of ${plural(track.frames_total, "frame")} are measured and kept. Resuming goes on from there.`;
}

function doneWords() {
  const { frames, frames_measured, seconds, frames_per_second } = results?.summary ?? {};
  const speed =
    frames_measured && frames_per_second ? ` in ${duration(seconds)}, ${fixed(frames_per_second, 1)} frames/s` : "";
  return `Measured ${plural(frames ?? track.frames_total, "frame")}${speed}.`;
}

function showMethods() {
  fill(find("header", HTMLElement, methods), h("h2", {}, "Method"), filterBadge(store));
  const box = find(".choices", HTMLElement, methods);
  const focused = box.contains(document.activeElement);
  refill(
    box,
    METHODS.map((method) => {
      const on = store.project.method === method.value;
      const input = h("input", {
        type: "radio",
        name: "method",
        value: method.value,
        checked: on,
        disabled: isRunning(track.job),
        onchange: () => chooseMethod(method.value),
      });
      return h(
        "label",
        { class: `choice ${on ? "on" : ""}` },
        input,
        h("span", {}, h("strong", {}, method.name), h("span", { class: "small soft" }, method.line)),
      );
    }),
  );
  if (focused) /** @type {HTMLElement | null} */ (box.querySelector("input:checked"))?.focus();
}

/** @param {"geometric" | "paper"} method */
function chooseMethod(method) {
  const name = METHODS.find((entry) => entry.value === method)?.name ?? method;
  void store
    .edit(`Method: ${name}`, (draft) => {
      draft.method = method;
      draft.drift.filter = method === "paper" ? "high-pass" : "none";
    })
    .then(() => loadResults())
    .catch((error) => announce(sentence(error)));
}

function showFacts() {
  const counts = results?.summary?.targets?.[currentTarget()]?.counts;
  facts.hidden = !results?.ready || !counts || !isMeasured() || isRunning(track.job);
  if (facts.hidden) return;
  const statusLine = (/** @type {string} */ status, /** @type {string} */ words) => [
    h("dt", {}, h("span", { class: `status-key ${status}` }), status),
    h("dd", {}, `${count(counts[status] ?? 0)} `, h("span", { class: "faint" }, words)),
  ];
  fill(
    facts,
    h("header", {}, h("h2", {}, "Frames")),
    h(
      "dl",
      { class: "facts" },
      statusLine("ok", "measured"),
      statusLine("weak", "measured from few points"),
      statusLine("lost", "could not be measured"),
      statusLine("excluded", "rejected by you"),
    ),
    h("header", {}, h("h2", {}, "Quality")),
    h("dl", { class: "facts" }, qualityFacts()),
  );
}

/** What the engine says of its own fits. */
function qualityFacts() {
  const {
    reference_fit: reference,
    ground_fit: ground,
    self_calibration: calibration,
    targets,
  } = results?.summary ?? {};
  const sigma = targets?.[currentTarget()]?.sigma_median_m;
  const fact = (/** @type {string} */ name, /** @type {string} */ value, /** @type {string} */ words = "") => [
    h("dt", {}, name),
    h("dd", {}, value, words && h("span", { class: "faint" }, ` ${words}`)),
  ];
  return [
    reference
      ? fact("Reference", pixels(reference.rms_px), `RMS, ${pixels(reference.left_out_rms_px)} leave-one-out`)
      : [],
    ground ? fact("Ground", `${count(ground.median_inliers)} features`, `a frame, ${pixels(ground.rms_px)} RMS`) : [],
    sigma ? fact("Noise", `${millimetres(sigma.x, 2)} / ${millimetres(sigma.y, 2)}`, "1 σ, east / north") : [],
    calibration?.rms_after_m
      ? fact(
          "At rest",
          millimetres(calibration.rms_after_m, 2),
          `RMS after self-calibration, ${millimetres(calibration.rms_before_m, 2)} before`,
        )
      : [],
  ].flat();
}
