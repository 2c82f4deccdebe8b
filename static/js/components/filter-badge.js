// The filter that the displacement shown has gone through, with the way to where it is chosen.

import { h } from "../lib/dom.js";
import { fixed } from "../lib/format.js";
import { stepUrl } from "./header.js";

/** @param {import("../lib/store.js").ProjectStore} store @returns {HTMLElement | null} nothing where no filter is applied */
export function filterBadge(store) {
  const { filter, corner_hz } = store.project.drift;
  if (filter === "none") return null;
  const title = "Takes slower motion out of the displacement, a residual too. It is chosen at the Drift step.";
  return h("a", { class: "badge accent", href: stepUrl(store.id, "drift"), title }, `High-pass ${fixed(corner_hz, 2)}\u202fHz`);
}
