// The outlines of what moves, as a list.

import { fill, h, refill } from "../../lib/dom.js";
import { plural } from "../../lib/format.js";
import { icon } from "../../lib/icons.js";

/** @typedef {import("../../lib/types.js").Point} Point */

const ADVICE =
  "Outline everything that moves: building, table, its shadow. Nothing inside is used to follow the camera.";
const HOW = "Click the corners in the left picture, one after the other; Enter or a double click closes the outline.";

/** @param {HTMLElement} element @param {{onSelect: (index: number) => void, onRemove: (index: number) => void}} options */
export function movingPanel(element, { onSelect, onRemove }) {
  const list = h("ul", { class: "target-list" });
  fill(element, h("header", {}, h("h2", {}, "Moving regions")), list, h("p", { class: "small faint" }, HOW));
  const row = (/** @type {Point[]} */ corners, /** @type {number} */ index, /** @type {boolean} */ selected) => {
    const name = `Region ${index + 1}`;
    const look = { class: "button quiet small icon-only", type: "button", "aria-label": `Delete region ${index + 1}` };
    return h(
      "li",
      { "aria-selected": String(selected) },
      h("span", { class: "swatch moving" }),
      h("button", { class: "name plain", type: "button", onclick: () => onSelect(index) }, name),
      h("span", { class: "badge" }, plural(corners.length, "corner")),
      h("button", { ...look, onclick: () => onRemove(index) }, icon("trash")),
    );
  };

  /** @param {Point[][]} regions @param {number | null} selected */
  return function show(regions, selected) {
    const rows = regions.map((corners, index) => row(corners, index, index === selected));
    refill(list, rows.length === 0 ? h("li", { class: "none" }, ADVICE) : rows);
  };
}
