// Step 3: pairs of places in the reference frame and on the orthoimage. Two panes, no modes.

import { ApiError, get, post, projectPath } from "../lib/api.js";
import { orthoFromWorld, worldFromOrtho } from "../lib/coordinates.js";
import { find, h } from "../lib/dom.js";
import { downloadText, pickFiles } from "../lib/download.js";
import { centimetres, fixed, pixels, plural } from "../lib/format.js";
import { latest } from "../lib/latest.js";
import { setView, viewNumber, viewNumbers, viewText } from "../lib/view-state.js";
import { PaneImage } from "../components/pane-image.js";
import { nudgeKeys, paneKeys } from "../components/pane-keys.js";
import { menuButton } from "../components/menu.js";
import { numberField } from "../components/number-field.js";
import { openPage } from "../components/page.js";
import { sortableTable } from "../components/table.js";
import { announce, toast, toastError } from "../components/toast.js";
import { fitPanel } from "./correspondences/fit-panel.js";
import { compareControls } from "./correspondences/compare.js";
import { PairPane, halvesWithout, identity, offset } from "./correspondences/pair-pane.js";
import { pairsFromPoints, pointsText } from "./correspondences/points-file.js";
import { Slots, otherSide } from "./correspondences/slots.js";
import { selectionPanel } from "./correspondences/selection-panel.js";

/** @typedef {import("../lib/types.js").Point} Point */
/** @typedef {import("../lib/types.js").OrthoGrid} OrthoGrid */
/** @typedef {import("../lib/types.js").Correspondence} Correspondence */
/** @typedef {import("./correspondences/fit-panel.js").Fit} Fit */
/** @typedef {import("./correspondences/slots.js").Side} Side */

const REFINE_SCALE = 4; // CSS px per image px when zooming to a pair
const COMPARED_PIXELS = 4_000_000; // enough to compare by eye, and quick to make after each edit
const NO_FIT = /** @type {Fit} */ ({ state: "too_few", message: "", rms_px: null, rms_m: null, loo_rms_px: null, pairs: [], coverage: null, camera: null });

const page = await openPage("correspondences");
const { store } = page;
const slots = new Slots(store);
slots.selected = viewText("pair") === null ? null : viewNumber("pair", 0);

/** @type {OrthoGrid | null} */
let grid = null;
let fit = NO_FIT;
let linked = viewText("linked") === "1";
let undistorted = viewText("und") === "1";
let arrows = true;

// --- the two panes

const frameElement = h("div");
const orthoElement = h("div");
const frame = new PairPane(frameElement, slots, {
  side: "frame_px",
  label: "Reference frame. Enter places a mark in the middle.",
  title: "Reference frame",
  readout: ([u, v]) => [`${fixed(u, 1)}, ${fixed(v, 1)} px`],
});
const ortho = new PairPane(orthoElement, slots, {
  side: "ground_m",
  label: "Orthoimage. Enter places a mark in the middle.",
  title: "Orthoimage",
  readout: (point) => (grid === null ? [] : [`${worldFromOrtho(grid, point).map((value) => fixed(value, 2)).join(", ")} m`]),
});
const sides = [frame, ortho];
const panes = sides.map((side) => side.pane);
const counterpart = (/** @type {PairPane} */ side) => (side === frame ? ortho : frame);
const focused = () => sides.find((side) => side.pane.hasFocus) ?? null;
const frameName = () => (undistorted ? "und" : "raw");

// --- what the server knows

/** @param {string} from @param {string} to @param {Point[]} points @returns {Promise<(Point | null)[]>} */
async function transform(from, to, points) {
  if (points.length === 0) return [];
  return (await post(projectPath(page.id, "transform"), { from, to, points })).points;
}

/** @param {string} from @param {string} to @param {Point[]} points @returns {Promise<Point[]>} */
async function transformAll(from, to, points) {
  return (await transform(from, to, points)).map((point, i) => point ?? points[i]);
}

