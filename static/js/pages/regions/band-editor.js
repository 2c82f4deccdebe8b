// The three search bands of a target on the orthorectified frame. Three clicks make a band: two along the line, the
// third sets the half-width. Afterwards the band, its ends and its edge are dragged, nudged, turned, typed.

import { Emitter } from "../../lib/emitter.js";
import { add, subtract } from "../../lib/coordinates.js";
import { LINE_NAMES, SMALLEST_WIDTH_M, cornersOf, movedBy, rounded, turnedBy, widthHandle, widthTo } from "./band.js";

/** @typedef {import("../../lib/types.js").Point} Point */
/** @typedef {import("../../lib/types.js").Band} Band */
/** @typedef {import("../../lib/types.js").LineName} LineName */
/** @typedef {import("../../components/pane.js").Pane} Pane */
/** @typedef {import("../../components/shapes.js").Shape} Shape */
/** @typedef {"band" | "from_m" | "to_m" | "width"} Part */
/** @typedef {Partial<Record<LineName, Band>>} Bands */

const SMALLEST_LENGTH_M = 0.1;

/**
 * @typedef {object} BandOptions
 * @property {() => Bands} bands  as stored now
 * @property {(line: LineName, band: Band, label: string, merge: boolean) => void} save
 * @property {() => boolean} accepts  whether clicks draw here
 * @property {(plan: Point) => Point} toPixels
 * @property {(pixels: Point) => Point} toPlan
 */

/** @extends {Emitter<{change: null, moving: Bands}>} */
export class BandEditor extends Emitter {
  /** @type {Point[]} clicks of the band being drawn, plan metres */
  draft = [];
  /** @type {LineName | null} a band to draw again; the old one stands until the third click */
  redrawing = null;
  /** @type {{line: LineName, part: Part} | null} */
  selected = null;
  /** @type {Bands | null} while dragging */
  #live = null;

  /** @param {Pane} pane @param {BandOptions} options */
  constructor(pane, options) {
    super();
    this.pane = pane;
    this.options = options;
    pane.on("click", ({ point }) => options.accepts() && this.click(options.toPlan(point)));
    pane.on("select", ({ id }) => this.#at(id, (line, part) => this.#take(line, part)));
    pane.on("drag", ({ id, point, delta }) => this.#at(id, (line, part) => this.#drag(line, part, point, delta)));
    pane.on("drop", ({ id, point, delta }) => this.#at(id, (line, part) => this.#drop(line, part, point, delta)));
    pane.on("cancel", () => this.#abandon());
    pane.on("hover", () => this.draft.length > 0 && this.emit("change", null));
  }

  /** Bands as they stand, also in the middle of a drag. @returns {Bands} */
  get bands() {
    return this.#live ?? this.options.bands();
  }

  /** The line the next click draws. @returns {LineName | null} */
  get nextLine() {
    return this.redrawing ?? LINE_NAMES.find((name) => this.options.bands()[name] === undefined) ?? null;
  }

  get isDrawing() {
    return this.draft.length > 0;
  }

  /** While a band is drawn, bands lie in no click's way. */
  get #grabs() {
    return !this.isDrawing && this.redrawing === null;
  }

  /** @returns {Shape[]} */
  shapes() {
    const { toPixels } = this.options;
    /** @type {Shape[]} */
    const shapes = [];
    for (const line of LINE_NAMES) {
      const band = this.bands[line];
      if (band === undefined) continue;
      const isSelected = this.selected?.line === line;
      const look = line.toLowerCase();
      shapes.push({
        id: `band:${line}:band`,
        kind: "polygon",
        class: `${look} ${isSelected ? "hot" : "thin"} ${line === this.redrawing ? "old" : ""}`,
        points: cornersOf(band).map(toPixels),
        label: line,
        grab: this.#grabs,
      });
      if (!isSelected) continue;
      for (const [part, place] of /** @type {[Part, Point][]} */ ([
        ["width", widthHandle(band)],
        ["from_m", band.from_m],
        ["to_m", band.to_m],
      ])) {
        shapes.push({
          id: `band:${line}:${part}`,
          kind: "handle",
          class: `${look} ${this.selected?.part === part ? "selected" : ""}`,
          points: [toPixels(place)],
          grab: true,
        });
      }
    }
    return [...shapes, ...this.#draftShapes()];
  }

  /** @returns {Shape[]} */
  #draftShapes() {
    const line = this.nextLine;
    if (!this.isDrawing || line === null) return [];
    const { toPixels, toPlan } = this.options;
    const cursor = this.pane.cursor === null ? null : toPlan(this.pane.cursor);
    const [from, to] = this.draft;
    const look = `${line.toLowerCase()} dashed`;
    /** @type {Shape[]} */
    const shapes = this.draft.map((point, i) => ({
      id: `draft:${i}`,
      kind: "handle",
      class: look,
      points: [toPixels(point)],
    }));
    if (to === undefined && cursor !== null)
      shapes.push({
        id: "draft:line",
        kind: "polyline",
        class: look,
        points: [from, cursor].map(toPixels),
        label: line,
      });
    if (to !== undefined) {
      const band = { from_m: from, to_m: to, width_m: cursor === null ? SMALLEST_WIDTH_M : widthTo(from, to, cursor) };
      shapes.push({
        id: "draft:band",
        kind: "polygon",
        class: look,
        points: cornersOf(band).map(toPixels),
        label: line,
      });
    }
    return shapes;
  }

  /** @param {Point} plan */
  click(plan) {
    const line = this.nextLine;
    if (line === null) return this.select(null);
    const [from, to] = this.draft;
    this.selected = null;
    if (from !== undefined && to === undefined && Math.hypot(plan[0] - from[0], plan[1] - from[1]) < SMALLEST_LENGTH_M)
      return;
    if (to === undefined) this.draft = [...this.draft, plan];
    else {
      this.draft = [];
      this.redrawing = null;
      this.selected = { line, part: "band" };
      this.options.save(
        line,
        rounded({ from_m: from, to_m: to, width_m: widthTo(from, to, plan) }),
        `Draw ${line}`,
        false,
      );
    }
    this.emit("change", null);
  }

  /** Take back the newest click, or select nothing. */
  back() {
    if (this.isDrawing) this.draft = this.draft.slice(0, -1);
    else if (this.redrawing !== null) this.redrawing = null;
    else this.selected = null;
    this.emit("change", null);
  }

  /** A click on a band: where the next click is to draw another one, it does. @param {LineName} line @param {Part} part */
  #take(line, part) {
    const { accepts, toPlan } = this.options;
    if (part === "band" && this.nextLine !== null && this.pane.cursor !== null && accepts())
      this.click(toPlan(this.pane.cursor));
    else this.select(line, part);
  }

  /** @param {LineName | null} line @param {Part} [part] */
  select(line, part = "band") {
    this.selected = line === null ? null : { line, part };
    this.emit("change", null);
  }

  /** @param {LineName} line */
  redraw(line) {
    this.redrawing = line;
    this.draft = [];
    this.selected = null;
    this.emit("change", null);
  }

  /** @param {Point} delta image px of the orthorectified frame */
  nudge(delta) {
    if (this.selected === null) return;
    const { toPixels, toPlan } = this.options;
    const { line, part } = this.selected;
    this.#change((band) => {
      const by = (/** @type {Point} */ place) => toPlan(add(toPixels(place), delta));
      if (part === "from_m" || part === "to_m") return { ...band, [part]: by(band[part]) };
      if (part === "width") return { ...band, width_m: widthTo(band.from_m, band.to_m, by(widthHandle(band))) };
      return movedBy(band, subtract(by(band.from_m), band.from_m));
    }, `Nudge ${line}`);
  }

