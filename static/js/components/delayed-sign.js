// A sign that an answer is awaited. What is quick needs none, so it comes only after a while and nothing flickers.

/** An answer that is quicker is taken for immediate. */
export const FAINT_AFTER_MS = 120;

/**
 * @param {number} after_ms
 * @param {(on: boolean) => void} show
 */
export function delayedSign(after_ms, show) {
  /** @type {number | null} */
  let timer = null;
  let shown = false;
  const set = (/** @type {boolean} */ on) => {
    shown = on;
    show(on);
  };
  return {
    get shown() {
      return shown;
    },
    /** An answer is awaited, perhaps for some time already. */
    begin() {
      timer ??= window.setTimeout(() => set(true), after_ms);
    },
    /** The answer is here. */
    end() {
      if (timer !== null) window.clearTimeout(timer);
      timer = null;
      if (shown) set(false);
    },
  };
}
