// Which columns of the GPS file hold time and place, and where on the roof the antenna stood.

import { h } from "../../lib/dom.js";
import { dialogActions, openDialog } from "../../components/dialog.js";
import { numberField } from "../../components/number-field.js";

const COLUMNS = /** @type {const} */ ([
  ["time", "Time, s"],
  ["x", "East, m"],
  ["y", "North, m"],
]);

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

/** @param {import("../../lib/store.js").ProjectStore} store @param {string[]} columns found in the file */
export async function gpsSettings(store, columns) {
  const now = store.project.inputs.gps;
  if (now === null) return;
  const wanted = structuredClone(now);
  const at = /** @type {[number | null, number | null]} */ ([...(now.at_m ?? [null, null])]);
  const accepted = await openDialog({
    title: "GPS columns and antenna",
    body: (close) => {
      const inputs = COLUMNS.map(([key, label]) => {
        const input = columnChoice(columns, now[key]);
        input.id = `gps-${key}`;
        input.addEventListener("change", () => (wanted[key] = input.value));
        return h("div", { class: "field" }, h("label", { class: "label", for: `gps-${key}` }, label), input);
      });
      const antenna = /** @type {const} */ ([
        ["Antenna east", 0],
        ["Antenna north", 1],
      ]).map(
        ([label, axis]) =>
          numberField({
            label,
            unit: "m",
            value: at[axis],
            decimals: 3,
            optional: true,
            onChange: (value) => (at[axis] = value),
          }).element,
      );
      const submit = (/** @type {Event} */ event) => (event.preventDefault(), close(true));
      const hint = h(
        "p",
        { class: "small faint" },
        "The antenna's place on the roof lets the building's rotation be taken into account. Leave it empty for the middle of P1 and P2.",
      );
      return [
        h(
          "form",
          { class: "dialog-form", onsubmit: submit },
          h(
            "div",
            { class: "dialog-body" },
            h("div", { class: "field-row" }, inputs),
            h("div", { class: "field-row" }, antenna),
            hint,
          ),
          dialogActions(() => close(null), h("button", { class: "button primary", type: "submit" }, "Save")),
        ),
      ];
    },
  });
  if (accepted === null) return;
  const [east, north] = at;
  await store.edit(
    "GPS columns",
    (draft) => void (draft.inputs.gps = { ...wanted, at_m: east === null || north === null ? null : [east, north] }),
  );
}
