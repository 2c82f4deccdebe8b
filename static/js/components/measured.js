// Pages that show results wait here until there are any.

import { fill, find, h } from "../lib/dom.js";
import { icon } from "../lib/icons.js";
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
    fill(main, emptyState(page.id, other ? `Not measured by the ${method} method yet` : "Nothing measured yet", what));
    await new Promise((resolve) => {
      page.events.on("results", () => resolve(null));
      if (other) page.store.on("change", ({ project }) => project.method !== method && resolve(null));
    });
  }
}

/** @param {string} id @param {string} title @param {string} what */
function emptyState(id, title, what) {
  return h(
    "div",
    { class: "empty-state" },
    h("h1", {}, title),
    h("p", {}, what),
    h("a", { class: "button primary", href: stepUrl(id, "track") }, "Go to Track", icon("arrow_right")),
  );
}
