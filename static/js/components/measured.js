// Pages that show results wait here until there are any.

import { get, isOffline, projectPath, sentence, untilNextTry } from "../lib/api.js";
import { fill, find, h } from "../lib/dom.js";
import { icon } from "../lib/icons.js";
import { told } from "../lib/problems.js";
import { stepUrl } from "./header.js";
import { fetchResults } from "./histories.js";

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
    const results = await answered("The results cannot be shown", () => fetchResults(page.id));
    const { method } = page.store.project;
    const other = byMethod && results.ready && !results.methods.includes(method);
    if (results.ready && !other) {
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
    const { video } = await answered("The video cannot be shown", () => get(projectPath(page.id, "inputs")));
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

/**
 * What the server answers, however often it has to be asked; meanwhile the page says why it shows nothing.
 * @template Answer
 * @param {string} title
 * @param {() => Promise<Answer>} ask
 * @returns {Promise<Answer>}
 */
async function answered(title, ask) {
  for (;;) {
    try {
      return await ask();
    } catch (error) {
      await untilWorthAsking(title, error);
    }
  }
}

/** A server that did not answer may be back soon; one that refused is asked again when the person wants it. @param {string} title @param {unknown} error @returns {Promise<unknown>} */
function untilWorthAsking(title, error) {
  const main = find("#main");
  main.className = "page";
  return new Promise((resolve) => {
    const again = h("button", { class: "button primary", type: "button", onclick: resolve }, "Try again");
    fill(main, emptyState(title, sentence(error), again));
    if (isOffline(error)) void untilNextTry().then(resolve);
  });
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
