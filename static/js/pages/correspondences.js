// Step 3: pairs of places in the reference frame and on the orthoimage. Two panes, no modes.

import { get, post, projectPath } from "../lib/api.js";
import { orthoFromWorld, subtract, worldFromOrtho } from "../lib/coordinates.js";
import { find, h } from "../lib/dom.js";
import { downloadText, pickFiles } from "../lib/download.js";
import { fixed, plural } from "../lib/format.js";
import { latest } from "../lib/latest.js";
import { setView, viewNumber, viewText } from "../lib/view-state.js";
import { PaneImage } from "../components/pane-image.js";
import { activePane, nudgeKeys, paneKeys } from "../components/pane-keys.js";
import { FAINT_AFTER_MS, delayedSign } from "../components/delayed-sign.js";
import { menuButton } from "../components/menu.js";
import { numberField } from "../components/number-field.js";
import { openPage } from "../components/page.js";
import { noteContent, stepButton } from "../components/problem-note.js";
import { announce, toast, toastError } from "../components/toast.js";
import { toggleButton } from "../components/toggle-button.js";
import { askAboutImport, askAboutPairs } from "./correspondences/ask-about-pairs.js";
import { fitPanel } from "./correspondences/fit-panel.js";
import { compareControls } from "./correspondences/compare.js";
import { linkedViews } from "./correspondences/linked-views.js";
import { ARROW_PX, PairPane, halvesWithout, identity } from "./correspondences/pair-pane.js";
import { lengthOf, pairsTable } from "./correspondences/pairs-table.js";
import { notAmong, pairsFromPoints, pointsText } from "./correspondences/points-file.js";
import { Slots, otherSide } from "./correspondences/slots.js";
import { selectionPanel } from "./correspondences/selection-panel.js";
import { transformer, undistortion } from "./correspondences/transform.js";

/** @typedef {import("../lib/types.js").Point} Point */
/** @typedef {import("../lib/types.js").OrthoGrid} OrthoGrid */
/** @typedef {import("../lib/types.js").Correspondence} Correspondence */
/** @typedef {import("./correspondences/fit-panel.js").Fit} Fit */
/** @typedef {import("./correspondences/fit-panel.js").PairFit} PairFit */
/** @typedef {import("./correspondences/slots.js").Side} Side */

const REFINE_SCALE = 4; // CSS px per image px when zooming to a pair
const COMPARED_PIXELS = 4_000_000; // enough to compare by eye, and quick to make after each edit
const NO_FIT = /** @type {Fit} */ ({
  state: "too_few",
  message: "",
  rms_px: null,
  rms_m: null,
  loo_rms_px: null,
  pairs: [],
  coverage: null,
  camera: null,
});

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
let lastFrame = Infinity; // until the video is known

// --- the two panes

const frame = new PairPane(h("div"), slots, {
  side: "frame_px",
  view: "frame",
  label: "Reference frame. Enter places a mark in the middle.",
  title: "Reference frame",
  frameName: () => (undistorted ? "und" : "raw"),
  readout: ([u, v]) => `${fixed(u, 1)}, ${fixed(v, 1)} px`,
});
const ortho = new PairPane(h("div"), slots, {
  side: "ground_m",
  view: "ortho",
  label: "Orthoimage. Enter places a mark in the middle.",
  title: "Orthoimage",
  frameName: () => "ortho",
  readout: (point) => (grid === null ? "" : `${placeWords(worldFromOrtho(grid, point))} m`),
});
const sides = /** @type {[PairPane, PairPane]} */ ([frame, ortho]);
const panes = sides.map((side) => side.pane);
const focused = () => sides.find((side) => side.pane.hasFocus) ?? null;
const sideOf = (/** @type {import("../components/pane.js").Pane} */ pane) => sides.find((side) => side.pane === pane);
/** @param {Point} place */
const placeWords = (place) => place.map((value) => fixed(value, 2)).join(", ");

// --- what the server knows

