// Step 2: the cloud in 3D, the ground plane in it, heights of places, and the orthoimage made from it.

import { get, post, projectPath, sentence } from "../lib/api.js";
import { worldFromOrtho } from "../lib/coordinates.js";
import { fill, find, h } from "../lib/dom.js";
import { degrees, fixed, metres, millimetres } from "../lib/format.js";
import { icon } from "../lib/icons.js";
import { told } from "../lib/problems.js";
import { Targets } from "../lib/targets.js";
import { setView, viewText } from "../lib/view-state.js";
import { isRunning, jobCard } from "../components/job-card.js";
import { note } from "../components/notes.js";
import { numberField } from "../components/number-field.js";
import { openPage } from "../components/page.js";
import { noteContent, stepButton } from "../components/problem-note.js";
import { Pane } from "../components/pane.js";
import { paneChrome } from "../components/pane-chrome.js";
import { PaneImage } from "../components/pane-image.js";
import { paneKeys } from "../components/pane-keys.js";
import { sceneFrame } from "../components/scene-cover.js";
import { segmented } from "../components/segmented.js";
import { toast, toastError } from "../components/toast.js";
import { extentFields } from "./orthoimage/extent-fields.js";
import { heightPanel } from "./orthoimage/height-panel.js";
import { scenePanel } from "./orthoimage/scene-panel.js";

/** @typedef {import("../lib/types.js").OrthoGrid} OrthoGrid */
/** @typedef {import("../lib/types.js").Point} Point */
/** @typedef {import("../lib/types.js").Job} Job */
/** @typedef {import("./orthoimage/extent-fields.js").Extent} Extent */
/** @typedef {"scene" | "picture"} Tab */

const LARGE_SPREAD_M = 0.1; // the paper's ground: "less than 10 cm"

const page = await openPage("orthoimage");
const { store } = page;
const targets = new Targets(store);

/** @type {OrthoGrid | null} */
let grid = null;
/** @type {Point | null} */
let picked = null;

// --- stage

const pane = new Pane(find("#picture"), {
  label: "Orthoimage. A click, or Enter in the middle, reads the height there.",
});
const chrome = paneChrome(pane, {
  title: "Orthoimage",
  readout: (point) =>
    grid === null
      ? []
      : [
          `${worldFromOrtho(grid, point)
            .map((value) => fixed(value, 2))
            .join(", ")} m`,
        ],
});
const tabs = segmented({
  label: "View",
  choices: /** @type {{value: Tab, name: string}[]} */ ([
    { value: "scene", name: "3D" },
    { value: "picture", name: "Orthoimage" },
  ]),
  value: viewText("view") === "picture" ? "picture" : "scene",
  onChange: showTab,
});
find("#tabs").append(tabs.element);

/** @param {Tab} tab */
function showTab(tab) {
  tabs.set(tab);
  setView({ view: tab === "picture" ? tab : null });
  find("#scene").hidden = tab !== "scene";
  find("#picture").hidden = tab !== "picture";
  if (tab === "scene") openScene();
}

const isSceneOpen = () => find("#scene").querySelector("iframe") !== null;

function openScene() {
  if (!isSceneOpen()) find("#scene").prepend(sceneFrame("3D scene of the point cloud"));
  scene.send();
}

// --- heights

const heights = heightPanel(find("#height"), targets, (name) =>
  toast(`${name} stands at this height now.`, { tone: "good" }),
);

pane.on("click", async ({ point }) => {
  if (grid === null) return;
  const place_m = worldFromOrtho(grid, point);
  picked = point;
  drawPick();
  try {
    heights.show({ place_m, ...(await get(projectPath(page.id, "height", { x: place_m[0], y: place_m[1] }))) });
  } catch (error) {
    heights.refuse(sentence(error));
  }
});
page.events.on("pick", ({ xyz_m, height_m, spread_m, points, message }) => {
  if (xyz_m && height_m !== undefined)
    heights.show({ place_m: xyz_m, height_m, spread_m: spread_m ?? null, points: points ?? 0 });
  else heights.refuse(message ?? "The click met nothing of the cloud.");
});

function drawPick() {
  pane.setShapes(picked === null ? [] : [{ id: "picked", kind: "mark", class: "selected", points: [picked] }]);
}

// --- panels

const scene = scenePanel(find("#scene-settings"), page.id, find("#scene"));
const ground = h("div", { class: "settings" });
const groundLevel = numberField({
  label: "Ground level in the cloud",
  unit: "m",
  value: null,
  optional: true,
  step: 0.05,
  hint: "Empty: the plane found in the whole cloud.",
  onChange: (value) => void store.edit("Ground level", (draft) => void (draft.orthoimage.ground_z_m = value)),
});
fill(find("#ground"), h("header", {}, h("h2", {}, "Ground plane")), ground, groundLevel.element);