  /** @param {number} by_m */
  widen(by_m) {
    if (this.selected !== null)
      this.#change(
        (band) => ({ ...band, width_m: Math.max(SMALLEST_WIDTH_M, band.width_m + by_m) }),
        `Width of ${this.selected.line}`,
      );
  }

  /** @param {number} angle_rad counter-clockwise */
  turn(angle_rad) {
    if (this.selected !== null) this.#change((band) => turnedBy(band, angle_rad), `Turn ${this.selected.line}`);
  }

  /** @param {(band: Band) => Band} change @param {string} label */
  #change(change, label) {
    if (this.selected === null) return;
    const { line } = this.selected;
    const band = this.options.bands()[line];
    if (band !== undefined) this.options.save(line, rounded(change(band)), label, true);
  }

  /** @param {string} id @param {(line: LineName, part: Part) => void} use */
  #at(id, use) {
    const [kind, line, part] = id.split(":");
    if (kind === "band") use(/** @type {LineName} */ (line), /** @type {Part} */ (part));
  }

  /** @param {LineName} line @param {Part} part @param {Point} point image px of the handle @param {Point} delta image px */
  #drag(line, part, point, delta) {
    const { toPlan, toPixels } = this.options;
    const stored = this.options.bands();
    const band = stored[line];
    if (band === undefined) return;
    const place = toPlan(point);
    let moved = movedBy(band, subtract(toPlan(delta), toPlan([0, 0])));
    if (part === "width") moved = { ...band, width_m: widthTo(band.from_m, band.to_m, place) };
    if (part === "from_m" || part === "to_m") moved = { ...band, [part]: toPlan(add(toPixels(band[part]), delta)) };
    if (Math.hypot(moved.to_m[0] - moved.from_m[0], moved.to_m[1] - moved.from_m[1]) < SMALLEST_LENGTH_M) return;
    this.#live = { ...stored, [line]: rounded(moved) };
    this.selected = { line, part };
    this.emit("moving", this.#live);
    this.emit("change", null);
  }

  /** @param {LineName} line @param {Part} part @param {Point} point @param {Point} delta */
  #drop(line, part, point, delta) {
    this.#drag(line, part, point, delta);
    const band = this.#live?.[line];
    this.#live = null;
    if (band !== undefined) this.options.save(line, band, `Move ${line}`, false);
    this.emit("change", null);
  }

  #abandon() {
    this.#live = null;
    this.emit("change", null);
  }
}
