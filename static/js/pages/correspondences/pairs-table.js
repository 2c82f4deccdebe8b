// The pairs in numbers; sorted by the leave-one-out error, a bad click comes first.

import { h } from "../../lib/dom.js";
import { centimetres, pixels } from "../../lib/format.js";
import { SortableTable } from "../../components/table.js";

/** @typedef {import("../../lib/types.js").Point} Point */
/** @typedef {import("../../lib/types.js").Correspondence} Correspondence */
/** @typedef {import("./fit-panel.js").Fit} Fit */

// How far a pair's left-out error must stand out from all, and its least size, to be marked: a 2 px slip among 0.5 px.
const BAD_RATIO = 2.2;
const BAD_PX = 1;

/** Length of a residual, null where there is none. @param {Point | undefined | null} vector */
export const lengthOf = (vector) => (!vector || vector[0] === null ? null : Math.hypot(...vector));

/**
 * @param {Element} element
 * @param {{onSelect: (id: number) => void, onToggle: (id: number) => void}} options
 */
export function pairsTable(element, { onSelect, onToggle }) {
  /** @type {Fit | null} */
  let fit = null;
  const fitOf = (/** @type {Correspondence} */ pair) => fit?.pairs.find((entry) => entry.id === pair.id);
  const px = (/** @type {Correspondence} */ pair) => lengthOf(fitOf(pair)?.residual_px);
  const metres = (/** @type {Correspondence} */ pair) => lengthOf(fitOf(pair)?.residual_m);
  const leftOut = (/** @type {Correspondence} */ pair) => fitOf(pair)?.loo_px ?? null;
  const isBad = (/** @type {Correspondence} */ pair) => {
    const error = leftOut(pair);
    return pair.enabled && error !== null && error > BAD_PX && error > BAD_RATIO * (fit?.loo_rms_px ?? Infinity);
  };
  const counts = (/** @type {Correspondence} */ pair) => {
    const onclick = (/** @type {Event} */ event) => (event.stopPropagation(), onToggle(pair.id));
    return h("input", { type: "checkbox", checked: pair.enabled, "aria-label": `Pair ${pair.id} counts`, onclick });
  };
  const residualHint = "Distance between the click and where all pairs together put it";
  const leftOutHint = "Error of this pair when the fit does not use it: a bad click stands out here";
  const table = new SortableTable({
    label: "Pairs",
    empty: "Click a place in either picture, then the same place in the other.",
    id: (/** @type {Correspondence} */ pair) => String(pair.id),
    rowClass: (pair) => (pair.enabled ? "" : "off"),
    onSelect: (pair) => onSelect(pair.id),
    columns: [
      { key: "on", title: "On", cell: counts },
      { key: "id", title: "Pair", number: true, cell: (pair) => String(pair.id), sort: (pair) => pair.id },
      { key: "px", title: "Residual", hint: residualHint, number: true, tone: () => "of-fit", cell: (pair) => pixels(px(pair)), sort: px },
      { key: "cm", title: "On ground", number: true, tone: () => "of-fit", cell: (pair) => centimetres(metres(pair)), sort: metres },
      {
        key: "loo",
        title: "Leave-one-out",
        hint: leftOutHint,
        number: true,
        cell: (pair) => pixels(leftOut(pair)),
        sort: leftOut,
        tone: (pair) => (isBad(pair) ? "of-fit bad" : "of-fit"),
      },
    ],
  });
  element.append(table.element);
  return {
    /** @param {Correspondence[]} pairs @param {Fit} newest */
    show(pairs, newest) {
      fit = newest;
      table.setRows(pairs);
    },
    /** @param {number | null} id */
    select: (id) => table.select(id === null ? null : String(id)),
    /** Ids as sorted now. */
    order: () => table.order().map(Number),
  };
}