const pixelSize = numberField({
  label: "Pixel on the ground",
  unit: "cm",
  value: null,
  decimals: 1,
  step: 0.5,
  min: 0.1,
  max: 100,
  onChange: (value) =>
    value !== null &&
    void store.edit("Pixel size of the orthoimage", (draft) => void (draft.orthoimage.pixel_size_m = value / 100)),
});
const extent = extentFields(
  (wanted) => void store.edit("Extent of the orthoimage", (draft) => void (draft.orthoimage.extent_m = wanted)),
);
const whole = h(
  "button",
  {
    class: "button small",
    type: "button",
    onclick: () => {
      extent.forget();
      if (store.project.orthoimage.extent_m !== null)
        void store.edit("Whole cloud as extent", (draft) => void (draft.orthoimage.extent_m = null));
    },
  },
  "Whole cloud",
);
const inView = h(
  "button",
  {
    class: "button small",
    type: "button",
    title: "The part of the ground now in the orthoimage's view",
    onclick: takeView,
  },
  "What is in view",
);
const make = h(
  "button",
  { class: "button primary", type: "button", onclick: () => void start() },
  "Make the orthoimage",
);
const facts = h("div", { class: "settings" });
const job = jobCard();
let making = false;
fill(
  find("#raster"),
  h("header", {}, h("h2", {}, "Orthoimage"), h("span", { class: "badge", id: "raster-state" })),
  pixelSize.element,
  h(
    "div",
    { class: "field" },
    h("div", { class: "section-head" }, h("span", { class: "label spring" }, "Extent"), whole, inView),
    extent.element,
  ),
  make,
  job.element,
  facts,
);

function takeView() {
  if (grid === null) return;
  const here = grid;
  const [west, north] = worldFromOrtho(here, pane.view.toImage([0, 0]));
  const [east, south] = worldFromOrtho(here, pane.view.toImage(pane.size));
  const wanted = /** @type {Extent} */ ([west, south, east, north].map((value) => Math.round(value * 10) / 10));
  void store.edit("Extent of the orthoimage", (draft) => void (draft.orthoimage.extent_m = wanted));
}

async function start() {
  try {
    await store.settled();
    showJob((await post(projectPath(page.id, "orthoimage"))).job);
  } catch (error) {
    toastError(error);
  }
}

/** @param {Job | null} running */
function showJob(running) {
  if (running === null || !["orthoimage", "cloud"].includes(running.kind)) return;
  job.show(running);
  making = isRunning(running);
  make.disabled = making;
  if (running.state === "done" || running.state === "failed") void load();
}

function showSettings() {
  const { orthoimage } = store.project;
  pixelSize.set(orthoimage.pixel_size_m * 100);
  groundLevel.set(orthoimage.ground_z_m);
  extent.show(orthoimage.extent_m, grid === null ? null : extentOf(grid));
  inView.disabled = grid === null;
  make.disabled = store.project.inputs.cloud === null || making;
}

/** Outer edges of a raster. @param {OrthoGrid} raster @returns {Extent} */
const extentOf = (raster) => [
  raster.west_m,
  raster.north_m - raster.height * raster.pixel_size_m,
  raster.west_m + raster.width * raster.pixel_size_m,
  raster.north_m,
];

// --- what the server has

/** Address of the picture shown, so that an unchanged one is not fetched again. */
let loaded = "";

async function load() {
  try {
    const [answer, inputs] = await Promise.all([
      get(projectPath(page.id, "orthoimage")),
      get(projectPath(page.id, "inputs")),
    ]);
    grid = answer.grid;
    showGround(inputs.cloud);
    showRaster(answer);
    showSettings();
    if (answer.job) showJob(answer.job);
    if (answer.ready) await showPicture();
    else if (store.project.inputs.cloud === null)
      chrome.setNote("This project has no point cloud.", stepButton(page.id, "inputs", "Choose a point cloud"));
    else chrome.setNote("There is no orthoimage yet: choose pixel and extent on the right, and make it.");
  } catch (error) {
    chrome.setNote(...noteContent(error, page));
  }
}

async function showPicture() {
  const url = `/api/${projectPath(page.id, "orthoimage.png", { v: JSON.stringify([grid, madeTimes]) })}`;
  if (url === loaded) return;
  if (pane.image === null) chrome.setNote("Loading the orthoimage…");
  pane.setImage(await PaneImage.load(url, { onLevel: () => pane.invalidate() }));
  loaded = url;
  chrome.setNote();
}

