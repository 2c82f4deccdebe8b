// A new project: its name, and the files it starts from, by their place on this computer or sent by the browser.

import { post, sentence } from "../../lib/api.js";
import { fill, h } from "../../lib/dom.js";
import { icon } from "../../lib/icons.js";
import { dialogActions, openDialog } from "../../components/dialog.js";
import { chooseFiles } from "../../components/file-browser.js";

const INPUTS = /** @type {const} */ ([
  { kind: "video", name: "Video", hint: "mp4, mov, mkv" },
  { kind: "cloud", name: "Point cloud", hint: "laz, las, ply, pcd, e57; a table: csv, xyz, pts, asc, txt" },
  { kind: "lens", name: "Lens", hint: "yaml from a checkerboard; can be calibrated later" },
  { kind: "gps", name: "GPS", hint: "csv, to compare with" },
]);

/** @returns {Promise<string | null>} id of the project made */
export function newProjectDialog() {
  return openDialog({
    title: "New project",
    body: (close) => {
      const name = nameInput();
      const problem = h("p", { class: "note bad", role: "alert", hidden: true });
      /** @type {Record<string, string>} */
      const chosen = {};
      const onChosen = (/** @type {string} */ kind, /** @type {string} */ path) => {
        chosen[kind] = path;
        if (name.value === "" && kind === "video") name.value = stem(path);
      };
      const create = h("button", { class: "button primary", type: "submit" }, "Create");
      const submit = async (/** @type {Event} */ event) => {
        event.preventDefault();
        create.disabled = true; // a double click makes one project; Enter obeys this too
        try {
          close((await post("projects", { name: name.value.trim(), ...chosen })).id);
        } catch (error) {
          problem.hidden = false;
          problem.textContent = sentence(error);
          create.disabled = false;
        }
      };
      const field = h("div", { class: "field" }, h("label", { class: "label", for: name.id }, "Name"), name);
      return [
        h(
          "form",
          { class: "dialog-form", onsubmit: submit },
          h("div", { class: "dialog-body" }, field, sourceRows(onChosen), problem),
          dialogActions(() => close(null), create),
        ),
      ];
    },
  });
}

const nameInput = () =>
  h("input", {
    class: "input",
    id: "project-name",
    type: "text",
    required: true,
    placeholder: "EQ7",
    autocomplete: "off",
    spellcheck: "false",
    autofocus: true,
  });

/** @param {(kind: string, path: string) => void} onChosen */
const sourceRows = (onChosen) =>
  h(
    "div",
    { class: "source-rows" },
    INPUTS.map((input) => sourceRow(input, onChosen)),
    h(
      "p",
      { class: "small faint" },
      "Files stay where they are. All of them can be chosen, sent or changed later, in step 1.",
    ),
  );

/** @param {typeof INPUTS[number]} input @param {(kind: string, path: string) => void} onChosen */
function sourceRow({ kind, name, hint }, onChosen) {
  const path = h("span", { class: "path soft" }, hint);
  const choose = async () => {
    const files = await chooseFiles({ title: `Choose the ${name.toLowerCase()}`, kind });
    if (files === null) return;
    fill(path, h("bdi", {}, files[0])); // cut off at its beginning, so set from the right; its slashes stay in place
    path.title = files[0];
    path.className = "path";
    onChosen(kind, files[0]);
  };
  return h(
    "div",
    { class: "source-row", "data-kind": kind },
    h("span", { class: "label" }, name),
    path,
    h(
      "button",
      { class: "button small", type: "button", onclick: () => void choose() },
      icon("folder", "small"),
      "Browse…",
    ),
  );
}

/** A file's name without folder and ending. @param {string} path */
const stem = (path) =>
  path
    .split("/")
    .at(-1)
    ?.replace(/\.[^.]+$/, "") ?? "";
