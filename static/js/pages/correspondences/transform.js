// Points led from one frame of reference to another by the engine, through the saved pairs and the lens.

import { post, projectPath } from "../../lib/api.js";

/** @typedef {import("../../lib/types.js").Point} Point */
/** @typedef {"raw" | "und" | "plan" | "ortho"} FrameName */
/** @typedef {(from: FrameName, to: FrameName, points: Point[]) => Promise<(Point | null)[]>} Transform  null: no image there */

/** @param {string} projectId @returns {Transform} */
export const transformer = (projectId) => async (from, to, points) => {
  if (points.length === 0) return [];
  return (await post(projectPath(projectId, "transform"), { from, to, points })).points;
};

/**
 * The undistorted picture, while raw px are stored.
 * @param {Transform} transform
 * @returns {import("./pair-pane.js").Mapping}
 */
export function undistortion(transform) {
  return {
    shown: (points) => transform("raw", "und", points),
    stored: async (point) => (await transform("und", "raw", [point]))[0],
  };
}
