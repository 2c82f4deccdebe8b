// Deleted projects are kept for a while: a list of them, to fetch one back from.

import { sentence } from "../../lib/api.js";
import { fill, h } from "../../lib/dom.js";
import { ago, day } from "../../lib/format.js";
import { icon } from "../../lib/icons.js";
import { deletedProjects } from "../../lib/trash.js";
import { openDialog } from "../../components/dialog.js";
import { note } from "../../components/notes.js";

/** @typedef {import("../../lib/trash.js").Deleted} Deleted */

/** @returns {Promise<Deleted | null>} the project to fetch back */
export function chooseDeleted() {
  return openDialog({
    title: "Deleted projects",
    body: (/** @type {(chosen: Deleted | null) => void} */ close) => {
      const body = h("div", { class: "dialog-body" });
      void showDeleted(body, close);
      return [body];
    },
  });
}

/** @param {HTMLElement} body @param {(chosen: Deleted) => void} onChosen */
async function showDeleted(body, onChosen) {
  fill(body, h("p", { class: "soft", role: "status" }, "Looking for deleted projects…"));
  try {
    const deleted = await deletedProjects();
    if (deleted.length === 0) fill(body, h("p", { class: "soft" }, "No deleted project is kept any more."));
    else fill(body, h("ul", { class: "file-rows" }, deleted.map((project) => deletedRow(project, onChosen))));
  } catch (error) {
    const again = () => void showDeleted(body, onChosen);
    fill(body, note("bad", sentence(error)), h("button", { class: "button", type: "button", onclick: again }, "Try again"));
  }
}

/** @param {Deleted} project @param {(chosen: Deleted) => void} onChosen */
function deletedRow(project, onChosen) {
  const { id, name, deleted_s, kept_until_s } = project;
  const label = `Restore ${name}`;
  const onclick = () => onChosen(project);
  return h(
    "li",
    { "data-project": id },
    icon("trash"),
    h(
      "span",
      { class: "file-words" },
      h("span", { class: "file-name", title: name }, name),
      h(
        "span",
        { class: "small faint" },
        id === name ? "" : `in folder ${id} · `,
        `deleted ${ago(deleted_s)} · kept until ${day(kept_until_s)}`,
      ),
    ),
    h("button", { class: "button small", type: "button", "aria-label": label, onclick }, "Restore"),
  );
}
