// The list of keys, straight from the table that binds them.

import { h } from "../lib/dom.js";
import { keyLabel, keyTable } from "../lib/keys.js";
import { openDialog } from "./dialog.js";

/** @param {string} title */
export function openHelp(title) {
  /** @type {Map<string, import("../lib/keys.js").KeyBinding[]>} */
  const groups = new Map();
  for (const binding of keyTable()) groups.set(binding.group, [...(groups.get(binding.group) ?? []), binding]);
  const sections = [...groups].map(([group, bindings]) =>
    h("section", {}, h("h3", {}, group), h("dl", { class: "keys" }, bindings.flatMap(row))),
  );
  void openDialog({
    title: `Keys and gestures: ${title}`,
    size: "wide",
    body: () => [h("div", { class: "dialog-body help" }, sections)],
  });
}

/** @param {import("../lib/keys.js").KeyBinding} binding */
function row({ keys, label }) {
  const alternatives = keys.split(" / ").map((key) => h("kbd", {}, keyLabel(key)));
  return [h("dt", {}, alternatives), h("dd", {}, label)];
}
