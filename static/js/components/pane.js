// Image pane: pan, zoom and grab, exact to the pixel. One canvas for pixels, one SVG for shapes.
// It speaks image px only; canvas px stay inside (see lib/coordinates.js). No modes: a press on a shape that can be
// grabbed drags it, a press elsewhere pans, and a press that does not move is a click. Two fingers pan and zoom.

import { Emitter } from "../lib/emitter.js";
import { h } from "../lib/dom.js";
import { Fingers } from "../lib/fingers.js";
import { View, add, canvasPoint, distance, subtract } from "../lib/coordinates.js";
import { ShapeLayer, shapeAt } from "./shapes.js";

/** @typedef {import("../lib/types.js").Point} Point */
/** @typedef {import("./shapes.js").Shape} Shape */
/** @typedef {import("./pane-image.js").PaneImage} PaneImage */
/** @typedef {(context: CanvasRenderingContext2D, view: View) => void} Painter  draws in CSS px */

/**
 * @typedef {object} PaneEvents
 * @property {{point: Point, event: PointerEvent | KeyboardEvent}} click  on no shape
 * @property {{id: string, event: PointerEvent}} select  a click on a shape
 * @property {{id: string, point: Point, delta: Point}} drag  shape's first point as it would be; delta since the grab
 * @property {{id: string, point: Point, delta: Point}} drop
 * @property {{id: string}} cancel  a drag was given up (Escape)
 * @property {{point: Point | null, id: string | null}} hover
 * @property {{point: Point, id: string | null}} doubleclick
 * @property {View} view
 * @property {PaneImage | null} picture  another one is shown
 */

const STILL_PX = 3;
const FINGER = 1.7; // a finger grabs from so many times as far as a mouse: from within 24 px, as wide as a fingertip
const TRUE_PIXELS_FROM = 3; // device px per image px above which pixels are shown as squares

/** @extends {Emitter<PaneEvents>} */
export class Pane extends Emitter {
  #layer = new ShapeLayer();
  /** @type {Set<Painter>} */
  #painters = new Set();
  /** @type {Shape[]} */
  #shapes = [];
  /** @type {string | null} */
  #hot = null;
  /** @type {Point | null} CSS px, where the pointer is */
  #at = null;
  #drawing = 0;
  #lastClick = { time: 0, at: /** @type {Point} */ ([0, 0]) };
  /** @type {{at: Point, last: Point, moved: boolean, shape: Shape | null, from: Point, pointer: number} | null} */
  #press = null;
  #fingers = new Fingers();

