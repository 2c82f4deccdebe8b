// A table one can sort, select in and move through with the arrow keys.

import { fill, h } from "../lib/dom.js";

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
 * @param {object} options
 * @param {string} options.label
 * @param {Column<Row>[]} options.columns
 * @param {(row: Row) => string} options.id
 * @param {(row: Row) => void} [options.onSelect]
 * @param {(row: Row) => void} [options.onOpen]  Enter or double click
 * @param {(row: Row) => string} [options.rowClass]
 * @param {string} [options.empty]
 */
export function sortableTable({ label, columns, id, onSelect, onOpen, rowClass, empty = "Nothing yet." }) {
  const head = h("tr");
  const body = h("tbody");
  const element = h("table", { class: "table", "aria-label": label }, h("thead", {}, head), body);
  /** @type {Row[]} */
  let rows = [];
  /** @type {string | null} */
  let selected = null;
  /** @type {{key: string, down: boolean} | null} */
  let order = null;

  const sorted = () => {
    const column = columns.find((entry) => entry.key === order?.key);
    if (!column?.sort || order === null) return rows;
    const { sort } = column;
    const sign = order.down ? -1 : 1;
    return [...rows].sort((a, b) => sign * compare(sort(a), sort(b), order?.down ?? false));
  };
  const toggle = (/** @type {string} */ key) => {
    if (order?.key !== key) order = { key, down: true };
    else if (order.down) order = { key, down: false };
    else order = null;
    show();
  };
  const show = () => {
    const focused =
      document.activeElement instanceof HTMLTableRowElement && body.contains(document.activeElement)
        ? document.activeElement.dataset.id
        : null;
    fill(
      head,
      columns.map((column) => heading(column, order, toggle)),
    );
    if (rows.length === 0) return fill(body, h("tr", { class: "empty" }, h("td", { colspan: columns.length }, empty)));
    fill(
      body,
      sorted().map((row) => tableRow(row)),
    );
    if (focused)
      /** @type {HTMLElement | null} */ (body.querySelector(`tr[data-id="${CSS.escape(focused)}"]`))?.focus();
  };
  const tableRow = (/** @type {Row} */ row) => {
    const key = id(row);
    const cells = columns.map((column) =>
      h("td", { class: `${column.number ? "number" : ""} ${column.tone?.(row) ?? ""}` }, column.cell(row)),
    );
    return h(
      "tr",
      {
        "data-id": key,
        tabindex: 0,
        class: rowClass?.(row) ?? "",
        "aria-selected": key === selected ? "true" : "false",
        onclick: () => onSelect?.(row),
        ondblclick: () => onOpen?.(row),
      },
      cells,
    );
  };
  body.addEventListener("keydown", (event) => {
    if (!(event.target instanceof HTMLTableRowElement)) return;
    const row = rows.find((entry) => id(entry) === /** @type {HTMLElement} */ (event.target).dataset.id);
    const next =
      event.key === "ArrowDown"
        ? event.target.nextElementSibling
        : event.key === "ArrowUp"
          ? event.target.previousElementSibling
          : null;
    if (next instanceof HTMLElement) {
      event.preventDefault();
      next.focus();
      const moved = rows.find((entry) => id(entry) === next.dataset.id);
      if (moved) onSelect?.(moved);
    } else if (event.key === "Enter" && row) {
      event.preventDefault();
      (onOpen ?? onSelect)?.(row);
    }
  });
  show();
  return {
    element,
    /** Ids in the order shown. */
    order: () => sorted().map(id),
    /** @param {Row[]} newRows */
    setRows(newRows) {
      rows = newRows;
      show();
    },
    /** @param {string | null} key */
    select(key) {
      selected = key;
      for (const row of body.querySelectorAll("tr[data-id]")) {
        const on = /** @type {HTMLElement} */ (row).dataset.id === key;
        row.setAttribute("aria-selected", String(on));
        if (on) row.scrollIntoView({ block: "nearest" });
      }
    },
  };
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
