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
 * @property {number} [decimals]
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
  const {
    label,
    unit,
    onChange,
    decimals = 2,
    step = 10 ** -decimals,
    min = -Infinity,
    optional = false,
  } = options;
  const greatest = () => (typeof options.max === "function" ? options.max() : (options.max ?? Infinity));
  const id = `number-${(fields += 1)}`;
  const input = h("input", {
    class: "input",
    id,
    type: "text",
    inputmode: "decimal",
    autocomplete: "off",
    spellcheck: "false",
    placeholder: options.placeholder ?? (optional ? "–" : ""),
    "aria-label": options.bare ? `${label}${unit ? `, ${unit}` : ""}` : null,
  });
  const words = fieldWords(input);
  const box = h(
    "div",
    { class: `number-field ${options.compact ? "compact" : ""}` },
    input,
    words.element,
    h("span", { class: "unit" }, unit),
  );
  const element = options.bare
    ? box
    : h(
        "div",
        { class: "field" },
        h("label", { class: "label", for: id }, label),
        box,
        options.hint && h("p", { class: "hint" }, options.hint),
      );
  let current = options.value;

  const refuse = (/** @type {number} */ value) =>
    words.say(options.tooGreat && value > greatest() ? options.tooGreat() : permitted(min, greatest(), decimals, unit));
  const show = () => {
    input.value = current === null ? "" : current.toFixed(decimals);
    input.removeAttribute("aria-invalid");
  };
  const take = (/** @type {number | null} */ value) => {
    if (value === current) return show();
    current = value;
    show();
    onChange(value);
  };
  const read = () => {
    const text = input.value.trim().replace(",", ".").replace("\u2212", "-");
    if (text === "" && optional) return take(null);
    const value = Number(text);
    if (text === "" || !Number.isFinite(value) || value < min || value > greatest()) {
      input.setAttribute("aria-invalid", "true");
      return refuse(value);
    }
    if (current !== null && text === current.toFixed(decimals)) return show();
    take(value);
  };
  input.addEventListener("change", read);
  input.addEventListener("blur", () => input.getAttribute("aria-invalid") === "true" && show());
  input.addEventListener("keydown", (event) => {
    const turn = event.key === "ArrowUp" ? 1 : event.key === "ArrowDown" ? -1 : 0;
    if (event.key === "Enter") read();
    if (event.key === "Escape") (show(), input.blur());
    if (turn === 0) return;
    event.preventDefault();
    const size = step * (event.shiftKey ? 10 : event.altKey ? 0.1 : 1);
    const wanted = Number(((current ?? 0) + turn * size).toFixed(8));
    take(Math.min(greatest(), Math.max(min, wanted)));
    if (wanted !== current) refuse(wanted);
  });
  show();
  return {
    element,
    input,
    /** Show another value, unless a person is typing. @param {number | null} value */
    set(value) {
      if (value === current) return;
      current = value;
      if (document.activeElement !== input || input.value === "") show();
      else input.value = current === null ? "" : current.toFixed(decimals);
    },
  };
}

/** What a field takes, in words. @param {number} min @param {number} max @param {number} decimals @param {string} unit */
function permitted(min, max, decimals, unit) {
  const [least, most] = [min, max].map((value) => fixed(value, value % 1 === 0 ? 0 : decimals));
  const range = Number.isFinite(min) && Number.isFinite(max) ? `from ${least} to ${most}` : "";
  const half = Number.isFinite(min) ? `of at least ${least}` : Number.isFinite(max) ? `of at most ${most}` : "";
  return ["A number", range || half, range || half ? unit : ""].filter(Boolean).join(" ") + ", please.";
}