  /**
   * @param {HTMLElement} element
   * @param {{label: string, viewOnly?: boolean}} options  label: for assistive technology
   */
  constructor(element, { label, viewOnly = false }) {
    super();
    this.element = element;
    this.canvas = h("canvas", { class: "pixels", "aria-hidden": "true" });
    this.view = new View();
    /** @type {PaneImage | null} */
    this.image = null;
    /** @type {PaneImage | null} same extent as the image (its pixels may be larger), drawn over it */
    this.overlay = null;
    /** @type {{mode: "blend" | "swipe", amount: number}} how much of the overlay shows, 0 to 1 */
    this.mix = { mode: "blend", amount: 0.5 };
    /** @type {Point} CSS px */
    this.size = [element.clientWidth || 1, element.clientHeight || 1];
    /** @type {Point | null} image px under the pointer */
    this.cursor = null;
    /** When it last had the focus; of several, keys go to the newest. */
    this.usedAt = 0;
    this.#fitted = false;
    element.classList.add("pane");
    element.classList.toggle("view-only", viewOnly);
    element.tabIndex = 0;
    element.setAttribute("role", "application");
    element.setAttribute("aria-label", label);
    element.prepend(this.canvas, this.#layer.element);
    this.#watchSize();
    this.#listen();
  }

  /** @type {boolean} whether the view is still the whole image, and so follows the window's size */
  #fitted;

  /** @param {Shape[]} shapes  replaces all shapes; later ones lie on top */
  setShapes(shapes) {
    this.#shapes = shapes;
    this.invalidate();
  }

  get shapes() {
    return this.#shapes;
  }

  /** Draw on the canvas over the image: for hundreds of points, where SVG would be slow. @param {Painter} painter @returns {() => void} takes it off */
  addPainter(painter) {
    this.#painters.add(painter);
    this.invalidate();
    return () => {
      this.#painters.delete(painter);
      this.invalidate();
    };
  }

  /** Show a picture; the view stays when it has the size of the one before. @param {PaneImage | null} image */
  setImage(image) {
    const same =
      this.image !== null && image !== null && this.image.width === image.width && this.image.height === image.height;
    this.image = image;
    this.element.dataset.picture = image === null ? "" : `${image.width}x${image.height}`;
    this.element.classList.toggle("upright", image !== null && image.height > image.width);
    if (image !== null && !same) this.fit();
    if (this.#at !== null) this.#hover(this.#at, shapeAt(this.#shapes, this.view, this.#at));
    this.emit("picture", image);
    this.invalidate();
  }

  /** @param {PaneImage | null} overlay */
  setOverlay(overlay) {
    this.overlay = overlay;
    this.invalidate();
  }

  /** @param {View} view @param {{silent?: boolean}} [options] silent: do not tell listeners (linked views) */
  setView(view, { silent = false } = {}) {
    this.view = view;
    this.#fitted = false;
    this.invalidate();
    if (!silent) this.emit("view", view);
  }

  fit() {
    if (this.image === null) return;
    this.setView(View.fitting([this.image.width, this.image.height], this.size));
    this.#fitted = true;
  }

  /** @param {Point} point image px @param {number} [scale] CSS px per image px */
  lookAt(point, scale = this.view.scale) {
    this.setView(this.view.centredOn(point, this.size, scale));
  }

  /** Show a few places with room around them. @param {Point[]} points image px */
  lookAtAll(points) {
    const [u, v] = [points.map((point) => point[0]), points.map((point) => point[1])];
    const span = [Math.max(...u) - Math.min(...u), Math.max(...v) - Math.min(...v)];
    const scale = Math.min(this.size[0] / (span[0] * 1.5 + 40), this.size[1] / (span[1] * 1.5 + 40));
    this.lookAt([(Math.max(...u) + Math.min(...u)) / 2, (Math.max(...v) + Math.min(...v)) / 2], scale);
  }

  /** Zoom at the middle. @param {number} factor */
  zoom(factor) {
    this.setView(this.view.zoomedAt([this.size[0] / 2, this.size[1] / 2], factor));
  }

  /** Move the view. @param {number} dx @param {number} dy CSS px */
  pan(dx, dy) {
    this.setView(this.view.pannedBy(dx, dy));
  }

  /** Image px in the middle of the pane: where the keyboard aims. @returns {Point} */
  get centre() {
    return this.view.centreOf(this.size);
  }

  /** A click by the keyboard, in the middle. @param {KeyboardEvent} event */
  clickCentre(event) {
    this.emit("click", { point: this.centre, event });
  }

  get hasFocus() {
    return document.activeElement === this.element;
  }

  get isDragging() {
    return this.#press !== null && this.#press.moved && this.#press.shape !== null;
  }

  invalidate() {
    if (this.#drawing === 0) this.#drawing = requestAnimationFrame(() => this.draw());
  }

  draw() {
    cancelAnimationFrame(this.#drawing);
    this.#drawing = 0;
    const context = /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d"));
    const ratio = this.canvas.width / this.size[0];
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    if (this.image !== null) this.#drawImages(context, ratio);
    for (const painter of this.image === null ? [] : this.#painters) {
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
      context.globalAlpha = 1;
      painter(context, this.view);
    }
    this.#layer.draw(this.image === null ? [] : this.#shapes, this.view, this.#hot);
  }

  /** @param {CanvasRenderingContext2D} context @param {number} ratio */
  #drawImages(context, ratio) {
    this.#drawImage(context, ratio, /** @type {PaneImage} */ (this.image));
    if (this.overlay === null) return;
    context.save();
    if (this.mix.mode === "blend") context.globalAlpha = this.mix.amount;
    else {
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.beginPath();
      context.rect(0, 0, this.canvas.width * this.mix.amount, this.canvas.height);
      context.clip();
    }
    this.#drawImage(context, ratio, this.overlay);
    context.restore();
  }

  /** @param {CanvasRenderingContext2D} context @param {number} ratio @param {PaneImage} image */
  #drawImage(context, ratio, image) {
    const base = /** @type {PaneImage} */ (this.image);
    const bitmap = image.level((this.view.scale * ratio * base.width) / image.width);
    context.imageSmoothingEnabled = this.view.scale * ratio < TRUE_PIXELS_FROM;
    this.view.applyTo(context, ratio, [base.width / bitmap.width, base.height / bitmap.height]);
    context.drawImage(bitmap, 0, 0);
  }

  #watchSize() {
    new ResizeObserver(([entry]) => {
      const ratio = window.devicePixelRatio;
      const device = entry.devicePixelContentBoxSize?.[0];
      const { width, height } = entry.contentRect;
      if (width === 0 || height === 0) return;
      this.canvas.width = devicePixels(width * ratio, device?.inlineSize);
      this.canvas.height = devicePixels(height * ratio, device?.blockSize);
      const before = this.size;
      this.size = [width, height];
      if (this.#fitted) this.fit();
      else this.view = this.view.pannedBy((width - before[0]) / 2, (height - before[1]) / 2);
      this.draw();
    }).observe(this.element);
  }

  #listen() {
    const element = this.element;
    element.addEventListener("wheel", (event) => this.#onWheel(event), { passive: false });
    element.addEventListener("pointerdown", (event) => this.#onDown(event));
    element.addEventListener("pointermove", (event) => this.#onMove(event));
    element.addEventListener("pointerup", (event) => this.#onUp(event));
    for (const name of /** @type {const} */ (["pointercancel", "lostpointercapture"]))
      element.addEventListener(name, (event) => {
        this.#fingers.up(event);
        this.#giveUp();
      });
    element.addEventListener("pointerleave", () => this.#hover(null, null));
    element.addEventListener("focus", () => (this.usedAt = performance.now()));
    element.addEventListener("keydown", (event) => {
      if (event.key === "Escape" && this.isDragging) {
        event.preventDefault();
        this.#giveUp();
      }
    });
  }

  /** @param {WheelEvent} event */
  #onWheel(event) {
    event.preventDefault();
    const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 20 : 1;
    const speed = event.ctrlKey ? 0.01 : 0.0016; // a pinch arrives as a wheel with Ctrl and small steps
    this.setView(this.view.zoomedAt(canvasPoint(event, this.element), Math.exp(-event.deltaY * lines * speed)));
  }

  /** @param {PointerEvent} event */
  #onDown(event) {
    if (event.target instanceof Element && event.target.closest("button, a, input, select") !== null) return;
    if (event.button > 1) return;
    this.element.focus({ preventScroll: true });
    this.element.setPointerCapture(event.pointerId);
    this.#fingers.down(event);
    if (this.#fingers.isPinch) return this.#giveUp();
    const at = canvasPoint(event, this.element);
    const generosity = event.pointerType === "touch" ? FINGER : 1;
    const shape = event.button === 0 ? shapeAt(this.#shapes, this.view, at, generosity) : null;
    this.#press = { at, last: at, moved: false, shape, from: shape?.points[0] ?? [0, 0], pointer: event.pointerId };
  }

  /** @param {PointerEvent} event */
  #onMove(event) {
    const pinch = this.#fingers.moved(event);
    if (pinch !== null) this.#pinch(pinch);
    if (this.#fingers.isPinch) return;
    const at = canvasPoint(event, this.element);
    const press = this.#press;
    if (press === null) return this.#hover(at, shapeAt(this.#shapes, this.view, at));
    if (!press.moved && distance(at, press.at) > STILL_PX) press.moved = true;
    if (!press.moved) return;
    this.element.classList.add(press.shape === null ? "panning" : "dragging");
    if (press.shape === null) this.pan(...subtract(at, press.last));
    else this.emit("drag", this.#dragged(press, at));
    press.last = at;
    this.#hover(at, press.shape);
  }

  /** @param {import("../lib/fingers.js").Pinch} pinch */
  #pinch({ shift, middle, factor }) {
    const box = this.element.getBoundingClientRect();
    this.setView(this.view.pannedBy(...shift).zoomedAt(subtract(middle, [box.left, box.top]), factor));
  }

  /** @param {PointerEvent} event */
  #onUp(event) {
    this.#fingers.up(event);
    const press = this.#press;
    this.#press = null;
    this.element.classList.remove("panning", "dragging");
    if (press === null || event.button > 1) return;
    const at = canvasPoint(event, this.element);
    const point = this.view.toImage(at);
    if (press.moved) {
      if (press.shape !== null) this.emit("drop", this.#dragged(press, at));
    } else if (this.#isSecondClick(at)) this.emit("doubleclick", { point, id: press.shape?.id ?? null });
    else if (press.shape !== null) this.emit("select", { id: press.shape.id, event });
    else if (event.button === 0) this.emit("click", { point, event });
  }

  #giveUp() {
    const press = this.#press;
    this.#press = null;
    this.element.classList.remove("panning", "dragging");
    if (press?.moved && press.shape !== null) this.emit("cancel", { id: press.shape.id });
  }

  /** @param {{at: Point, shape: Shape | null, from: Point}} press @param {Point} at */
  #dragged(press, at) {
    const delta = subtract(this.view.toImage(at), this.view.toImage(press.at));
    return { id: /** @type {Shape} */ (press.shape).id, point: add(press.from, delta), delta };
  }

  /** @param {Point} at */
  #isSecondClick(at) {
    const now = performance.now();
    const second = now - this.#lastClick.time < 350 && distance(at, this.#lastClick.at) < 5;
    this.#lastClick = { time: second ? 0 : now, at };
    return second;
  }

  /** @param {Point | null} at CSS px @param {Shape | null} shape */
  #hover(at, shape) {
    const id = shape?.id ?? null;
    this.#at = at;
    this.cursor = at === null ? null : this.view.toImage(at);
    if (id !== this.#hot) {
      this.#hot = id;
      this.element.classList.toggle("can-grab", id !== null);
      this.invalidate();
    }
    this.emit("hover", { point: this.cursor, id });
  }
}

/** What the browser says it lays out, where that is about right (an emulated screen tells CSS px). @param {number} about @param {number | undefined} told */
const devicePixels = (about, told) => (told !== undefined && Math.abs(told - about) <= 1 ? told : Math.round(about));
