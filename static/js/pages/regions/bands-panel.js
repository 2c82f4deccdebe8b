// The three bands in numbers, with what the engine finds in each.

import { fill, h } from "../../lib/dom.js";
import { icon } from "../../lib/icons.js";
import { told } from "../../lib/problems.js";
import { count, metres, pixels } from "../../lib/format.js";
import { numberField } from "../../components/number-field.js";
import { LINE_NAMES, lengthOf, rounded } from "./band.js";

/** @typedef {import("../../lib/types.js").Band} Band */
/** @typedef {import("../../lib/types.js").LineName} LineName */
/** @typedef {import("./band-editor.js").BandEditor} BandEditor */
/** @typedef {import("./preview.js").Preview} Preview */

const WORDS = { L1: "first line of the pair", L2: "second line of the pair", T1: "line across them" };

/** @param {HTMLElement} element @param {BandEditor} editor @param {(line: LineName, band: Band) => void} save */
export function bandsPanel(element, editor, save) {
  const rows = new Map(LINE_NAMES.map((line) => [line, bandRow(line, editor, save)]));
  const message = h("p", { class: "note", role: "status", hidden: true });
  fill(
    element,
    h("header", {}, h("h2", {}, "Search bands")),
    [...rows.values()].map((row) => row.element),
    message,
  );

  /** @param {Preview | null} preview */
  return function show(preview) {
    for (const line of LINE_NAMES) rows.get(line)?.show(editor.bands[line] ?? null, preview?.lines?.[line] ?? null);
    message.hidden = !preview?.message;
    message.className = "note";
    fill(message, icon("info"), h("span", {}, told(preview?.message ?? "").words));
  };
}

/** @param {LineName} line @param {BandEditor} editor @param {(line: LineName, band: Band) => void} save */
function bandRow(line, editor, save) {
  const found = h("span", { class: "found small number" });
  const redraw = h(
    "button",
    {
      class: "button small",
      type: "button",
      title: "Draw again with three clicks",
      onclick: () => editor.redraw(line),
    },
    "Redraw",
  );
  const head = h(
    "button",
    { class: "band-head", type: "button", onclick: () => editor.select(line) },
    h("span", { class: `swatch ${line.toLowerCase()}` }),
    h("strong", {}, line),
    found,
  );
  const field = (
    /** @type {string} */ label,
    /** @type {(band: Band) => number} */ read,
    /** @type {(band: Band, value: number) => Band} */ write,
    min = -Infinity,
  ) => ({
    read,
    field: numberField({
      label,
      unit: "m",
      value: null,
      decimals: 3,
      step: 0.01,
      min,
      compact: true,
      onChange(value) {
        const band = editor.bands[line];
        if (band !== undefined && value !== null) save(line, rounded(write(band, value)));
      },
    }),
  });
  const fields = [
    field(
      "from east",
      (band) => band.from_m[0],
      (band, value) => ({ ...band, from_m: [value, band.from_m[1]] }),
    ),
    field(
      "from north",
      (band) => band.from_m[1],
      (band, value) => ({ ...band, from_m: [band.from_m[0], value] }),
    ),
    field(
      "width",
      (band) => band.width_m,
      (band, value) => ({ ...band, width_m: value }),
      0.05,
    ),
    field(
      "to east",
      (band) => band.to_m[0],
      (band, value) => ({ ...band, to_m: [value, band.to_m[1]] }),
    ),
    field(
      "to north",
      (band) => band.to_m[1],
      (band, value) => ({ ...band, to_m: [band.to_m[0], value] }),
    ),
  ];
  const length = h("p", { class: "small faint number" });
  const numbers = h(
    "div",
    { class: "band-fields" },
    fields.map((entry) => entry.field.element),
    length,
  );
  const element = h(
    "div",
    { class: "band-row", "data-line": line },
    h("div", { class: "band-title" }, head, redraw),
    numbers,
  );
  return {
    element,
    /** @param {Band | null} band @param {{points: number, rms_px: number | null, message: string | null} | null} line_found */
    show(band, line_found) {
      const isNext = editor.nextLine === line;
      element.classList.toggle("selected", editor.selected?.line === line || isNext);
      numbers.hidden = band === null || editor.selected?.line !== line;
      redraw.hidden = band === null;
      found.className = `found small number ${line_found !== null && line_found.points === 0 ? "bad" : "soft"}`;
      if (isNext)
        found.textContent = ["click one end of it", "click its other end", "click at half its width"][
          editor.draft.length
        ];
      else if (band === null) found.textContent = WORDS[line];
      else
        found.textContent =
          line_found === null
            ? metres(lengthOf(band))
            : told(line_found.message ?? "").words || `${count(line_found.points)} points, ${pixels(line_found.rms_px)}`;
      if (band === null) return;
      for (const { read, field: input } of fields) input.set(read(band));
      length.textContent = `${metres(lengthOf(band), 2)} long`;
    },
  };
}
