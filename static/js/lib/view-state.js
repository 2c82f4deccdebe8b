// The URL is the state of a view: what is selected, where one looks. A link or a reload shows the same.

/** @param {string} name @returns {string | null} */
export const viewText = (name) => new URLSearchParams(location.search).get(name);

/** @param {string} name @param {number} fallback */
export function viewNumber(name, fallback) {
  const text = viewText(name);
  const value = text === null || text === "" ? NaN : Number(text);
  return Number.isFinite(value) ? value : fallback;
}

/** Numbers joined by commas, or null. @param {string} name @param {number} length @returns {number[] | null} */
export function viewNumbers(name, length) {
  const values = (viewText(name) ?? "").split(",").map(Number);
  return values.length === length && values.every(Number.isFinite) ? values : null;
}

/** @type {Record<string, string | number | null>} */
let waiting = {};
let timer = 0;

/**
 * Write values to the query string (null removes), without a history entry: at once, but of many in quick turn, such as
 * while one drags, the first and the last. Browsers refuse more than some hundred changes in half a minute.
 * @param {Record<string, string | number | null>} values
 */
export function setView(values) {
  waiting = { ...waiting, ...values };
  if (timer === 0) flushView();
  window.clearTimeout(timer);
  timer = window.setTimeout(settle, 200);
}

function settle() {
  timer = 0;
  flushView();
}

function flushView() {
  if (Object.keys(waiting).length === 0) return;
  const query = new URLSearchParams(location.search);
  for (const [name, value] of Object.entries(waiting)) {
    if (value === null || value === "") query.delete(name);
    else query.set(name, String(value));
  }
  waiting = {};
  const search = query.toString().replaceAll("%2C", ",");
  history.replaceState(history.state, "", search === "" ? location.pathname : `${location.pathname}?${search}`);
}
