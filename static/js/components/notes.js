// A sentence with a sign, in the tone of what it says.

import { h } from "../lib/dom.js";
import { icon } from "../lib/icons.js";

const ICONS = /** @type {const} */ ({ good: "check", info: "info", warn: "warn", bad: "warn" });

/** @param {"info" | "good" | "warn" | "bad"} tone @param {string} words */
export const note = (tone, words) =>
  h("div", { class: `note ${tone}`, role: tone === "bad" ? "alert" : null }, icon(ICONS[tone]), h("p", {}, words));

/** Takes a message away. @param {() => void} onclick */
export const dismissButton = (onclick) =>
  h(
    "button",
    { class: "button quiet small icon-only", type: "button", "aria-label": "Dismiss", onclick },
    icon("close", "small"),
  );
