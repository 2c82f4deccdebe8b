// Review: look at every frame as the engine saw it, beside the motion it made of it.

import { fill, find, h } from "../lib/dom.js";
import { count, fixed, plural } from "../lib/format.js";
import { setView, viewNumber, viewText } from "../lib/view-state.js";
import { busyOver } from "../components/busy.js";
import { earlierNote } from "../components/earlier-note.js";
import { ExclusionEditor } from "../components/exclusions.js";
import { filterBadge } from "../components/filter-badge.js";
import { FrameLibrary } from "../components/frames.js";
import { FrameView } from "../components/frame-view.js";
import { AXES, fetchHistory, fetchResults, methodName, METHODS, worstStatuses } from "../components/histories.js";
import { stepUrl } from "../components/header.js";
import { whenMeasured, whenVideo } from "../components/measured.js";
import { openPage } from "../components/page.js";
import { paneKeys } from "../components/pane-keys.js";
import { Player } from "../components/player.js";
import { Plot } from "../components/plot.js";
import { statusRuns } from "../components/plot-marks.js";
import { LAYERS } from "../components/review-overlay.js";
import { SceneView } from "../components/scene-view.js";
import { segmented } from "../components/segmented.js";
import { Solver } from "../components/solver.js";
import { toast, toastError } from "../components/toast.js";

/** @typedef {import("../lib/types.js").Point} Point */
/** @typedef {import("../components/histories.js").History} History */
/** @typedef {import("../components/histories.js").Method} Method */
/** @typedef {import("../components/review-overlay.js").Layer} Layer */
/** @typedef {"frame" | "both" | "scene"} Stage */

/** @type {{value: Stage, name: string}[]} */
const STAGES = [
  { value: "frame", name: "Frame" },
  { value: "both", name: "Both" },
  { value: "scene", name: "3D" },
];
/** @type {Record<string, string>} */
const STATUS_TONES = { ok: "good", weak: "warn", lost: "bad", excluded: "" };

const page = await openPage("review");
const { store } = page;
let results = await whenMeasured(
  page,
  "Track the video first; every frame can then be looked at here, with what was measured on it.",
);
const video = await whenVideo(page, "Its frames are looked at here, with what was measured on each.");

// what is looked at
const has = (/** @type {string | null} */ name) => results.methods.find((method) => method === name);
let method = has(viewText("method")) ?? has(store.project.method) ?? results.methods[0];
let target = results.targets.find((name) => name === viewText("target")) ?? results.targets[0] ?? "";
let compared = viewText("compare") === "1" && results.methods.length > 1;
let stage = STAGES.find((entry) => entry.value === viewText("view"))?.value ?? "frame";
/** @type {Set<Layer>} */
const layers = new Set(LAYERS.map((entry) => entry.layer));
for (const layer of (viewText("hidden") ?? "").split(",")) layers.delete(/** @type {Layer} */ (layer));
/** The frame to begin with: keys may lead to others before any can be shown, and change the address. */
const firstFrame = viewNumber("frame", store.project.reference_frame);
/** Histories by "method/target". @type {Map<string, History>} */
const histories = new Map();