const askFit = latest(
  (/** @type {Correspondence[]} */ correspondences) => post(projectPath(page.id, "fit"), { correspondences }),
  (/** @type {Fit} */ answer) => {
    fit = answer;
    showFit();
  },
  toastError,
);

/** Counterparts of waiting halves, where the saved pairs already tie the views together. */
async function findGhosts() {
  for (const side of sides) {
    const halves = fit.state === "ok" ? halvesWithout(slots, side.side) : [];
    const from = side === frame ? "plan" : "raw";
    const to = side === frame ? frameName() : "ortho";
    try {
      const points = await transform(from, to, halves.map((half) => /** @type {Point} */ (half[otherSide(side.side)])));
      side.ghosts = new Map(halves.flatMap((half, i) => (points[i] === null ? [] : [[half.id, /** @type {Point} */ (points[i])]])));
    } catch (error) {
      if (!(error instanceof ApiError)) throw error;
      side.ghosts = new Map();
    }
    side.draw();
  }
}

// --- side panel

const showFitFigures = fitPanel(find("#fit"));
const table = sortableTable({
  label: "Pairs",
  empty: "Click a place in either picture, then the same place in the other.",
  id: (/** @type {Correspondence} */ pair) => String(pair.id),
  rowClass: (pair) => (pair.enabled ? "" : "off"),
  onSelect: (pair) => goTo(pair.id),
  columns: [
    { key: "on", title: "On", cell: (pair) => h("input", { type: "checkbox", checked: pair.enabled, "aria-label": `Pair ${pair.id} counts`, onclick: (/** @type {Event} */ event) => (event.stopPropagation(), slots.toggle(pair.id)) }) },
    { key: "id", title: "Pair", number: true, cell: (pair) => String(pair.id), sort: (pair) => pair.id },
    { key: "px", title: "Residual", hint: "Distance between the click and where all pairs together put it", number: true, cell: (pair) => pixels(size(fitOf(pair.id)?.residual_px)), sort: (pair) => size(fitOf(pair.id)?.residual_px) },
    { key: "cm", title: "on ground", number: true, cell: (pair) => centimetres(size(fitOf(pair.id)?.residual_m)), sort: (pair) => size(fitOf(pair.id)?.residual_m) },
    { key: "loo", title: "Left out", hint: "Error of this pair when the fit does not use it: a bad click stands out here", number: true, cell: (pair) => pixels(fitOf(pair.id)?.loo_px), sort: (pair) => fitOf(pair.id)?.loo_px ?? null, tone: (pair) => (isBad(pair) ? "bad" : "") },
  ],
});
find("#pairs").append(table.element);
const selection = selectionPanel(find("#selection"), slots, { goTo });

/** @param {number} id */
const fitOf = (id) => fit.pairs.find((entry) => entry.id === id);
/** @param {Point | undefined | null} vector */
const size = (vector) => (vector === undefined || vector === null || vector[0] === null ? null : Math.hypot(...vector));
/** @param {Correspondence} pair */
function isBad(pair) {
  const loo = fitOf(pair.id)?.loo_px;
  return pair.enabled && typeof loo === "number" && fit.loo_rms_px !== null && loo > 2.2 * fit.loo_rms_px && loo > 1;
}

function showFit() {
  const pairs = store.project.correspondences;
  showFitFigures(fit, pairs.filter((pair) => pair.enabled).length, pairs.length);
  table.setRows(pairs);
  const enabled = new Map(pairs.map((pair) => [pair.id, pair]));
  const drawn = arrows ? fit.pairs.filter((entry) => enabled.get(entry.id)?.enabled && size(entry.residual_px) !== null) : [];
  frame.residuals = new Map(drawn.map((entry) => [entry.id, offset(/** @type {Correspondence} */ (enabled.get(entry.id)).frame_px, entry.predicted_px)]));
  ortho.residuals = new Map();
  if (grid !== null) {
    const here = grid;
    ortho.residuals = new Map(drawn.map((entry) => [entry.id, offset(orthoFromWorld(here, /** @type {Correspondence} */ (enabled.get(entry.id)).ground_m), orthoFromWorld(here, entry.predicted_m))]));
  }
  sides.forEach((side) => side.draw());
  void findGhosts();
}

