// Why a field does not take what was typed: a few words under it, over whatever lies there, gone by themselves.

import { h } from "../lib/dom.js";

const SHOWN_MS = 5000;

/** @param {HTMLInputElement} input */
export function fieldWords(input) {
  const element = h("p", { class: "field-words", role: "alert", popover: "manual" });
  let timer = 0;
  const hide = () => {
    window.clearTimeout(timer);
    if (element.isConnected && element.matches(":popover-open")) element.hidePopover();
  };
  input.addEventListener("input", hide);
  return {
    element,
    hide,
    /** @param {string} words */
    say(words) {
      hide();
      element.textContent = words;
      element.showPopover();
      const { left, bottom } = input.getBoundingClientRect();
      element.style.left = `${Math.max(8, Math.min(left, window.innerWidth - element.offsetWidth - 8))}px`;
      element.style.top = `${bottom + 4}px`;
      timer = window.setTimeout(hide, SHOWN_MS);
    },
  };
}
