// A button that stays pressed: something shown or not.

import { h } from "../lib/dom.js";

/**
 * @param {{label: string, hint: string, on: boolean, onChange: (on: boolean) => void}} options  hint: with its key
 */
export function toggleButton({ label, hint, on, onChange }) {
  const attributes = { class: "button small", type: "button", "aria-pressed": String(on), title: hint };
  const element = h("button", attributes, label);
  element.addEventListener("click", () => {
    const now = element.getAttribute("aria-pressed") !== "true";
    element.setAttribute("aria-pressed", String(now));
    onChange(now);
  });
  return { element, toggle: () => element.click() };
}
