// The selected pair in numbers: to type what a total station measured, or to correct by hand.

import { fill, h } from "../../lib/dom.js";
import { icon } from "../../lib/icons.js";
import { numberField } from "../../components/number-field.js";

/** @typedef {import("../../lib/types.js").Point} Point */
/** @typedef {import("./slots.js").Side} Side */
/** @typedef {import("./slots.js").Slots} Slots */

const FIELDS = /** @type {const} */ ([
  { side: "frame_px", axis: 0, label: "u", unit: "px", decimals: 2, step: 0.1 },
  { side: "frame_px", axis: 1, label: "v", unit: "px", decimals: 2, step: 0.1 },
  { side: "ground_m", axis: 0, label: "east", unit: "m", decimals: 3, step: 0.01 },
  { side: "ground_m", axis: 1, label: "north", unit: "m", decimals: 3, step: 0.01 },
]);

/** @returns {Record<Side, [number | null, number | null]>} */
const nothingTyped = () => ({ frame_px: [null, null], ground_m: [null, null] });

/** @param {HTMLElement} element @param {Slots} slots @param {{goTo: (id: number) => void}} options */
export function selectionPanel(element, slots, { goTo }) {
  const title = h("h2");
  const on = h("input", { type: "checkbox" });
  const zoom = iconButton("target", "Zoom to this pair (G)");
  const remove = iconButton("trash", "Delete this pair (Delete)", "danger");
  const fields = FIELDS.map((field) =>
    numberField({
      ...field,
      value: null,
      optional: true,
      compact: true,
      onChange: (value) => type(field.side, field.axis, value),
    }),
  );
  /** Typed coordinates whose other axis is still empty. */
  let typed = nothingTyped();
  let shown = /** @type {number | undefined} */ (undefined);
  fill(
    element,
    h("header", {}, title, h("label", { class: "switch small" }, on, "counts"), zoom, remove),
    h(
      "div",
      { class: "field-row" },
      fields.map((field) => field.element),
    ),
  );
  on.addEventListener("change", () => slots.selected !== null && slots.toggle(slots.selected));
  zoom.addEventListener("click", () => slots.selected !== null && goTo(slots.selected));
  remove.addEventListener("click", () => slots.selected !== null && slots.remove(slots.selected));

  const entry = () =>
    slots.pairs.find((pair) => pair.id === slots.selected) ?? slots.halves.find((half) => half.id === slots.selected);
  const type = (/** @type {Side} */ side, /** @type {0 | 1} */ axis, /** @type {number | null} */ value) => {
    const now = entry();
    if (now === undefined) return;
    const point = [...(now[side] ?? typed[side])];
    point[axis] = value;
    typed = { ...typed, [side]: point };
    const [a, b] = point;
    if (a !== null && b !== null) slots.move(now.id, side, [a, b]);
  };
  return {
    /** Always there, also for no pair: the table below must not move under a double click. */
    show() {
      const now = entry();
      if (shown !== now?.id) typed = nothingTyped();
      shown = now?.id;
      const pair = slots.pairs.find((candidate) => candidate.id === now?.id);
      title.textContent =
        now === undefined ? "No pair selected" : pair ? `Pair ${now.id}` : `Pair ${now.id}, unfinished`;
      on.checked = pair?.enabled ?? false;
      on.disabled = pair === undefined;
      for (const control of [zoom, remove, ...fields.map((field) => field.input)]) control.disabled = now === undefined;
      FIELDS.forEach(({ side, axis }, i) => fields[i].set(now?.[side]?.[axis] ?? typed[side][axis]));
    },
  };
}

/** @param {import("../../lib/icons.js").IconName} glyph @param {string} words @param {string} [tone] */
const iconButton = (glyph, words, tone = "") =>
  h(
    "button",
    { class: `button quiet small icon-only ${tone}`, type: "button", "aria-label": words, title: words },
    icon(glyph),
  );