const transform = transformer(page.id);
const askFit = latest(
  (/** @type {Correspondence[]} */ correspondences) => post(projectPath(page.id, "fit"), { correspondences }),
  (/** @type {Fit} */ answer) => {
    fit = answer;
    fitAwaited.end();
    showFit();
  },
  toastError,
);

/** The numbers shown are of earlier pairs: the server takes its time, or does not answer. */
const fitAwaited = delayedSign(FAINT_AFTER_MS, () => showNumbers());

/** @param {Correspondence[]} correspondences */
function fitAnew(correspondences) {
  fitAwaited.begin();
  if (fitAwaited.shown) showNumbers();
  void askFit(correspondences);
}

/** Asks for the counterparts of waiting halves on a side. @param {PairPane} side */
const ghostsOf = (side) =>
  latest(
    async () => {
      // Where the saved pairs already tie the views together.
      const halves = fit.state === "ok" ? halvesWithout(slots, side.side) : [];
      const placed = halves.map((half) => /** @type {Point} */ (half[otherSide(side.side)]));
      return { halves, places: await transform(side === frame ? "plan" : "raw", side.frameName, placed) };
    },
    ({ halves, places }) => side.setGhosts(halves, places),
    () => side.setGhosts([], []), // no fit, no ghost: the fit panel says why
  );
const askGhosts = sides.map(ghostsOf);

function findGhosts() {
  for (const ask of askGhosts) void ask(null);
}

// --- side panel

const showFitFigures = fitPanel(find("#fit"));
const table = pairsTable(find("#pairs"), { onSelect: goTo, onToggle: (id) => slots.toggle(id) });
const selection = selectionPanel(find("#selection"), slots, { goTo });

function showNumbers() {
  const pairs = store.project.correspondences;
  const enabled = pairs.filter((pair) => pair.enabled).length;
  showFitFigures(fit, { enabled, total: pairs.length, awaited: fitAwaited.shown });
  table.show(pairs, fit);
  find("#main").classList.toggle("fit-awaited", fitAwaited.shown); // what it says stands in the table and in both pictures
}

function showFit() {
  showNumbers();
  frame.residuals = residuals((pair, predicted) => subtract(predicted.predicted_px, pair.frame_px));
  ortho.residuals = residuals(({ ground_m }, { predicted_m }) =>
    grid === null ? null : subtract(orthoFromWorld(grid, predicted_m), orthoFromWorld(grid, ground_m)),
  );
  // as long for as many metres as in the frame
  if (grid !== null && fit.rms_px && fit.rms_m) ortho.arrowPx = (ARROW_PX * grid.pixel_size_m * fit.rms_px) / fit.rms_m;
  sides.forEach((side) => side.draw());
  findGhosts();
}

/**
 * From each enabled mark to where the fit wants it.
 * @param {(pair: Correspondence, predicted: PairFit) => Point | null} offset
 * @returns {Map<number, Point>}
 */
function residuals(offset) {
  /** @type {Map<number, Point>} */
  const found = new Map();
  for (const pair of arrows ? store.project.correspondences.filter(({ enabled }) => enabled) : []) {
    const predicted = fit.pairs.find(({ id }) => id === pair.id);
    if (predicted === undefined || lengthOf(predicted.residual_px) === null) continue;
    const vector = offset(pair, predicted);
    if (vector !== null) found.set(pair.id, vector);
  }
  return found;
}

function showSelection() {
  table.select(slots.selected);
  selection.show();
  setView({ pair: slots.selected });
}

// --- looking

/** Zoom both panes to a pair, to refine it. @param {number | null} id */
function goTo(id) {
  if (id === null) return;
  slots.select(id);
  for (const side of sides) side.goTo(id, REFINE_SCALE);
  const inTable = document.activeElement?.matches("#pairs tr:focus-visible") ?? false; // moving through it by keys
  if (!inTable) sideOf(activePane(panes))?.focus();
}

/** @param {number} step */
function goToNeighbour(step) {
  goTo(slots.neighbour(step, slots.selected, table.order()));
}

const follow = linkedViews(sides, transform);