// the page
const frameBox = h("div", { class: "review-frame" });
const sceneBox = h("div", { class: "review-scene" });
const stageBody = h("div", { class: "stage-body review-stage" }, frameBox, sceneBox);
const transport = h("div", { class: "review-transport" });
const plotArea = h("div", { class: "review-plots" });
const stageChoice = segmented({ label: "View", choices: STAGES, value: stage, onChange: chooseStage });
const targetChoice = segmented({
  label: "Target",
  choices: results.targets.map((name) => ({ value: name, name })),
  value: target,
  onChange: chooseTarget,
});
const methodChoice = segmented({
  label: "Method",
  choices: results.methods.map((name) => ({ value: name, name: methodName(name) })),
  value: method,
  onChange: chooseMethod,
});
const compareSwitch = h("input", {
  type: "checkbox",
  checked: compared,
  onchange: () => compare(compareSwitch.checked),
});
const compareLabel = h("label", { class: "switch small" }, compareSwitch, "Compare methods");
const solving = h("span", { class: "badge accent", role: "status", hidden: true }, "Solving again…");
const earlier = earlierNote(page);
const facts = h("section", { class: "section", "aria-label": "This frame" });
const doubtful = h("section", { class: "section", "aria-label": "Weak and lost frames" });
const excluded = h("section", { class: "section", "aria-label": "Excluded frames" });
const layerList = h("section", { class: "section", "aria-label": "Overlay" });
targetChoice.element.hidden = results.targets.length < 2;
methodChoice.element.hidden = results.methods.length < 2;
fill(
  find("#main"),
  h(
    "div",
    { class: "stage" },
    h(
      "div",
      { class: "stage-bar" },
      h("h1", {}, "Review"),
      stageChoice.element,
      targetChoice.element,
      h("span", { class: "spring" }),
      solving,
      compareLabel,
      methodChoice.element,
    ),
    earlier.element,
    stageBody,
    transport,
    plotArea,
  ),
  h("aside", { class: "side", "aria-label": "Frame and overlay" }, facts, doubtful, excluded, layerList),
);
const view = new FrameView(
  frameBox,
  new FrameLibrary(page.id, { size: [video.width, video.height], count: video.frames }),
  method,
);
const scene = new SceneView(sceneBox, page.id, page.events);
const player = new Player(transport);
const plots = AXES.map(
  (axis) => new Plot(plotArea, { title: axis.title, unit: "m", link: "review", drag: "seek", leastSpan: 0.002 }),
);
const solver = new Solver(page, {
  isFresh: () => results.ready && !results.stale,
  onBusy: (busy) => (solving.hidden = !busy),
  reload: refresh,
});
const exclusions = new ExclusionEditor(excluded, {
  store,
  solver,
  onSelection: showSelection,
  onJump: (frame) => player.go(frame),
});

listen();
page.keys(keys());
showLayers();
view.setLayers(layers);
exclusions.show();
chooseStage(stage);
const opened = busyOver(stageBody, "Solving…");
await loadHistories().catch(toastError);
opened();
player.go(firstFrame);

function listen() {
  player.on("frame", onFrame);
  player.on("playing", ({ playing }) => view.setPlaying(playing));
  view.on("shown", showFacts);
  for (const plot of plots) {
    plot.on("seek", ({ x }) => player.goTo(x));
    plot.on("select", ({ from, to }) => exclusions.select(from, to));
    plot.on("interval", ({ from, to }) => exclusions.select(from, to));
  }
  page.events.on("results", () => void refresh().catch(toastError));
  page.events.on("online", () => void refresh().catch(toastError));
  store.on("change", () => {
    exclusions.show();
    showFacts();
  });
}

