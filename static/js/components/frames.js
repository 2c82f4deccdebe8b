// Frames of the video and what was measured on them, fetched before they are asked for.

import { get, picture, projectPath } from "../lib/api.js";
import { PaneImage } from "./pane-image.js";

/** @typedef {import("../lib/types.js").Point} Point */

/**
 * @typedef {object} TargetOverlay all in raw px of the frame
 * @property {Record<string, Point[]>} [bands_raw]
 * @property {Record<string, Point[]>} [edges_raw]
 * @property {Record<string, Point[]>} [lines_raw]
 * @property {{used: Point[], rejected: Point[]}} [points_raw]
 * @property {Point | null} p1_raw
 * @property {Point | null} p2_raw
 *
 * @typedef {object} FrameReview what the engine measured on one frame
 * @property {number} frame
 * @property {number} time_s
 * @property {Record<string, string>} status by target
 * @property {{used: Point[], rejected: Point[]}} ground
 * @property {Record<string, TargetOverlay>} targets
 */

const FULL_FRAMES_KEPT = 9; // a 4K frame takes 33 MB
const SMALL_FRAMES_KEPT = 60;
const REVIEWS_KEPT = 240;

/** A frame that may have fewer pixels than the video, but lies on the video's pixel grid. */
export class FrameImage extends PaneImage {
  /** @param {ImageBitmap} bitmap @param {Point} size of the video, px */
  constructor(bitmap, [width, height]) {
    super(bitmap);
    this.isWhole = bitmap.width === width;
    this.width = width;
    this.height = height;
  }
}

/** The newest few of what was fetched. @template Value */
class Kept {
  /** @type {Map<string, Promise<Value>>} */
  #values = new Map();

  /** @param {number} limit */
  constructor(limit) {
    this.limit = limit;
  }

  /** @param {string} key @param {() => Promise<Value>} fetchIt @returns {Promise<Value>} */
  get(key, fetchIt) {
    const value = this.#values.get(key) ?? fetchIt();
    this.#values.delete(key);
    this.#values.set(key, value);
    value.catch(() => this.#values.delete(key));
    if (this.#values.size > this.limit) this.#values.delete(/** @type {string} */ (this.#values.keys().next().value));
    return value;
  }

  /** @param {string} key */
  has(key) {
    return this.#values.has(key);
  }

  clear() {
    this.#values.clear();
  }
}

export class FrameLibrary {
  /** @type {Kept<FrameImage>} */
  #whole = new Kept(FULL_FRAMES_KEPT);
  /** @type {Kept<FrameImage>} */
  #small = new Kept(SMALL_FRAMES_KEPT);
  /** @type {Kept<FrameReview>} */
  #reviews = new Kept(REVIEWS_KEPT);

  /**
   * @param {string} projectId
   * @param {{size: Point, count: number}} video size in px, number of frames
   */
  constructor(projectId, { size, count }) {
    this.projectId = projectId;
    this.size = size;
    this.count = count;
  }

  /** @param {number} frame @param {number | null} width fewer px for playing; null: all of them @returns {Promise<FrameImage>} */
  image(frame, width) {
    const small = width !== null && width < this.size[0];
    const kept = small ? this.#small : this.#whole;
    return kept.get(`${frame}/${small ? width : ""}`, () => this.#load(frame, small ? width : null));
  }

  /** Whether all pixels of a frame are here or on their way. @param {number} frame */
  hasWhole(frame) {
    return this.#whole.has(`${frame}/`);
  }

  /** @param {number} frame @param {string} method @returns {Promise<FrameReview>} */
  review(frame, method) {
    return this.#reviews.get(`${frame}/${method}`, () =>
      get(projectPath(this.projectId, `review/${frame}`, { method })),
    );
  }

  /** Fetch in advance; failures are told when the frame is asked for. @param {number[]} frames @param {number | null} width @param {string} method */
  prepare(frames, width, method) {
    for (const frame of frames.filter((candidate) => candidate >= 0 && candidate < this.count)) {
      this.image(frame, width).catch(() => undefined);
      this.review(frame, method).catch(() => undefined);
    }
  }

  /** After another solve the overlays are others; the pictures stay. */
  forgetReviews() {
    this.#reviews.clear();
  }

  /** @param {number} frame @param {number | null} width @returns {Promise<FrameImage>} */
  async #load(frame, width) {
    const path = projectPath(this.projectId, `frames/${frame}.jpg`, { w: width });
    return new FrameImage(await picture(`/api/${path}`), this.size);
  }
}
