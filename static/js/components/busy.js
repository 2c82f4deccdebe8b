// A few words over a part of the page while the engine works on it.

import { h } from "../lib/dom.js";

const SHOWN_AFTER_MS = 250; // what is quick needs no words

/**
 * @param {HTMLElement} element
 * @param {string} words
 * @returns {() => void} takes them away
 */
export function busyOver(element, words) {
  const cover = h(
    "div",
    { class: "busy", role: "status" },
    h("p", {}, h("span", { class: "busy-sign", "aria-hidden": "true" }), words),
  );
  const timer = window.setTimeout(() => element.append(cover), SHOWN_AFTER_MS);
  return () => {
    window.clearTimeout(timer);
    cover.remove();
  };
}
