// Pointer, wheel and keys of a plot. No modes: a drag does the plot's own business, the wheel zooms at the cursor,
// Alt or the middle button pans, two fingers pan and zoom, a double click shows all.

import { Fingers } from "../lib/fingers.js";

/** @typedef {import("./plot.js").Plot} Plot */

const MOVED_PX = 3;

/** @param {Plot} plot */
export function attachGestures(plot) {
  const { body } = plot;
  const fingers = new Fingers();
  body.addEventListener("wheel", (event) => wheel(plot, event), { passive: false });
  body.addEventListener("pointerdown", (event) => press(plot, fingers, event));
  body.addEventListener("dblclick", () => plot.setView(null));
  body.addEventListener("keydown", (event) => key(plot, event));
}

/** @param {Plot} plot @param {MouseEvent} event @returns {number} CSS px from the left edge of the plotting area */
function across(plot, event) {
  return event.clientX - plot.u.over.getBoundingClientRect().left;
}

/** @param {Plot} plot @param {MouseEvent} event @returns {number} x, within the data */
function valueAt(plot, event) {
  const [low, high] = plot.whole;
  return Math.min(Math.max(plot.u.posToVal(across(plot, event), "x"), low), high);
}

/** @param {Plot} plot @param {WheelEvent} event */
function wheel(plot, event) {
  if (event.ctrlKey) return;
  event.preventDefault();
  const sideways = event.shiftKey ? event.deltaY || event.deltaX : event.deltaX;
  if (Math.abs(sideways) > Math.abs(event.shiftKey ? 0 : event.deltaY)) pan(plot, sideways);
  else zoom(plot, across(plot, event), Math.exp(event.deltaY * 0.0015));
}

/** Zoom about a pixel; a factor under 1 comes closer. @param {Plot} plot @param {number} at @param {number} factor */
function zoom(plot, at, factor) {
  const width = plot.u.over.clientWidth;
  showPixels(plot, at - at * factor, at + (width - at) * factor);
}

/** @param {Plot} plot @param {import("../lib/fingers.js").Pinch} pinch */
function pinch(plot, { shift, middle, factor }) {
  pan(plot, -shift[0]);
  zoom(plot, middle[0] - plot.u.over.getBoundingClientRect().left, 1 / factor);
}

/** Move along x as far as the data goes. @param {Plot} plot @param {number} by CSS px */
function pan(plot, by) {
  const [low, high] = plot.whole;
  const least = plot.u.valToPos(low, "x");
  const most = plot.u.valToPos(high, "x") - plot.u.over.clientWidth;
  const allowed = Math.min(Math.max(by, least), most);
  if (least < most) showPixels(plot, allowed, plot.u.over.clientWidth + allowed);
}

/** Show what lies between two pixels, in pixels so that logarithmic axes zoom evenly. @param {Plot} plot @param {number} left @param {number} right */
function showPixels(plot, left, right) {
  const [low, high] = plot.whole;
  const from = Math.max(plot.u.posToVal(left, "x"), low);
  const to = Math.min(plot.u.posToVal(right, "x"), high);
  if (to - from < (high - low) / 2000) return;
  plot.setView(from <= low && to >= high ? null : [from, to]);
}

/** @param {Plot} plot @param {Fingers} fingers @param {PointerEvent} event */
function press(plot, fingers, event) {
  const nothing = (plot.data[0]?.length ?? 0) === 0;
  if (nothing || event.button > 1 || !plot.u.over.contains(/** @type {Node} */ (event.target))) return;
  const own = plot.options.drag ?? "view";
  const other = own === "seek" ? "select" : "seek";
  const action = event.button === 1 || event.altKey ? "view" : event.shiftKey && own !== "view" ? other : own;
  const start = { x: valueAt(plot, event), px: event.clientX, moved: false, last: event.clientX };
  plot.body.setPointerCapture(event.pointerId);
  fingers.down(event);
  if (fingers.isPinch) plot.u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
  const atOnce = action === "seek" && event.pointerType !== "touch"; // a second finger may follow the first
  if (atOnce) plot.emit("seek", { x: start.x });
  const move = (/** @type {PointerEvent} */ now) => {
    if (now.pointerId !== event.pointerId) return;
    const pinched = fingers.moved(now);
    if (pinched !== null) pinch(plot, pinched);
    if (fingers.isPinch) return;
    start.moved ||= Math.abs(now.clientX - start.px) > MOVED_PX;
    if (start.moved) drag(plot, action, start, now);
  };
  const end = (/** @type {PointerEvent} */ now) => {
    if (now.pointerId !== event.pointerId) return;
    const wasPinch = fingers.isPinch;
    fingers.up(now);
    plot.body.removeEventListener("pointermove", move);
    plot.body.removeEventListener("pointerup", end);
    plot.body.removeEventListener("pointercancel", end);
    plot.u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    if (wasPinch) return;
    if (!start.moved && !atOnce) plot.emit("seek", { x: start.x });
    if (start.moved && action === "select" && now.type === "pointerup")
      emitSelection(plot, start.x, valueAt(plot, now));
  };
  plot.body.addEventListener("pointermove", move);
  plot.body.addEventListener("pointerup", end);
  plot.body.addEventListener("pointercancel", end);
}

/**
 * @param {Plot} plot
 * @param {"seek"|"select"|"view"} action
 * @param {{x: number, last: number}} start
 * @param {PointerEvent} now
 */
function drag(plot, action, start, now) {
  if (action === "seek") plot.emit("seek", { x: valueAt(plot, now) });
  if (action === "view") pan(plot, start.last - now.clientX);
  if (action === "select") {
    const a = plot.u.valToPos(start.x, "x");
    const b = plot.u.valToPos(valueAt(plot, now), "x");
    plot.u.setSelect({ left: Math.min(a, b), width: Math.abs(b - a), top: 0, height: plot.u.over.clientHeight }, false);
  }
  start.last = now.clientX;
}

/** @param {Plot} plot @param {number} a @param {number} b */
function emitSelection(plot, a, b) {
  plot.emit("select", { from: Math.min(a, b), to: Math.max(a, b) });
}

/** @param {Plot} plot @param {KeyboardEvent} event */
function key(plot, event) {
  if (event.target !== plot.body || event.ctrlKey || event.metaKey || event.altKey) return;
  const middle = plot.u.over.clientWidth / 2;
  /** @type {Record<string, () => void>} */
  const actions = {
    "+": () => zoom(plot, middle, 0.7),
    "=": () => zoom(plot, middle, 0.7),
    "-": () => zoom(plot, middle, 1 / 0.7),
    0: () => plot.setView(null),
    ArrowLeft: () => step(plot, event.shiftKey ? -10 : -1),
    ArrowRight: () => step(plot, event.shiftKey ? 10 : 1),
    Home: () => plot.emit("seek", { x: plot.whole[0] }),
    End: () => plot.emit("seek", { x: plot.whole[1] }),
  };
  const action = actions[event.key];
  if (!action) return;
  event.preventDefault();
  event.stopPropagation();
  action();
}

/** Move the play head by values of the data, or by the plot's own step. @param {Plot} plot @param {number} count */
function step(plot, count) {
  const x = plot.data[0] ?? [];
  const at = plot.head ?? plot.whole[0];
  const stepped = plot.options.seekStep ? at + count * plot.options.seekStep : x[plot.u.valToIdx(at) + count];
  if (stepped !== undefined) plot.emit("seek", { x: Number(stepped) });
}
