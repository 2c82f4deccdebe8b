// A row of choices of which one holds. Arrow keys move between them, as between radio buttons.

import { h, refill } from "../lib/dom.js";

/**
 * @template {string} Value
 * @param {object} options
 * @param {string} options.label for assistive technology
 * @param {{value: Value, name: string, hint?: string}[]} options.choices
 * @param {Value} options.value
 * @param {(value: Value) => void} options.onChange
 */
export function segmented({ label, choices, value, onChange }) {
  const element = h("div", { class: "segmented", role: "radiogroup", "aria-label": label });
  let chosen = value;
  let offered = choices;
  const choose = (/** @type {Value} */ wanted) => {
    if (wanted === chosen) return;
    chosen = wanted;
    show();
    onChange(wanted);
  };
  const show = () => {
    const hadFocus = element.contains(document.activeElement);
    refill(
      element,
      offered.map((choice) => {
        const on = choice.value === chosen;
        const attributes = {
          type: "button",
          role: "radio",
          "aria-checked": String(on),
          tabindex: on ? 0 : -1,
          title: choice.hint,
          "data-value": choice.value,
        };
        return h("button", { ...attributes, onclick: () => choose(choice.value) }, choice.name);
      }),
    );
    if (hadFocus) /** @type {HTMLElement | null} */ (element.querySelector("[aria-checked=true]"))?.focus();
  };
  element.addEventListener("keydown", (event) => {
    const direction =
      event.key === "ArrowRight" || event.key === "ArrowDown"
        ? 1
        : event.key === "ArrowLeft" || event.key === "ArrowUp"
          ? -1
          : 0;
    if (direction === 0) return;
    event.preventDefault();
    const at = offered.findIndex((choice) => choice.value === chosen);
    choose(offered[(at + direction + offered.length) % offered.length].value);
  });
  show();
  return {
    element,
    /** @param {Value} wanted */
    set(wanted) {
      chosen = wanted;
      show();
    },
    /** @param {{value: Value, name: string, hint?: string}[]} wanted */
    offer(wanted) {
      offered = wanted;
      show();
    },
  };
}
