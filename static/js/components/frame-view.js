// The picture of the current frame with what was measured on it. Shows the newest frame asked for, never an older
// one: fewer pixels while it moves, all of them as soon as it rests.

import { Emitter } from "../lib/emitter.js";
import { ApiError, sentence } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { icon } from "../lib/icons.js";
import { busyOver } from "./busy.js";
import { Loupe } from "./loupe.js";
import { Pane } from "./pane.js";
import { overlayShapes, PointPainter } from "./review-overlay.js";
import { toastError } from "./toast.js";

/** @typedef {import("./frames.js").FrameReview} FrameReview */
/** @typedef {import("./review-overlay.js").Layer} Layer */

const PREPARED_BY_STEPPING = [1, -1, 2, -2];
const PREPARED_BY_PLAYING = [1, 2, 3, 4, 5, 6, 7, 8];
const RESTS_AFTER_MS = 140;

/** @extends {Emitter<{shown: {review: FrameReview | null}}>} */
export class FrameView extends Emitter {
  #wanted = 0;
  #shown = "";
  /** Counts the solutions, so that the overlay of one is not taken for that of the next. */
  #solution = 0;
  #loading = false;
  #moved_ms = 0;
  #resting = 0;
  #loupeOn = false;
  #told = "";
  /** @type {FrameReview | null} */
  review = null;
  playing = false;
  active = true;

  /**
   * @param {HTMLElement} element
   * @param {import("./frames.js").FrameLibrary} library
   * @param {string} method
   */
  constructor(element, library, method) {
    super();
    this.element = element;
    this.library = library;
    this.method = method;
    /** @type {Set<Layer>} */
    this.layers = new Set();
    this.pane = new Pane(element, { label: "Frame with what was measured on it", viewOnly: true });
    this.painter = new PointPainter(this.pane);
    this.loupe = new Loupe(this.pane);
    this.loupeButton = this.#tool("target", "Loupe (Z)", () => this.toggleLoupe());
    const tools = [
      this.loupeButton,
      this.#tool("zoom_in", "Zoom in (+)", () => this.pane.zoom(1.4)),
      this.#tool("fit", "Whole picture (0)", () => this.pane.fit()),
    ];
    this.chip = h("span", { class: "pane-chip" });
    element.append(h("div", { class: "pane-caption" }, this.chip), h("div", { class: "pane-tools" }, tools));
    this.#setLoupe();
  }

  /** @param {number} frame */
  show(frame) {
    const far = Math.abs(frame - this.#wanted) > 1 && !this.library.hasWhole(frame);
    this.#wanted = frame;
    this.#moved_ms = far ? performance.now() : 0;
    window.clearTimeout(this.#resting);
    if (far) this.#resting = window.setTimeout(() => void this.#load(), RESTS_AFTER_MS);
    void this.#load();
  }

  /** @param {boolean} playing */
  setPlaying(playing) {
    this.playing = playing;
    this.#setLoupe();
    void this.#load();
  }

  /** @param {string} method */
  setMethod(method) {
    this.method = method;
    void this.#load();
  }

  /** @param {Set<Layer>} layers */
  setLayers(layers) {
    this.layers = layers;
    this.#showOverlay();
  }

  /** Whether a frame is on the screen, with its overlay or without. @param {number} frame */
  isShown(frame) {
    return this.element.dataset.frame === String(frame);
  }

  /** Not needed while only the 3D scene is seen. @param {boolean} active */
  setActive(active) {
    this.active = active;
    void this.#load();
  }

  /** Read the overlay again: the results are others. */
  refresh() {
    this.library.forgetReviews();
    this.#solution += 1;
    void this.#load();
  }

  /** @param {string} words @param {boolean} attention */
  setCaption(words, attention) {
    this.chip.textContent = words;
    this.chip.classList.toggle("attention", attention);
  }

  toggleLoupe() {
    this.#loupeOn = !this.#loupeOn;
    this.#setLoupe();
  }

  async #load() {
    if (this.#loading || !this.active) return;
    this.#loading = true;
    for (let next = this.#next(); next.key !== this.#shown; next = this.#next()) {
      await this.#showOne(next).catch(toastError);
      this.#shown = next.key; // what cannot be shown is not asked for again and again
    }
    this.#loading = false;
    const steps = this.playing ? PREPARED_BY_PLAYING : PREPARED_BY_STEPPING;
    this.library.prepare(
      steps.map((by) => this.#wanted + by),
      this.#next().width,
      this.method,
    );
  }

  /** @param {{frame: number, width: number | null}} next */
  async #showOne({ frame, width }) {
    const measured = this.library.review(frame, this.method).catch((error) => this.#without(error));
    const image = await this.library.image(frame, width);
    // The first overlay may have to wait for the engine to solve; a picture of its own is better than none.
    if (this.pane.image === null) this.pane.setImage(image);
    const solved = this.review === null ? busyOver(this.element, "Solving…") : () => undefined;
    const review = await measured;
    solved();
    this.pane.setImage(image);
    this.review = review;
    this.#showOverlay();
    this.#setLoupe();
    this.element.dataset.frame = String(frame);
    this.element.dataset.whole = String(image.isWhole);
    this.emit("shown", { review });
  }

  /** A frame without overlay is still worth looking at; why there is none is told once, by the page if it is a state. @param {unknown} error */
  #without(error) {
    const words = sentence(error);
    const isState = error instanceof ApiError && error.path === "track";
    if (words !== this.#told && !isState) toastError(error);
    this.#told = words;
    return null;
  }

  /** What should be on the screen now. */
  #next() {
    const moving = this.playing || performance.now() - this.#moved_ms < RESTS_AFTER_MS;
    const width = moving ? this.#playWidth() : null;
    return { frame: this.#wanted, width, key: `${this.#wanted}/${width ?? ""}/${this.method}/${this.#solution}` };
  }

  /** Width that fills the pane, in steps so that a resized window still finds its pictures. @returns {number} px */
  #playWidth() {
    const whole = this.library.size[0];
    const scale = this.pane.image === null ? this.pane.size[0] / whole : this.pane.view.scale;
    return Math.min(whole, Math.max(640, Math.ceil((whole * scale * window.devicePixelRatio) / 320) * 320));
  }

  #showOverlay() {
    this.painter.review = this.review;
    this.painter.shown = this.layers;
    this.pane.setShapes(this.review === null ? [] : overlayShapes(this.review, this.layers));
  }

  /** The loupe needs every pixel, so it rests while fewer are shown. */
  #setLoupe() {
    const image = /** @type {import("./frames.js").FrameImage | null} */ (this.pane.image);
    this.loupe.setEnabled(this.#loupeOn && !this.playing && image !== null && image.isWhole);
    this.loupeButton.setAttribute("aria-pressed", String(this.#loupeOn));
  }

  /** @param {import("../lib/icons.js").IconName} name @param {string} label @param {() => void} run */
  #tool(name, label, run) {
    return h("button", { type: "button", "aria-label": label, title: label, onclick: run }, icon(name));
  }
}