/** @param {Record<string, any> | null} cloud */
function showGround(cloud) {
  if (cloud === null)
    return fill(
      ground,
      note(
        "info",
        "Without a point cloud, ground coordinates are typed beside each correspondence, and heights in Regions.",
      ),
    );
  if (cloud.error) return fill(ground, note("bad", told(cloud.error.message).words));
  if (cloud.reading || !cloud.ground)
    return fill(
      ground,
      h("p", { class: "soft" }, "The cloud is being read…"),
      h("progress", { "aria-label": "Reading the cloud" }),
    );
  const { z_m, spread_m, tilt_deg } = cloud.ground;
  const figure = (/** @type {string} */ value, /** @type {string} */ name) =>
    h("div", {}, h("span", { class: "value" }, value), h("span", { class: "name" }, name));
  const verdict =
    spread_m < LARGE_SPREAD_M
      ? note("good", "Flat enough: less than 10 cm of spread.")
      : note(
          "warn",
          "The ground is uneven by more than 10 cm: relief moves the picture where the camera looks aslant.",
        );
  fill(
    ground,
    h(
      "div",
      { class: "figures" },
      figure(metres(z_m), "level"),
      figure(millimetres(spread_m, 0), "spread"),
      figure(degrees(tilt_deg, 2), "tilt"),
    ),
    verdict,
  );
}

/** @param {{ready: boolean, stale: boolean, grid: OrthoGrid | null, measured_share: number | null, filled_share: number | null, notes: string[]}} answer */
function showRaster({ ready, stale, grid: raster, measured_share, filled_share, notes }) {
  const state = find("#raster-state");
  state.className = `badge ${ready ? (stale ? "warn" : "good") : ""}`;
  state.textContent = ready ? (stale ? "out of date" : "made") : "not made yet";
  fill(make, ready ? "Make it again" : "Make the orthoimage");
  make.className = `button ${ready && !stale ? "" : "primary"}`;
  if (raster === null || !ready) return fill(facts);
  const share = (/** @type {number} */ value) => `${fixed(100 * value, 0)} %`;
  const rows = [
    [
      "Size",
      `${raster.width} × ${raster.height} px, ${metres(raster.width * raster.pixel_size_m, 1)} × ${metres(raster.height * raster.pixel_size_m, 1)}`,
    ],
  ];
  // An orthoimage made by `rooftrack run` says nothing of how it was filled.
  if (measured_share !== null && filled_share !== null)
    rows.push(["Measured", `${share(measured_share)} of the pixels, ${share(filled_share)} filled from neighbours`]);
  fill(
    facts,
    h(
      "dl",
      { class: "facts small" },
      rows.flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]),
    ),
    notes.map((words) => note("info", words)),
  );
}

// --- flow

let madeTimes = 0;
store.on("change", ({ project, previous, origin }) => {
  showSettings();
  const changed =
    JSON.stringify([project.orthoimage, project.inputs.cloud]) !==
    JSON.stringify([previous.orthoimage, previous.inputs.cloud]);
  if (origin === "saved" || changed) void load();
});
page.events.on("job", showJob);
page.events.on("hello", ({ job: running }) => {
  showJob(running);
  if (isSceneOpen()) scene.send(); // another window may have taken the scene meanwhile
});
page.events.on("scene", ({ owner }) => {
  if (scene.cover.isElsewhere(owner)) scene.cover.show({ ready: false, message: "", owner });
});
page.events.on("inputs", () => {
  void load();
  if (isSceneOpen()) scene.send();
});
page.events.on("orthoimage", () => {
  madeTimes += 1;
  void load();
  showTab("picture");
});
page.keys([
  { keys: "Click", group: "Heights", label: "Read the height of a place, in 3D or on the orthoimage" },
  {
    keys: "Enter / Space",
    group: "Heights",
    label: "Read the height in the middle of the orthoimage (keyboard)",
    when: () => pane.hasFocus,
    run: (event) => pane.clickCentre(event),
  },
  {
    keys: "T",
    group: "Looking",
    label: "3D or orthoimage",
    run: () => showTab(find("#scene").hidden ? "scene" : "picture"),
  },
  ...paneKeys([pane]),
]);
find("#next").append(
  h(
    "a",
    { class: "button", href: `/p/${encodeURIComponent(page.id)}/correspondences` },
    "Correspondences",
    icon("arrow_right", "small"),
  ),
);
showSettings();
showTab(viewText("view") === "picture" ? "picture" : "scene");
await load();