function showSelection() {
  table.select(slots.selected === null ? null : String(slots.selected));
  selection.show();
  setView({ pair: slots.selected });
}

// --- looking

/** Zoom both panes to a pair, to refine it. @param {number | null} id */
function goTo(id) {
  if (id === null) return;
  slots.select(id);
  for (const side of sides) side.goTo(id, REFINE_SCALE);
}

/** @param {number} step */
function goToNeighbour(step) {
  goTo(slots.neighbour(step, slots.selected, table.order().map(Number)));
}

const follow = latest(
  async (/** @type {PairPane} */ leader) => {
    const { centre, view } = leader.pane;
    const reach = 40 / view.scale;
    const points = /** @type {Point[]} */ ([centre, [centre[0] + reach, centre[1]]]);
    const [from, to] = leader === frame ? [frameName(), "ortho"] : ["ortho", frameName()];
    return { leader, points, seen: await transform(from, to, points) };
  },
  ({ leader, points, seen }) => {
    const [middle, beside] = seen;
    if (!linked || !middle || !beside) return;
    const ratio = Math.hypot(...offset(points[0], points[1])) / Math.hypot(...offset(middle, beside));
    const follower = counterpart(leader);
    const { pane } = follower;
    pane.setView(pane.view.centredOn(middle, pane.size, leader.pane.view.scale * ratio), { silent: true });
    follower.chrome.refresh();
    follower.draw();
    rememberView(follower);
  },
  () => undefined,
);

/** @param {PairPane} side */
function rememberView(side) {
  const { centre, view } = side.pane;
  setView({ [side === frame ? "frame" : "ortho"]: [...centre.map((value) => value.toFixed(1)), view.scale.toPrecision(4)].join(",") });
}

/** @param {PairPane} side */
function restoreView(side) {
  const stored = viewNumbers(side === frame ? "frame" : "ortho", 3);
  if (stored !== null) side.pane.lookAt([stored[0], stored[1]], stored[2]);
}

for (const side of sides) {
  side.pane.on("view", () => {
    rememberView(side);
    if (linked && fit.state === "ok") follow(side);
  });
  side.on("moving", ({ id, side: which, point }) => {
    askFit(store.project.correspondences.map((pair) => (pair.id === id ? { ...pair, [which]: point } : pair)));
  });
}

// --- stage bar

/** @param {string} label @param {string} words @param {boolean} on @param {(on: boolean) => void} change */
function toggleButton(label, words, on, change) {
  const button = h("button", { class: "button small", type: "button", "aria-pressed": String(on), title: words }, label);
  const set = (/** @type {boolean} */ value) => {
    button.setAttribute("aria-pressed", String(value));
    change(value);
  };
  button.addEventListener("click", () => set(button.getAttribute("aria-pressed") !== "true"));
  return { button, toggle: () => button.click() };
}

