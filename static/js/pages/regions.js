// Step 4: what moves (polygons on the raw frame), and what is measured (bands or a region on the orthorectified frame).

import { get, post, projectPath, sentence } from "../lib/api.js";
import { orthoFromWorld, worldFromOrtho } from "../lib/coordinates.js";
import { find } from "../lib/dom.js";
import { fixed } from "../lib/format.js";
import { latest } from "../lib/latest.js";
import { Targets, isComplete } from "../lib/targets.js";
import { told } from "../lib/problems.js";
import { setView, viewText } from "../lib/view-state.js";
import { Loupe } from "../components/loupe.js";
import { Pane } from "../components/pane.js";
import { paneChrome } from "../components/pane-chrome.js";
import { PaneImage } from "../components/pane-image.js";
import { activePane, nudgeKeys, paneKeys } from "../components/pane-keys.js";
import { openPage } from "../components/page.js";
import { colourOf } from "../components/palette.js";
import { noteContent, stepButton } from "../components/problem-note.js";
import { PolygonEditor } from "../components/polygon-editor.js";
import { segmented } from "../components/segmented.js";
import { toastError } from "../components/toast.js";
import { BandEditor } from "./regions/band-editor.js";
import { cornersOf } from "./regions/band.js";
import { bandsPanel } from "./regions/bands-panel.js";
import { movingPanel } from "./regions/moving-panel.js";
import { edgePainter, previewShapes } from "./regions/preview.js";
import { targetsPanel } from "./regions/targets-panel.js";

/** @typedef {import("../lib/types.js").Point} Point */
/** @typedef {import("../lib/types.js").OrthoGrid} OrthoGrid */
/** @typedef {import("../lib/targets.js").OpenTarget} OpenTarget */
/** @typedef {import("./regions/preview.js").Preview} Preview */

const WIDTH_STEP_M = 0.02;
const TURN_STEP_RAD = (0.2 * Math.PI) / 180;

const page = await openPage("regions");
const { store } = page;
const targets = new Targets(store);
const wanted = viewText("target");
if (wanted !== null) targets.select(wanted);

/** @type {OrthoGrid} */
let grid = { west_m: 0, north_m: 0, pixel_size_m: 0.01, width: 0, height: 0 };
/** @type {Preview | null} */
let preview = null;
let camera_m = Infinity; // height above the ground, until the fit is known

const toPixels = (/** @type {Point} */ plan) => orthoFromWorld(grid, plan);
const toPlan = (/** @type {Point} */ pixels) => worldFromOrtho(grid, pixels);
const same = (/** @type {Point} */ point) => point;

// --- panes

const framePane = new Pane(find("#frame"), { label: "Reference frame. Clicks draw the outline of what moves." });
const planPane = new Pane(find("#plan"), {
  label: "Orthorectified reference frame. Clicks draw the search bands of the chosen target.",
});
const panes = [framePane, planPane];
const loupes = panes.map((pane) => new Loupe(pane));
const frameChrome = paneChrome(framePane, {
  title: "Reference frame · raw",
  readout: ([u, v]) => [`${fixed(u, 1)}, ${fixed(v, 1)} px`],
});
const planChrome = paneChrome(planPane, {
  title: "Orthorectified frame",
  readout: (point) => [
    `${toPlan(point)
      .map((value) => fixed(value, 2))
      .join(", ")} m`,
  ],
});

const moving = new PolygonEditor(framePane, {
  prefix: "moving",
  look: "moving",
  noun: "moving region",
  polygons: () => store.project.moving_regions_px,
  save: (label, polygons, merge) =>
    void store.edit(label, (draft) => void (draft.moving_regions_px = polygons.map(tenths)), { merge }),
  accepts: () => framePane.image !== null,
  numbered: true,
});
/** @type {PolygonEditor} */
const region = new PolygonEditor(planPane, {
  prefix: "region",
  look: "corner-point",
  noun: "region",
  polygons: () =>
    targets.selected?.kind === "points" && targets.selected.region_m ? [targets.selected.region_m.map(toPixels)] : [],
  save: (label, polygons, merge) =>
    changeSelected(
      label,
      (target) => void (target.region_m = polygons[0]?.map(toPlan).map(millimetres) ?? target.region_m),
      merge,
    ),
  accepts: () =>
    planPane.image !== null &&
    targets.selected?.kind === "points" &&
    (region.isDrawing || targets.selected.region_m === null),
  single: true,
});
const bands = new BandEditor(planPane, {
  bands: () => (targets.selected?.kind === "lines" ? (targets.selected.lines ?? {}) : {}),
  save: (line, band, label, merge) => saveBand(line, band, label, merge),
  accepts: () => planPane.image !== null && targets.selected?.kind !== "points",
  toPixels,
  toPlan,
});

