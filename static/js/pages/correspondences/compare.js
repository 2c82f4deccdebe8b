// Swipe or blend the orthorectified frame over the orthoimage: where they part, a pair is wrong.

import { h } from "../../lib/dom.js";
import { clamp } from "../../lib/coordinates.js";
import { latest } from "../../lib/latest.js";
import { markColour } from "../../components/palette.js";
import { toastError } from "../../components/toast.js";

/** @typedef {import("../../components/pane.js").Pane} Pane */
/** @typedef {import("../../components/pane-image.js").PaneImage} PaneImage */
/** @typedef {"off" | "blend" | "swipe"} Mode */

/** @param {Pane} pane @param {{load: () => Promise<PaneImage>}} options */
export function compareControls(pane, { load }) {
  /** @type {Mode} */
  let mode = "off";
  const slider = shareSlider();
  const buttons = /** @type {Mode[]} */ (["off", "blend", "swipe"]).map((name) =>
    h(
      "button",
      { type: "button", "aria-pressed": String(name === mode), "data-mode": name, onclick: () => set(name) },
      { off: "Ortho", blend: "Blend", swipe: "Swipe" }[name],
    ),
  );
  const element = h(
    "div",
    { class: "compare" },
    slider,
    h("div", { class: "segmented", role: "group", "aria-label": "Compare with the orthorectified frame" }, buttons),
  );
  slider.addEventListener("input", () => mix());

  const isOn = () => mode !== "off";
  const mix = () => {
    if (mode !== "off") pane.mix = { mode, amount: Number(slider.value) };
    pane.invalidate();
  };
  const set = (/** @type {Mode} */ next) => {
    mode = next;
    slider.hidden = next === "off";
    for (const button of buttons) button.setAttribute("aria-pressed", String(button.dataset.mode === next));
    mix();
    refresh();
  };
  const ask = latest(
    load,
    (image) => isOn() && pane.setOverlay(image),
    (error) => {
      if (!isOn()) return;
      toastError(error);
      set("off");
    },
  );
  const refresh = () => {
    if (isOn()) void ask(null);
    else pane.setOverlay(null);
  };
  pane.addPainter((context) => {
    if (mode === "swipe" && pane.overlay !== null) drawEdge(context, pane.size[0] * pane.mix.amount, pane.size[1]);
  });
  return {
    element,
    /** The same choice twice goes back. @param {Mode} wanted */
    choose: (wanted) => set(mode === wanted ? "off" : wanted),
    /** @param {number} amount */
    step(amount) {
      slider.value = String(clamp(Number(slider.value) + amount, 0, 1));
      mix();
    },
    /** After a saved edit the frame is rectified anew. */
    refresh,
  };
}

const shareSlider = () =>
  h("input", {
    type: "range",
    min: 0,
    max: 1,
    step: 0.01,
    value: 0.5,
    "aria-label": "Share of the orthorectified frame",
    hidden: true,
  });

/** Where one picture ends and the other begins, canvas px. @param {CanvasRenderingContext2D} context @param {number} x @param {number} height */
function drawEdge(context, x, height) {
  context.fillStyle = markColour("--halo");
  context.fillRect(x - 1.5, 0, 3, height);
  context.fillStyle = "#ffffff";
  context.fillRect(x - 0.5, 0, 1, height);
}
