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

/** @typedef {import("./preview.js").LinePreview} LinePreview */
/** @typedef {{label: string, min?: number, read: (band: Band) => number, write: (band: Band, value: number) => Band}} BandNumber */

const WORDS = { L1: "first line of the pair", L2: "second line of the pair", T1: "line across them" };
const NEXT_CLICK = ["click one end of it", "click its other end", "click at half its width"];

/** @type {BandNumber[]} in the order shown */
const NUMBERS = [
  {
    label: "from east",
    read: (band) => band.from_m[0],
    write: (band, value) => ({ ...band, from_m: [value, band.from_m[1]] }),
  },
  {
    label: "from north",
    read: (band) => band.from_m[1],
    write: (band, value) => ({ ...band, from_m: [band.from_m[0], value] }),
  },
  { label: "width", min: 0.05, read: (band) => band.width_m, write: (band, value) => ({ ...band, width_m: value }) },
  {
    label: "to east",
    read: (band) => band.to_m[0],
    write: (band, value) => ({ ...band, to_m: [value, band.to_m[1]] }),
  },
  {
    label: "to north",
    read: (band) => band.to_m[1],
    write: (band, value) => ({ ...band, to_m: [band.to_m[0], value] }),
  },
];

const NOTED_ERROR = 0.02; // of P1–P2: more than lines found to a pixel and a height known to some centimetres explain
const WRONG_ERROR = 0.1; // another pair of lines, or another height

/** @param {number} error  share of the distance given */
const toneOf = (error) => (error > WRONG_ERROR ? "bad" : error > NOTED_ERROR ? "warn" : "");

/** @param {HTMLElement} element @param {BandEditor} editor @param {(line: LineName, band: Band) => void} save */
export function bandsPanel(element, editor, save) {
  const rows = new Map(LINE_NAMES.map((line) => [line, new BandRow(line, editor, save)]));
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
    const tone = toneOf(Math.abs(preview?.p1_p2_error ?? 0));
    message.className = `note ${tone}`;
    fill(message, icon(tone === "" ? "info" : "warn"), h("span", {}, told(preview?.message ?? "").words));
  };
}

/** One band: its name, what is found in it or what to click next, and its numbers while it is selected. */
class BandRow {
  #found = h("span", { class: "found small number" });
  #length = h("p", { class: "small faint number" });

  /** @param {LineName} line @param {BandEditor} editor @param {(line: LineName, band: Band) => void} save */
  constructor(line, editor, save) {
    this.line = line;
    this.editor = editor;
    this.fields = NUMBERS.map((number) => bandField(number, line, editor, save));
    this.redraw = redrawButton(line, editor);
    this.numbers = h(
      "div",
      { class: "band-fields" },
      this.fields.map((field) => field.element),
      this.#length,
    );
    this.element = h(
      "div",
      { class: "band-row", "data-line": line },
      h("div", { class: "band-title" }, this.#head(), this.redraw),
      this.numbers,
    );
  }

  #head() {
    return h(
      "button",
      { class: "band-head", type: "button", onclick: () => this.editor.select(this.line) },
      h("span", { class: `swatch ${this.line.toLowerCase()}` }),
      h("strong", {}, this.line),
      " ", // for who hears both
      this.#found,
    );
  }

  /** @param {Band | null} band @param {LinePreview | null} preview */
  show(band, preview) {
    const { editor, line } = this;
    const isSelected = editor.selected?.line === line;
    this.element.classList.toggle("selected", isSelected || editor.nextLine === line);
    this.numbers.hidden = band === null || !isSelected;
    this.redraw.hidden = band === null;
    this.#found.className = `found small number ${preview !== null && preview.points === 0 ? "bad" : "soft"}`;
    this.#found.textContent = this.#words(band, preview);
    if (band === null) return;
    NUMBERS.forEach(({ read }, i) => this.fields[i].set(read(band)));
    this.#length.textContent = `${metres(lengthOf(band), 2)} long`;
  }

  /** @param {Band | null} band @param {LinePreview | null} preview */
  #words(band, preview) {
    if (this.editor.nextLine === this.line) return NEXT_CLICK[this.editor.draft.length];
    if (band === null) return WORDS[this.line];
    if (preview === null) return metres(lengthOf(band));
    return told(preview.message ?? "").words || `${count(preview.points)} points, ${pixels(preview.rms_px)}`;
  }
}

/** @param {LineName} line @param {BandEditor} editor */
const redrawButton = (line, editor) =>
  h(
    "button",
    {
      class: "button small",
      type: "button",
      title: "Draw again with three clicks",
      onclick: () => editor.redraw(line),
    },
    "Redraw",
  );

/** @param {BandNumber} number @param {LineName} line @param {BandEditor} editor @param {(line: LineName, band: Band) => void} save */
const bandField = ({ label, min, write }, line, editor, save) =>
  numberField({
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
  });
