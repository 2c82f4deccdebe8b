// A picture and its halved copies, so that a zoomed-out pane draws few pixels and does not shimmer.

import { picture } from "../lib/api.js";

const SMALLEST_LEVEL_PX = 700;

export class PaneImage {
  /** @param {ImageBitmap} bitmap */
  constructor(bitmap) {
    this.width = bitmap.width;
    this.height = bitmap.height;
    /** @type {ImageBitmap[]} from full size downwards */
    this.levels = [bitmap];
  }

  /**
   * Fetch and decode; the smaller levels follow in the background and `onLevel` tells of each.
   * @param {string} url
   * @param {{signal?: AbortSignal, onLevel?: () => void}} [options]
   */
  static async load(url, { signal, onLevel } = {}) {
    const image = new PaneImage(await picture(url, signal));
    void image.#addLevels(onLevel);
    return image;
  }

  /** @param {(() => void) | undefined} onLevel */
  async #addLevels(onLevel) {
    let last = this.levels[0];
    while (Math.max(last.width, last.height) > SMALLEST_LEVEL_PX) {
      const size = { resizeWidth: Math.max(1, last.width >> 1), resizeHeight: Math.max(1, last.height >> 1) };
      last = await createImageBitmap(last, { ...size, resizeQuality: "medium" });
      this.levels.push(last);
      onLevel?.();
    }
  }

  /** The smallest level that still has a pixel per device pixel. @param {number} deviceScale device px per image px */
  level(deviceScale) {
    let index = 0;
    while (index + 1 < this.levels.length && deviceScale * 2 ** (index + 1) <= 1.01) index += 1;
    return this.levels[index];
  }
}
