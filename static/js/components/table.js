// A table one can sort, select in and move through with the arrow keys.

import { decorate, h, refill } from "../lib/dom.js";

/**
 * @template Row
 * @typedef {object} Column
 * @property {string} key
 * @property {string} title
 * @property {string} [hint]  shown on the heading
 * @property {(row: Row) => import("../lib/dom.js").Child} cell
 * @property {(row: Row) => number | string | null} [sort]  absent: cannot be sorted by
 * @property {boolean} [number]  right-aligned figures
 * @property {(row: Row) => string} [tone]  class of the cell
 */

/**
 * @template Row
 * @typedef {object} TableOptions
 * @property {string} label
 * @property {Column<Row>[]} columns
 * @property {(row: Row) => string} id
 * @property {(row: Row) => void} [onSelect]
 * @property {(row: Row) => void} [onOpen]  Enter or double click
 * @property {(row: Row) => string} [rowClass]
 * @property {string} [empty]
 */

/** @template Row */
export class SortableTable {
  /** @type {Row[]} */
  #rows = [];
  /** @type {string | null} */
  #selected = null;
  /** @type {{key: string, down: boolean} | null} */
  #order = null;
  /** By id; a row stays while its figures change, so that a click begun on it ends on it. @type {Map<string, HTMLTableRowElement>} */
  #shown = new Map();
  #head = h("tr");
  #body = h("tbody");

  /** @param {TableOptions<Row>} options */
  constructor(options) {
    this.options = options;
    this.element = h("table", { class: "table", "aria-label": options.label }, h("thead", {}, this.#head), this.#body);
    this.#body.addEventListener("keydown", (event) => this.#onKey(event));
    this.#show();
  }

  /** Ids in the order shown. */
  order() {
    return this.#sorted().map(this.options.id);
  }

  /** @param {Row[]} rows */
  setRows(rows) {
    this.#rows = rows;
    this.#show();
  }

  /** @param {string | null} key */
  select(key) {
    this.#selected = key;
    for (const [id, row] of this.#shown) {
      const on = id === key;
      row.setAttribute("aria-selected", String(on));
      if (on) row.scrollIntoView({ block: "nearest" });
    }
  }

  #sorted() {
    const order = this.#order;
    const sort = this.options.columns.find((column) => column.key === order?.key)?.sort;
    if (sort === undefined || order === null) return this.#rows;
    const sign = order.down ? -1 : 1;
    return [...this.#rows].sort((a, b) => sign * compare(sort(a), sort(b), order.down));
  }

  /** Downwards first, then upwards, then as given. @param {string} key */
  #turn(key) {
    if (this.#order?.key !== key) this.#order = { key, down: true };
    else this.#order = this.#order.down ? { key, down: false } : null;
    this.#show();
  }

  #show() {
    const { columns, empty = "Nothing yet." } = this.options;
    const focused = this.#body.contains(document.activeElement) ? keyOf(document.activeElement) : null;
    refill(
      this.#head,
      columns.map((column) => heading(column, this.#order, (key) => this.#turn(key))),
    );
    const rows = this.#sorted().map((row) => this.#tableRow(row));
    this.#shown = new Map(rows.map((row) => [row.dataset.id ?? "", row]));
    const none = () => h("tr", { class: "empty" }, h("td", { colspan: columns.length }, empty));
    refill(this.#body, rows.length === 0 ? none() : rows);
    if (focused) this.#shown.get(focused)?.focus();
  }

  /** @param {Row} row */
  #tableRow(row) {
    const { columns, id, rowClass } = this.options;
    const key = id(row);
    const element = this.#shown.get(key) ?? this.#emptyRow(key);
    decorate(element, { class: rowClass?.(row) ?? "", "aria-selected": String(key === this.#selected) });
    columns.forEach((column, i) => {
      element.cells[i].className = `${column.number ? "number" : ""} ${column.tone?.(row) ?? ""}`;
      refill(element.cells[i], column.cell(row));
    });
    return element;
  }

  /** @param {string} key */
  #emptyRow(key) {
    const { columns, onSelect, onOpen } = this.options;
    const run = (/** @type {((row: Row) => void) | undefined} */ act) => {
      const row = this.#rowOf(element);
      if (row) act?.(row);
    };
    const element = h(
      "tr",
      { "data-id": key, tabindex: 0, onclick: () => run(onSelect), ondblclick: () => run(onOpen) },
      columns.map(() => h("td")),
    );
    return element;
  }

  /** @param {KeyboardEvent} event */
  #onKey(event) {
    const { onSelect, onOpen } = this.options;
    const row = this.#rowOf(event.target);
    const next = neighbour(event);
    if (next instanceof HTMLElement) {
      event.preventDefault();
      next.focus();
      const moved = this.#rowOf(next);
      if (moved) onSelect?.(moved);
    } else if (event.key === "Enter" && row) {
      event.preventDefault();
      (onOpen ?? onSelect)?.(row);
    }
  }

  /** @param {EventTarget | null} element */
  #rowOf(element) {
    const key = keyOf(element);
    return this.#rows.find((row) => this.options.id(row) === key);
  }
}

/** Id of the row that an element is; none for what is inside of one. @param {EventTarget | null} element */
const keyOf = (element) => (element instanceof HTMLTableRowElement ? element.dataset.id : undefined);

/** The row above or below, for the arrow keys. @param {KeyboardEvent} event */
function neighbour({ key, target }) {
  if (!(target instanceof HTMLTableRowElement)) return null;
  if (key === "ArrowDown") return target.nextElementSibling;
  return key === "ArrowUp" ? target.previousElementSibling : null;
}

/** @param {Column<any>} column @param {{key: string, down: boolean} | null} order @param {(key: string) => void} toggle */
function heading(column, order, toggle) {
  const direction = order?.key === column.key ? (order.down ? "descending" : "ascending") : null;
  const arrow = direction === null ? "" : direction === "descending" ? " ↓" : " ↑";
  const content = column.sort
    ? h(
        "button",
        { type: "button", title: column.hint ?? null, onclick: () => toggle(column.key) },
        column.title + arrow,
      )
    : h("span", { title: column.hint ?? null }, column.title);
  return h("th", { scope: "col", class: column.number ? "number" : "", "aria-sort": direction }, content);
}

/** Missing values always last. @param {number | string | null} a @param {number | string | null} b @param {boolean} down */
function compare(a, b, down) {
  if (a === null || b === null) return a === b ? 0 : (a === null) === down ? -1 : 1;
  return a < b ? -1 : a > b ? 1 : 0;
}
