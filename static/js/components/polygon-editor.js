// Polygons on a pane: click corner after corner, close by Enter, a double click or a click on the first corner;
// afterwards drag corners, drag an edge's middle to add one, nudge, delete. Works in image px.

import { Emitter } from "../lib/emitter.js";
import { add } from "../lib/coordinates.js";

/** @typedef {import("../lib/types.js").Point} Point */
/** @typedef {import("./shapes.js").Shape} Shape */
/** @typedef {import("./pane.js").Pane} Pane */

/**
 * @typedef {object} PolygonOptions
 * @property {string} prefix  of shape ids, unique in the pane
 * @property {string} look  CSS class of the shapes
 * @property {string} noun  "moving region": named in undo
 * @property {() => Point[][]} polygons  as stored now
 * @property {(label: string, polygons: Point[][], merge: boolean) => void} save
 * @property {() => boolean} accepts  whether a click on empty ground starts or continues a polygon
 * @property {boolean} [numbered]  each carries its number, as its list does
 * @property {boolean} [single]  a closed polygon takes the place of the one before
 */

/** @extends {Emitter<{change: null}>} */
export class PolygonEditor extends Emitter {
  /** @type {Point[]} corners placed so far of a polygon not yet closed */
  draft = [];
  /** @type {{polygon: number, corner: number | null} | null} */
  selected = null;
  /** @type {Point[][] | null} while dragging */
  #live = null;

