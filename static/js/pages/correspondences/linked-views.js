// The other view follows, when asked: same middle, same metres on the screen.

import { distance } from "../../lib/coordinates.js";
import { latest } from "../../lib/latest.js";

/** @typedef {import("../../lib/types.js").Point} Point */
/** @typedef {import("./pair-pane.js").PairPane} PairPane */

const REACH_PX = 40; // CSS px over which the two scales are compared

/**
 * @param {[PairPane, PairPane]} sides
 * @param {import("./transform.js").Transform} transform
 * @returns {(leader: PairPane) => void} brings the other side to where the leader looks
 */
export function linkedViews(sides, transform) {
  const otherThan = (/** @type {PairPane} */ side) => (side === sides[0] ? sides[1] : sides[0]);
  return latest(
    async (/** @type {PairPane} */ leader) => {
      const [u, v] = leader.pane.centre;
      const points = /** @type {Point[]} */ ([
        [u, v],
        [u + REACH_PX / leader.pane.view.scale, v],
      ]);
      return { points, seen: await transform(leader.frameName, otherThan(leader).frameName, points) };
    },
    ({ points, seen: [middle, beside] }, leader) => {
      if (!middle || !beside) return;
      const ratio = distance(points[0], points[1]) / distance(middle, beside);
      otherThan(leader).follow(middle, leader.pane.view.scale * ratio);
    },
    () => undefined, // no fit, no link: the fit panel says why
  );
}