const linkToggle = toggleButton("Link views", "The other picture follows (L)", linked, (on) => {
  linked = on;
  setView({ linked: on ? 1 : null });
  if (on && fit.state !== "ok") toast("Views can be linked once the fit stands: four well-spread pairs.", { tone: "info" });
  else if (on) follow(focused() ?? frame);
});
const undistortToggle = toggleButton("Undistorted", "Show the frame without lens distortion; raw pixels are stored all the same (U)", undistorted, (on) => {
  undistorted = on;
  setView({ und: on ? 1 : null });
  void loadFrame();
});
const arrowToggle = toggleButton("Residuals", "Arrows from each mark towards where the fit wants it, enlarged (R)", arrows, (on) => {
  arrows = on;
  showFit();
});
const loupeToggle = toggleButton("Loupe", "True pixels around the pointer (Z)", true, (on) => sides.forEach((side) => side.loupe.setEnabled(on)));
const compare = compareControls(ortho.pane, { load: () => loadImage(projectPath(page.id, "rectified.jpg", { v: store.revision, pixels: COMPARED_PIXELS }), ortho) });
const referenceFrame = numberField({
  label: "Reference frame",
  unit: "",
  value: store.project.reference_frame,
  decimals: 0,
  step: 1,
  min: 0,
  compact: true,
  bare: true,
  onChange: (value) => void store.edit(`Reference frame ${value}`, (draft) => void (draft.reference_frame = value ?? 0)),
});
referenceFrame.element.classList.add("narrow");
find("#tools").append(
  h("span", { class: "label" }, "Frame"),
  referenceFrame.element,
  undistortToggle.button,
  linkToggle.button,
  arrowToggle.button,
  loupeToggle.button,
  h("span", { class: "spring" }),
  compare.element,
  menuButton({
    label: "Import and export",
    icon: "more",
    items: () => [
      { label: "Import QGIS .points…", icon: "upload", run: () => void importPoints() },
      { label: "Export QGIS .points", icon: "download", disabled: slots.pairs.length === 0, run: () => downloadText(pointsText(slots.pairs), `${page.id}.points`) },
      { label: "Delete all pairs", icon: "trash", danger: true, disabled: slots.pairs.length === 0, run: () => void store.edit("Delete all pairs", (draft) => void (draft.correspondences = [])) },
    ],
  }),
);
find("#panes").append(frameElement, orthoElement);

async function importPoints() {
  const [file] = await pickFiles({ accept: ".points,.csv,.txt" });
  if (file === undefined) return;
  try {
    const imported = pairsFromPoints(await file.text(), file.name);
    await store.edit(`Import ${plural(imported.length, "pair")}`, (draft) => {
      const first = Math.max(0, ...draft.correspondences.map((pair) => pair.id)) + 1;
      draft.correspondences.push(...imported.map((pair, i) => ({ id: first + i, ...pair })));
    });
    toast(`${plural(imported.length, "pair")} added from ${file.name}.`, { tone: "good" });
  } catch (error) {
    toastError(error);
  }
}

// --- pictures

/** @param {string} path @param {PairPane} side */
const loadImage = (path, side) => PaneImage.load(`/api/${path}`, { onLevel: () => side.pane.invalidate() });

async function loadFrame() {
  const wanted = undistorted;
  if (frame.pane.image === null) frame.chrome.setNote("Loading the frame…");
  try {
    const image = await loadImage(projectPath(page.id, `frames/${store.project.reference_frame}.jpg`, { und: wanted ? 1 : 0 }), frame);
    if (wanted !== undistorted) return;
    frame.mapping = wanted
      ? { shown: (points) => transformAll("raw", "und", points), stored: async (point) => (await transformAll("und", "raw", [point]))[0] }
      : identity;
    frame.pane.setImage(image);
    frame.chrome.setTitle(`Frame ${store.project.reference_frame} · ${wanted ? "undistorted" : "raw"}`);
    frame.chrome.setNote();
    frame.refresh();
    void findGhosts();
  } catch (error) {
    frame.chrome.setNote(error instanceof Error ? error.message : String(error));
  }
}

async function loadOrtho() {
  if (ortho.pane.image === null) ortho.chrome.setNote("Loading the orthoimage…");
  try {
    const answer = await get(projectPath(page.id, "orthoimage"));
    grid = answer.grid;
    if (!answer.ready) {
      const words = store.project.inputs.cloud === null ? "This project has no point cloud. Click the frame, then type the ground coordinates on the right." : "There is no orthoimage yet.";
      ortho.chrome.setNote(words, h("a", { class: "button primary", href: `/p/${encodeURIComponent(page.id)}/orthoimage` }, "Make the orthoimage"));
      return;
    }
    const here = answer.grid;
    ortho.mapping = { shown: (points) => points.map((point) => orthoFromWorld(here, point)), stored: (point) => worldFromOrtho(here, point) };
    ortho.pane.setImage(await loadImage(projectPath(page.id, "orthoimage.png", { v: `${here.west_m},${here.north_m},${here.pixel_size_m}` }), ortho));
    ortho.chrome.setNote();
    ortho.refresh();
    showFit();
  } catch (error) {
    ortho.chrome.setNote(error instanceof Error ? error.message : String(error));
  }
}

