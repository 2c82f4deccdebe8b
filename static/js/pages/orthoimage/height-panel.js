// Height of a clicked place above the ground, and taking it into a target.

import { fill, h } from "../../lib/dom.js";
import { fixed, metres, millimetres, plural } from "../../lib/format.js";
import { icon } from "../../lib/icons.js";
import { note } from "../../components/notes.js";

/** @typedef {{place_m: number[], height_m: number, spread_m: number | null, points: number}} Height spread_m: null where only the clicked point itself is that high */
/** @typedef {import("../../lib/targets.js").Targets} Targets */

const NEW = "";
const UNEVEN_M = 0.1;

/** @param {HTMLElement} element @param {Targets} targets @param {(name: string) => void} onTaken */
export function heightPanel(element, targets, onTaken) {
  const box = h("div", { class: "settings", role: "status" });
  const target = h("select", { class: "input", id: "height-target" });
  const take = h("button", { class: "button", type: "button" }, icon("height"), "Take this height");
  const row = h(
    "div",
    { class: "take-height", hidden: true },
    h("div", { class: "field" }, h("label", { class: "label", for: "height-target" }, "As the height of"), target),
    take,
  );
  /** @type {Height | null} */
  let seen = null;
  fill(element, h("header", {}, h("h2", {}, "Height of a place")), box, row);
  fill(
    box,
    h(
      "p",
      { class: "soft" },
      "Click the roof, in 3D or on the orthoimage: its height above the ground is read from the full cloud.",
    ),
  );
  take.addEventListener("click", () => {
    if (seen === null) return;
    const height_m = Math.round(seen.height_m * 100) / 100;
    const name = target.value === NEW ? targets.add("lines").name : target.value;
    targets.change(name, `Height of ${name}`, (entry) => void (entry.height_m = height_m));
    onTaken(name);
  });
  const offer = () => offerTargets(target, targets.all);
  targets.on("change", offer);
  offer();
  return {
    /** @param {Height} height */
    show(height) {
      seen = height;
      row.hidden = false;
      fill(box, reading(height));
    },
    /** @param {string} message */
    refuse(message) {
      seen = null;
      row.hidden = true;
      fill(box, note("warn", message));
    },
  };
}

/** Refresh the choice of targets, keeping what is chosen. @param {HTMLSelectElement} select @param {Targets["all"]} all */
function offerTargets(select, all) {
  const chosen = select.value;
  fill(
    select,
    all.map(({ name, height_m }) =>
      h("option", { value: name }, height_m === null ? name : `${name} (now ${metres(height_m)})`),
    ),
    h("option", { value: NEW }, "a new target"),
  );
  select.value = all.some(({ name }) => name === chosen) ? chosen : (all[0]?.name ?? NEW);
}

/** @param {Height} height */
function reading({ place_m: [x, y], height_m, spread_m, points }) {
  return [
    h(
      "div",
      { class: "figures" },
      figure(metres(height_m), "above the ground"),
      spread_m === null
        ? figure("–", "no spread: one point below the upper surface")
        : figure(`± ${millimetres(spread_m, 0)}`, `spread of ${plural(points, "point")}`),
    ),
    h("p", { class: "small faint number" }, `at ${fixed(x, 2)}, ${fixed(y, 2)} m`),
    spread_m !== null &&
      spread_m > UNEVEN_M &&
      note("warn", "The cloud is uneven here: an edge, or several surfaces. Click the middle of a flat part."),
  ];
}

/** @param {string} value @param {string} name */
const figure = (value, name) => h("div", {}, h("span", { class: "value" }, value), h("span", { class: "name" }, name));
