// The list of projects: where one begins, and where nothing is lost.

import { get, post, projectPath, put, remove, upload } from "../lib/api.js";
import { fill, find, h, svg } from "../lib/dom.js";
import { pickFiles } from "../lib/download.js";
import { ago, count, fixed } from "../lib/format.js";
import { icon } from "../lib/icons.js";
import { bindKeys } from "../lib/keys.js";
import { latest } from "../lib/latest.js";
import { told } from "../lib/problems.js";
import { deletedProjects, undelete } from "../lib/trash.js";
import { askName } from "../components/dialog.js";
import { STEPS, projectsHeader, statusMark, stepUrl } from "../components/header.js";
import { menuButton } from "../components/menu.js";
import { toast, toastError } from "../components/toast.js";
import { chooseDeleted } from "./projects/deleted-projects.js";
import { newProjectDialog } from "./projects/new-project.js";

/** @typedef {import("../lib/types.js").Steps} Steps */
/** @typedef {{id: string, name: string, updated_s: number, steps: Steps}} Listed */

const list = h("div", { class: "project-list" });
const create = h(
  "button",
  { class: "button primary", type: "button", onclick: () => void newProject() },
  icon("add"),
  "New project",
);
const restore = h(
  "button",
  { class: "button", type: "button", onclick: () => void restoreArchive() },
  icon("upload"),
  "Restore archive…",
);
const deletedCount = h("span");
const deleted = h(
  "button",
  { class: "button quiet", type: "button", hidden: true, onclick: () => void restoreDeleted() },
  icon("trash"),
  deletedCount,
);

projectsHeader();
fill(
  find("#main"),
  h(
    "div",
    { class: "page-title" },
    h(
      "div",
      {},
      h("h1", {}, "Projects"),
      h(
        "p",
        {},
        "Displacement of a structure from a drone video: each project is a folder with its inputs, your decisions and the results.",
      ),
    ),
    h("div", { class: "toolbar" }, deleted, restore, create),
  ),
  list,
);
bindKeys([{ keys: "C", group: "Projects", label: "New project", run: () => void newProject() }]);

const askProjects = latest(
  () => get("projects"),
  (/** @type {Listed[]} */ projects) => fill(list, projects.length === 0 ? emptyState() : projects.map(card)),
  toastError,
);
const askDeleted = latest(
  deletedProjects,
  ({ length }) => {
    deleted.hidden = length === 0;
    deletedCount.textContent = `Deleted projects (${count(length)})`;
  },
  toastError,
);

function load() {
  void askProjects(null);
  void askDeleted(null);
}

/** The video's first frame. @param {Listed} project */
const still = (project) =>
  h("img", {
    class: "still",
    alt: "",
    loading: "lazy",
    src: `/api/${projectPath(project.id, "frames/0.jpg", { w: 360 })}`,
    onerror: (/** @type {Event} */ event) => /** @type {Element} */ (event.target).replaceWith(placeholder()),
  });

const placeholder = () => h("div", { class: "still placeholder" }, icon("video"));

/** @param {Listed} project */
function card(project) {
  const hasVideo = project.steps.inputs.status !== "todo";
  const next = STEPS.find(({ step }) => !["done", "unneeded"].includes(project.steps[step].status));
  const steps = STEPS.map(({ step, name }, i) => {
    const { status, message } = project.steps[step];
    const words = told(message).words;
    return h(
      "li",
      {},
      h(
        "a",
        { href: stepUrl(project.id, step), title: `${name}: ${words}` },
        statusMark(status, i + 1),
        h("span", { class: "name" }, name),
      ),
    );
  });
  return h(
    "article",
    { class: "card project-card", "data-project": project.id },
    hasVideo ? still(project) : placeholder(),
    h(
      "header",
      {},
      h("h2", { title: project.name }, h("a", { href: `/p/${encodeURIComponent(project.id)}` }, project.name)),
      // Two projects may be called the same, as a copied folder's; two folders may not.
      project.id !== project.name && h("span", { class: "folder faint small", title: project.id }, `in folder ${project.id}`),
      h("span", { class: "faint small" }, ago(project.updated_s)),
      actions(project),
    ),
    h("ol", { class: "step-strip", "aria-label": "Steps" }, steps),
    h(
      "p",
      { class: "small soft" },
      next === undefined ? "All steps done." : `${next.name}: ${told(project.steps[next.step].message).words}`,
    ),
  );
}