/** @returns {import("../lib/keys.js").KeyBinding[]} */
function keys() {
  return [
    { keys: "Space / K", group: "Player", label: "Play or pause", run: () => player.toggle() },
    {
      keys: "ArrowLeft / ,",
      group: "Player",
      label: "One frame back",
      run: () => player.step(-1),
      when: () => !view.pane.hasFocus,
    },
    {
      keys: "ArrowRight / .",
      group: "Player",
      label: "One frame on",
      run: () => player.step(1),
      when: () => !view.pane.hasFocus,
    },
    { keys: "Shift+ArrowLeft", group: "Player", label: "Ten frames back", run: () => player.step(-10) },
    { keys: "Shift+ArrowRight", group: "Player", label: "Ten frames on", run: () => player.step(10) },
    { keys: "N", group: "Player", label: "Next weak or lost frame", run: () => jump(1) },
    { keys: "Shift+N", group: "Player", label: "Previous weak or lost frame", run: () => jump(-1) },
    { keys: "Home", group: "Player", label: "First frame", run: () => player.go(0) },
    { keys: "End", group: "Player", label: "Last frame", run: () => player.go(Infinity) },
    {
      keys: "[",
      group: "Excluding frames",
      label: "Selection begins at this frame",
      run: () => exclusions.begin(player.frame),
    },
    {
      keys: "]",
      group: "Excluding frames",
      label: "Selection ends at this frame",
      run: () => exclusions.end(player.frame),
    },
    {
      keys: "X",
      group: "Excluding frames",
      label: "Exclude the selection, or else this frame",
      run: () => exclusions.exclude(player.frame),
    },
    {
      keys: "Escape",
      group: "Excluding frames",
      label: "Forget the selection",
      run: () => exclusions.forget(),
      when: () => exclusions.selection !== null,
    },
    ...LAYERS.map((entry) => ({
      keys: entry.key,
      group: "Overlay",
      label: entry.name,
      run: () => setLayer(entry.layer, !layers.has(entry.layer)),
    })),
    { keys: "M", group: "Overlay", label: "Compare methods", run: () => compare(!compared) },
    { keys: "V", group: "Looking", label: "Frame, both, 3D", run: nextStage },
    { keys: "Z", group: "Looking", label: "Loupe", run: () => view.toggleLoupe() },
    ...paneKeys([view.pane]),
    { keys: "Drag", group: "Plots", label: "Move through the video" },
    { keys: "Shift+Drag", group: "Plots", label: "Select frames to exclude" },
    { keys: "Wheel", group: "Plots", label: "Zoom in time; Alt+drag pans, a double click shows all" },
  ];
}

/** @param {{frame: number, time_s: number}} place */
function onFrame({ frame, time_s }) {
  setView({ frame });
  for (const plot of plots) plot.setPlayHead(time_s);
  scene.show(frame);
  view.show(frame);
  showFacts();
}

async function loadHistories() {
  const methods = compared ? results.methods : [method];
  await Promise.all(
    results.targets.flatMap((name) =>
      methods.map(async (wanted) => histories.set(`${wanted}/${name}`, await fetchHistory(page.id, name, wanted))),
    ),
  );
  const main = current();
  if (main === undefined) return;
  player.setFrames(
    main.time_s,
    worstStatuses(results.targets.map((name) => histories.get(`${method}/${name}`)?.status ?? [])),
  );
  exclusions.setFrames(main.time_s);
  earlier.show(results, { method, isEarlier: main.is_earlier });
  drawPlots(main);
  showDoubtful();
  showFacts();
}

async function refresh() {
  results = await fetchResults(page.id);
  histories.clear();
  view.refresh();
  await loadHistories();
}

/** @returns {History | undefined} */
function current() {
  return histories.get(`${method}/${target}`);
}

/** @param {History} main */
function drawPlots(main) {
  const other = results.methods.find((name) => name !== method) ?? method;
  const beside = compared && other !== method ? histories.get(`${other}/${target}`) : undefined;
  plots.forEach((plot, i) => {
    const axis = i === 0 ? "dx" : "dy";
    /** @type {import("../components/plot.js").Trace[]} */
    const traces = [
      { label: "P1", colour: i === 0 ? "--series-1" : "--series-2" },
      { label: "P2", colour: "--series-3", dash: [6, 4], hidden: true },
    ];
    const columns = [main[`p1_${axis}_m`], main[`p2_${axis}_m`]];
    if (beside) {
      const label = `P1 ${methodName(other).toLowerCase()}${beside.is_earlier ? ", before the change" : ""}`;
      traces.push({ label, colour: "--series-4", dash: [3, 3] });
      columns.push(beside[`p1_${axis}_m`]);
    }
    plot.setTraces(traces, [main.time_s, ...columns]);
    plot.setStatuses(main.status);
    plot.setPlayHead(player.time_s);
  });
  showSelection();
}

function showSelection() {
  const selected = exclusions.interval;
  for (const plot of plots) {
    plot.setIntervals(
      selected
        ? [{ key: "selection", label: "selected", from: selected[0], to: selected[1], colour: "--bad", editable: true }]
        : [],
    );
  }
}

