// Part of the ground the orthoimage shows: typed, taken from the view, or all of the cloud.

import { h } from "../../lib/dom.js";
import { numberField } from "../../components/number-field.js";
import { fixed } from "../../lib/format.js";

/** @typedef {[number, number, number, number]} Extent west, south, east, north */

const SIDES = ["west", "south", "east", "north"];

/** @param {(extent: Extent | null) => void} onChange */
export function extentFields(onChange) {
  /** @type {(number | null)[]} */
  let typed = [null, null, null, null];
  /** @type {Extent | null} of the project, as last shown */
  let shown = null;
  const isPart = () => typed.includes(null) && typed.some((entry) => entry !== null);
  const missing = h("p", { class: "hint", role: "status" });
  const tellMissing = () => {
    const left = SIDES.filter((_, i) => typed[i] === null);
    missing.hidden = !isPart();
    missing.textContent = isPart() ? `Give ${new Intl.ListFormat("en-GB").format(left)} too: until then, the extent stays as it was.` : "";
  };
  const take = (/** @type {number} */ side, /** @type {number | null} */ value) => {
    typed = typed.with(side, value);
    tellMissing();
    const [west, south, east, north] = typed;
    if (west !== null && south !== null && east !== null && north !== null) save([west, south, east, north]);
    else if (typed.every((entry) => entry === null)) save(null);
  };
  const save = (/** @type {Extent | null} */ wanted) => wanted?.join() !== shown?.join() && onChange(wanted);
  const fields = SIDES.map((side, i) =>
    numberField({
      label: side,
      unit: "m",
      value: null,
      optional: true,
      compact: true,
      step: 0.5,
      onChange: (value) => take(i, value),
    }),
  );
  return {
    element: h(
      "div",
      { class: "field" },
      h(
        "div",
        { class: "field-row" },
        fields.map((field) => field.element),
      ),
      missing,
    ),
    /** Forget what is typed of an extent that is not whole yet. */
    forget() {
      typed = shown === null ? [null, null, null, null] : [...shown];
      tellMissing();
      fields.forEach((field, i) => field.set(typed[i]));
    },
    /** Sides typed so far stay as long as the project's extent does. @param {Extent | null} extent @param {Extent | null} made of the orthoimage as it is */
    show(extent, made) {
      const isAsBefore = extent?.join() === shown?.join();
      if (!isAsBefore || !isPart()) typed = extent === null ? [null, null, null, null] : [...extent];
      shown = extent;
      tellMissing();
      fields.forEach((field, i) => {
        field.set(typed[i]);
        field.input.placeholder = made === null ? "–" : fixed(made[i], 2);
      });
    },
  };
}
