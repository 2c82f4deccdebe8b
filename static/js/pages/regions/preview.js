// What the engine finds in the bands of a target right now, and how it is drawn over both pictures.

import { markColour } from "../../components/palette.js";

/** @typedef {import("../../lib/types.js").Point} Point */
/** @typedef {import("../../lib/types.js").LineName} LineName */
/** @typedef {import("../../components/shapes.js").Shape} Shape */

/**
 * @typedef {object} LinePreview
 * @property {Point[]} band_plan
 * @property {Point[]} band_raw
 * @property {Point[][]} edges_plan  both edges of the line
 * @property {Point[][]} edges_raw
 * @property {Point[]} midline_plan
 * @property {Point[]} midline_raw
 * @property {number | null} rms_px
 * @property {number} points
 * @property {string | null} message
 *
 * @typedef {{plan: Point, raw: Point, world: Point} | null} PointPreview
 * @typedef {{lines: Partial<Record<LineName, LinePreview>>, p1: PointPreview, p2: PointPreview, points_plan?: Point[], points_raw?: Point[], message: string | null, p1_p2_error?: number | null}} Preview  points: patches of a region
 * @typedef {"plan" | "raw"} Frame
 */

/** Lines and intersections as shapes. @param {Preview | null} preview @param {Frame} frame @param {(point: Point) => Point} toPixels @returns {Shape[]} */
export function previewShapes(preview, frame, toPixels) {
  /** @type {Shape[]} */
  const shapes = [];
  for (const [line, found] of lines(preview)) {
    const midline = frame === "plan" ? found.midline_plan : found.midline_raw;
    if (frame === "raw" && found.band_raw)
      shapes.push({
        id: `found-band:${line}`,
        kind: "polygon",
        class: `${line.toLowerCase()} thin`,
        points: found.band_raw.map(toPixels),
        label: line,
      });
    if (midline)
      shapes.push({
        id: `found:${line}`,
        kind: "polyline",
        class: `${line.toLowerCase()} thin`,
        points: midline.map(toPixels),
      });
  }
  for (const name of /** @type {const} */ (["p1", "p2"])) {
    const point = preview?.[name]?.[frame];
    if (point)
      shapes.push({
        id: `found:${name}`,
        kind: "mark",
        class: "corner-point",
        label: name.toUpperCase(),
        points: [toPixels(point)],
      });
  }
  return shapes;
}

/** Hundreds of edge points, on the canvas. @param {() => Preview | null} current @param {Frame} frame @param {(point: Point) => Point} toPixels @returns {import("../../components/pane.js").Painter} */
export function edgePainter(current, frame, toPixels) {
  return (context, view) => {
    const preview = current();
    const dots = (/** @type {Point[]} */ points, /** @type {string} */ colour) =>
      drawDots(
        context,
        points.map((point) => view.toCanvas(toPixels(point))),
        colour,
        Math.min(2.4, Math.max(1, view.scale * 0.6)),
      );
    for (const [line, found] of lines(preview))
      dots((frame === "plan" ? found.edges_plan : found.edges_raw).flat(), markColour(`--${line.toLowerCase()}`));
    dots((frame === "plan" ? preview?.points_plan : preview?.points_raw) ?? [], markColour("--corner-point"));
  };
}

/** @param {CanvasRenderingContext2D} context @param {Point[]} canvas @param {string} colour @param {number} radius */
function drawDots(context, canvas, colour, radius) {
  context.fillStyle = colour;
  context.beginPath();
  for (const [x, y] of canvas) {
    context.moveTo(x + radius, y);
    context.arc(x, y, radius, 0, 2 * Math.PI);
  }
  context.fill();
}

/** @param {Preview | null} preview */
const lines = (preview) => /** @type {[LineName, LinePreview][]} */ (Object.entries(preview?.lines ?? {}));
