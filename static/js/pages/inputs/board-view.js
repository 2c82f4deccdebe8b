// One checkerboard picture with the corners found in it, in the order of the board.

import { h } from "../../lib/dom.js";
import { projectPath } from "../../lib/api.js";
import { Pane } from "../../components/pane.js";
import { PaneImage } from "../../components/pane-image.js";
import { paneChrome } from "../../components/pane-chrome.js";
import { markColour } from "../../components/palette.js";
import { plural } from "../../lib/format.js";

/** @typedef {import("./calibration.js").BoardImage} BoardImage */
/** @typedef {import("../../lib/types.js").Point} Point */

export class BoardView {
  /** @type {BoardImage | null} */
  #shown = null;

  /** @param {string} projectId @param {[number, number]} size of the pictures, px */
  constructor(projectId, size) {
    this.projectId = projectId;
    this.size = size;
    this.element = h("div", { class: "board-view" });
    this.pane = new Pane(this.element, { label: "Checkerboard picture with the corners found", viewOnly: true });
    this.chrome = paneChrome(this.pane, { title: "", readout: () => [] });
    this.pane.addPainter((context, view) => {
      const corners = (this.#shown?.corners_px ?? []).map((corner) => view.toCanvas(corner));
      drawChain(context, corners);
    });
  }

  /** @param {BoardImage} image */
  async show(image) {
    this.#shown = image;
    this.chrome.setTitle(
      `${image.name} · ${image.corners_px === null ? "no board found" : plural(image.corners_px.length, "corner")}`,
    );
    this.chrome.setNote();
    try {
      const loaded = await PaneImage.load(
        `/api/${projectPath(this.projectId, `lens/images/${encodeURIComponent(image.name)}`)}`,
        { onLevel: () => this.pane.invalidate() },
      );
      if (this.#shown === image) this.pane.setImage(loaded);
    } catch {
      if (this.#shown !== image) return;
      this.pane.setImage(await blank(this.size)); // a video's frames or files elsewhere: the corners alone
    }
  }
}

/** @param {[number, number]} size */
async function blank([width, height]) {
  const canvas = new OffscreenCanvas(width, height);
  const context = /** @type {OffscreenCanvasRenderingContext2D} */ (canvas.getContext("2d"));
  context.fillStyle = "#2b3037";
  context.fillRect(0, 0, width, height);
  return new PaneImage(await createImageBitmap(canvas));
}

/** @param {CanvasRenderingContext2D} context @param {Point[]} corners canvas px */
function drawChain(context, corners) {
  context.lineWidth = 1;
  context.strokeStyle = markColour("--mark-ghost");
  context.beginPath();
  corners.forEach(([x, y], i) => (i === 0 ? context.moveTo(x, y) : context.lineTo(x, y)));
  context.stroke();
  corners.forEach(([x, y], i) => {
    context.fillStyle = markColour(i === 0 ? "--mark-selected" : "--mark");
    context.beginPath();
    context.arc(x, y, i === 0 ? 4 : 2.4, 0, 2 * Math.PI);
    context.fill();
  });
}
