// Results of an earlier state of the project are shown as such, with the way to newer ones.

import { post, projectPath } from "../lib/api.js";
import { fill, h } from "../lib/dom.js";
import { methodName } from "./histories.js";
import { isRunning } from "./job-card.js";
import { note } from "./notes.js";
import { stepUrl } from "./header.js";
import { toastError } from "./toast.js";

/** @typedef {import("./page.js").Page} Page */
/** @typedef {import("./histories.js").Results} Results */
/** @typedef {import("./histories.js").Method} Method */

/**
 * Above results: nothing where they and their files are the project's as it stands.
 * @param {Page} page
 */
export function earlierNote(page) {
  const element = h("div", { class: "earlier-note", role: "status", hidden: true });
  const update = h("button", { type: "button", class: "button small", onclick: () => void updateFiles(page) }, "Update the files");
  page.events.on("job", (job) => (update.disabled = isRunning(job)));
  return {
    element,
    /** @param {Results} results @param {{method: Method, isEarlier: boolean}} shown the curves: by which method, and whether the project cannot be solved as it stands */
    show(results, { method, isEarlier }) {
      const isMeasured = results.measured.includes(method);
      const wanted = page.store.project.method;
      element.hidden = !results.stale;
      if (element.hidden) fill(element);
      else if (isEarlier || !isMeasured) fill(element, fromBefore(page));
      else if (method !== wanted)
        fill(element, withTrackLink(page, `Not measured by the ${methodName(wanted)} method yet. This is the ${methodName(method)} one.`));
      else fill(element, banner("The project has changed: what you see here follows it already, the files are older.", update));
    },
  };
}

/** @param {Page} page @param {string} [words] */
export const fromBefore = (
  page,
  words = "The project or one of its files has changed since it was tracked. This is the last result, from before the change.",
) => withTrackLink(page, words);

/** @param {Page} page @param {string} words */
const withTrackLink = (page, words) =>
  banner(words, h("a", { class: "button small", href: stepUrl(page.id, "track") }, "Go to Track"));

/** @param {string} words @param {HTMLElement} remedy */
function banner(words, remedy) {
  const element = note("warn", words);
  element.classList.add("banner");
  element.append(remedy);
  return element;
}

/** Make the files anew from what is measured. @param {Page} page */
async function updateFiles(page) {
  try {
    await post(projectPath(page.id, "report"));
  } catch (error) {
    toastError(error);
  }
}
