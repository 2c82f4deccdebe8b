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

/** @typedef {"video" | "cloud" | "lens" | "gps" | "image"} FileKind */

/**
 * @param {{title: string, kind: FileKind, multiple?: boolean}} options
 * @returns {Promise<string[] | null>} absolute paths
 */
export function chooseFiles({ title, kind, multiple = false }) {
  return openDialog({
    title,
    size: "wide tall",
    body: (close) => {
      const browser = new FileBrowser(kind, multiple, close);
      void browser.go(localStorage.getItem(REMEMBERED));
      return [browser.element, dialogActions(() => close(null), browser.button)];
    },
  });
}

/** A folder at a time, with what is chosen in it. */
class FileBrowser {
  /** @type {Set<string>} */
  #chosen = new Set();
  /** The row that the last single click or the first one of a double click met. @type {HTMLElement | null} */
  #clicked = null;
  /** How many folders were asked for: only what is asked last is shown, whenever it is answered. */
  #asked = 0;
  #trail = h("nav", { class: "file-trail", "aria-label": "Folder" });
  #note = h("p", { class: "soft small", role: "status" });

  /** @param {FileKind} kind @param {boolean} multiple @param {(paths: string[]) => void} onChosen */
  constructor(kind, multiple, onChosen) {
    this.kind = kind;
    this.multiple = multiple;
    this.onChosen = onChosen;
    this.list = h("ul", {
      class: "file-list",
      role: "listbox",
      "aria-label": "Files",
      "aria-multiselectable": String(multiple),
    });
    this.element = h("div", { class: "dialog-body file-browser" }, this.#trail, this.list, this.#note);
    this.button = h(
      "button",
      { class: "button primary", type: "button", disabled: true, onclick: () => this.#finish() },
      "Choose",
    );
  }

  /** Show a folder; null is where the server begins. @param {string | null} dir @returns {Promise<void>} */
  async go(dir) {
    const turn = (this.#asked += 1);
    this.#chosen.clear();
    this.button.disabled = true;
    try {
      const where = dir === null ? "" : `&dir=${encodeURIComponent(dir)}`;
      const listing = /** @type {Listing} */ (await get(`browse?kind=${this.kind}${where}`));
      if (turn === this.#asked) this.#show(listing);
    } catch (error) {
      if (turn !== this.#asked) return;
      if (dir !== null && this.list.children.length === 0) return this.go(null); // the folder of last time may be gone
      this.#note.textContent = sentence(error);
    }
  }

  /** @param {Listing} listing */
  #show(listing) {
    localStorage.setItem(REMEMBERED, listing.dir);
    fill(
      this.#trail,
      crumbs(
        listing,
        (path) => void this.go(path),
        (path) => void this.#take(path),
      ),
    );
    fill(this.list, listing.entries.map(this.#row, this));
    this.#note.textContent = listing.entries.length === 0 ? "Nothing of this kind here." : "";
    /** @type {HTMLElement | null} */ (this.list.firstElementChild)?.focus();
  }

  /** A path that was typed or pasted: of a folder to look into, or of the file itself. @param {string} path */
  async #take(path) {
    try {
      const { file } = await get(`browse/which?path=${encodeURIComponent(path)}`);
      if (file === null) return await this.go(path);
      this.#chosen = new Set([file]);
      this.#finish();
    } catch (error) {
      this.#note.textContent = sentence(error);
    }
  }

  /** @param {Entry} entry */
  #row(entry) {
    const element = fileRow(entry);
    const pick = () => this.#pick(element, entry.path);
    const open = () => this.#open(element, entry);
    // The second click of a double click may meet the list of the folder that the first one opened.
    element.addEventListener("click", (event) => {
      if (event.detail <= 1) this.#clicked = element;
      if (this.#clicked === element) (entry.is_dir ? open : pick)();
    });
    element.addEventListener("dblclick", () => this.#clicked === element && !entry.is_dir && open());
    element.addEventListener("keydown", (event) => onRowKey(event, element, open));
    return element;
  }

  /** Enter a folder, or take a file; of many files each is picked, and the button takes them. @param {HTMLElement} element @param {Entry} entry */
  #open(element, entry) {
    if (entry.is_dir) return void this.go(entry.path);
    this.#pick(element, entry.path);
    if (!this.multiple) this.#finish();
  }

  /** @param {HTMLElement} element @param {string} path */
  #pick(element, path) {
    if (!this.multiple) this.#chosen.clear();
    if (this.#chosen.has(path)) this.#chosen.delete(path);
    else this.#chosen.add(path);
    for (const item of this.list.children) {
      const isChosen = this.#chosen.has(/** @type {HTMLElement} */ (item).dataset.path ?? "");
      item.setAttribute("aria-selected", String(isChosen));
    }
    this.button.disabled = this.#chosen.size === 0;
    this.button.textContent = this.#chosen.size > 1 ? `Choose ${this.#chosen.size} files` : "Choose";
    element.focus();
  }

  #finish() {
    if (this.#chosen.size > 0) this.onChosen([...this.#chosen]);
  }
}

/** @param {Entry} entry */
const fileRow = (entry) =>
  h(
    "li",
    { role: "option", tabindex: 0, "aria-selected": "false", "data-path": entry.path },
    icon(ICONS[entry.kind ?? ""] ?? (entry.is_dir ? "folder" : "file")),
    h("span", { class: "name" }, entry.name),
    h("span", { class: "faint number" }, entry.is_dir ? "" : size(entry.size)),
  );

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
