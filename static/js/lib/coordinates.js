// The one module that knows canvas pixels and the half-pixel rule.
//
// Image coordinates (`raw`, `und`, `ortho`) put (0, 0) at the *centre* of the top-left pixel, as the engine and OpenCV
// do. A canvas puts (0, 0) at the *corner*. So canvas = scale * (image + 0.5) + offset, here and nowhere else.

/** @typedef {import("./types.js").Point} Point */
/** @typedef {import("./types.js").OrthoGrid} OrthoGrid */

const SMALLEST_SCALE = 0.01;
const LARGEST_SCALE = 96;

/** How an image lies on a canvas: CSS px per image px, and where the image's outer corner is. Immutable. */
export class View {
  /** @param {number} scale CSS px per image px  @param {number} x  @param {number} y  outer corner, CSS px */
  constructor(scale = 1, x = 0, y = 0) {
    this.scale = scale;
    this.x = x;
    this.y = y;
  }

  /** @param {Point} image @returns {Point} CSS px in the pane */
  toCanvas([u, v]) {
    return [this.scale * (u + 0.5) + this.x, this.scale * (v + 0.5) + this.y];
  }

  /** @param {Point} canvas CSS px in the pane @returns {Point} image px */
  toImage([x, y]) {
    return [(x - this.x) / this.scale - 0.5, (y - this.y) / this.scale - 0.5];
  }

  /** The same place stays under `canvas` while the scale is multiplied. @param {Point} canvas @param {number} factor */
  zoomedAt([x, y], factor) {
    const scale = clamp(this.scale * factor, SMALLEST_SCALE, LARGEST_SCALE);
    const f = scale / this.scale;
    return new View(scale, x - (x - this.x) * f, y - (y - this.y) * f);
  }

  /** @param {number} dx @param {number} dy CSS px */
  pannedBy(dx, dy) {
    return new View(this.scale, this.x + dx, this.y + dy);
  }

  /** With an image point in the middle of a pane of a given size. @param {Point} image @param {Point} size CSS px @param {number} [scale] */
  centredOn([u, v], [width, height], scale = this.scale) {
    return new View(scale, width / 2 - scale * (u + 0.5), height / 2 - scale * (v + 0.5));
  }

  /** Image point in the middle of a pane of a given size. @param {Point} size CSS px @returns {Point} */
  centreOf([width, height]) {
    return this.toImage([width / 2, height / 2]);
  }

  /** The whole image inside the pane. @param {Point} image width and height, px @param {Point} size CSS px */
  static fitting([imageWidth, imageHeight], [width, height]) {
    const scale = Math.min(width / imageWidth, height / imageHeight);
    return new View(scale, (width - scale * imageWidth) / 2, (height - scale * imageHeight) / 2);
  }

  /**
   * Put this view on a canvas context, so that drawing a bitmap at (0, 0) lands exactly.
   * @param {CanvasRenderingContext2D} context
   * @param {number} ratio device px per CSS px
   * @param {Point} shrink image px per bitmap px, both axes (pyramid level)
   */
  applyTo(context, ratio, [shrinkX, shrinkY]) {
    const s = ratio * this.scale;
    context.setTransform(s * shrinkX, 0, 0, s * shrinkY, ratio * this.x, ratio * this.y);
  }
}

/** Where an event happened inside an element, CSS px. @param {MouseEvent} event @param {Element} element @returns {Point} */
export function canvasPoint(event, element) {
  const box = element.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
}

/** Pixel of an orthoimage to metres on the ground. @param {OrthoGrid} grid @param {Point} ortho @returns {Point} */
export function worldFromOrtho(grid, [u, v]) {
  return [grid.west_m + (u + 0.5) * grid.pixel_size_m, grid.north_m - (v + 0.5) * grid.pixel_size_m];
}

/** Metres on the ground to a pixel of an orthoimage. @param {OrthoGrid} grid @param {Point} world @returns {Point} */
export function orthoFromWorld(grid, [x, y]) {
  return [(x - grid.west_m) / grid.pixel_size_m - 0.5, (grid.north_m - y) / grid.pixel_size_m - 0.5];
}

/** Image px to QGIS source coordinates: origin at the pixel's corner, v negative. @param {Point} image @returns {Point} */
export function qgisFromImage([u, v]) {
  return [u + 0.5, -(v + 0.5)];
}

/** QGIS source coordinates to image px. @param {Point} source @returns {Point} */
export function imageFromQgis([x, y]) {
  return [x - 0.5, -y - 0.5];
}

/** @param {Point} a @param {Point} b @returns {Point} */
export const add = (a, b) => [a[0] + b[0], a[1] + b[1]];
/** @param {Point} a @param {Point} b @returns {Point} */
export const subtract = (a, b) => [a[0] - b[0], a[1] - b[1]];
/** @param {Point} a @param {number} k @returns {Point} */
export const times = (a, k) => [a[0] * k, a[1] * k];
/** @param {Point} a @param {Point} b */
export const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
/** @param {number} value @param {number} low @param {number} high */
export const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

/** Distance from a point to a segment. @param {Point} p @param {Point} a @param {Point} b */
export function distanceToSegment(p, a, b) {
  const ab = subtract(b, a);
  const length2 = ab[0] ** 2 + ab[1] ** 2;
  const along = length2 === 0 ? 0 : clamp(((p[0] - a[0]) * ab[0] + (p[1] - a[1]) * ab[1]) / length2, 0, 1);
  return distance(p, add(a, times(ab, along)));
}

/** Whether a point lies inside a polygon (even-odd rule). @param {Point} p @param {Point[]} polygon */
export function isInside([x, y], polygon) {
  let inside = false;
  for (let i = 0, j = polygon.length - 1; i < polygon.length; j = i++) {
    const [ax, ay] = polygon[i];
    const [bx, by] = polygon[j];
    if (ay > y !== by > y && x < ((bx - ax) * (y - ay)) / (by - ay) + ax) inside = !inside;
  }
  return inside;
}