/** @param {1 | -1} direction */
function jump(direction) {
  if (!player.jump(direction))
    toast(direction > 0 ? "No weak or lost frame follows." : "No weak or lost frame comes before.");
}

/** @param {string} name */
function chooseTarget(name) {
  target = name;
  setView({ target: name });
  void loadHistories().catch(toastError);
}

/** @param {Method} wanted */
function chooseMethod(wanted) {
  method = wanted;
  setView({ method: wanted === store.project.method ? null : wanted });
  view.setMethod(wanted);
  void loadHistories().catch(toastError);
}

/** @param {boolean} on */
function compare(on) {
  compared = compareSwitch.checked = on && results.methods.length > 1;
  if (on && !compared) return tellOtherMethod();
  setView({ compare: on ? "1" : null });
  void loadHistories().catch(toastError);
}

/** Comparing takes two measurements of the video. */
function tellOtherMethod() {
  const other = METHODS.find(({ value }) => !results.methods.includes(value))?.name ?? "other";
  toast(`Only one method has measured this video. Choose ${other} on the Track page and measure; both are kept.`, {
    action: { label: "Go to Track", run: () => location.assign(stepUrl(page.id, "track")) },
  });
}

/** @param {Stage} wanted */
function chooseStage(wanted) {
  stage = wanted;
  stageBody.dataset.stage = wanted;
  frameBox.hidden = wanted === "scene";
  sceneBox.hidden = wanted === "frame";
  stageChoice.set(wanted);
  setView({ view: wanted === "frame" ? null : wanted });
  scene.setActive(wanted !== "frame", player.frame);
  view.setActive(wanted !== "scene");
  showFacts();
}

function nextStage() {
  const at = STAGES.findIndex((entry) => entry.value === stage);
  chooseStage(STAGES[(at + 1) % STAGES.length].value);
}

/** @param {Layer} layer @param {boolean} on */
function setLayer(layer, on) {
  if (on) layers.add(layer);
  else layers.delete(layer);
  setView({
    hidden:
      LAYERS.map((entry) => entry.layer)
        .filter((name) => !layers.has(name))
        .join(",") || null,
  });
  showLayers();
  view.setLayers(layers);
}

function showLayers() {
  const focused =
    document.activeElement instanceof HTMLInputElement && layerList.contains(document.activeElement)
      ? document.activeElement.name
      : "";
  const rows = LAYERS.map((entry) => {
    const box = h("input", {
      type: "checkbox",
      name: entry.layer,
      checked: layers.has(entry.layer),
      onchange: () => setLayer(entry.layer, box.checked),
    });
    const sign = h("span", { class: `layer-sign ${entry.sign}`, "aria-hidden": "true" });
    sign.style.setProperty("--sign", `var(${entry.colour})`);
    return h(
      "label",
      { class: "check layer" },
      box,
      sign,
      h("span", { class: "grow" }, entry.name),
      h("kbd", { "aria-hidden": "true" }, entry.key.replace("Shift+", "⇧")),
    );
  });
  fill(layerList, h("header", {}, h("h2", {}, "Overlay, as measured")), h("div", { class: "layers" }, rows));
  if (focused) find(`[name=${focused}]`, HTMLInputElement, layerList).focus();
}

function showDoubtful() {
  const runs = statusRuns(player.statuses).filter((run) => run.status === "weak" || run.status === "lost");
  const number = (/** @type {string} */ status) => player.statuses.filter((entry) => entry === status).length;
  const rows = runs.map((run) =>
    h(
      "button",
      { type: "button", class: "run-row run-jump", onclick: () => player.go(run.first) },
      h("span", { class: `status-key ${run.status}` }),
      h("span", { class: "number" }, run.first === run.last ? `${run.first}` : `${run.first}–${run.last}`),
      h("span", { class: "faint" }, run.status),
      h("span", { class: "number faint end" }, `${run.first === run.last ? "at" : "from"} ${fixed(player.times_s[run.first], 2)} s`),
    ),
  );
  fill(
    doubtful,
    h(
      "header",
      {},
      h("h2", {}, "Weak and lost frames"),
      h("span", { class: `badge ${number("weak") ? "warn" : ""}` }, `${count(number("weak"))} weak`),
      h("span", { class: `badge ${number("lost") ? "bad" : ""}` }, `${count(number("lost"))} lost`),
    ),
    runs.length ? h("div", { class: "run-list" }, rows) : h("p", { class: "soft" }, "Every frame was measured well."),
  );
}