for (const side of sides) {
  side.pane.on("view", () => {
    side.rememberView();
    if (linked && fit.state === "ok") follow(side);
  });
  side.on("moving", ({ id, side: which, point }) => {
    fitAnew(store.project.correspondences.map((pair) => (pair.id === id ? { ...pair, [which]: point } : pair)));
  });
}

// --- stage bar

const linkToggle = toggleButton({
  label: "Link views",
  hint: "The other picture follows (L)",
  on: linked,
  onChange(on) {
    linked = on;
    setView({ linked: on ? 1 : null });
    if (on && fit.state !== "ok") toast("Views can be linked once the fit stands: four well-spread pairs.");
    else if (on) follow(focused() ?? frame);
  },
});
const undistortToggle = toggleButton({
  label: "Undistorted",
  hint: "Show the frame without lens distortion; raw pixels are stored all the same (U)",
  on: undistorted,
  onChange(on) {
    undistorted = on;
    setView({ und: on ? 1 : null });
    void loadFrame();
  },
});
const arrowToggle = toggleButton({
  label: "Residuals",
  hint: "Arrows from each mark towards where the fit wants it, enlarged (R)",
  on: arrows,
  onChange(on) {
    arrows = on;
    showFit();
  },
});
const loupeToggle = toggleButton({
  label: "Loupe",
  hint: "True pixels around the pointer (Z)",
  on: true,
  onChange: (on) => sides.forEach((side) => side.loupe.setEnabled(on)),
});
const compare = compareControls(ortho.pane, {
  load: () => loadImage(projectPath(page.id, "rectified.jpg", { v: store.revision, pixels: COMPARED_PIXELS }), ortho),
});
const referenceFrame = numberField({
  label: "Reference frame",
  unit: "",
  value: store.project.reference_frame,
  decimals: 0,
  step: 1,
  min: 0,
  max: () => lastFrame,
  compact: true,
  bare: true,
  onChange: (value) => void chooseReferenceFrame(value ?? 0),
});
referenceFrame.element.classList.add("narrow");
find("#tools").append(
  h("span", { class: "label" }, "Frame"),
  referenceFrame.element,
  undistortToggle.element,
  linkToggle.element,
  arrowToggle.element,
  loupeToggle.element,
  h("span", { class: "spring" }),
  compare.element,
  menuButton({
    label: "Import and export",
    icon: "more",
    items: () => [
      { label: "Import QGIS .points…", icon: "upload", run: () => void importPoints() },
      {
        label: "Export QGIS .points",
        icon: "download",
        disabled: slots.pairs.length === 0,
        run: () => downloadText(pointsText(slots.pairs), `${page.id}.points`),
      },
      {
        label: "Delete all pairs",
        icon: "trash",
        danger: true,
        disabled: slots.pairs.length === 0,
        run: () => slots.removeAll(),
      },
    ],
  }),
);
find("#panes").append(...panes.map((pane) => pane.element));

/** Pairs were clicked in one frame of the video; in another one their places may show something else. @param {number} wanted */
async function chooseReferenceFrame(wanted) {
  const set = (/** @type {import("../lib/types.js").Project} */ draft) => void (draft.reference_frame = wanted);
  const clicked = slots.pairs.length + slots.halves.length;
  const choice = clicked === 0 ? "keep" : await askAboutPairs(clicked, store.project.reference_frame, wanted);
  if (choice === "keep") await store.edit(`Reference frame ${wanted}`, set);
  else if (choice === "delete") slots.removeAll(`Reference frame ${wanted}, pairs deleted`, set);
  else referenceFrame.set(store.project.reference_frame);
}

