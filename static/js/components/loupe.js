// A round glass in a pane's corner: true pixels around the pointer, or around what is being nudged.

import { h } from "../lib/dom.js";
import { View } from "../lib/coordinates.js";
import { markColour } from "./palette.js";

/** @typedef {import("../lib/types.js").Point} Point */
/** @typedef {import("./pane.js").Pane} Pane */

const SIZE = 172;
const SMALLEST_SCALE = 8;

export class Loupe {
  /** @type {Point | null} */
  #point = null;
  #drawing = 0;

  /** @param {Pane} pane */
  constructor(pane) {
    this.pane = pane;
    this.enabled = true;
    this.canvas = h("canvas", { width: SIZE * 2, height: SIZE * 2 });
    this.element = h("div", { class: "loupe", hidden: true, "aria-hidden": "true" }, this.canvas);
    pane.element.append(this.element);
    pane.on("hover", ({ point }) => this.show(point));
    pane.on("drag", ({ point }) => this.show(point));
    pane.on("picture", () => this.show(this.#point));
  }

  /** @param {boolean} enabled */
  setEnabled(enabled) {
    this.enabled = enabled;
    if (!enabled) this.element.hidden = true;
  }

  /** @param {Point | null} point image px; null hides */
  show(point) {
    this.#point = point;
    if (this.#drawing === 0) this.#drawing = requestAnimationFrame(() => this.#draw());
  }

  #draw() {
    this.#drawing = 0;
    const image = this.pane.image;
    const point = this.#point;
    const useful = this.enabled && point !== null && image !== null && this.pane.view.scale < SMALLEST_SCALE;
    this.element.hidden = !useful;
    if (!useful || point === null || image === null) return;
    this.#keepAway(point);
    const context = /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d"));
    const view = new View().centredOn(point, [SIZE, SIZE], Math.max(SMALLEST_SCALE, this.pane.view.scale * 3));
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = "#14181d";
    context.fillRect(0, 0, SIZE * 2, SIZE * 2);
    context.imageSmoothingEnabled = false;
    view.applyTo(context, 2, [1, 1]);
    context.drawImage(image.levels[0], 0, 0);
    context.setTransform(2, 0, 0, 2, 0, 0);
    this.#drawMarks(context, view);
    drawCross(context, SIZE / 2, SIZE / 2);
  }

  /** Not under the pointer. @param {Point} point */
  #keepAway(point) {
    const [x, y] = this.pane.view.toCanvas(point);
    this.element.classList.toggle("left", x > this.pane.size[0] - SIZE - 60 && y < SIZE + 60);
  }

  /** @param {CanvasRenderingContext2D} context @param {View} view */
  #drawMarks(context, view) {
    for (const shape of this.pane.shapes) {
      if (shape.kind !== "mark" && shape.kind !== "handle") continue;
      const [x, y] = view.toCanvas(shape.points[0]);
      if (x < 0 || y < 0 || x > SIZE || y > SIZE) continue;
      context.strokeStyle = markColour(shape.class?.includes("ghost") ? "--mark-ghost" : "--mark");
      context.lineWidth = 1.5;
      context.beginPath();
      context.arc(x, y, 6, 0, 2 * Math.PI);
      context.stroke();
    }
  }
}

/** @param {CanvasRenderingContext2D} context @param {number} x @param {number} y */
function drawCross(context, x, y) {
  const arms = new Path2D(
    `M${x - 60} ${y}H${x - 5}M${x + 5} ${y}H${x + 60}M${x} ${y - 60}V${y - 5}M${x} ${y + 5}V${y + 60}`,
  );
  context.lineWidth = 3;
  context.strokeStyle = markColour("--halo");
  context.stroke(arms);
  context.lineWidth = 1;
  context.strokeStyle = "#ffffff";
  context.stroke(arms);
}
