// Which columns of the GPS file hold time and place, and where on the roof the antenna stood.

import { h } from "../../lib/dom.js";
import { dialogActions, openDialog } from "../../components/dialog.js";
import { numberField } from "../../components/number-field.js";

const COLUMNS = /** @type {const} */ ([
  ["time", "Time, s"],
  ["x", "East, m"],
  ["y", "North, m"],
]);

const ANTENNA = /** @type {const} */ ([
  ["Antenna east", 0],
  ["Antenna north", 1],
]);

/** @typedef {import("../../lib/types.js").GpsInput} GpsInput */

/** @param {import("../../lib/store.js").ProjectStore} store @param {string[]} columns found in the file */
export async function gpsSettings(store, columns) {
  const now = store.project.inputs.gps;
  if (now === null) return;
  const wanted = structuredClone(now);
  const at = /** @type {[number | null, number | null]} */ ([...(now.at_m ?? [null, null])]);
  if ((await ask(wanted, at, columns)) === null) return;
  const [east, north] = at;
  await store.edit(
    "GPS columns",
    (draft) => void (draft.inputs.gps = { ...wanted, at_m: east === null || north === null ? null : [east, north] }),
  );
}

/**
 * Write what a person chooses into `wanted` and `at`; null when it is not to be used.
 * @param {GpsInput} wanted
 * @param {[number | null, number | null]} at
 * @param {string[]} columns
 */
function ask(wanted, at, columns) {
  return openDialog({
    title: "GPS columns and antenna",
    body: (close) => {
      const submit = (/** @type {Event} */ event) => (event.preventDefault(), close(true));
      const hint =
        "The antenna's place on the roof lets the building's rotation be taken into account. Leave it empty for the middle of P1 and P2.";
      return [
        h(
          "form",
          { class: "dialog-form", onsubmit: submit },
          h(
            "div",
            { class: "dialog-body" },
            h("div", { class: "field-row" }, columnFields(wanted, columns)),
            h("div", { class: "field-row" }, antennaFields(at)),
            h("p", { class: "small faint" }, hint),
          ),
          dialogActions(() => close(null), h("button", { class: "button primary", type: "submit" }, "Save")),
        ),
      ];
    },
  });
}

/** @param {GpsInput} wanted @param {string[]} columns */
const columnFields = (wanted, columns) =>
  COLUMNS.map(([key, label]) => {
    const choice = columnChoice(columns, wanted[key]);
    choice.id = `gps-${key}`;
    choice.addEventListener("change", () => (wanted[key] = choice.value));
    return h("div", { class: "field" }, h("label", { class: "label", for: choice.id }, label), choice);
  });

/** The columns of the file; what was chosen and is not among them has to be chosen anew. @param {string[]} columns @param {string} chosen */
function columnChoice(columns, chosen) {
  const known = columns.includes(chosen);
  return h(
    "select",
    { class: "input", required: true },
    known ? null : h("option", { value: "", selected: true, disabled: true }, `no “${chosen}” here`),
    columns.map((name) => h("option", { value: name, selected: name === chosen }, name)),
  );
}

/** @param {[number | null, number | null]} at */
const antennaFields = (at) =>
  ANTENNA.map(([label, axis]) => {
    const field = numberField({
      label,
      unit: "m",
      value: at[axis],
      decimals: 3,
      optional: true,
      onChange: (value) => (at[axis] = value),
    });
    return field.element;
  });
