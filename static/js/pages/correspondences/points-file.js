// QGIS Georeferencer `.points` files. Their source coordinates start at a pixel's corner with v negative;
// lib/coordinates.js knows how that relates to ours.

import { imageFromQgis, qgisFromImage } from "../../lib/coordinates.js";

/** @typedef {import("../../lib/types.js").Correspondence} Correspondence */

const COLUMNS = ["mapX", "mapY", "sourceX", "sourceY", "enable", "dX", "dY", "residual"];
const OLD_NAMES = /** @type {Record<string, string>} */ ({ pixelX: "sourceX", pixelY: "sourceY" });

/** @param {Correspondence[]} pairs @returns {string} */
export function pointsText(pairs) {
  const rows = pairs.map(({ ground_m, frame_px, enabled }) => {
    const source = qgisFromImage(frame_px);
    return [...ground_m, ...source]
      .map((value) => Number(value.toFixed(6)))
      .concat([enabled ? 1 : 0, 0, 0, 0])
      .join(",");
  });
  return [COLUMNS.join(","), ...rows, ""].join("\n");
}

/**
 * @param {string} text
 * @param {string} name  named in messages
 * @returns {Omit<Correspondence, "id">[]}
 */
export function pairsFromPoints(text, name) {
  const lines = text
    .split(/\r?\n/)
    .map((line, i) => ({ line: line.trim(), number: i + 1 }))
    .filter(({ line }) => line !== "" && !line.startsWith("#"));
  const header = (lines[0]?.line ?? "").split(",").map((column) => OLD_NAMES[column.trim()] ?? column.trim());
  const missing = COLUMNS.slice(0, 4).filter((column) => !header.includes(column));
  if (missing.length > 0)
    throw new Error(
      `${name}: the first line lacks ${missing.join(", ")}; save the points from the QGIS Georeferencer as .points.`,
    );
  return lines.slice(1).map(({ line, number }) => {
    const cells = line.split(",");
    const value = (/** @type {string} */ column) => Number(cells[header.indexOf(column)]?.trim() || NaN);
    const [x, y, u, v] = COLUMNS.slice(0, 4).map(value);
    if (![x, y, u, v].every(Number.isFinite))
      throw new Error(`${name}: line ${number} holds no four numbers; correct or remove it.`);
    return {
      ground_m: [x, y],
      frame_px: imageFromQgis([u, v]),
      enabled: !header.includes("enable") || value("enable") !== 0,
    };
  });
}

const SAME = 1e-3; // px or m; a file keeps six decimals

/** Those of a file that are not among the pairs. @param {Omit<Correspondence, "id">[]} read @param {Correspondence[]} pairs */
export const notAmong = (read, pairs) =>
  read.filter((found) => !pairs.some((pair) => isNear(found.ground_m, pair.ground_m) && isNear(found.frame_px, pair.frame_px)));

/** @param {number[]} a @param {number[]} b */
const isNear = (a, b) => a.every((value, i) => Math.abs(value - b[i]) < SAME);
