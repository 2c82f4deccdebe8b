// Short messages in the lower right corner, and a voice for screen readers.

import { h } from "../lib/dom.js";
import { icon } from "../lib/icons.js";
import { isAbort, isOffline, sentence } from "../lib/api.js";
import { dismissButton } from "./notes.js";

/**
 * @typedef {object} ToastOptions
 * @property {"info" | "good" | "warn" | "bad"} [tone]
 * @property {{label: string, run: () => void}} [action]  one thing to do about it, such as Undo
 * @property {number} [seconds]  how long; 0 until dismissed
 */

const tray = h("div", { class: "toasts", role: "region", "aria-label": "Messages" });
const voice = h("div", { class: "visually-hidden", role: "status", "aria-live": "polite" });
const ICONS = /** @type {const} */ ({ info: "info", good: "check", warn: "warn", bad: "warn" });

/** @param {string} message @param {ToastOptions} [options] @returns {() => void} takes it away */
export function toast(message, { tone = "info", action, seconds = tone === "bad" ? 12 : 6 } = {}) {
  if (!tray.isConnected) document.body.append(tray, voice);
  const close = () => element.remove();
  const element = h(
    "div",
    { class: `toast ${tone}`, role: tone === "bad" || tone === "warn" ? "alert" : "status" },
    icon(ICONS[tone]),
    h("p", {}, message),
    action &&
      h("button", { class: "button small", type: "button", onclick: () => (close(), action.run()) }, action.label),
    dismissButton(close),
  );
  element.dataset.message = `${tone}: ${message}`;
  for (const older of /** @type {HTMLElement[]} */ ([...tray.children]))
    if (older.dataset.message === element.dataset.message) older.remove(); // said once, and for as long again
  tray.append(element);
  if (seconds > 0) hideAfter(element, seconds);
  makeRoom();
  return close;
}

/** Tell what went wrong in the engine's sentence; our own cancelling is no news, nor what a bar says already. @param {unknown} error */
export function toastError(error) {
  const said = isOffline(error) && document.querySelector(".connection-bar:not([hidden])");
  if (!isAbort(error) && !said) toast(sentence(error), { tone: "bad" });
}

/** Say to assistive technology only. @param {string} message */
export function announce(message) {
  if (!voice.isConnected) document.body.append(tray, voice);
  voice.textContent = message;
}

/** Not by taking away what waits for an answer, such as edits to do again. */
function makeRoom() {
  const passing = tray.querySelectorAll(".toast[data-passing]");
  for (let i = 0; i < passing.length && tray.children.length > 4; i++) passing[i].remove();
}

/** Wait while the pointer rests on one of its buttons. @param {HTMLElement} element @param {number} seconds */
function hideAfter(element, seconds) {
  element.dataset.passing = "";
  let timer = window.setTimeout(() => element.remove(), seconds * 1000);
  element.addEventListener("pointerenter", () => window.clearTimeout(timer));
  element.addEventListener("pointerleave", () => (timer = window.setTimeout(() => element.remove(), 3000)));
}
