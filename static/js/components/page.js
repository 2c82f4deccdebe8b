// How to write a page (read this first).
//
// - `static/<step>.html` is a skeleton with landmarks: <header id="header">, <main id="main">; it links css/main.css,
//   js/theme-first.js and one module, js/pages/<step>.js. The server's content security policy allows no inline
//   script, no <style> and no style="" in markup; `element.style.x = …` and SVG attributes are fine.
// - A page module starts with `const page = await openPage("track");` and gets
//     page.id      the project's id                     page.store   the project with revisions and undo (lib/store.js)
//     page.events  what the server tells on its own     page.keys    bindKeys: bound and listed under `?`
//   Change the project only with `store.edit("Move pair 3", (draft) => { … })`; redraw on `store.on("change", …)`.
// - Ask the server through lib/api.js, catch with `toastError`. Results (fits, transforms, residuals) come from there:
//   the browser never computes one. Only lib/coordinates.js knows canvas px and the half-pixel rule.
// - What one looks at (selection, view, tab) goes to the query string with lib/view-state.js.
// - Elements come from `h("button", { class: "button", onclick: … }, "Text")`; icons from lib/icons.js;
//   numbers for people from lib/format.js.
// - Imports run lib → components → pages. Files are named with hyphens, exports in camelCase.

import { ProjectStore } from "../lib/store.js";
import { ServerEventStream } from "../lib/events.js";
import { bindKeys } from "../lib/keys.js";
import { fill, find, h } from "../lib/dom.js";
import { isConflict, isMissing, sentence } from "../lib/api.js";
import { plural } from "../lib/format.js";
import { deletedProjects, undelete } from "../lib/trash.js";
import { projectHeader, projectsHeader, stepUrl, tellConnection } from "./header.js";
import { toast, toastError } from "./toast.js";

/** @typedef {import("../lib/types.js").StepName} StepName */
/** @typedef {{id: string, step: StepName, store: ProjectStore, events: ServerEventStream, keys: typeof bindKeys}} Page */

/** Open the project named in the URL, fill the header, bind undo. @param {StepName} step @returns {Promise<Page>} */
export async function openPage(step) {
  const id = decodeURIComponent(location.pathname.split("/")[2] ?? "");
  try {
    const store = await ProjectStore.open(id);
    const events = new ServerEventStream(id);
    projectHeader(store, step, events);
    tellConnection(events, store);
    tellTroubles(store);
    tellSteps(store);
    window.addEventListener("beforeunload", (event) => store.hasUnsaved && event.preventDefault());
    events.on("hello", ({ revision }) => store.heardOf(revision));
    events.on("project", ({ revision }) => store.heardOf(revision));
    for (const name of /** @type {const} */ (["inputs", "orthoimage", "results"]))
      events.on(name, () => void store.refresh().catch(toastError));
    bindKeys(historyKeys(store));
    return { id, step, store, events, keys: bindKeys };
  } catch (error) {
    showDeadEnd(sentence(error), isMissing(error) ? await restoring(id, step) : null);
    return new Promise(() => undefined); // the page goes no further
  }
}

/** @param {ProjectStore} store @returns {import("../lib/keys.js").KeyBinding[]} */
function historyKeys(store) {
  return [
    {
      keys: "Ctrl+Z",
      group: "Everywhere",
      label: "Undo",
      run: () => store.undo().catch(toastError),
    },
    {
      keys: "Ctrl+Shift+Z / Ctrl+Y",
      group: "Everywhere",
      label: "Redo",
      run: () => store.redo().catch(toastError),
    },
  ];
}

/** @param {ProjectStore} store */
function tellTroubles(store) {
  store.on("lost", ({ labels, error, again }) =>
    toast(`${these(labels)} not saved${whyLost(error)}`, {
      tone: "warn",
      seconds: 0,
      action: { label: "Do it again", run: again },
    }),
  );
  store.on("refused", ({ label, error }) => toast(`“${label}” was not saved. ${sentence(error)}`, { tone: "bad" }));
}

/** What is undone may be an edit of another page, without a sign on this one. @param {ProjectStore} store */
function tellSteps(store) {
  /** @type {() => void} */
  let takeAway = () => undefined;
  store.on("stepped", ({ which, label }) => {
    takeAway();
    takeAway = toast(`${which === "undo" ? "Undone" : "Redone"}: “${label}”`, { seconds: 4 });
  });
}

/** "“Nudge pair 3” and 2 more edits were" @param {string[]} labels */
const these = ([first, ...rest]) =>
  rest.length === 0 ? `“${first}” was` : `“${first}” and ${plural(rest.length, "more edit")} were`;

/** @param {unknown} error */
const whyLost = (error) =>
  isConflict(error)
    ? ": another window has changed this project. You now see its newer state."
    : `. ${sentence(error)}`;

/** A button that fetches a deleted project back, to the step that was asked for; null where none of this id is kept. @param {string} id @param {StepName} step */
async function restoring(id, step) {
  const kept = await deletedProjects().catch(() => []);
  const deleted = kept.find((project) => project.id === id);
  if (deleted === undefined) return null;
  const restore = async () => {
    const restored = await undelete(deleted.undo_token);
    location.assign(stepUrl(restored.id, step));
  };
  const onclick = () => restore().catch(toastError);
  return h("button", { class: "button", type: "button", onclick }, "Restore the deleted project");
}

/** @param {string} message @param {HTMLElement | null} remedy */
function showDeadEnd(message, remedy) {
  projectsHeader();
  const box = h(
    "div",
    { class: "empty-state" },
    h("h1", {}, "This project cannot be opened"),
    h("p", {}, message),
    h("div", { class: "toolbar" }, remedy, h("a", { class: "button primary", href: "/" }, "All projects")),
  );
  const main = find("#main");
  main.className = "page";
  fill(main, box);
}
