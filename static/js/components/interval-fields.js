// The three intervals of a measurement in numbers: pre-event, event, residual.

import { fill, h } from "../lib/dom.js";
import { fixed } from "../lib/format.js";
import { numberField } from "./number-field.js";

/** @typedef {"pre_event" | "event" | "residual"} IntervalName */
/** @typedef {[number, number] | null} Seconds */

/** @type {{name: IntervalName, label: string, colour: string, hint: string}[]} */
export const INTERVALS = [
  { name: "pre_event", label: "Pre-event", colour: "--series-3", hint: "the building stands still" },
  { name: "event", label: "Event", colour: "--series-5", hint: "where peaks are looked for" },
  { name: "residual", label: "Residual", colour: "--series-4", hint: "averaged for the residual" },
];

/**
 * Fields for start and end of each interval.
 * @param {HTMLElement} host
 * @param {(name: IntervalName, interval: Seconds) => void} onChange null: the interval is taken away
 * @param {() => number} end_s where the video ends
 */
export function intervalFields(host, onChange, end_s) {
  /** @type {Map<IntervalName, Seconds>} */
  const current = new Map();
  const rows = INTERVALS.map(({ name, label, colour, hint }) => {
    const change = (/** @type {0 | 1} */ end) => (/** @type {number | null} */ value) => {
      if (value === null) return onChange(name, null);
      const known = current.get(name) ?? (end === 0 ? [value, value + 1] : [Math.max(0, value - 1), value]);
      const wanted = /** @type {[number, number]} */ (end === 0 ? [value, known[1]] : [known[0], value]);
      onChange(name, wanted[0] < wanted[1] ? wanted : [Math.min(...wanted), Math.max(...wanted) + 0.1]);
    };
    const field = (/** @type {0 | 1} */ end) =>
      numberField({
        label: `${label} ${end === 0 ? "from" : "to"}`,
        unit: "s",
        value: null,
        decimals: 2,
        step: 0.1,
        min: 0,
        max: end_s,
        tooGreat: () => `The video ends at ${fixed(end_s(), 2)} s.`,
        optional: true,
        compact: true,
        bare: true,
        onChange: change(end),
      });
    const [from, to] = [field(0), field(1)];
    const key = h("span", { class: "interval-key", "aria-hidden": "true" });
    key.style.background = `var(${colour})`;
    const element = h(
      "div",
      { class: "interval-row" },
      h("span", { title: hint }, key, label),
      from.element,
      to.element,
    );
    return { name, from, to, element };
  });
  fill(
    host,
    h(
      "div",
      { class: "interval-rows" },
      rows.map((row) => row.element),
    ),
  );
  return {
    /** @param {import("../lib/types.js").Project["intervals_s"]} intervals */
    show(intervals) {
      for (const { name, from, to } of rows) {
        current.set(name, intervals[name]);
        from.set(intervals[name]?.[0] ?? null);
        to.set(intervals[name]?.[1] ?? null);
      }
    },
  };
}
