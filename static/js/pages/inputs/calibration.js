// Lens calibration in the page: checkerboard pictures or a video of the board, a job, and the report with what was
// found in each picture.

import { get, post, projectPath, remove, sentence } from "../../lib/api.js";
import { fill, h } from "../../lib/dom.js";
import { pickFiles } from "../../lib/download.js";
import { icon } from "../../lib/icons.js";
import { fixed, pixels, plural } from "../../lib/format.js";
import { chooseFiles } from "../../components/file-browser.js";
import { dialogActions, openDialog } from "../../components/dialog.js";
import { numberField } from "../../components/number-field.js";
import { SortableTable } from "../../components/table.js";
import { toastError } from "../../components/toast.js";
import { BoardView } from "./board-view.js";
import { sendWithProgress } from "./input-card.js";

/**
 * @typedef {object} BoardImage
 * @property {string} name
 * @property {boolean} used
 * @property {string} left_out
 * @property {number | null} rms_px
 * @property {number | null} tilt_rad
 * @property {[number, number][] | null} corners_px
 *
 * @typedef {object} Report
 * @property {[number, number]} image_size_px
 * @property {[number, number]} board
 * @property {number} square_m
 * @property {number | null} rms_px
 * @property {{name: string, value: number, deviation: number}[]} parameters
 * @property {number[][]} coverage_grid
 * @property {number} covered_share
 * @property {BoardImage[]} views
 * @property {string[]} warnings
 */

/** Ask what to calibrate from, and start. Resolves with true when a job was started. @param {string} projectId @returns {Promise<boolean | null>} */
export function calibrationDialog(projectId) {
  return openDialog({
    title: "Calibrate the lens",
    size: "wide",
    body: (close) => {
      const board = boardFields();
      const pictures = new BoardPictures(projectId);
      const problem = h("p", { class: "note bad", role: "alert", hidden: true });
      const start = async () => {
        try {
          await post(projectPath(projectId, "lens/calibrate"), { files: pictures.files, ...board.value() });
          close(true);
        } catch (error) {
          problem.hidden = false;
          problem.textContent = sentence(error);
        }
      };
      return [
        h("div", { class: "dialog-body" }, board.element, ...pictures.elements, problem),
        dialogActions(
          () => close(null),
          h("button", { class: "button primary", type: "button", onclick: () => void start() }, "Calibrate"),
        ),
      ];
    },
  });
}

/** What the board is like: its inner corners and the side of a square. */
function boardFields() {
  let square_m = /** @type {number | null} */ (0.025);
  let columns = 9;
  let rows = 6;
  const corners = { unit: "", decimals: 0, step: 1, min: 3 };
  const across = numberField({
    ...corners,
    label: "Inner corners, long side",
    value: columns,
    onChange: (value) => (columns = value ?? columns),
  });
  const down = numberField({
    ...corners,
    label: "short side",
    value: rows,
    onChange: (value) => (rows = value ?? rows),
  });
  const size = numberField({
    label: "Square",
    unit: "m",
    value: square_m,
    decimals: 4,
    step: 0.001,
    min: 0.0001,
    onChange: (value) => (square_m = value),
  });
  return {
    element: h("div", { class: "field-row" }, across.element, down.element, size.element),
    value: () => ({ board: `${columns}x${rows}`, square_m }),
  };
}

/** The pictures to calibrate from: those sent to the project, or files on this computer. */
class BoardPictures {
  /** @type {string[] | null} paths on this computer; null: the pictures sent */
  #chosen = null;
  #list = h("ul", { class: "board-images" });
  #transfer = h("div");

