// Step 1: the files measured from, and what was understood of each.

import { get, projectPath } from "../lib/api.js";
import { fill, find, h } from "../lib/dom.js";
import { icon } from "../lib/icons.js";
import { told } from "../lib/problems.js";
import { stepUrl } from "../components/header.js";
import { isRunning, jobCard } from "../components/job-card.js";
import { openPage } from "../components/page.js";
import { toast, toastError } from "../components/toast.js";
import { calibrationDialog, calibrationReport } from "./inputs/calibration.js";
import { gpsSettings } from "./inputs/gps-settings.js";
import { inputCard } from "./inputs/input-card.js";

/** @typedef {import("./inputs/input-card.js").InputKind} InputKind */
/** @typedef {import("../lib/types.js").Project} Project */

const page = await openPage("inputs");
const { store } = page;

/** @param {Project} draft @param {InputKind} kind @param {string | null} path */
function setInput(draft, kind, path) {
  if (kind === "video") draft.inputs.video = path ?? "";
  else if (kind === "gps")
    draft.inputs.gps =
      path === null ? null : { time: "time_s", x: "east_m", y: "north_m", at_m: null, ...draft.inputs.gps, file: path };
  else draft.inputs[kind] = path;
}

const KINDS = /** @type {const} */ ([
  {
    kind: "video",
    title: "Video",
    glyph: "video",
    accept: "video/*,.mp4,.mov,.m4v,.mkv,.avi,.mts,.m2ts,.ts,.webm",
    why: "A drone video of the structure from above, ground around it in view.",
  },
  {
    kind: "cloud",
    title: "Point cloud",
    glyph: "cube",
    accept: ".las,.laz,.ply,.pcd,.xyz,.asc,.pts,.txt,.csv,.e57",
    why: "A LiDAR cloud of the site: it ties the picture to metres and gives the roof's height.",
  },
  {
    kind: "lens",
    title: "Lens",
    glyph: "target",
    accept: ".yaml,.yml,.xml",
    why: "Interior orientation of the camera. Calibrate it here from pictures of a checkerboard.",
  },
  {
    kind: "gps",
    title: "GPS",
    glyph: "clock",
    accept: ".csv,.txt",
    why: "Optional: a GPS record on the roof, to compare the result with.",
  },
]);
/** What undo calls the choice of a file. @param {{title: string}} entry */
const choosing = ({ title }) => `Choose ${title.toLowerCase()}`;

const calibrate = h(
  "button",
  { class: "button small", type: "button", onclick: () => void calibrationDialog(page.id).catch(toastError) },
  icon("target", "small"),
  "Calibrate…",
);
/** @type {string[]} of the GPS file */
let columnsFound = [];
/** Files whose cards say what is wrong with them. @type {string[]} */
let toldOnCards = [];
const columns = h(
  "button",
  { class: "button small", type: "button", onclick: () => void gpsSettings(store, columnsFound).catch(toastError) },
  icon("edit", "small"),
  "Columns…",
);
/** @type {Partial<Record<InputKind, Node[]>>} */
const FURTHER = { lens: [calibrate], gps: [columns] };
const cards = new Map(
  KINDS.map((entry) => [
    entry.kind,
    inputCard({
      ...entry,
      projectId: page.id,
      onPath: (path) => store.edit(choosing(entry), (draft) => setInput(draft, entry.kind, path)),
      onChange: () => void store.refresh().catch(toastError),
      onRemove:
        entry.kind === "video"
          ? null
          : () => store.edit(`Remove ${entry.title.toLowerCase()}`, (draft) => setInput(draft, entry.kind, null)),
      more: FURTHER[entry.kind],
    }),
  ]),
);
store.on("refused", ({ label, error }) =>
  KINDS.filter((entry) => label === choosing(entry)).forEach(({ kind }) => cards.get(kind)?.refuse(error)),
);
const job = jobCard();
const report = calibrationReport(page.id);
const problems = h("div", { class: "problems" });
const next = h(
  "a",
  { class: "button primary", href: stepUrl(page.id, "orthoimage") },
  "Orthoimage & 3D",
  icon("arrow_right", "small"),
);
fill(
  find("#main"),
  h(
    "div",
    { class: "page-title" },
    h(
      "div",
      {},
      h("h1", {}, "Inputs"),
      h(
        "p",
        {},
        "Choose files on this computer, or drop and send them from anywhere. Each is read at once; what was understood stands beside it.",
      ),
    ),
    next,
  ),
  problems,
  h(
    "div",
    { class: "card-grid" },
    [...cards.values()].map((card) => card.element),
  ),
  job.element,
  report.element,
);

/** @param {{again?: boolean}} [options] again: have a cloud read anew where reading it broke off */
async function load({ again = false } = {}) {
  try {
    const facts = await get(projectPath(page.id, "inputs", again ? { again: 1 } : {}));
    for (const [kind, card] of cards) card.show(facts[kind]);
    columnsFound = facts.gps?.columns_found ?? [];
    columns.hidden = columnsFound.length === 0;
    toldOnCards = Object.values(facts).flatMap((fact) => (fact?.error ? [fact.file] : []));
  } catch (error) {
    toastError(error);
  }
  showProblems();
}

/** Only what concerns the files themselves and stands on no card: later steps tell their own. */
function showProblems() {
  const own = (store.state.problems ?? [])
    .filter((problem) => !toldOnCards.some((file) => problem.startsWith(`${file}: `)))
    .map((problem) => told(problem))
    .filter(({ step }) => step === "inputs");
  fill(
    problems,
    own.map(({ words }) => h("p", { class: "note warn" }, icon("warn"), h("span", {}, words))),
  );
}

/** @param {import("../lib/types.js").Job | null} running */
function showJob(running) {
  if (running === null || !["calibrate", "cloud"].includes(running.kind)) return;
  job.show(running);
  calibrate.disabled = isRunning(running);
  if (running.kind === "calibrate" && running.state === "done") {
    toast("The lens is calibrated and in use.", { tone: "good" });
    void report.refresh();
  }
  if (running.state === "done" || running.state === "failed") void load();
}

store.on("change", ({ project, previous, origin }) => {
  showProblems();
  if (origin !== "edit" && JSON.stringify(project.inputs) !== JSON.stringify(previous.inputs)) void load();
  if (origin === "saved") void load();
});
page.events.on("inputs", () => void load());
page.events.on("job", showJob);
page.events.on("hello", ({ job: running }) => showJob(running));
await Promise.all([load({ again: true }), report.refresh()]);
