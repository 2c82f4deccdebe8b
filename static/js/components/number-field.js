// A number with its unit: typed, or stepped with the arrow keys (Shift ten times, Alt a tenth).

import { h } from "../lib/dom.js";
import { fixed } from "../lib/format.js";
import { fieldWords } from "./field-words.js";

/**
 * @typedef {object} NumberFieldOptions
 * @property {string} label
 * @property {string} unit
 * @property {number | null} value
 * @property {(value: number | null) => void} onChange  on Enter, on leaving, and on each step
 * @property {number} [decimals]  0: whole numbers only
 * @property {number} [step]
 * @property {number} [min]
 * @property {number | (() => number)} [max]  a function where it is known later
 * @property {() => string} [tooGreat]  what to say of a greater one
 * @property {boolean} [optional]  may be empty (null)
 * @property {boolean} [compact]
 * @property {boolean} [bare]  without the visible label (it is still spoken)
 * @property {string} [placeholder]
 * @property {string} [hint]
 */

let fields = 0;

/** @param {NumberFieldOptions} options */
export function numberField(options) {
  const { unit, onChange, decimals = 2, step = 10 ** -decimals, min = -Infinity, optional = false } = options;
  const greatest = () => (typeof options.max === "function" ? options.max() : (options.max ?? Infinity));
  const input = inputOf(options);
  const words = fieldWords(input);
  let current = options.value;

  const written = () => (current === null ? "" : current.toFixed(decimals));
  const isWhole = decimals === 0;
  const refuse = (/** @type {number} */ value) =>
    words.say(options.tooGreat && value > greatest() ? options.tooGreat() : permitted(min, greatest(), decimals, unit));
  const show = () => {
    input.value = written();
    input.removeAttribute("aria-invalid");
    input.dataset.atRest = ""; // so undo is the page's
  };
  const take = (/** @type {number | null} */ value) => {
    const isNew = value !== current;
    current = value;
    show();
    if (isNew) onChange(value);
  };
  const read = () => {
    const text = plainNumber(input.value);
    if (text === "" && optional) return take(null);
    const value = Number(text);
    const isOther = text === "" || !Number.isFinite(value) || (isWhole && !Number.isInteger(value));
    if (isOther || value < min || value > greatest()) {
      input.setAttribute("aria-invalid", "true");
      return refuse(value);
    }
    if (current !== null && text === written()) return show(); // as rounded for the eye: nothing was typed
    take(value);
  };
  const turn = (/** @type {number} */ steps) => {
    const wanted = Number(((current ?? 0) + steps * step).toFixed(isWhole ? 0 : 8));
    take(Math.min(greatest(), Math.max(min, wanted)));
    if (wanted !== current) refuse(wanted);
  };
  input.addEventListener("input", () => delete input.dataset.atRest);
  input.addEventListener("change", read);
  input.addEventListener("blur", show); // after "change": what could not be used, or what came meanwhile
  input.addEventListener("keydown", (event) => {
    if (event.key === "Enter") read();
    if (event.key === "Escape") (show(), input.blur());
    const steps = stepsOf(event);
    if (steps === 0) return;
    event.preventDefault();
    turn(steps);
  });
  show();
  return {
    element: framed(input, words.element, options),
    input,
    /** Show another value, unless a person is typing. @param {number | null} value */
    set(value) {
      if (value === current) return;
      const isTyping = document.activeElement === input && input.value !== written();
      current = value;
      if (!isTyping) show();
    },
  };
}

/** @param {NumberFieldOptions} options */
function inputOf({ label, unit, placeholder, optional = false, bare = false }) {
  return h("input", {
    class: "input",
    id: `number-${(fields += 1)}`,
    type: "text",
    inputmode: "decimal",
    autocomplete: "off",
    spellcheck: "false",
    placeholder: placeholder ?? (optional ? "–" : ""),
    "aria-label": bare ? `${label}${unit ? `, ${unit}` : ""}` : null,
  });
}

/**
 * With its unit and what is said of it, and with its label unless bare.
 * @param {HTMLInputElement} input
 * @param {HTMLElement} words
 * @param {NumberFieldOptions} options
 */
function framed(input, words, { label, unit, compact, bare, hint }) {
  const unitBox = h("span", { class: "unit" }, unit);
  const box = h("div", { class: `number-field ${compact ? "compact" : ""}` }, input, words, unitBox);
  if (bare) return box;
  return h(
    "div",
    { class: "field" },
    h("label", { class: "label", for: input.id }, label),
    box,
    hint && h("p", { class: "hint" }, hint),
  );
}

/** As typed, with a comma or a long minus read as people mean them. @param {string} text */
const plainNumber = (text) => text.trim().replace(",", ".").replace("\u2212", "-");

/** @param {KeyboardEvent} event @returns {number} steps of an arrow key, upwards; 0 for other keys */
function stepsOf({ key, shiftKey, altKey }) {
  const way = key === "ArrowUp" ? 1 : key === "ArrowDown" ? -1 : 0;
  return way * (shiftKey ? 10 : altKey ? 0.1 : 1);
}

/** What a field takes, in words. @param {number} min @param {number} max @param {number} decimals @param {string} unit */
function permitted(min, max, decimals, unit) {
  const [least, most] = [min, max].map((value) => fixed(value, value % 1 === 0 ? 0 : decimals));
  const range = Number.isFinite(min) && Number.isFinite(max) ? `from ${least} to ${most}` : "";
  const half = Number.isFinite(min) ? `of at least ${least}` : Number.isFinite(max) ? `of at most ${most}` : "";
  return [decimals === 0 ? "A whole number" : "A number", range || half, range || half ? unit : ""].filter(Boolean).join(" ") + ", please.";
}