async function importPoints() {
  const [file] = await pickFiles({ accept: ".points,.csv,.txt" });
  if (file === undefined) return;
  try {
    const read = pairsFromPoints(await file.text(), file.name);
    const fresh = notAmong(read, slots.pairs);
    if (fresh.length === 0) return void toast(`All ${plural(read.length, "pair")} of ${file.name} are here already.`);
    const counts = { now: slots.pairs.length, read: read.length, fresh: fresh.length };
    const choice = counts.now === 0 ? "add" : await askAboutImport(file.name, counts);
    if (choice === null) return;
    const imported = choice === "add" ? fresh : read;
    await store.edit(`Import ${plural(imported.length, "pair")}`, (draft) => {
      if (choice === "replace") draft.correspondences = [];
      const first = Math.max(0, ...draft.correspondences.map((pair) => pair.id)) + 1;
      draft.correspondences.push(...imported.map((pair, i) => ({ id: first + i, ...pair })));
    });
    toast(`${plural(imported.length, "pair")} taken from ${file.name}.`, { tone: "good" });
  } catch (error) {
    toastError(error);
  }
}

// --- pictures

void get(projectPath(page.id, "inputs")).then(({ video }) => (lastFrame = (video?.frames || Infinity) - 1), toastError);

/** @param {string} path @param {PairPane} side */
const loadImage = (path, side) => PaneImage.load(`/api/${path}`, { onLevel: () => side.pane.invalidate() });

const askFrame = latest(
  (/** @type {{number: number, und: boolean}} */ { number, und }) =>
    loadImage(projectPath(page.id, `frames/${number}.jpg`, { und: und ? 1 : 0 }), frame),
  showFrame,
  (error) => frame.chrome.setNote(...noteContent(error, page)),
);
const askOrtho = latest(fetchOrtho, showOrtho, (error) => ortho.chrome.setNote(...noteContent(error, page)));

/** What the picture of the frame is made of. @param {import("../lib/types.js").Project} project */
const shownOf = ({ reference_frame, inputs }) => JSON.stringify([reference_frame, inputs.video, inputs.lens]);

function loadFrame() {
  if (frame.pane.image === null) frame.chrome.setNote("Loading the frame…");
  return askFrame({ number: store.project.reference_frame, und: undistorted });
}

/** @param {PaneImage} image @param {{number: number, und: boolean}} shown */
function showFrame(image, { number, und }) {
  frame.mapping = und ? undistortion(transform) : identity;
  frame.pane.setImage(image);
  frame.chrome.setTitle(`Frame ${number} · ${und ? "undistorted" : "raw"}`);
  frame.chrome.setNote();
  frame.refresh();
  findGhosts();
}

function loadOrtho() {
  if (ortho.pane.image === null) ortho.chrome.setNote("Loading the orthoimage…");
  return askOrtho(null);
}

/** The raster and the picture on it; no picture where none is made. @returns {Promise<{raster: OrthoGrid, image: PaneImage} | null>} */
async function fetchOrtho() {
  const { ready, grid: raster } = await get(projectPath(page.id, "orthoimage"));
  if (!ready) return null;
  const v = `${raster.west_m},${raster.north_m},${raster.pixel_size_m}`;
  return { raster, image: await loadImage(projectPath(page.id, "orthoimage.png", { v }), ortho) };
}

/** @param {{raster: OrthoGrid, image: PaneImage} | null} made */
function showOrtho(made) {
  grid = made?.raster ?? null;
  if (made === null) return showNoOrtho();
  const { raster, image } = made;
  ortho.mapping = {
    shown: (points) => points.map((point) => orthoFromWorld(raster, point)),
    stored: (point) => worldFromOrtho(raster, point),
  };
  ortho.pane.setImage(image);
  ortho.chrome.setNote();
  ortho.refresh();
  showFit();
}

function showNoOrtho() {
  if (store.project.inputs.cloud === null)
    ortho.chrome.setNote(
      "This project has no point cloud. Click the frame and type the ground coordinates on the right, or choose a cloud.",
      stepButton(page.id, "inputs", "Choose a point cloud"),
    );
  else
    ortho.chrome.setNote("There is no orthoimage yet.", stepButton(page.id, "orthoimage", "Make the orthoimage"));
}

// --- keys