/** @param {Listed} project */
function actions(project) {
  return menuButton({
    label: `Actions for ${project.name}`,
    icon: "more",
    items: () => [
      { label: "Rename…", icon: "edit", run: () => void rename(project) },
      { label: "Duplicate…", icon: "copy", run: () => void duplicate(project) },
      { label: "Archive with inputs", icon: "archive", run: () => archive(project, true) },
      { label: "Archive without inputs", icon: "archive", run: () => archive(project, false) },
      { label: "Delete", icon: "trash", danger: true, run: () => void removeProject(project) },
    ],
  });
}

/** @param {() => Promise<unknown>} task */
async function attempt(task) {
  try {
    await task();
  } catch (error) {
    toastError(error);
  }
  load();
}

async function newProject() {
  const made = await newProjectDialog();
  if (made !== null) location.assign(stepUrl(made, "inputs"));
}

/** @param {Listed} project */
async function rename(project) {
  const name = await askName({ title: "Rename project", label: "Name", value: project.name, action: "Rename" });
  if (name === null || name === project.name) return;
  await attempt(async () => {
    const state = await get(projectPath(project.id));
    await put(projectPath(project.id), {
      project: { ...state.project, name },
      revision: state.revision,
      label: `Rename to ${name}`,
    });
  });
}

/** @param {Listed} project */
async function duplicate(project) {
  const name = await askName({
    title: "Duplicate project",
    label: "Name of the copy",
    value: `${project.name} copy`,
    action: "Duplicate",
  });
  if (name !== null) await attempt(() => post(projectPath(project.id, "duplicate"), { name }));
}

/** @param {Listed} project @param {boolean} inputs */
function archive(project, inputs) {
  h("a", {
    href: `/api/${projectPath(project.id, "archive", { inputs: inputs ? 1 : 0 })}`,
    download: `${project.id}.zip`,
  }).click();
}

/** @param {Listed} project */
async function removeProject(project) {
  await attempt(async () => {
    const { undo_token } = await remove(projectPath(project.id));
    const bringBack = () => void attempt(() => undelete(undo_token));
    toast(`${project.name} was deleted.`, { action: { label: "Undo", run: bringBack }, seconds: 20 });
  });
}

async function restoreDeleted() {
  const chosen = await chooseDeleted();
  if (chosen === null) return load(); // another window may have restored some
  await attempt(async () => {
    const { id } = await undelete(chosen.undo_token);
    tellRestored(chosen.name, id);
  });
}

/** @param {string} name @param {string} id */
function tellRestored(name, id) {
  const open = () => location.assign(`/p/${encodeURIComponent(id)}`);
  toast(`${name} was restored.`, { tone: "good", action: { label: "Open", run: open } });
}

async function restoreArchive() {
  const [file] = await pickFiles({ accept: ".zip" });
  if (file === undefined) return;
  const cancel = new AbortController();
  const bar = h("progress", { max: 1, value: 0, "aria-label": "Restoring" });
  const words = h("span", { class: "numbers number" });
  const row = h(
    "div",
    { class: "job" },
    h(
      "div",
      { class: "job-head" },
      h("strong", {}, `Restoring ${file.name}`),
      words,
      h("button", { class: "button small", type: "button", onclick: () => cancel.abort() }, "Cancel"),
    ),
    bar,
  );
  list.before(row);
  await attempt(async () => {
    const sent = (/** @type {number} */ done, /** @type {number} */ total) => {
      bar.value = done / total;
      words.textContent = `${fixed((100 * done) / total, 0)} %`;
    };
    const { id } = await upload("POST", "projects/restore", file, sent, cancel.signal);
    tellRestored(file.name, id);
  });
  row.remove();
}

function emptyState() {
  const drawing = svg(
    "svg",
    { viewBox: "0 0 72 72", fill: "none", stroke: "currentColor", "stroke-width": 1.6, "aria-hidden": "true" },
    svg("path", { d: "M10 56h52M18 56V34l18-12 18 12v22M18 34h36M28 12h16M22 9h12M38 9h12" }),
    svg("path", { d: "M36 12 20 34M36 12l16 22", "stroke-dasharray": "3 3" }),
  );
  const begin = h(
    "button",
    { class: "button primary", type: "button", onclick: () => void newProject() },
    icon("add"),
    "New project",
  );
  return h(
    "div",
    { class: "empty-state" },
    drawing,
    h("h2", {}, "No project yet"),
    h("p", {}, "Begin with a drone video of the structure; the point cloud, lens and GPS can follow."),
    begin,
  );
}

load();
window.addEventListener("pageshow", (event) => event.persisted && load());
