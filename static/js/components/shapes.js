// Marks, lines, bands and polygons drawn over a picture, given in image px and kept in SVG by id.

import { decorate, svg } from "../lib/dom.js";
import { distance, distanceToSegment, isInside } from "../lib/coordinates.js";

/** @typedef {import("../lib/types.js").Point} Point */
/** @typedef {import("../lib/coordinates.js").View} View */

/**
 * @typedef {object} Shape
 * @property {string} id  unique in its pane
 * @property {"mark" | "handle" | "aim" | "polygon" | "polyline" | "arrow"} kind
 * @property {Point[]} points  image px; a mark, handle or aim has one, an arrow two (tail, head)
 * @property {string} [class]  "selected", "off", "ghost", "pending", "moving", "l1", "l2", "t1", "corner-point", "dashed", "thin", "empty"
 * @property {string} [label]  drawn beside a mark, or at the first point of a line
 * @property {boolean} [grab]  can be selected and dragged; polygons also by their inside
 */

/** @typedef {{x: number, y: number, anchor: "start" | "end"}} LabelPlace  CSS px: one end of the text's base line */
/** @typedef {{left: number, top: number, right: number, bottom: number}} Box  CSS px */

const GRAB_RADIUS = { mark: 14, handle: 13, aim: 0, arrow: 0, polyline: 8, polygon: 7 };
const MARK = "M-11 0H-3.5M3.5 0H11M0-11V-3.5M0 3.5V11M6.5 0a6.5 6.5 0 1 1-13 0 6.5 6.5 0 1 1 13 0";
const MARK_RADIUS = 11;
/** Where the label of a mark may stand, from its middle; the first that covers nothing is taken. @type {LabelPlace[]} */
const BESIDE_MARK = [
  { x: 10, y: -9, anchor: "start" },
  { x: 10, y: 18, anchor: "start" },
  { x: -10, y: -9, anchor: "end" },
  { x: -10, y: 18, anchor: "end" },
];
const LETTER = { width: 7.5, height: 11 }; // CSS px, about
const AIM = "M-16 0H-5M5 0H16M0-16V-5M0 5V16";
const HANDLE = "M4.5 0a4.5 4.5 0 1 1-9 0 4.5 4.5 0 1 1 9 0";
const HANDLE_CORE = "M2.5 0a2.5 2.5 0 1 1-5 0 2.5 2.5 0 1 1 5 0";

/** What lies at one point, of one size at any zoom. @type {Partial<Record<Shape["kind"], {halo: string, ink: string}>>} */
const OUTLINES = {
  mark: { halo: MARK, ink: MARK },
  handle: { halo: HANDLE, ink: HANDLE_CORE },
  aim: { halo: AIM, ink: AIM },
};

/** The SVG elements of a pane's shapes, made once per id and moved afterwards. */
export class ShapeLayer {
  /** @type {Map<string, {group: SVGGElement, halo: SVGPathElement, ink: SVGPathElement, text: SVGTextElement}>} */
  #drawn = new Map();

  constructor() {
    this.element = svg("svg", { class: "shapes", "aria-hidden": "true" });
  }

  /** @param {Shape[]} shapes @param {View} view @param {string | null} hot id under the pointer */
  draw(shapes, view, hot) {
    const wanted = new Set(shapes.map((shape) => shape.id));
    for (const [id, { group }] of this.#drawn) {
      if (wanted.has(id)) continue;
      group.remove();
      this.#drawn.delete(id);
    }
    let next = this.element.firstElementChild;
    const labels = labelsBesideMarks(shapes, view);
    for (const shape of shapes) {
      this.#place(shape, view, shape.id === hot, labels.get(shape.id) ?? BESIDE_MARK[0]);
      const { group } = this.#parts(shape.id);
      if (group === next) next = next.nextElementSibling;
      else this.element.insertBefore(group, next); // later shapes lie on top, whichever was made first
    }
  }

  /** @param {string} id */
  #parts(id) {
    let parts = this.#drawn.get(id);
    if (parts === undefined) {
      const halo = svg("path", { class: "halo" });
      const ink = svg("path", { class: "ink" });
      const text = svg("text");
      const group = svg("g", { "data-id": id }, halo, ink, text);
      parts = { group, halo, ink, text };
      this.#drawn.set(id, parts);
    }
    return parts;
  }

  /** @param {Shape} shape @param {View} view @param {boolean} hot @param {LabelPlace} label  of a shape at one point */
  #place(shape, view, hot, label) {
    const { group, halo, ink, text } = this.#parts(shape.id);
    const outline = OUTLINES[shape.kind];
    const isPoint = outline !== undefined;
    const family = isPoint || shape.kind === "arrow" ? "" : "line";
    group.setAttribute("class", `${shape.kind} ${family} ${shape.class ?? ""} ${hot ? "hot" : ""}`);
    const canvas = shape.points.map((point) => view.toCanvas(point));
    if (isPoint) {
      group.setAttribute("transform", `translate(${canvas[0][0]} ${canvas[0][1]})`);
      halo.setAttribute("d", outline.halo);
      ink.setAttribute("d", outline.ink);
    } else {
      const path =
        shape.kind === "arrow" ? arrowPath(canvas[0], canvas[1]) : linePath(canvas, shape.kind === "polygon");
      halo.setAttribute("d", path);
      ink.setAttribute("d", path);
    }
    if (text.textContent !== (shape.label ?? "")) text.textContent = shape.label ?? "";
    const { x, y, anchor } = isPoint ? label : { x: (canvas[0]?.[0] ?? 0) + 8, y: (canvas[0]?.[1] ?? 0) - 8, anchor: "start" };
    decorate(text, { x, y, "text-anchor": anchor });
  }
}