const hasSelection = () => slots.selected !== null;
const newestHalf = () => slots.halves.length > 0;
page.keys([
  { keys: "Click", group: "Placing", label: "Fill the next free slot: no mode, no button" },
  { keys: "Drag", group: "Placing", label: "A mark: move it. Elsewhere: pan" },
  {
    keys: "Enter / Space",
    group: "Placing",
    label: "Place at the cross in the middle (keyboard)",
    run: () => focused()?.placeAtAim(),
    when: () => focused() !== null,
  },
  ...nudgeKeys(panes, {
    what: "the selected mark",
    when: () => hasSelection(),
    nudge: (pane, delta) => sideOf(pane)?.nudge(delta),
  }),
  {
    keys: "Delete / Backspace",
    group: "Pairs",
    label: "Delete the selected pair",
    run: () => slots.selected !== null && slots.remove(slots.selected),
    when: hasSelection,
  },
  {
    keys: "X",
    group: "Pairs",
    label: "Selected pair on or off",
    run: () => slots.selected !== null && slots.toggle(slots.selected),
    when: hasSelection,
  },
  { keys: "N", group: "Pairs", label: "Zoom to the next pair, in the table's order", run: () => goToNeighbour(1) },
  { keys: "P", group: "Pairs", label: "Zoom to the previous pair", run: () => goToNeighbour(-1) },
  {
    keys: "G",
    group: "Pairs",
    label: "Zoom both pictures to the selected pair or its ghost",
    run: () => goTo(slots.selected),
    when: hasSelection,
  },
  {
    keys: "Escape",
    group: "Pairs",
    label: "Drop the newest unfinished pair, or select nothing",
    run: () => (newestHalf() ? slots.dropNewestHalf() : slots.select(null)),
  },
  {
    keys: "Ctrl+Z",
    group: "Pairs",
    label: "Take back an unfinished click, where that came last",
    run: () => slots.dropNewestHalf(),
    when: () => slots.isHalfNewest,
  },
  {
    keys: "Ctrl+Shift+Z / Ctrl+Y",
    group: "Pairs",
    label: "Bring back the click just taken back",
    run: () => slots.bringBack(),
    when: () => slots.isHalfNext,
  },
  { keys: "L", group: "Looking", label: "Link the views", run: linkToggle.toggle },
  { keys: "U", group: "Looking", label: "Raw or undistorted frame", run: undistortToggle.toggle },
  { keys: "R", group: "Looking", label: "Residual arrows", run: arrowToggle.toggle },
  { keys: "Z", group: "Looking", label: "Loupe", run: loupeToggle.toggle },
  {
    keys: "B",
    group: "Looking",
    label: "Blend the orthorectified frame over the orthoimage",
    run: () => compare.choose("blend"),
  },
  { keys: "S", group: "Looking", label: "Swipe between the two", run: () => compare.choose("swipe") },
  { keys: "[", group: "Looking", label: "Blend or swipe less", run: () => compare.step(-0.1) },
  { keys: "]", group: "Looking", label: "Blend or swipe more", run: () => compare.step(0.1) },
  ...paneKeys(panes, { canPan: () => !hasSelection(), chosen: activePane }),
]);

// --- flow

slots.on("change", () => {
  sides.forEach((side) => side.refresh());
  showSelection();
  findGhosts();
});
store.on("change", ({ project, previous, origin }) => {
  sides.forEach((side) => side.refresh());
  if (project.reference_frame !== previous.reference_frame) referenceFrame.set(project.reference_frame);
  if (shownOf(project) !== shownOf(previous)) void loadFrame();
  if (origin === "edit" || JSON.stringify(project.correspondences) !== JSON.stringify(previous.correspondences))
    fitAnew(project.correspondences);
  if (origin === "saved") {
    compare.refresh();
    findGhosts();
  }
  if (project.correspondences.length > previous.correspondences.length)
    announce(`${plural(project.correspondences.length, "pair")} placed`);
});
page.events.on("orthoimage", () => void loadOrtho());
page.events.on("inputs", ({ kind }) => ["video", "lens"].includes(kind) && void loadFrame());

fitAnew(store.project.correspondences);
await Promise.all([loadFrame(), loadOrtho()]);
showSelection();
