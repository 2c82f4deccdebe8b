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
import { sortableTable } from "../../components/table.js";
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
      const list = h("ul", { class: "board-images" });
      const transfer = h("div");
      const problem = h("p", { class: "note bad", role: "alert", hidden: true });
      const start = h("button", { class: "button primary", type: "button" }, "Calibrate");
      /** @type {string[] | null} paths on this computer; null: the pictures sent */
      let chosen = null;
      let square_m = /** @type {number | null} */ (0.025);
      let columns = 9;
      let rows = 6;
      const size = numberField({
        label: "Square",
        unit: "m",
        value: square_m,
        decimals: 4,
        step: 0.001,
        min: 0.0001,
        onChange: (value) => (square_m = value),
      });
      const across = numberField({
        label: "Inner corners, long side",
        unit: "",
        value: columns,
        decimals: 0,
        step: 1,
        min: 3,
        onChange: (value) => (columns = value ?? columns),
      });
      const down = numberField({
        label: "short side",
        unit: "",
        value: rows,
        decimals: 0,
        step: 1,
        min: 3,
        onChange: (value) => (rows = value ?? rows),
      });

      const show = async () => {
        if (chosen !== null)
          fill(
            list,
            h("li", { class: "path" }, chosen.length === 1 ? chosen[0] : `${chosen.length} files on this computer`),
          );
        else {
          const { images } = await get(projectPath(projectId, "lens/images"));
          fill(
            list,
            images.length === 0
              ? h(
                  "li",
                  { class: "soft" },
                  "No pictures yet. Fifteen or more, the board at many places of the picture and tilted by 20 to 40°.",
                )
              : images.map(thumbnail),
          );
        }
      };
      const thumbnail = (/** @type {{name: string}} */ { name }) => {
        const path = projectPath(projectId, `lens/images/${encodeURIComponent(name)}`);
        const drop = h(
          "button",
          { type: "button", "aria-label": `Remove ${name}`, onclick: () => void remove(path).then(show, toastError) },
          icon("close", "small"),
        );
        return h("li", { class: "thumbnail" }, h("img", { src: `/api/${path}`, alt: name, loading: "lazy" }), drop);
      };
      const send = async () => {
        chosen = null;
        for (const file of await pickFiles({ accept: "image/*", multiple: true }))
          await sendWithProgress(
            transfer,
            projectPath(projectId, "upload/checkerboard", { filename: file.name }),
            file,
          );
        await show();
      };
      const choose = async (/** @type {"image" | "video"} */ kind) => {
        const files = await chooseFiles({
          title: kind === "image" ? "Choose the checkerboard pictures" : "Choose a video of the board",
          kind,
          multiple: kind === "image",
        });
        if (files !== null) chosen = files;
        await show();
      };
      start.addEventListener("click", async () => {
        try {
          await post(projectPath(projectId, "lens/calibrate"), {
            files: chosen ?? "uploaded",
            board: `${columns}x${rows}`,
            square_m,
          });
          close(true);
        } catch (error) {
          problem.hidden = false;
          problem.textContent = sentence(error);
        }
      });
      void show().catch(toastError);
      const sources = h(
        "div",
        { class: "toolbar" },
        h(
          "button",
          { class: "button small", type: "button", onclick: () => void send().catch(toastError) },
          icon("upload", "small"),
          "Send pictures…",
        ),
        h(
          "button",
          { class: "button small", type: "button", onclick: () => void choose("image").catch(toastError) },
          icon("folder", "small"),
          "Pictures on this computer…",
        ),
        h(
          "button",
          { class: "button small", type: "button", onclick: () => void choose("video").catch(toastError) },
          icon("video", "small"),
          "Video of the board…",
        ),
      );
      return [
        h(
          "div",
          { class: "dialog-body" },
          h("div", { class: "field-row" }, across.element, down.element, size.element),
          sources,
          transfer,
          list,
          problem,
        ),
        dialogActions(() => close(null), start),
      ];
    },
  });
}

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
  const table = sortableTable({
    label: "Pictures of the board",
    id: (/** @type {BoardImage} */ view) => view.name,
    rowClass: (view) => (view.used ? "" : "off"),
    onSelect: (view) => {
      table.select(view.name);
      board.show(view);
    },
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
  table.setRows(report.views);
  const parameters = h(
    "dl",
    { class: "facts" },
    report.parameters.flatMap(({ name, value, deviation }) => {
      const decimals = Math.abs(value) > 10 ? 1 : 5;
      return [h("dt", {}, name), h("dd", {}, `${fixed(value, decimals)} ± ${fixed(deviation, decimals)}`)];
    }),
  );
  const figures = h(
    "div",
    { class: "figures" },
    [
      [pixels(report.rms_px, 3), "RMS"],
      [`${used.length} of ${report.views.length}`, "pictures used"],
      [`${fixed(100 * report.covered_share, 0)} %`, "of the picture covered"],
      [`${report.board.join(" × ")}, ${fixed(report.square_m * 1000, 1)} mm`, "board"],
    ].map(([value, name]) => h("div", {}, h("span", { class: "value" }, value), h("span", { class: "name" }, name))),
  );
  const warnings = report.warnings.map((warning) =>
    h("p", { class: "note warn" }, icon("warn"), h("span", {}, warning)),
  );
  element.hidden = false;
  fill(
    element,
    h("header", {}, h("h2", {}, "Calibration report"), h("span", { class: "badge" }, plural(used.length, "picture"))),
    figures,
    ...warnings,
    h(
      "div",
      { class: "report-columns" },
      h("div", { class: "report-table" }, table.element),
      board.element,
      parameters,
    ),
  );
  const first = used[0] ?? report.views[0];
  if (first !== undefined) {
    table.select(first.name);
    board.show(first);
  }
}
