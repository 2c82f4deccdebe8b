// What surrounds a picture in a pane: its title, where the pointer is, buttons to zoom, a note when there is no picture.

import { fill, h } from "../lib/dom.js";
import { icon } from "../lib/icons.js";
import { fixed } from "../lib/format.js";
import { announce } from "./toast.js";

/** @typedef {import("./pane.js").Pane} Pane */
/** @typedef {import("../lib/types.js").Point} Point */

/**
 * @param {Pane} pane
 * @param {{title: string, readout: (point: Point) => (Node | string)[]}} options  readout: words for the place under the pointer
 */
export function paneChrome(pane, { title, readout }) {
  const name = h("span", { class: "pane-chip" }, title);
  const hint = h("span", { class: "pane-chip attention", hidden: true, role: "status" });
  const legend = h("span", { class: "pane-chip legend", hidden: true });
  const place = h("div", { class: "pane-readout", "aria-hidden": "true" });
  const note = h("div", { class: "pane-note", hidden: true });
  const tool = (
    /** @type {import("../lib/icons.js").IconName} */ glyph,
    /** @type {string} */ words,
    /** @type {() => void} */ run,
  ) => h("button", { type: "button", "aria-label": words, title: words, onclick: run }, icon(glyph));
  const tools = h(
    "div",
    { class: "pane-tools" },
    tool("zoom_in", "Zoom in (+)", () => pane.zoom(1.6)),
    tool("fit", "Whole picture (0)", () => pane.fit()),
  );
  pane.element.append(h("div", { class: "pane-caption" }, name, legend, hint), place, tools, note);

  const show = () => {
    const zoom = `${fixed(pane.view.scale * 100, pane.view.scale < 0.1 ? 1 : 0)} %`;
    fill(place, ...(pane.cursor === null ? [] : readout(pane.cursor)), h("span", {}, zoom));
  };
  // A click on a picture that is not there is answered by what stands in its place.
  pane.on("click", () => {
    if (pane.image !== null || note.hidden) return;
    note.getAnimations().forEach((animation) => animation.cancel());
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches)
      note.animate([{ scale: 1 }, { scale: 1.05 }, { scale: 1 }], { duration: 260, easing: "ease-out" });
    note.dataset.clicks = String(Number(note.dataset.clicks ?? 0) + 1);
    announce(`Nothing was placed. ${note.firstChild?.textContent ?? ""}`);
  });
  pane.on("hover", show);
  pane.on("view", show);
  show();
  return {
    /** After a view was set from elsewhere. */
    refresh: show,
    /** @param {string} words */
    setTitle(words) {
      name.textContent = words;
    },
    /** What a click does now; empty hides. @param {string} words */
    setHint(words) {
      hint.hidden = words === "";
      hint.textContent = words;
    },
    /** What is drawn over the picture, and how; empty hides. @param {string} words */
    setLegend(words) {
      legend.hidden = words === "";
      legend.textContent = words;
    },
    /** Instead of a picture. @param {...(Node | string)} content none hides */
    setNote(...content) {
      note.hidden = content.length === 0;
      fill(note, ...content);
    },
  };
}