/** Where labels of marks cover neither each other nor other marks, as far as there is room. @param {Shape[]} shapes @param {View} view @returns {Map<string, LabelPlace>} */
function labelsBesideMarks(shapes, view) {
  const marks = shapes
    .filter(({ kind }) => kind === "mark")
    .map((shape) => ({ shape, at: view.toCanvas(shape.points[0]), isChosen: /\bselected\b/.test(shape.class ?? "") }));
  /** @type {{owner: Shape, box: Box}[]} */
  const taken = marks.map(({ shape, at: [x, y] }) => ({
    owner: shape,
    box: { left: x - MARK_RADIUS, right: x + MARK_RADIUS, top: y - MARK_RADIUS, bottom: y + MARK_RADIUS },
  }));
  /** @type {Map<string, LabelPlace>} */
  const places = new Map();
  for (const { shape, at } of marks.sort((a, b) => Number(b.isChosen) - Number(a.isChosen))) {
    const width = LETTER.width * (shape.label ?? "").length;
    const free = BESIDE_MARK.find((place) => {
      const box = labelBox(at, place, width);
      return !taken.some((one) => one.owner !== shape && overlap(one.box, box));
    });
    const place = free ?? BESIDE_MARK[0];
    places.set(shape.id, place);
    taken.push({ owner: shape, box: labelBox(at, place, width) });
  }
  return places;
}

/** @param {Point} mark @param {LabelPlace} place @param {number} width @returns {Box} */
function labelBox([u, v], { x, y, anchor }, width) {
  const left = u + x - (anchor === "end" ? width : 0);
  return { left, right: left + width, top: v + y - LETTER.height, bottom: v + y };
}

/** @param {Box} a @param {Box} b */
const overlap = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;

/** The shape a pointer would grab: points before lines before insides, nearest first. @param {Shape[]} shapes @param {View} view @param {Point} canvas @param {number} [generosity] times as far as a mouse */
export function shapeAt(shapes, view, canvas, generosity = 1) {
  /** @type {{shape: Shape, rank: number, distance: number} | null} */
  let best = null;
  for (const shape of shapes) {
    if (!shape.grab) continue;
    const found = reach(shape, view, canvas, generosity);
    if (
      found !== null &&
      (best === null || found.rank < best.rank || (found.rank === best.rank && found.distance <= best.distance))
    )
      best = { shape, ...found };
  }
  return best?.shape ?? null;
}

/** @param {Shape} shape @param {View} view @param {Point} pointer @param {number} generosity @returns {{rank: number, distance: number} | null} */
function reach(shape, view, pointer, generosity) {
  const canvas = shape.points.map((point) => view.toCanvas(point));
  const radius = generosity * GRAB_RADIUS[shape.kind];
  if (shape.kind === "mark" || shape.kind === "handle") {
    const d = distance(canvas[0], pointer);
    return d <= radius ? { rank: 0, distance: d } : null;
  }
  const ends = shape.kind === "polygon" ? [...canvas.slice(1), canvas[0]] : canvas.slice(1);
  const d = Math.min(...ends.map((end, i) => distanceToSegment(pointer, canvas[i], end)));
  if (d <= radius) return { rank: 1, distance: d };
  return shape.kind === "polygon" && isInside(pointer, canvas) ? { rank: 2, distance: 0 } : null;
}

/** @param {Point[]} points @param {boolean} closed */
const linePath = (points, closed) =>
  points.length === 0 ? "" : `M${points.map((point) => point.join(" ")).join("L")}${closed ? "Z" : ""}`;

/** @param {Point} tail @param {Point} head */
function arrowPath(tail, head) {
  const along = Math.atan2(head[1] - tail[1], head[0] - tail[0]);
  const barb = (/** @type {number} */ turn) =>
    [head[0] - 7 * Math.cos(along + turn), head[1] - 7 * Math.sin(along + turn)].join(" ");
  const barbs = distance(tail, head) > 9 ? `M${barb(0.5)}L${head.join(" ")}L${barb(-0.5)}` : "";
  return `M${tail.join(" ")}L${head.join(" ")}${barbs}`;
}
