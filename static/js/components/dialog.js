// Modal dialogs on the browser's own <dialog>: focus stays inside, Escape closes, focus returns. A click beside one
// closes it only where nothing can be filled in: what a person entered is not thrown away by a slip of the hand.

import { h } from "../lib/dom.js";
import { icon } from "../lib/icons.js";
import { fieldWords } from "./field-words.js";

/** @typedef {import("../lib/dom.js").Child} Child */

let opened = 0;

/**
 * Open a dialog. The promise resolves when it is closed, with what `close` was given (null for Escape or Cancel).
 * @template Result
 * @param {object} options
 * @param {string} options.title
 * @param {(close: (result: Result | null) => void) => Child[]} options.body
 * @param {string} [options.size]  "small", "wide", "tall"
 * @returns {Promise<Result | null>}
 */
export function openDialog({ title, body, size = "" }) {
  return new Promise((resolve) => {
    const titleId = `dialog-title-${(opened += 1)}`;
    const dialog = h("dialog", { class: `dialog ${size}`, "aria-labelledby": titleId });
    const close = (/** @type {Result | null} */ result) => {
      dialog.close();
      dialog.remove();
      resolve(result);
    };
    const dismiss = h(
      "button",
      { class: "button quiet icon-only", type: "button", "aria-label": "Close", onclick: () => close(null) },
      icon("close"),
    );
    dialog.append(
      h("header", {}, h("h2", { id: titleId }, title), dismiss),
      ...body(close).filter((child) => child instanceof Node),
    );
    dialog.addEventListener("cancel", (event) => (event.preventDefault(), close(null)));
    dialog.addEventListener("pointerdown", (event) => {
      if (event.target === dialog && dialog.querySelector("input, select, textarea") === null) close(null);
    });
    document.body.append(dialog);
    dialog.showModal();
    const first = dialog.querySelector("[autofocus], .dialog-body input, .dialog-body select, .dialog-body button");
    if (first instanceof HTMLElement) first.focus();
    if (first instanceof HTMLInputElement && first.type === "text") first.select();
  });
}

/**
 * Ask for a name.
 * @param {object} options
 * @param {string} options.title
 * @param {string} options.label
 * @param {string} options.value
 * @param {string} options.action
 * @param {string} [options.hint]
 * @param {(name: string) => string | null} [options.refusal]  why a name does not do: it is told, and can be mended
 * @returns {Promise<string | null>}
 */
export function askName({ title, label, value, action, hint, refusal = () => null }) {
  return openDialog({
    title,
    size: "small",
    body: (close) => {
      const input = h("input", {
        class: "input",
        type: "text",
        id: "ask-name",
        value,
        required: true,
        autocomplete: "off",
        spellcheck: "false",
      });
      const words = fieldWords(input);
      input.addEventListener("input", () => input.removeAttribute("aria-invalid"));
      const submit = (/** @type {Event} */ event) => {
        event.preventDefault();
        const name = input.value.trim();
        const problem = name === "" ? "A name, please." : refusal(name);
        if (problem === null) return close(name);
        input.setAttribute("aria-invalid", "true");
        input.focus();
        words.say(problem);
      };
      const field = h(
        "div",
        { class: "field" },
        h("label", { class: "label", for: "ask-name" }, label),
        input,
        words.element,
        hint && h("p", { class: "hint" }, hint),
      );
      return [
        h(
          "form",
          { class: "dialog-form", novalidate: true, onsubmit: submit },
          h("div", { class: "dialog-body" }, field),
          dialogActions(() => close(null), h("button", { class: "button primary", type: "submit" }, action)),
        ),
      ];
    },
  });
}

/** Foot of a dialog: Cancel, then what it is for. @param {() => void} cancel @param {...HTMLElement} actions */
export function dialogActions(cancel, ...actions) {
  return h("footer", {}, h("button", { class: "button", type: "button", onclick: cancel }, "Cancel"), ...actions);
}
