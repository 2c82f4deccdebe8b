// The bar on top of every page: the eight steps with their status, saving, undo, theme, help.

import { fill, find, h, svg } from "../lib/dom.js";
import { icon } from "../lib/icons.js";
import { bindKeys } from "../lib/keys.js";
import { told } from "../lib/problems.js";
import { nextTheme, themeIcon } from "../lib/theme.js";
import { openHelp } from "./help.js";
import { isRunning } from "./job-card.js";
import { toastError } from "./toast.js";

/** @typedef {import("../lib/types.js").StepName} StepName */
/** @typedef {import("../lib/types.js").StepStatus} StepStatus */
/** @typedef {import("../lib/store.js").ProjectStore} ProjectStore */

/** @type {readonly {step: StepName, name: string}[]} */
export const STEPS = [
  { step: "inputs", name: "Inputs" },
  { step: "orthoimage", name: "Orthoimage & 3D" },
  { step: "correspondences", name: "Correspondences" },
  { step: "regions", name: "Regions" },
  { step: "track", name: "Track" },
  { step: "review", name: "Review" },
  { step: "drift", name: "Drift" },
  { step: "export", name: "Export" },
];

const STATUS_ICONS = /** @type {const} */ ({
  done: "check",
  warn: "warn",
  error: "close",
  stale: "stale",
  running: "running",
  unneeded: "minus",
});
const STATUS_WORDS = {
  todo: "to do",
  done: "done",
  warn: "done, with a warning",
  error: "needs attention",
  stale: "out of date",
  running: "running",
  unneeded: "not needed",
};
/** Which step a job works for. @type {Record<string, StepName>} */
const STEP_OF_JOB = { track: "track", orthoimage: "orthoimage" };
/** @type {{status: StepStatus, message: string}} */
const RUNNING = { status: "running", message: "" };

/** Header of a page outside any project. @param {...Node} actions */
export function projectsHeader(...actions) {
  fill(
    find("#header"),
    brand(),
    h("span", { class: "steps" }),
    h("div", { class: "header-actions" }, ...actions, themeButton(), helpButton("Projects")),
  );
  bindKeys([helpKey("Projects")]);
}

/** @param {ProjectStore} store @param {StepName} step @param {import("../lib/events.js").ServerEventStream} events */
export function projectHeader(store, step, events) {
  const title = STEPS.find((entry) => entry.step === step)?.name ?? "";
  const name = h("span", { class: "project-name" });
  const links = STEPS.map((entry) => stepLink(store.id, entry.step, entry.step === step));
  const steps = h("nav", { class: "steps", "aria-label": "Steps" }, links);
  const saved = h("span", { class: "save-state", role: "status" });
  const undo = actionButton("undo", "Undo", () => store.undo().catch(toastError));
  const redo = actionButton("redo", "Redo", () => store.redo().catch(toastError));
  fill(
    find("#header"),
    brand(),
    name,
    steps,
    h("div", { class: "header-actions" }, saved, undo, redo, themeButton(), helpButton(title)),
  );

  /** What works now, heard from the server; the project's own state is as old as the last edit. @type {StepName | null} */
  let working = null;
  const show = () => {
    const { state } = store;
    const stateOf = (/** @type {StepName} */ name) => (name === working ? RUNNING : state.steps?.[name]);
    name.textContent = store.project.name;
    name.title = store.project.name;
    document.title = `${title} · ${store.project.name} · Rooftrack`;
    STEPS.forEach((entry, i) => showStep(links[i], entry.name, i + 1, stateOf(entry.step)));
    setAction(undo, state.can_undo, `Undo${state.undo_label ? `: ${state.undo_label}` : ""} (Ctrl+Z)`);
    setAction(redo, state.can_redo, `Redo${state.redo_label ? `: ${state.redo_label}` : ""} (Ctrl+Shift+Z)`);
  };
  const hear = (/** @type {import("../lib/types.js").Job | null} */ job) => {
    if (job !== null && !(job.kind in STEP_OF_JOB)) return;
    const before = working;
    working = isRunning(job) ? STEP_OF_JOB[/** @type {import("../lib/types.js").Job} */ (job).kind] : null;
    if (working === before) return;
    show();
    // The end of tracking is told as new results too, which makes the page take the new state.
    if (working === null && job?.kind !== "track") void store.refresh().catch(toastError);
  };
  events.on("job", hear);
  events.on("hello", ({ job }) => hear(job));
  store.on("change", show);
  store.on("saving", (state) => showSaving(saved, state));
  show();
  showSaving(saved, "saved");
  // In a narrow window the steps scroll, and are as wide as they stay only once their letters are there.
  void document.fonts.ready.then(() =>
    steps.querySelector("[aria-current]")?.scrollIntoView({ inline: "center", block: "nearest" }),
  );
  bindKeys([
    helpKey(title),
    ...STEPS.map((entry, i) => ({
      keys: `Alt+${i + 1}`,
      group: "Everywhere",
      label: entry.name,
      run: () => location.assign(stepUrl(store.id, entry.step)),
    })),
  ]);
}

