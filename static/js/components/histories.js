// Measured histories as the server tells them, and the words for methods, axes and statuses.

import { get, projectPath } from "../lib/api.js";

/** @typedef {"geometric" | "paper"} Method */
/** @typedef {(number | null)[]} Column null where nothing was measured */

/**
 * @typedef {object} History one target by one method; columns named as in its CSV
 * @property {number[]} frame
 * @property {number[]} time_s
 * @property {string[]} status
 * @property {Column} p1_dx_m
 * @property {Column} p1_dy_m
 * @property {Column} p2_dx_m
 * @property {Column} p2_dy_m
 * @property {Column} rotation_rad
 * @property {Column} p1_dx_sigma_m
 * @property {Column} p1_dy_sigma_m
 * @property {Column} p2_dx_sigma_m
 * @property {Column} p2_dy_sigma_m
 * @property {Column} p1_dx_raw_m
 * @property {Column} p1_dy_raw_m
 * @property {Column} p2_dx_raw_m
 * @property {Column} p2_dy_raw_m
 * @property {boolean} is_earlier the project cannot be solved as it stands: this is what the last run wrote
 *
 * @typedef {object} ResultFile
 * @property {string} name
 * @property {number} size bytes
 * @property {number} [modified_s]
 *
 * @typedef {object} Results
 * @property {boolean} ready
 * @property {boolean} stale the project has changed since the files were made
 * @property {Method[]} measured the methods that have measured the whole video as the project wants it now
 * @property {any} summary the engine's summary.json
 * @property {string[]} targets
 * @property {Method[]} methods these, and the one of the results written last
 * @property {ResultFile[]} files
 */

/** @type {{value: Method, name: string, line: string}[]} */
export const METHODS = [
  {
    value: "geometric",
    name: "Geometric",
    line: "Camera pose of every frame from the tracked ground, roof lines cut at the roof's own height: no parallax, and without a filter the residual stays.",
  },
  {
    value: "paper",
    name: "Paper",
    line: "The published method: ground homography, scale from P1–P2, high-pass against the drift that is left. Needs no lens and no height.",
  },
];

/** @param {string} method */
export const methodName = (method) => METHODS.find((entry) => entry.value === method)?.name ?? method;

/** @type {{value: "x" | "y", name: string, title: string}[]} */
export const AXES = [
  { value: "x", name: "East (x)", title: "East displacement, x" },
  { value: "y", name: "North (y)", title: "North displacement, y" },
];

const STATUS_ORDER = ["ok", "weak", "lost", "excluded"];

/** @param {string} id @returns {Promise<Results>} */
export const fetchResults = (id) => get(projectPath(id, "results"));

/** @param {string} id @param {string} target @param {string} [method] @param {boolean} [unfiltered]  whatever the project filters @returns {Promise<History>} */
export function fetchHistory(id, target, method, unfiltered) {
  return get(projectPath(id, `results/${encodeURIComponent(target)}`, { method, unfiltered }));
}

/** Per frame the worst status of several targets. @param {string[][]} lists @returns {string[]} */
export function worstStatuses(lists) {
  const [first = [], ...others] = lists;
  return first.map((status, i) =>
    others.reduce(
      (worst, list) => (STATUS_ORDER.indexOf(list[i]) > STATUS_ORDER.indexOf(worst) ? list[i] : worst),
      status,
    ),
  );
}
