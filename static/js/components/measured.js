// Pages that show results wait here until there are any.

import { get, projectPath } from "../lib/api.js";
import { fill, find, h } from "../lib/dom.js";
import { icon } from "../lib/icons.js";
import { told } from "../lib/problems.js";
import { stepUrl } from "./header.js";
import { fetchResults } from "./histories.js";
import { toastError } from "./toast.js";

/** @typedef {import("./histories.js").Results} Results */

/**
 * The results, at once or as soon as there are some; until then the page says what is missing.
 * @param {import("./page.js").Page} page
 * @param {string} what it will be good for
 * @param {{byMethod?: boolean}} [options] byMethod: results of another method than the one chosen are none
 * @returns {Promise<Results>}
 */
export async function whenMeasured(page, what, { byMethod = false } = {}) {
  const main = find("#main");
  const layout = main.className;
  for (;;) {
    const results = await fetchResults(page.id).catch((error) => (toastError(error), null));
    const { method } = page.store.project;
    const other = byMethod && results?.ready && !results.methods.includes(method);
    if (results?.ready && !other) {
      main.className = layout;
      return results;
    }
    main.className = "page";
    const title = other ? `Not measured by the ${method} method yet` : "Nothing measured yet";
    fill(main, emptyState(title, what, stepButton(page.id, "track")));
    await new Promise((resolve) => {
      page.events.on("results", () => resolve(null));
      if (other) page.store.on("change", ({ project }) => project.method !== method && resolve(null));
    });
  }
}

/**
 * What the video is, at once or as soon as it is there; until then the page says what is missing.
 * @param {import("./page.js").Page} page
 * @param {string} what it is needed for
 * @returns {Promise<{width: number, height: number, frames: number}>}
 */
export async function whenVideo(page, what) {
  const main = find("#main");
  const layout = main.className;
  for (;;) {
    const { video } = await get(projectPath(page.id, "inputs"));
    if (video && !video.error) {
      main.className = layout;
      return video;
    }
    const why = video?.error ? `${told(video.error.message).words} ` : "";
    main.className = "page";
    fill(main, emptyState("The video cannot be shown", why + what, stepButton(page.id, "inputs")));
    await new Promise((resolve) => page.events.on("inputs", resolve));
  }
}

/** @param {string} title @param {string} what @param {HTMLElement} remedy */
const emptyState = (title, what, remedy) =>
  h("div", { class: "empty-state" }, h("h1", {}, title), h("p", {}, what), remedy);

/** @param {string} id @param {"inputs" | "track"} step */
const stepButton = (id, step) =>
  h(
    "a",
    { class: "button primary", href: stepUrl(id, step) },
    step === "inputs" ? "Go to Inputs" : "Go to Track",
    icon("arrow_right"),
  );