/** @param {import("../lib/types.js").LineName} line @param {import("../lib/types.js").Band} band @param {string} label @param {boolean} merge */
function saveBand(line, band, label, merge) {
  if (targets.selected === null) targets.add("lines");
  changeSelected(label, (target) => void (target.lines = { ...target.lines, [line]: band }), merge);
}

/** @param {string} label @param {(target: OpenTarget) => void} change @param {boolean} [merge] */
function changeSelected(label, change, merge = false) {
  const { selected } = targets;
  if (selected !== null) targets.change(selected.name, `${label} of ${selected.name}`, change, { merge });
}

/** Tenths of a pixel, thousandths of a metre: what is stored. @param {Point[]} points @returns {Point[]} */
const tenths = (points) => points.map(([u, v]) => [Math.round(u * 10) / 10, Math.round(v * 10) / 10]);
/** @param {Point} point @returns {Point} */
const millimetres = ([x, y]) => [Math.round(x * 1000) / 1000, Math.round(y * 1000) / 1000];

framePane.addPainter(edgePainter(() => preview, "raw", same));
planPane.addPainter(edgePainter(() => preview, "plan", toPixels));

// --- panels

const showTargets = targetsPanel(find("#targets"), targets, () => camera_m);
const showBands = bandsPanel(find("#bands"), bands, (line, band) => saveBand(line, band, `Number of ${line}`, true));
const showMoving = movingPanel(find("#moving"), {
  onSelect: (index) => moving.select(index),
  onRemove: (index) =>
    void store.edit("Delete moving region", (draft) => void draft.moving_regions_px.splice(index, 1)),
});

// --- drawing and preview

function draw() {
  framePane.setShapes([...moving.shapes(), ...previewShapes(preview, "raw", same)]);
  const isPoints = targets.selected?.kind === "points";
  planPane.setShapes([...(isPoints ? region.shapes() : bands.shapes()), ...previewShapes(preview, "plan", toPixels)]);
  frameChrome.setHint(frameHint());
  planChrome.setHint(planHint());
  find("#bands").hidden = isPoints;
  showBands(preview);
  showMoving(store.project.moving_regions_px, moving.selected?.polygon ?? null);
}

function frameHint() {
  if (moving.isDrawing) return moving.draft.length < 3 ? "Click the next corner" : "Enter or a double click closes";
  const first = framePane.image !== null && store.project.moving_regions_px.length === 0;
  return first ? "Click the first corner of what moves" : "";
}

function planHint() {
  const { selected } = targets;
  if (planPane.image === null) return "";
  if (selected?.kind === "points")
    return region.isDrawing
      ? region.draft.length < 3
        ? "Click the next corner"
        : "Enter or a double click closes"
      : selected.region_m === null
        ? `Click the corners of ${selected.name}`
        : "";
  const line = bands.nextLine;
  return line === null
    ? ""
    : `${line}: ${["click one end", "click the other end", "click at half the width"][bands.draft.length]}`;
}

const askPreview = latest(
  (/** @type {OpenTarget} */ target) => post(projectPath(page.id, "lines/preview"), { target }),
  (answer) => {
    preview = answer;
    draw();
  },
  (error) => {
    preview = { lines: {}, p1: null, p2: null, message: sentence(error) };
    draw();
  },
);

/** Whether there is anything of a target to look for: a band, or a closed region. @param {OpenTarget} target */
const hasDrawing = (target) =>
  target.kind === "lines" ? Object.keys(target.lines ?? {}).length > 0 : isComplete(target);

