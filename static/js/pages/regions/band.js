// Geometry of a search band as a person handles it: two ends and a width, in plan metres.

import { add, distance, subtract, times } from "../../lib/coordinates.js";

/** @typedef {import("../../lib/types.js").Point} Point */
/** @typedef {import("../../lib/types.js").Band} Band */
/** @typedef {import("../../lib/types.js").LineName} LineName */

/** @type {readonly LineName[]} */
export const LINE_NAMES = ["L1", "L2", "T1"];
export const SMALLEST_WIDTH_M = 0.05;

/** @param {Band} band @returns {Point} */
const middleOf = ({ from_m, to_m }) => times(add(from_m, to_m), 0.5);

/** Unit vector to the left of the line. @param {Point} from @param {Point} to @returns {Point} */
function normal(from, to) {
  const [x, y] = subtract(to, from);
  const length = Math.hypot(x, y) || 1;
  return [-y / length, x / length];
}

/** @param {Band} band @returns {Point[]} four corners, in order */
export function cornersOf({ from_m, to_m, width_m }) {
  const side = times(normal(from_m, to_m), width_m / 2);
  return [add(from_m, side), add(to_m, side), subtract(to_m, side), subtract(from_m, side)];
}

/** Handle that sets the width: on the long edge, in the middle. @param {Band} band @returns {Point} */
export const widthHandle = (band) => add(middleOf(band), times(normal(band.from_m, band.to_m), band.width_m / 2));

/** Full width when a person points at the half-width. @param {Point} from @param {Point} to @param {Point} point */
export function widthTo(from, to, point) {
  const [nx, ny] = normal(from, to);
  const [x, y] = subtract(point, from);
  return Math.max(SMALLEST_WIDTH_M, 2 * Math.abs(x * nx + y * ny));
}

/** @param {Band} band @param {Point} by @returns {Band} */
export const movedBy = (band, by) => ({ ...band, from_m: add(band.from_m, by), to_m: add(band.to_m, by) });

/** Turned about its middle, counter-clockwise. @param {Band} band @param {number} angle_rad @returns {Band} */
export function turnedBy(band, angle_rad) {
  const centre = middleOf(band);
  const [c, s] = [Math.cos(angle_rad), Math.sin(angle_rad)];
  const turn = (/** @type {Point} */ point) => {
    const [x, y] = subtract(point, centre);
    return add(centre, [c * x - s * y, s * x + c * y]);
  };
  return { ...band, from_m: turn(band.from_m), to_m: turn(band.to_m) };
}

/** @param {Band} band */
export const lengthOf = (band) => distance(band.from_m, band.to_m);

/** To a tenth of a millimetre, as stored. @param {Band} band @returns {Band} */
export function rounded(band) {
  const round = (/** @type {number} */ value) => Math.round(value * 1e4) / 1e4;
  return {
    from_m: [round(band.from_m[0]), round(band.from_m[1])],
    to_m: [round(band.to_m[0]), round(band.to_m[1])],
    width_m: round(band.width_m),
  };
}
