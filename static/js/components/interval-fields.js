// The three intervals of a measurement in numbers: pre-event, event, residual.

import { fill, h } from "../lib/dom.js";
import { fixed } from "../lib/format.js";
import { note } from "./notes.js";
import { numberField } from "./number-field.js";

/** @typedef {"pre_event" | "event" | "residual"} IntervalName */
/** @typedef {[number, number] | null} Seconds */

/** @type {{name: IntervalName, label: string, colour: string, hint: string}[]} */
export const INTERVALS = [
  { name: "pre_event", label: "Pre-event", colour: "--series-3", hint: "the building stands still" },
  { name: "event", label: "Event", colour: "--series-5", hint: "where peaks are looked for" },
  { name: "residual", label: "Residual", colour: "--series-4", hint: "averaged for the residual" },
];

const LEAST_S = 1; // of an interval whose other end is not known yet

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
      const [start, stop] = current.get(name) ?? [value, value];
      // What is typed stays; the other end gives way.
      if (end === 0) onChange(name, [value, stop > value ? stop : Math.min(value + LEAST_S, end_s())]);
      else onChange(name, [start < value ? start : Math.max(0, value - LEAST_S), value]);
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
  const words = h("div", { class: "interval-words", role: "status" });
  fill(
    host,
    h(
      "div",
      { class: "interval-rows" },
      rows.map((row) => row.element),
    ),
    words,
  );
  return {
    /** @param {import("../lib/types.js").Project["intervals_s"]} intervals */
    show(intervals) {
      for (const { name, from, to } of rows) {
        current.set(name, intervals[name]);
        from.set(intervals[name]?.[0] ?? null);
        to.set(intervals[name]?.[1] ?? null);
      }
      fill(words, overlapNotes(intervals));
    },
  };
}

/** What is wrong with intervals that overlap the event. @param {import("../lib/types.js").Project["intervals_s"]} intervals */
function overlapNotes({ pre_event, event, residual }) {
  const before = sharedWords(pre_event, event);
  const after = sharedWords(residual, event);
  return [
    before && note("warn", `Pre-event and event share ${before}. Nothing may move before the event: displacement is counted from the mean there.`),
    after && note("warn", `Event and residual share ${after}. The residual is a mean, and the shaking would be part of it.`),
  ];
}

/** @param {Seconds} a @param {Seconds} b @returns {string | null} null where they share nothing */
function sharedWords(a, b) {
  if (a === null || b === null) return null;
  const [from, to] = [Math.max(a[0], b[0]), Math.min(a[1], b[1])];
  return from < to ? `${fixed(from, 2)} to ${fixed(to, 2)} s` : null;
}