  /** @param {string} projectId */
  constructor(projectId) {
    this.projectId = projectId;
    this.elements = [this.#sources(), this.#transfer, this.#list];
    void this.#show().catch(toastError);
  }

  /** As the engine is told. */
  get files() {
    return this.#chosen ?? "uploaded";
  }

  #sources() {
    return h(
      "div",
      { class: "toolbar" },
      sourceButton("upload", "Send pictures…", () => this.#send()),
      sourceButton("folder", "Pictures on this computer…", () => this.#choose("image")),
      sourceButton("video", "Video of the board…", () => this.#choose("video")),
    );
  }

  async #send() {
    this.#chosen = null;
    for (const file of await pickFiles({ accept: "image/*", multiple: true })) {
      const path = projectPath(this.projectId, "upload/checkerboard", { filename: file.name });
      await sendWithProgress(this.#transfer, path, file);
    }
    await this.#show();
  }

  /** @param {"image" | "video"} kind */
  async #choose(kind) {
    const files = await chooseFiles({
      title: kind === "image" ? "Choose the checkerboard pictures" : "Choose a video of the board",
      kind,
      multiple: kind === "image",
    });
    if (files !== null) this.#chosen = files;
    await this.#show();
  }

  async #show() {
    fill(this.#list, this.#chosen === null ? await this.#thumbnails() : chosenFiles(this.#chosen));
  }

  async #thumbnails() {
    const { images } = await get(projectPath(this.projectId, "lens/images"));
    return images.length === 0 ? noPictures() : images.map(this.#thumbnail, this);
  }

  /** @param {{name: string}} image */
  #thumbnail({ name }) {
    const path = projectPath(this.projectId, `lens/images/${encodeURIComponent(name)}`);
    const drop = () => void remove(path).then(() => this.#show(), toastError);
    return h(
      "li",
      { class: "thumbnail" },
      h("img", { src: `/api/${path}`, alt: name, loading: "lazy" }),
      h("button", { type: "button", "aria-label": `Remove ${name}`, onclick: drop }, icon("close", "small")),
    );
  }
}

/** @param {"upload" | "folder" | "video"} sign @param {string} words @param {() => Promise<void>} run */
const sourceButton = (sign, words, run) =>
  h(
    "button",
    { class: "button small", type: "button", onclick: () => void run().catch(toastError) },
    icon(sign, "small"),
    words,
  );

/** @param {string[]} files */
const chosenFiles = (files) =>
  h("li", { class: "path" }, files.length === 1 ? files[0] : `${files.length} files on this computer`);

const noPictures = () =>
  h(
    "li",
    { class: "soft" },
    "No pictures yet. Fifteen or more, the board at many places of the picture and tilted by 20 to 40°.",
  );

/** The report of the last calibration, as a card. @param {string} projectId */
export function calibrationReport(projectId) {
  const element = h("section", { class: "card report-card", "aria-label": "Calibration report", hidden: true });
  return {
    element,
    async refresh() {
      const report = /** @type {Report | null} */ (await get(projectPath(projectId, "lens/report")).catch(() => null));
      if (report === null) element.hidden = true;
      else show(element, projectId, report);
    },
  };
}

/** @param {HTMLElement} element @param {string} projectId @param {Report} report */
function show(element, projectId, report) {
  const used = report.views.filter((view) => view.used);
  const board = new BoardView(projectId, report.image_size_px);
  const select = (/** @type {BoardImage} */ view) => {
    table.select(view.name);
    board.show(view);
  };
  const table = viewsTable(select);
  table.setRows(report.views);
  element.hidden = false;
  fill(
    element,
    h("header", {}, h("h2", {}, "Calibration report"), h("span", { class: "badge" }, plural(used.length, "picture"))),
    figures(report, used.length),
    ...report.warnings.map((warning) => h("p", { class: "note warn" }, icon("warn"), h("span", {}, warning))),
    h(
      "div",
      { class: "report-columns" },
      h("div", { class: "report-table" }, table.element),
      board.element,
      parameters(report),
    ),
  );
  const first = used[0] ?? report.views[0];
  if (first !== undefined) select(first);
}

/** @param {(view: BoardImage) => void} onSelect */
function viewsTable(onSelect) {
  return new SortableTable({
    label: "Pictures of the board",
    id: (/** @type {BoardImage} */ view) => view.name,
    rowClass: (view) => (view.used ? "" : "off"),
    onSelect,
    columns: [
      { key: "name", title: "Picture", cell: (view) => view.name, sort: (view) => view.name },
      {
        key: "rms",
        title: "Error",
        number: true,
        cell: (view) => (view.rms_px === null ? "–" : pixels(view.rms_px)),
        sort: (view) => view.rms_px,
      },
      {
        key: "state",
        title: "",
        cell: (view) => (view.used ? "used" : view.left_out),
        tone: (view) => (view.used ? "" : "warn"),
      },
    ],
  });
}

/** @param {Report} report @param {number} used */
function figures(report, used) {
  const entries = [
    [pixels(report.rms_px, 3), "RMS"],
    [`${used} of ${report.views.length}`, "pictures used"],
    [`${fixed(100 * report.covered_share, 0)} %`, "of the picture covered"],
    [`${report.board.join(" × ")}, ${fixed(report.square_m * 1000, 1)} mm`, "board"],
  ];
  return h(
    "div",
    { class: "figures" },
    entries.map(([value, name]) =>
      h("div", {}, h("span", { class: "value" }, value), h("span", { class: "name" }, name)),
    ),
  );
}

/** @param {Report} report */
function parameters(report) {
  return h(
    "dl",
    { class: "facts" },
    report.parameters.flatMap(({ name, value, deviation }) => {
      const decimals = Math.abs(value) > 10 ? 1 : 5;
      return [h("dt", {}, name), h("dd", {}, `${fixed(value, decimals)} ± ${fixed(deviation, decimals)}`)];
    }),
  );
}
