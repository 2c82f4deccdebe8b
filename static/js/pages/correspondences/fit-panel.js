// What the fit says: how good, which pair is bad, where pairs are missing.

import { fill, h } from "../../lib/dom.js";
import { icon } from "../../lib/icons.js";
import { told } from "../../lib/problems.js";
import { centimetres, fixed, metres, degrees, pixels } from "../../lib/format.js";

/**
 * @typedef {{id: number, residual_px: [number, number], residual_m: [number, number], loo_px: number | null, loo_m: number | null, predicted_px: [number, number], predicted_m: [number, number]}} PairFit
 *
 * @typedef {object} Fit
 * @property {string} state
 * @property {string} message
 * @property {number | null} rms_px
 * @property {number | null} rms_m
 * @property {number | null} loo_rms_px
 * @property {PairFit[]} pairs
 * @property {{grid: number[][], share: number} | null} coverage
 * @property {{centre_m: [number, number, number], height_m: number, tilt_deg: number, azimuth_deg: number} | null} camera
 */

/** @param {HTMLElement} element */
export function fitPanel(element) {
  const figures = h("div", { class: "figures four" });
  const message = h("p", { class: "note", role: "status", hidden: true });
  const grid = h("div", { class: "coverage", role: "img" });
  const camera = h("p", { class: "small faint number" });
  const coverage = h("div", { class: "coverage-row" }, grid, camera);
  fill(
    element,
    h("header", {}, h("h2", {}, "Fit")),
    figures,
    message,
    coverage,
  );

  /** @param {Fit} fit @param {{enabled: number, total: number, awaited: boolean}} state awaited: the fit is of earlier pairs */
  return function show(fit, { enabled, total, awaited }) {
    fill(
      figures,
      figure(total === enabled ? String(total) : `${enabled} / ${total}`, "pairs"),
      figure(pixels(fit.rms_px), "RMS"),
      figure(centimetres(fit.rms_m), "on the ground"),
      figure(pixels(fit.loo_rms_px), "leave-one-out"),
    );
    message.hidden = !fit.message;
    const early = fit.state === "too_few";
    message.className = `note ${early ? "" : "warn"}`;
    fill(message, icon(early ? "info" : "warn"), h("span", {}, told(fit.message).words));
    showCoverage(grid, fit.coverage);
    fill(
      camera,
      ...(fit.camera === null
        ? ["Pairs per part of the picture. Fill the empty parts first."]
        : cameraLines(fit.camera)),
    );
    for (const part of [figures, message, coverage]) part.classList.toggle("awaited", awaited);
  };
}

/** @param {string} value @param {string} name */
const figure = (value, name) => h("div", {}, h("span", { class: "value" }, value), h("span", { class: "name" }, name));

/** @param {HTMLElement} element @param {{grid: number[][], share: number} | null} coverage */
function showCoverage(element, coverage) {
  const rows = coverage?.grid ?? [];
  element.style.gridTemplateColumns = `repeat(${rows[0]?.length ?? 1}, 1fr)`;
  element.hidden = rows.length === 0;
  element.setAttribute("aria-label", `Pairs cover ${fixed(100 * (coverage?.share ?? 0), 0)} % of the picture`);
  fill(
    element,
    rows.flat().map((n) => h("span", { class: n === 0 ? "none" : n === 1 ? "one" : "some" }, n === 0 ? "" : n)),
  );
}

/** @param {NonNullable<Fit["camera"]>} camera */
function cameraLines({ centre_m, height_m, tilt_deg, azimuth_deg }) {
  const turned_deg = azimuth_deg > 180 ? azimuth_deg - 360 : azimuth_deg;
  return [
    `Camera ${metres(height_m, 1)} above ground`,
    h("br"),
    `at ${fixed(centre_m[0], 1)}, ${fixed(centre_m[1], 1)} m`,
    h("br"),
    `tilted ${degrees(tilt_deg)}, turned ${degrees(turned_deg)}`,
  ];
}