/** @param {OpenTarget | null} [target] as it stands while dragging */
function refreshPreview(target = targets.selected) {
  if (target !== null && hasDrawing(target) && planPane.image !== null) return askPreview(target);
  preview = null;
  draw();
}

bands.on("moving", (live) => targets.selected !== null && refreshPreview({ ...targets.selected, lines: live }));
for (const polygon of [moving, region]) polygon.on("change", draw);
bands.on("change", draw);
targets.on("change", () => {
  showTargets();
  setView({ target: targets.selected?.name ?? null });
  draw();
  refreshPreview();
});

// --- layout

/** @typedef {"both" | "frame" | "plan"} Layout */

const LAYOUTS = /** @type {{value: Layout, name: string}[]} */ ([
  { value: "both", name: "Both" },
  { value: "frame", name: "Frame" },
  { value: "plan", name: "Orthorectified" },
]);
let layout = LAYOUTS.find(({ value }) => value === viewText("layout"))?.value ?? "both";
const layouts = segmented({ label: "Pictures shown", choices: LAYOUTS, value: layout, onChange: setLayout });
find("#layout").append(layouts.element);
setLayout(layout);

/** @param {Layout} wanted */
function setLayout(wanted) {
  layout = wanted;
  layouts.set(wanted);
  find("#panes").dataset.layout = wanted;
  setView({ layout: wanted === "both" ? null : wanted });
}

function nextLayout() {
  const at = LAYOUTS.findIndex(({ value }) => value === layout);
  setLayout(LAYOUTS[(at + 1) % LAYOUTS.length].value);
}

// --- keys

const editorOf = (/** @type {Pane} */ pane) =>
  pane === framePane ? moving : targets.selected?.kind === "points" ? region : bands;
const focusedPane = () => panes.find((pane) => pane.hasFocus) ?? null;
const focusedEditor = () => {
  const pane = focusedPane();
  return pane === null ? null : editorOf(pane);
};
const bandKeys = () => activePane(panes) === planPane && bands.selected !== null;
page.keys([
  {
    keys: "Click",
    group: "Placing",
    label: "Left: next corner of a moving region. Right: two clicks along a line, the third at half the width",
  },
  { keys: "Drag", group: "Placing", label: "A corner, an edge, a band, its ends or its width. Elsewhere: pan" },
  {
    keys: "Enter",
    group: "Placing",
    label: "Close the outline; otherwise click in the middle (keyboard)",
    when: () => focusedPane() !== null,
    run(event) {
      const editor = focusedEditor();
      if (editor instanceof PolygonEditor && editor.draft.length >= 3) editor.close();
      else focusedPane()?.clickCentre(event);
    },
  },
  {
    keys: "Space",
    group: "Placing",
    label: "Click in the middle (keyboard)",
    when: () => focusedPane() !== null,
    run: (event) => focusedPane()?.clickCentre(event),
  },
  {
    keys: "Escape",
    group: "Placing",
    label: "Take back the newest click; then select nothing",
    run: () => (focusedEditor() ?? bands).back(),
  },
  {
    keys: "Delete / Backspace",
    group: "Placing",
    label: "Delete the selected corner or region",
    when: () => focusedEditor() instanceof PolygonEditor,
    run: () => focusedEditor() instanceof PolygonEditor && /** @type {PolygonEditor} */ (focusedEditor()).remove(),
  },
  ...nudgeKeys(panes, {
    what: "what is selected",
    when: (pane) => editorOf(pane).selected !== null,
    nudge: (pane, delta) => editorOf(pane).nudge(delta),
  }),
  {
    keys: "Ctrl+Z",
    group: "Placing",
    label: "Take back the newest click of an unfinished shape first",
    when: () => [moving, region, bands].some((editor) => editor.isDrawing),
    run: () => [moving, region, bands].find((editor) => editor.isDrawing)?.back(),
  },
  { keys: "[", group: "Bands", label: "Narrower by 2 cm", when: bandKeys, run: () => bands.widen(-WIDTH_STEP_M) },
  { keys: "]", group: "Bands", label: "Wider by 2 cm", when: bandKeys, run: () => bands.widen(WIDTH_STEP_M) },
  {
    keys: ",",
    group: "Bands",
    label: "Turn counter-clockwise by 0.2°",
    when: bandKeys,
    run: () => bands.turn(TURN_STEP_RAD),
  },
  { keys: ".", group: "Bands", label: "Turn clockwise by 0.2°", when: bandKeys, run: () => bands.turn(-TURN_STEP_RAD) },
  {
    keys: "Z",
    group: "Looking",
    label: "Loupe",
    run: () => loupes.forEach((loupe) => loupe.setEnabled(!loupe.enabled)),
  },
  { keys: "V", group: "Looking", label: "Both pictures, the frame, the orthorectified frame", run: nextLayout },
  ...paneKeys(panes, { canPan: () => editorOf(activePane(panes)).selected === null, chosen: activePane }),
]);