/** A bar at the foot of the header while the server does not answer. @param {import("../lib/events.js").ServerEventStream} events @param {ProjectStore} store */
export function tellConnection(events, store) {
  const words = h("span");
  const bar = h("p", { class: "connection-bar", role: "status", hidden: true }, icon("warn", "small"), words);
  find("#header").append(bar);
  let waits = false;
  const show = () => {
    bar.hidden = events.online && !waits;
    words.textContent = `The server does not answer – trying again${waits ? "; your edits wait here to be saved" : ""}`;
  };
  events.on("offline", show);
  events.on("online", show);
  store.on("saving", (state) => {
    waits = state === "waiting";
    show();
  });
}

/** @param {string} id @param {StepName} step */
export const stepUrl = (id, step) => `/p/${encodeURIComponent(id)}/${step}`;

/** Round mark of a step's status: glyph and colour. @param {StepStatus} status @param {number | string} number shown while to do */
export function statusMark(status, number = "") {
  return h("span", { class: `status ${status}` }, status === "todo" ? number : icon(STATUS_ICONS[status]));
}

/** A link to a step, empty until `showStep`. @param {string} id @param {StepName} step @param {boolean} current */
const stepLink = (id, step, current) =>
  h("a", { href: stepUrl(id, step), "aria-current": current ? "page" : null, "data-step": step });

/** @param {HTMLAnchorElement} link @param {string} name @param {number} number @param {{status: StepStatus, message: string} | undefined} state */
function showStep(link, name, number, state) {
  const status = state?.status ?? "todo";
  link.title = `${name}: ${STATUS_WORDS[status]}${state?.message ? `. ${told(state.message).words}` : ""}`;
  link.dataset.status = status;
  fill(
    link,
    statusMark(status, number),
    h("span", { class: "name" }, name),
    h("span", { class: "visually-hidden" }, `, ${STATUS_WORDS[status]}`),
  );
}

function brand() {
  const logo = svg(
    "svg",
    { viewBox: "0 0 24 24", "aria-hidden": "true" },
    svg("rect", { x: 1, y: 1, width: 22, height: 22, rx: 6, fill: "#0a5fb4" }),
    svg("path", {
      d: "M6 15.500 12 7l6 8.500",
      fill: "none",
      stroke: "#fff",
      "stroke-width": 2,
      "stroke-linecap": "round",
      "stroke-linejoin": "round",
    }),
    svg("circle", { cx: 12, cy: 15, r: 2.2, fill: "#ffd23f" }),
  );
  return h("a", { class: "brand", href: "/", title: "All projects" }, logo, h("span", { class: "brand-name" }, "Rooftrack"));
}

/** @param {"undo" | "redo"} name @param {string} label @param {() => void} run */
const actionButton = (name, label, run) =>
  h("button", { class: "button quiet icon-only", type: "button", "aria-label": label, onclick: run }, icon(name));

/** @param {HTMLButtonElement} button @param {boolean} enabled @param {string} words */
function setAction(button, enabled, words) {
  button.disabled = !enabled;
  button.title = words;
  button.setAttribute("aria-label", words);
}

/** @param {HTMLElement} element @param {import("../lib/store.js").Saving} state */
function showSaving(element, state) {
  const words = { saved: "Saved", saving: "Saving…", waiting: "Not saved yet", failed: "Not saved" }[state];
  element.className = `save-state ${state === "failed" || state === "waiting" ? "bad" : ""}`;
  element.dataset.state = state;
  fill(
    element,
    icon(state === "saved" ? "check" : state === "saving" ? "running" : "warn", "small"),
    h("span", { class: "word" }, words),
  );
}

function themeButton() {
  const button = h(
    "button",
    { class: "button quiet icon-only", type: "button", "aria-label": "Light or dark", title: "Light or dark" },
    icon(themeIcon()),
  );
  button.addEventListener("click", () => {
    nextTheme();
    fill(button, icon(themeIcon()));
  });
  return button;
}

/** @param {string} title */
const helpButton = (title) =>
  h(
    "button",
    {
      class: "button quiet icon-only",
      type: "button",
      "aria-label": "Keys and gestures (?)",
      title: "Keys and gestures (?)",
      onclick: () => openHelp(title),
    },
    icon("help"),
  );

/** @param {string} title @returns {import("../lib/keys.js").KeyBinding} */
const helpKey = (title) => ({ keys: "?", group: "Everywhere", label: "This list", run: () => openHelp(title) });
