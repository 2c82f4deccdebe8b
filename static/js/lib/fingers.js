// Fingers on an element: one does what a mouse does, two move and zoom what lies under them.

import { add, distance, subtract, times } from "./coordinates.js";

/** @typedef {import("./types.js").Point} Point */

/**
 * @typedef {object} Pinch  what a move of one of two fingers does to what lies under them
 * @property {Point} shift CSS px, first
 * @property {Point} middle CSS px in the window, about which it grows then
 * @property {number} factor
 */

export class Fingers {
  /** @type {Map<number, Point>} CSS px in the window */
  #at = new Map();
  #pinched = false;

  /** Whether there have been several since the first came down: then none of them clicks or drags. */
  get isPinch() {
    return this.#pinched;
  }

  /** @param {PointerEvent} event */
  down(event) {
    if (event.pointerType !== "touch") return;
    this.#at.set(event.pointerId, [event.clientX, event.clientY]);
    this.#pinched ||= this.#at.size > 1;
  }

  /** @param {PointerEvent} event @returns {Pinch | null} null where there are not several */
  moved(event) {
    const from = this.#at.get(event.pointerId);
    if (from === undefined) return null;
    /** @type {Point} */
    const to = [event.clientX, event.clientY];
    this.#at.set(event.pointerId, to);
    const other = [...this.#at].find(([pointer]) => pointer !== event.pointerId)?.[1];
    if (other === undefined) return null;
    return {
      shift: times(subtract(to, from), 0.5),
      middle: times(add(to, other), 0.5),
      factor: distance(to, other) / Math.max(distance(from, other), 1),
    };
  }

  /** @param {PointerEvent} event */
  up(event) {
    this.#at.delete(event.pointerId);
    if (this.#at.size === 0) this.#pinched = false;
  }
}
