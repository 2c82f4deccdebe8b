// What the 3D scene shows: colours, how many points, which parts. viser draws it; the server decides from full data.

import { post, projectPath } from "../../lib/api.js";
import { fill, h } from "../../lib/dom.js";
import { count, plural } from "../../lib/format.js";
import { pointsShown } from "../../lib/graphics.js";
import { latest } from "../../lib/latest.js";
import { SceneCover } from "../../components/scene-cover.js";
import { segmented } from "../../components/segmented.js";
import { toastError } from "../../components/toast.js";

/** @typedef {"cloud" | "ground" | "orthoimage" | "camera" | "lines"} Part */

const CHOICES = [
  { value: "100000", name: "100 k" },
  { value: "1000000", name: "1 M" },
  { value: "5000000", name: "5 M" },
];
const PARTS = /** @type {const} */ ([
  ["cloud", "Cloud"],
  ["ground", "Ground plane"],
  ["orthoimage", "Orthoimage"],
  ["camera", "Camera"],
  ["lines", "Lines"],
]);

/** @param {HTMLElement} element @param {string} projectId @param {HTMLElement} view what holds the 3D view */
export function scenePanel(element, projectId, view) {
  const wish = {
    colour: "rgb",
    points: pointsShown(),
    show: /** @type {Record<Part, boolean>} */ ({
      cloud: true,
      ground: true,
      orthoimage: false,
      camera: true,
      lines: true,
    }),
    take: true, // who opens the page wants to see this project
  };
  const cover = new SceneCover(view, projectId, () => {
    wish.take = true;
    send();
  });
  const shown = h("p", { class: "small faint number", role: "status" });
  const ask = latest(
    (/** @type {typeof wish} */ wanted) => post(projectPath(projectId, "scene"), wanted),
    (answer) => {
      cover.show(answer);
      if (!cover.isElsewhere(answer.owner)) wish.take = false;
      if (answer.points_total)
        shown.textContent = `${count(answer.points_shown)} of ${plural(answer.points_total, "point")} drawn; the engine uses all`;
    },
    toastError,
  );
  const send = () => ask(structuredClone(wish));
  const colour = segmented({
    label: "Colour of the cloud",
    choices: [
      { value: "rgb", name: "Colour" },
      { value: "intensity", name: "Intensity" },
      { value: "height", name: "Height" },
    ],
    value: "rgb",
    onChange: (value) => ((wish.colour = value), send()),
  });
  const points = segmented({
    label: "Points drawn",
    choices: CHOICES,
    value: String(wish.points),
    onChange: (value) => ((wish.points = Number(value)), send()),
  });
  const parts = PARTS.map(([part, name]) => {
    const input = h("input", {
      type: "checkbox",
      checked: wish.show[part],
      onchange: () => ((wish.show[part] = input.checked), send()),
    });
    return h("label", { class: "check" }, input, name);
  });
  fill(
    element,
    h("header", {}, h("h2", {}, "3D view")),
    h("div", { class: "toolbar" }, colour.element, points.element),
    h("div", { class: "parts" }, parts),
    shown,
  );
  return { send, cover };
}
