// What is measured: the list of targets, and the settings of the chosen one.

import { fill, h, refill } from "../../lib/dom.js";
import { icon } from "../../lib/icons.js";
import { metres } from "../../lib/format.js";
import { TARGET_NAME, isComplete } from "../../lib/targets.js";
import { askName } from "../../components/dialog.js";
import { menuButton } from "../../components/menu.js";
import { numberField } from "../../components/number-field.js";

/** @typedef {import("../../lib/targets.js").Targets} Targets */
/** @typedef {import("../../lib/targets.js").OpenTarget} OpenTarget */

/** @param {HTMLElement} element @param {Targets} targets @param {() => number} camera_m  height of the camera above the ground */
export function targetsPanel(element, targets, camera_m) {
  const add = menuButton({
    label: "Add target",
    icon: "add",
    items: () => [
      { label: "Three lines (L1, L2, T1)", icon: "target", run: () => void targets.add("lines") },
      { label: "Textured region", icon: "polygon", run: () => void targets.add("points") },
    ],
  });
  const list = h("ul", { class: "target-list", role: "listbox", "aria-label": "Targets" });
  const settings = targetSettings(targets, camera_m);
  fill(element, h("header", {}, h("h2", {}, "Targets"), add), list, settings.element);

  return function show() {
    const { all, selected } = targets;
    const rows = all.map((target) => row(targets, target, target.name === selected?.name));
    refill(list, rows.length === 0 ? noTargets() : rows);
    settings.show();
  };
}

/**
 * Height, P1–P2 distance and reference of the chosen target.
 * @param {Targets} targets
 * @param {() => number} camera_m
 */
function targetSettings(targets, camera_m) {
  const change = (/** @type {string} */ what, /** @type {(target: OpenTarget) => void} */ edit) => {
    const { selected } = targets;
    if (selected !== null) targets.change(selected.name, `${what} of ${selected.name}`, edit);
  };
  const height = numberField({
    label: "Height above ground",
    unit: "m",
    value: null,
    optional: true,
    step: 0.05,
    max: () => camera_m() - 0.01,
    tooGreat: () => `The camera is ${metres(camera_m(), 1)} above the ground by the pairs; a roof lies below it.`,
    onChange: (value) => change("Height", (target) => void (target.height_m = value)),
  });
  const apart = numberField({
    label: "P1–P2 distance",
    unit: "m",
    value: null,
    decimals: 3,
    step: 0.01,
    min: 0.001,
    optional: true,
    onChange: (value) => change("P1–P2 distance", (target) => void (target.p1_p2_m = value)),
  });
  const relative = h("select", {
    class: "input",
    id: "relative-to",
    onchange: () => change("Reference", (target) => void (target.relative_to = relative.value || null)),
  });
  const element = h(
    "div",
    { class: "settings" },
    h("div", { class: "field-row" }, height.element, apart.element),
    h(
      "div",
      { class: "field" },
      h("label", { class: "label", for: relative.id }, "Displacement relative to"),
      relative,
    ),
  );
  return {
    element,
    show() {
      const { all, selected } = targets;
      element.hidden = selected === null;
      if (selected === null) return;
      height.set(selected.height_m);
      apart.set(selected.p1_p2_m);
      fill(relative, h("option", { value: "" }, "its own rest position"), bases(all, selected));
      relative.value = selected.relative_to ?? "";
    },
  };
}

const noTargets = () =>
  h("li", { class: "none" }, "Nothing to measure yet. Add the roof, and the shake table if it is in view.");

/** What a target can be relative to: never itself, nor what is relative to something else. @param {OpenTarget[]} all @param {OpenTarget} selected */
const bases = (all, selected) =>
  all
    .filter((target) => target.name !== selected.name && target.relative_to === null && isComplete(target))
    .map((target) => h("option", { value: target.name }, target.name));

/** @param {Targets} targets @param {OpenTarget} target @param {boolean} isSelected */
function row(targets, target, isSelected) {
  const state = isComplete(target) ? (target.height_m === null ? "no height" : metres(target.height_m)) : "drawing";
  const choose = () => targets.select(target.name);
  const more = menuButton({
    label: `Actions for ${target.name}`,
    icon: "more",
    items: () => [
      { label: "Rename…", icon: "edit", run: () => void rename(targets, target.name) },
      { label: "Delete", icon: "trash", danger: true, run: () => targets.remove(target.name) },
    ],
  });
  return h(
    "li",
    {
      role: "option",
      tabindex: 0,
      "aria-selected": String(isSelected),
      "data-target": target.name,
      onclick: choose,
      onkeydown: (/** @type {KeyboardEvent} */ event) =>
        event.key === "Enter" && event.target === event.currentTarget && choose(),
    },
    icon(target.kind === "lines" ? "target" : "polygon"),
    h("span", { class: "name" }, target.name),
    h("span", { class: `badge ${isComplete(target) ? (target.height_m === null ? "warn" : "") : "accent"}` }, state),
    more,
  );
}

/** @param {Targets} targets @param {string} name */
async function rename(targets, name) {
  const wanted = await askName({
    title: "Rename target",
    label: "Name",
    value: name,
    action: "Rename",
    hint: "Up to 64 letters, digits, - and _, a letter or digit first. It names the result file.",
    refusal: (typed) => refusal(targets, name, typed),
  });
  if (wanted !== null && wanted !== name) targets.rename(name, wanted);
}

/** Why a target cannot be called so; null where it can. @param {Targets} targets @param {string} name as it is @param {string} wanted */
function refusal(targets, name, wanted) {
  if (!TARGET_NAME.test(wanted))
    return `“${wanted}” cannot name a file: letters a to z, digits, - and _ only, a letter or digit first, at most 64.`;
  // On some systems one file would be both.
  const same = targets.all.find((other) => other.name !== name && other.name.toLowerCase() === wanted.toLowerCase());
  if (same === undefined) return null;
  if (same.name === wanted) return `There is already a target “${wanted}”.`;
  return `“${wanted}” and “${same.name}” would share a result file on some computers; choose another name.`;
}
