// What the engine measured on a frame, drawn where it was measured: lines in SVG, hundreds of points on the canvas.

import { markColour } from "./palette.js";

/** @typedef {import("../lib/types.js").Point} Point */
/** @typedef {import("../lib/coordinates.js").View} View */
/** @typedef {import("./frames.js").FrameReview} FrameReview */
/** @typedef {import("./shapes.js").Shape} Shape */
/** @typedef {"used" | "rejected" | "bands" | "edges" | "lines" | "points"} Layer */

/** @type {{layer: Layer, name: string, key: string, colour: string, sign: "circle" | "cross" | "dot" | "line" | "dashes" | "mark"}[]} */
export const LAYERS = [
  { layer: "used", name: "Ground features used", key: "G", colour: "--ground-used", sign: "circle" },
  { layer: "rejected", name: "Ground features rejected", key: "Shift+G", colour: "--ground-rejected", sign: "cross" },
  { layer: "bands", name: "Search bands", key: "B", colour: "--l1", sign: "dashes" },
  { layer: "edges", name: "Edge points, patches", key: "E", colour: "--mark-selected", sign: "dot" },
  { layer: "lines", name: "Fitted lines", key: "L", colour: "--l2", sign: "line" },
  { layer: "points", name: "P1 and P2", key: "P", colour: "--corner-point", sign: "mark" },
];

const GROUND_RADIUS = 3.5;
// Edge points lie a few raw px apart: small where the picture is small, so that they do not run together.
const EDGE_RADIUS = { least: 1, most: 2.6, perScale: 0.7 };

/**
 * Bands, lines and intersections as shapes of a pane.
 * @param {FrameReview} review
 * @param {Set<Layer>} shown
 * @returns {Shape[]}
 */
export function overlayShapes(review, shown) {
  return Object.entries(review.targets).flatMap(([target, overlay]) => [
    ...(shown.has("bands")
      ? lineShapes(overlay.bands_raw ?? {}, `${target}/band`, "polygon", "empty dashed thin")
      : []),
    ...(shown.has("lines") ? lineShapes(overlay.lines_raw ?? {}, `${target}/line`, "polyline", "") : []),
    ...(shown.has("points") ? pointShapes(overlay, target) : []),
  ]);
}

/**
 * @param {Record<string, Point[]>} lines
 * @param {string} prefix
 * @param {"polygon" | "polyline"} kind
 * @param {string} extra
 * @returns {Shape[]}
 */
function lineShapes(lines, prefix, kind, extra) {
  return Object.entries(lines).map(([name, points]) => ({
    id: `${prefix}/${name}`,
    kind,
    points,
    class: `${name.toLowerCase()} ${extra}`,
    label: kind === "polygon" ? name : "",
  }));
}

/** @param {import("./frames.js").TargetOverlay} overlay @param {string} target @returns {Shape[]} */
function pointShapes(overlay, target) {
  return /** @type {const} */ (["p1", "p2"]).flatMap((name) => {
    const point = overlay[`${name}_raw`];
    return point
      ? [
          {
            id: `${target}/${name}`,
            kind: /** @type {const} */ ("mark"),
            points: [point],
            class: "corner-point",
            label: name.toUpperCase(),
          },
        ]
      : [];
  });
}

/** Paints ground features and edge points on a pane's canvas. */
export class PointPainter {
  /** @type {FrameReview | null} */
  review = null;
  /** @type {Set<Layer>} */
  shown = new Set();

  /** @param {import("./pane.js").Pane} pane */
  constructor(pane) {
    this.colours = {
      used: markColour("--ground-used"),
      rejected: markColour("--ground-rejected"),
      edge: markColour("--mark-selected"),
      halo: markColour("--halo"),
    };
    pane.addPainter((context, view) => this.#paint(context, view));
  }

  /** @param {CanvasRenderingContext2D} context @param {View} view */
  #paint(context, view) {
    if (this.review === null) return;
    const { ground, targets } = this.review;
    const { used, rejected, edge } = this.colours;
    if (this.shown.has("used")) this.#stroke(context, circles(ground.used, view, GROUND_RADIUS), used);
    if (this.shown.has("rejected")) this.#stroke(context, crosses(ground.rejected, view, GROUND_RADIUS), rejected);
    if (!this.shown.has("edges")) return;
    for (const overlay of Object.values(targets)) {
      for (const points of Object.values(overlay.edges_raw ?? {}))
        fillDots(context, points, view, { colour: edge, halo: this.colours.halo });
      this.#stroke(context, circles(overlay.points_raw?.used ?? [], view, GROUND_RADIUS), edge);
      this.#stroke(context, crosses(overlay.points_raw?.rejected ?? [], view, GROUND_RADIUS), rejected);
    }
  }

  /** @param {CanvasRenderingContext2D} context @param {Path2D} path @param {string} colour */
  #stroke(context, path, colour) {
    context.lineWidth = 3;
    context.strokeStyle = this.colours.halo;
    context.stroke(path);
    context.lineWidth = 1.4;
    context.strokeStyle = colour;
    context.stroke(path);
  }
}

/** @param {Point[]} points @param {View} view @param {number} radius @returns {Path2D} */
function circles(points, view, radius) {
  const path = new Path2D();
  for (const point of points) {
    const [x, y] = view.toCanvas(point);
    path.moveTo(x + radius, y);
    path.arc(x, y, radius, 0, 2 * Math.PI);
  }
  return path;
}

/** @param {Point[]} points @param {View} view @param {number} radius @returns {Path2D} */
function crosses(points, view, radius) {
  const path = new Path2D();
  for (const point of points) {
    const [x, y] = view.toCanvas(point);
    path.moveTo(x - radius, y - radius);
    path.lineTo(x + radius, y + radius);
    path.moveTo(x - radius, y + radius);
    path.lineTo(x + radius, y - radius);
  }
  return path;
}

/** @param {CanvasRenderingContext2D} context @param {Point[]} points @param {View} view @param {{colour: string, halo: string}} paint */
function fillDots(context, points, view, { colour, halo }) {
  const radius = Math.min(Math.max(EDGE_RADIUS.perScale * view.scale, EDGE_RADIUS.least), EDGE_RADIUS.most);
  const path = new Path2D();
  for (const point of points) {
    const [x, y] = view.toCanvas(point);
    path.moveTo(x + radius, y);
    path.arc(x, y, radius, 0, 2 * Math.PI);
  }
  context.lineWidth = radius > 1.5 ? 2 : 0.6;
  context.strokeStyle = halo;
  context.stroke(path);
  context.fillStyle = colour;
  context.fill(path);
}