  /** @param {Pane} pane @param {PolygonOptions} options */
  constructor(pane, options) {
    super();
    this.pane = pane;
    this.options = options;
    pane.on("click", ({ point }) => options.accepts() && this.click(point));
    pane.on("doubleclick", () => options.accepts() && this.close());
    pane.on("select", ({ id }) => this.#owns(id) && this.#select(id));
    pane.on("drag", ({ id, point }) => this.#owns(id) && this.#drag(id, point));
    pane.on("drop", ({ id, point }) => this.#owns(id) && this.#drop(id, point));
    pane.on("cancel", ({ id }) => this.#owns(id) && this.#abandon());
    pane.on("hover", () => this.draft.length > 0 && this.emit("change", null));
  }

  get polygons() {
    return this.#live ?? this.options.polygons();
  }

  get isDrawing() {
    return this.draft.length > 0;
  }

  /** @returns {Shape[]} */
  shapes() {
    const { prefix, look } = this.options;
    /** @type {Shape[]} */
    const shapes = [];
    this.polygons.forEach((corners, i) => {
      const isSelected = this.selected?.polygon === i;
      shapes.push({ id: `${prefix}:edge:${i}`, kind: "polygon", class: look, points: corners });
      shapes.push({
        id: `${prefix}:outline:${i}`,
        kind: "polyline",
        class: `${look} ${isSelected ? "hot" : ""}`,
        points: [...corners, corners[0]],
        grab: true,
      });
      // At another corner each, since outlines of one building share them.
      const at = corners[i % corners.length];
      if (this.options.numbered)
        shapes.push({ id: `${prefix}:number:${i}`, kind: "polyline", class: look, points: [at], label: `${i + 1}` });
      if (isSelected)
        corners.forEach((corner, j) =>
          shapes.push({
            id: `${prefix}:middle:${i}:${j}`,
            kind: "handle",
            class: `${look} faint`,
            points: [middle(corner, corners[(j + 1) % corners.length])],
            grab: true,
          }),
        );
      corners.forEach((corner, j) =>
        shapes.push({
          id: `${prefix}:corner:${i}:${j}`,
          kind: "handle",
          class: `${look} ${isSelected && this.selected?.corner === j ? "selected" : ""}`,
          points: [corner],
          grab: true,
        }),
      );
    });
    if (this.isDrawing) {
      const cursor = this.pane.cursor;
      shapes.push({
        id: `${prefix}:draft`,
        kind: "polyline",
        class: `${look} dashed`,
        points: cursor === null ? this.draft : [...this.draft, cursor],
      });
      this.draft.forEach((corner, j) =>
        shapes.push({ id: `${prefix}:placed:${j}`, kind: "handle", class: look, points: [corner], grab: true }),
      );
    }
    return shapes;
  }

  /** The next corner. @param {Point} point */
  click(point) {
    this.selected = null;
    this.draft = [...this.draft, point];
    this.emit("change", null);
  }

  /** Make a polygon of the corners placed. */
  close() {
    if (this.draft.length < 3) return;
    const before = this.options.single ? [] : this.options.polygons();
    const polygons = [...before, this.draft];
    this.draft = [];
    this.selected = { polygon: polygons.length - 1, corner: null };
    this.options.save(`Draw ${this.options.noun}`, polygons, false);
    this.emit("change", null);
  }

  /** Take back the newest corner, or select nothing. */
  back() {
    if (this.isDrawing) this.draft = this.draft.slice(0, -1);
    else this.selected = null;
    this.emit("change", null);
  }

  /** @param {Point} delta image px */
  nudge(delta) {
    if (this.selected === null) return;
    const { polygon, corner } = this.selected;
    const polygons = this.options
      .polygons()
      .map((corners, i) =>
        i === polygon
          ? corners.map((point, j) => (corner === null || corner === j ? add(point, delta) : point))
          : corners,
      );
    this.options.save(`Nudge ${this.options.noun}`, polygons, true);
  }

  /** Delete the selected corner, or the whole polygon. */
  remove() {
    if (this.selected === null) return;
    const { polygon, corner } = this.selected;
    const corners = this.options.polygons()[polygon] ?? [];
    const rest = corner !== null && corners.length > 3 ? [corners.filter((_, j) => j !== corner)] : [];
    this.selected = rest.length > 0 ? { polygon, corner: null } : null;
    this.options.save(
      `Delete ${corner === null ? this.options.noun : `corner of ${this.options.noun}`}`,
      this.options.polygons().toSpliced(polygon, 1, ...rest),
      false,
    );
  }

  /** @param {number} polygon */
  select(polygon) {
    this.selected = { polygon, corner: null };
    this.emit("change", null);
  }

  /** @param {string} id */
  #owns(id) {
    return id.startsWith(`${this.options.prefix}:`);
  }

  /** @param {string} id */
  #select(id) {
    const [, part, i, j] = id.split(":");
    if (part === "placed") return Number(i) === 0 ? this.close() : undefined;
    this.selected = { polygon: Number(i), corner: part === "corner" ? Number(j) : null };
    this.emit("change", null);
  }

  /** @param {string} id @param {Point} point */
  #drag(id, point) {
    const [, part, first, second] = id.split(":");
    const i = Number(first);
    const j = Number(second);
    if (part === "placed") {
      this.draft = this.draft.with(i, point);
      return this.emit("change", null);
    }
    const stored = this.options.polygons();
    if (part === "outline")
      this.#live = stored.with(
        i,
        stored[i].map((corner) => add(corner, [point[0] - stored[i][0][0], point[1] - stored[i][0][1]])),
      );
    if (part === "corner") this.#live = stored.with(i, stored[i].with(j, point));
    if (part === "middle") this.#live = stored.with(i, stored[i].toSpliced(j + 1, 0, point));
    this.selected = { polygon: i, corner: part === "corner" ? j : part === "middle" ? j + 1 : null };
    this.emit("change", null);
  }

  /** @param {string} id @param {Point} point */
  #drop(id, point) {
    this.#drag(id, point);
    const polygons = this.#live;
    this.#live = null;
    if (polygons !== null) this.options.save(`Move ${this.options.noun}`, polygons, false);
    this.emit("change", null);
  }

  #abandon() {
    this.#live = null;
    this.emit("change", null);
  }
}

/** @param {Point} a @param {Point} b @returns {Point} */
const middle = (a, b) => [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
