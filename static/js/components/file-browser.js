// Choosing files on this computer, inside the folders the server allows.

import { fill, h } from "../lib/dom.js";
import { icon } from "../lib/icons.js";
import { get, sentence } from "../lib/api.js";
import { size } from "../lib/format.js";
import { dialogActions, openDialog } from "./dialog.js";

/**
 * @typedef {{name: string, path: string, is_dir: boolean, size: number | null, kind: string | null}} Entry
 * @typedef {{dir: string, parent: string | null, roots: string[], home: string, workspace: string, entries: Entry[]}} Listing
 */

const ICONS = /** @type {Record<string, import("../lib/icons.js").IconName>} */ ({
  dir: "folder",
  video: "video",
  cloud: "cube",
});
const REMEMBERED = "rooftrack-browse-dir";

/**
 * @param {{title: string, kind: "video" | "cloud" | "lens" | "gps" | "image", multiple?: boolean}} options
 * @returns {Promise<string[] | null>} absolute paths
 */
export function chooseFiles({ title, kind, multiple = false }) {
  return openDialog({
    title,
    size: "wide tall",
    body: (close) => {
      const list = h("ul", {
        class: "file-list",
        role: "listbox",
        "aria-label": "Files",
        "aria-multiselectable": String(multiple),
      });
      const trail = h("nav", { class: "file-trail", "aria-label": "Folder" });
      const note = h("p", { class: "soft small", role: "status" });
      const choose = h("button", { class: "button primary", type: "button", disabled: true }, "Choose");
      /** @type {Set<string>} */
      const chosen = new Set();
      const finish = () => chosen.size > 0 && close([...chosen]);
      choose.addEventListener("click", finish);

      const pick = (/** @type {HTMLElement} */ row, /** @type {string} */ path) => {
        if (!multiple) chosen.clear();
        if (chosen.has(path)) chosen.delete(path);
        else chosen.add(path);
        for (const item of list.children)
          item.setAttribute("aria-selected", String(chosen.has(/** @type {HTMLElement} */ (item).dataset.path ?? "")));
        choose.disabled = chosen.size === 0;
        choose.textContent = chosen.size > 1 ? `Choose ${chosen.size} files` : "Choose";
        row.focus();
      };
      const row = (/** @type {Entry} */ entry) => {
        const element = h(
          "li",
          { role: "option", tabindex: 0, "aria-selected": "false", "data-path": entry.path },
          icon(ICONS[entry.kind ?? ""] ?? (entry.is_dir ? "folder" : "file")),
          h("span", { class: "name" }, entry.name),
          h("span", { class: "faint number" }, entry.is_dir ? "" : size(entry.size)),
        );
        const open = () =>
          entry.is_dir
            ? void go(entry.path)
            : multiple
              ? pick(element, entry.path)
              : (pick(element, entry.path), chosen.add(entry.path), finish());
        element.addEventListener("click", () => (entry.is_dir ? open() : pick(element, entry.path)));
        element.addEventListener("dblclick", () => !entry.is_dir && open());
        element.addEventListener("keydown", (event) => onRowKey(event, element, open));
        return element;
      };
      const go = async (/** @type {string | null} */ dir) => {
        chosen.clear();
        choose.disabled = true;
        try {
          const listing = /** @type {Listing} */ (
            await get(`browse?kind=${kind}${dir === null ? "" : `&dir=${encodeURIComponent(dir)}`}`)
          );
          localStorage.setItem(REMEMBERED, listing.dir);
          fill(
            trail,
            crumbs(
              listing,
              (path) => void go(path),
              (path) => void take(path),
            ),
          );
          fill(list, listing.entries.map(row));
          note.textContent = listing.entries.length === 0 ? "Nothing of this kind here." : "";
          /** @type {HTMLElement | null} */ (list.firstElementChild)?.focus();
        } catch (error) {
          if (dir !== null && list.children.length === 0) return go(null);
          note.textContent = sentence(error);
        }
      };
      /** A path that was typed or pasted: of a folder to look into, or of the file itself. */
      const take = async (/** @type {string} */ path) => {
        try {
          const { file } = await get(`browse/which?path=${encodeURIComponent(path)}`);
          if (file === null) return await go(path);
          chosen.clear();
          chosen.add(file);
          finish();
        } catch (error) {
          note.textContent = sentence(error);
        }
      };
      void go(localStorage.getItem(REMEMBERED));
      return [
        h("div", { class: "dialog-body file-browser" }, trail, list, note),
        dialogActions(() => close(null), choose),
      ];
    },
  });
}

/** @param {Listing} listing @param {(path: string) => void} go @param {(path: string) => void} take a path that was typed */
function crumbs(listing, go, take) {
  const button = (/** @type {string} */ path, /** @type {string} */ name) =>
    h("button", { class: "button quiet small", type: "button", onclick: () => go(path) }, name);
  const up = h(
    "button",
    {
      class: "button quiet small icon-only",
      type: "button",
      "aria-label": "Folder above",
      disabled: listing.parent === null,
      onclick: () => listing.parent !== null && go(listing.parent),
    },
    icon("arrow_left"),
  );
  const named = /** @type {Record<string, string>} */ ({ [listing.home]: "Home", [listing.workspace]: "Projects" });
  const roots = listing.roots
    .filter((root) => root !== listing.dir)
    .map((root) => button(root, named[root] ?? root.split("/").filter(Boolean).at(-1) ?? root));
  const path = h("input", {
    class: "input path",
    type: "text",
    "aria-label": "Path of a file or folder",
    title: "Type or paste the path of a file or folder, then Enter",
    spellcheck: "false",
    autocomplete: "off",
    value: listing.dir,
    onkeydown: (/** @type {KeyboardEvent} */ event) => {
      if (event.key !== "Enter") return;
      event.preventDefault();
      take(path.value.trim().replace(/^["']|["']$/g, ""));
    },
  });
  return [
    up,
    path,
    ...(roots.length > 0 ? [h("span", { class: "faint small" }, "Go to"), ...roots] : []),
  ];
}

/** @param {KeyboardEvent} event @param {HTMLElement} element @param {() => void} open */
function onRowKey(event, element, open) {
  const to =
    event.key === "ArrowDown"
      ? element.nextElementSibling
      : event.key === "ArrowUp"
        ? element.previousElementSibling
        : null;
  if (to instanceof HTMLElement) {
    event.preventDefault();
    to.focus();
  } else if (event.key === "Enter" || event.key === " ") {
    event.preventDefault();
    open();
  }
}