// --- keys

const hasSelection = () => slots.selected !== null;
const newestHalf = () => slots.halves.length > 0;
page.keys([
  { keys: "Click", group: "Placing", label: "Fill the next free slot: no mode, no button" },
  { keys: "Drag", group: "Placing", label: "A mark: move it. Elsewhere: pan" },
  { keys: "Enter / Space", group: "Placing", label: "Place at the cross in the middle (keyboard)", run: () => focused()?.placeAtAim(), when: () => focused() !== null },
  ...nudgeKeys(panes, { what: "the selected mark", when: () => hasSelection(), nudge: (_pane, delta) => focused()?.nudge(delta) }),
  { keys: "Delete / Backspace", group: "Pairs", label: "Delete the selected pair", run: () => slots.selected !== null && slots.remove(slots.selected), when: hasSelection },
  { keys: "X", group: "Pairs", label: "Selected pair on or off", run: () => slots.selected !== null && slots.toggle(slots.selected), when: hasSelection },
  { keys: "N", group: "Pairs", label: "Zoom to the next pair, in the table's order", run: () => goToNeighbour(1) },
  { keys: "P", group: "Pairs", label: "Zoom to the previous pair", run: () => goToNeighbour(-1) },
  { keys: "G", group: "Pairs", label: "Zoom both pictures to the selected pair or its ghost", run: () => goTo(slots.selected), when: hasSelection },
  { keys: "Escape", group: "Pairs", label: "Drop the newest unfinished pair, or select nothing", run: () => (newestHalf() ? slots.dropNewestHalf() : slots.select(null)) },
  { keys: "Ctrl+Z", group: "Pairs", label: "Take back the newest unfinished click first", run: () => slots.dropNewestHalf(), when: newestHalf },
  { keys: "L", group: "Looking", label: "Link the views", run: linkToggle.toggle },
  { keys: "U", group: "Looking", label: "Raw or undistorted frame", run: undistortToggle.toggle },
  { keys: "R", group: "Looking", label: "Residual arrows", run: arrowToggle.toggle },
  { keys: "Z", group: "Looking", label: "Loupe", run: loupeToggle.toggle },
  { keys: "B", group: "Looking", label: "Blend the orthorectified frame over the orthoimage", run: () => compare.choose("blend") },
  { keys: "S", group: "Looking", label: "Swipe between the two", run: () => compare.choose("swipe") },
  { keys: "[", group: "Looking", label: "Blend or swipe less", run: () => compare.step(-0.1) },
  { keys: "]", group: "Looking", label: "Blend or swipe more", run: () => compare.step(0.1) },
  ...paneKeys(panes, { canPan: () => !hasSelection() }),
]);

// --- flow

slots.on("change", () => {
  sides.forEach((side) => side.refresh());
  showSelection();
  void findGhosts();
});
store.on("change", ({ project, previous, origin }) => {
  sides.forEach((side) => side.refresh());
  if (project.reference_frame !== previous.reference_frame) {
    referenceFrame.set(project.reference_frame);
    void loadFrame();
  }
  if (origin === "edit" || JSON.stringify(project.correspondences) !== JSON.stringify(previous.correspondences)) askFit(project.correspondences);
  if (origin === "saved") {
    compare.refresh();
    void findGhosts();
  }
  if (project.correspondences.length > previous.correspondences.length) announce(`${plural(project.correspondences.length, "pair")} placed`);
});
page.events.on("orthoimage", () => void loadOrtho());

askFit(store.project.correspondences);
await Promise.all([loadFrame(), loadOrtho()]);
sides.forEach(restoreView);
showSelection();
