// A button with a list of actions: arrow keys move, Escape closes, focus returns to the button.

import { h } from "../lib/dom.js";
import { icon } from "../lib/icons.js";

/** @typedef {{label: string, icon?: import("../lib/icons.js").IconName, danger?: boolean, disabled?: boolean, run: () => void}} MenuItem */

/**
 * @param {object} options
 * @param {string} options.label  for assistive technology, and shown when there is no icon
 * @param {import("../lib/icons.js").IconName} [options.icon]
 * @param {() => MenuItem[]} options.items  asked each time it opens
 */
export function menuButton({ label, icon: name, items }) {
  const button = h(
    "button",
    {
      class: `button ${name ? "quiet icon-only" : ""}`,
      type: "button",
      "aria-haspopup": "menu",
      "aria-expanded": "false",
      "aria-label": label,
      title: label,
    },
    name ? icon(name) : label,
  );
  button.addEventListener("click", () =>
    button.getAttribute("aria-expanded") === "true" ? undefined : open(button, items()),
  );
  return button;
}

/** @param {HTMLButtonElement} button @param {MenuItem[]} items */
function open(button, items) {
  const list = h("div", { class: "menu", role: "menu", popover: "auto" });
  const close = () => (list.isConnected && list.hidePopover(), button.focus());
  for (const item of items) {
    const run = () => (close(), item.run());
    list.append(
      h(
        "button",
        { class: item.danger ? "danger" : "", role: "menuitem", type: "button", disabled: item.disabled, onclick: run },
        item.icon ? icon(item.icon) : null,
        item.label,
      ),
    );
  }
  list.addEventListener("keydown", (event) => moveFocus(event, list));
  list.addEventListener("toggle", (event) => {
    if (/** @type {ToggleEvent} */ (event).newState !== "closed") return;
    button.setAttribute("aria-expanded", "false");
    list.remove();
  });
  document.body.append(list);
  button.setAttribute("aria-expanded", "true");
  list.showPopover();
  placeBelow(list, button);
  /** @type {HTMLElement | null} */ (list.querySelector("button:not(:disabled)"))?.focus();
}

/** @param {HTMLElement} list @param {HTMLElement} button */
function placeBelow(list, button) {
  const anchor = button.getBoundingClientRect();
  const { width, height } = list.getBoundingClientRect();
  list.style.left = `${Math.max(8, Math.min(anchor.right - width, window.innerWidth - width - 8))}px`;
  list.style.top = `${anchor.bottom + height + 12 > window.innerHeight ? anchor.top - height - 4 : anchor.bottom + 4}px`;
}

/** @param {KeyboardEvent} event @param {HTMLElement} list */
function moveFocus(event, list) {
  const step = event.key === "ArrowDown" ? 1 : event.key === "ArrowUp" ? -1 : 0;
  if (step === 0) return;
  event.preventDefault();
  const buttons = /** @type {HTMLElement[]} */ ([...list.querySelectorAll("button:not(:disabled)")]);
  const at = buttons.indexOf(/** @type {HTMLElement} */ (document.activeElement));
  buttons[(at + step + buttons.length) % buttons.length]?.focus();
}