// --- pictures

/** @param {string} path @param {Pane} pane */
const loadImage = (path, pane) => PaneImage.load(`/api/${path}`, { onLevel: () => pane.invalidate() });

const askFrame = latest(
  (/** @type {number} */ number) => loadImage(projectPath(page.id, `frames/${number}.jpg`), framePane),
  (image, number) => {
    framePane.setImage(image);
    frameChrome.setTitle(`Frame ${number} · raw`);
    frameChrome.setNote();
    draw();
  },
  (error) => frameChrome.setNote(...noteContent(error, page)),
);
const askPlan = latest(fetchPlan, showPlan, (error) => planChrome.setNote(...noteContent(error, page)));

function loadFrame() {
  if (framePane.image === null) frameChrome.setNote("Loading the frame…");
  return askFrame(store.project.reference_frame);
}

/** The colour around both pictures, as six hexadecimal digits. */
function surround() {
  const [red, green, blue] = (colourOf(planPane.element, "--image-surround").match(/\d+/g) ?? []).map(Number);
  return [red, green, blue].map((level) => (level ?? 0).toString(16).padStart(2, "0")).join("");
}

function loadPlan() {
  if (planPane.image === null) planChrome.setNote("Laying the frame on the ground…");
  return askPlan(null);
}

/** The raster and the picture on it, or why there is none. @returns {Promise<{raster: OrthoGrid, image: PaneImage} | {message: string}>} */
async function fetchPlan() {
  const { ready, message, grid: raster } = await get(projectPath(page.id, "rectified"));
  if (!ready) return { message };
  const path = projectPath(page.id, "rectified.jpg", { v: store.revision, outside: surround() });
  return { raster, image: await loadImage(path, planPane) };
}

/** @param {{raster: OrthoGrid, image: PaneImage} | {message: string}} answer */
function showPlan(answer) {
  if ("message" in answer) return showNoPlan(answer.message);
  grid = answer.raster;
  planPane.setImage(answer.image);
  planChrome.setNote();
  draw();
  refreshPreview();
}

/** @param {string} message */
function showNoPlan(message) {
  const { words, step } = told(message);
  planChrome.setNote(
    words,
    step === "inputs"
      ? stepButton(page.id, "inputs")
      : stepButton(page.id, "correspondences", "Place correspondences"),
  );
}

async function findCamera() {
  const { correspondences } = store.project;
  const { camera } = await post(projectPath(page.id, "fit"), { correspondences });
  camera_m = camera?.height_m ?? Infinity;
}

store.on("change", ({ project, previous }) => {
  const rectifiedAnew =
    JSON.stringify([project.correspondences, project.orthoimage, project.inputs]) !==
    JSON.stringify([previous.correspondences, previous.orthoimage, previous.inputs]);
  if (project.reference_frame !== previous.reference_frame) void loadFrame();
  if (rectifiedAnew) void findCamera().catch(toastError);
  if (rectifiedAnew || project.reference_frame !== previous.reference_frame) void loadPlan();
});
page.events.on("orthoimage", () => void loadPlan());

showTargets();
draw();
void findCamera().catch(toastError);
await Promise.all([loadFrame(), loadPlan()]);
const drawn = [...Object.values(bands.bands).flatMap(cornersOf), ...(targets.selected?.region_m ?? [])].map(toPixels);
if (drawn.length > 0 && planPane.image !== null) planPane.lookAtAll(drawn);
const outlines = store.project.moving_regions_px.flat();
if (outlines.length > 0 && framePane.image !== null) framePane.lookAtAll(outlines);