function showFacts() {
  const main = current();
  if (main === undefined) return;
  const i = player.frame;
  const status = main.status[i] ?? "ok";
  const turn = main.rotation_rad[i];
  const row = (/** @type {"p1" | "p2"} */ point) =>
    h(
      "tr",
      {},
      h("th", { scope: "row" }, point.toUpperCase()),
      /** @type {const} */ (["dx", "dy"]).map((axis) => displacementCell(main, i, point, axis)),
    );
  view.setCaption(
    `${methodName(method)} · frame ${i}${status === "ok" ? "" : ` · ${status}`}`,
    status === "weak" || status === "lost",
  );
  fill(
    facts,
    h("header", {}, h("h2", {}, `Frame ${i}`), h("span", { class: `badge ${STATUS_TONES[status] ?? ""}` }, status)),
    h(
      "table",
      { class: "table facts-table", "aria-label": "Displacement in this frame" },
      h(
        "thead",
        {},
        h(
          "tr",
          {},
          h("th", {}, "mm ± 1 σ"),
          h("th", { class: "number" }, "east"),
          h("th", { class: "number" }, "north"),
        ),
      ),
      h("tbody", {}, row("p1"), row("p2")),
    ),
    h(
      "dl",
      { class: "facts" },
      h("dt", {}, "Time"),
      h("dd", {}, `${fixed(main.time_s[i], 3)} s`),
      h("dt", {}, "Rotation"),
      h("dd", {}, turn === null || turn === undefined ? "–" : `${fixed(turn * 1000, 2)} mrad`),
      stage === "scene" ? null : featureRows(i),
      filterRow(),
    ),
  );
}

/** The filter between what was measured and what is shown; the uncertainty is that of what was measured. */
function filterRow() {
  const badge = filterBadge(store);
  return badge && [h("dt", {}, "Filter"), h("dd", {}, badge, h("span", { class: "faint" }, " σ before it"))];
}

/** What took part in a frame and what did not: known only where the frame is looked at. @param {number} frame */
function featureRows(frame) {
  const review = view.review?.frame === frame ? view.review : null;
  /** @param {{used: Point[], rejected: Point[]} | undefined} found @param {[one: string, many: string]} name */
  const words = (found, [one, many]) => {
    if (!found) return view.isShown(frame) ? "–" : "…";
    if (found.used.length + found.rejected.length === 0) return "none";
    return `${plural(found.used.length, one, many)} used, ${count(found.rejected.length)} rejected`;
  };
  return [
    h("dt", {}, "Ground"),
    h("dd", {}, words(review?.ground, ["feature", "features"])),
    h("dt", {}, "Target"),
    h("dd", {}, words(review?.targets[target]?.points_raw, ["patch", "patches"])),
  ];
}

/** @param {History} history @param {number} i @param {"p1" | "p2"} point @param {"dx" | "dy"} axis */
function displacementCell(history, i, point, axis) {
  const value = history[`${point}_${axis}_m`][i];
  const sigma = history[`${point}_${axis}_sigma_m`][i];
  if (value === null || value === undefined) return h("td", { class: "number" }, "–");
  return h(
    "td",
    { class: "number" },
    fixed(value * 1000, 2),
    h("span", { class: "faint" }, sigma === null ? "" : ` ± ${fixed(sigma * 1000, 2)}`),
  );
}
