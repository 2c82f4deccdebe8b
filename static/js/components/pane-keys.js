// Keys every image pane answers to while it has the focus; where none has, the one a person works in may answer.

/** @typedef {import("./pane.js").Pane} Pane */
/** @typedef {import("../lib/keys.js").KeyBinding} KeyBinding */

const ARROWS = "ArrowLeft / ArrowRight / ArrowUp / ArrowDown";
/** @type {Record<string, import("../lib/types.js").Point>} */
const DIRECTIONS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const PAN_STEP_PX = 40;

/** @param {string} prefix "Shift+" or "Alt+" */
const arrowsWith = (prefix) =>
  ARROWS.split(" / ")
    .map((key) => prefix + key)
    .join(" / ");

/** Direction of an arrow key: u right, v down. @param {KeyboardEvent} event */
const arrowDirection = (event) => DIRECTIONS[event.key];

/** The pane with the focus, else the one under the pointer, else the one used last. @param {Pane[]} panes */
export const activePane = (panes) =>
  panes.find((pane) => pane.hasFocus) ??
  panes.find((pane) => pane.cursor !== null) ??
  panes.reduce((last, pane) => (pane.usedAt > last.usedAt ? pane : last), panes[0]);

/** The pane with the focus. @param {Pane[]} panes */
const focusedPane = (panes) => panes.find((pane) => pane.hasFocus);

/**
 * Zoom, fit and pan of the focused pane.
 * @param {Pane[]} panes
 * @param {{canPan?: () => boolean, chosen?: (panes: Pane[]) => Pane | undefined}} [options]  canPan: false while arrows
 *   nudge something; chosen: which pane answers
 * @returns {KeyBinding[]}
 */
export function paneKeys(panes, { canPan = () => true, chosen = focusedPane } = {}) {
  const focused = () => chosen(panes);
  const has = () => focused() !== undefined;
  const pan = (/** @type {KeyboardEvent} */ event) => {
    const [u, v] = arrowDirection(event);
    focused()?.pan(-u * PAN_STEP_PX, -v * PAN_STEP_PX);
  };
  return [
    {
      keys: "+ / =",
      group: "Looking",
      label: "Zoom in (or turn the wheel, at the pointer)",
      run: () => focused()?.zoom(1.4),
      when: has,
    },
    { keys: "-", group: "Looking", label: "Zoom out", run: () => focused()?.zoom(1 / 1.4), when: has },
    { keys: "0", group: "Looking", label: "Whole picture", run: () => focused()?.fit(), when: has },
    {
      keys: "1",
      group: "Looking",
      label: "One to one",
      run: () => focused()?.lookAt(/** @type {Pane} */ (focused()).centre, 1 / window.devicePixelRatio),
      when: has,
    },
    { keys: ARROWS, group: "Looking", label: "Pan (or drag)", run: pan, when: () => has() && canPan() },
  ];
}

/**
 * Nudging of what is selected, in the active pane: 0.1, with Shift 1, with Alt 0.02 image px.
 * @param {Pane[]} panes
 * @param {{what: string, when: (pane: Pane) => boolean, nudge: (pane: Pane, delta: import("../lib/types.js").Point) => void}} options
 * @returns {KeyBinding[]}
 */
export function nudgeKeys(panes, { what, when, nudge }) {
  const binding = (/** @type {string} */ prefix, /** @type {number} */ step) => ({
    keys: arrowsWith(prefix),
    group: "Placing",
    label: `Nudge ${what} by ${step} px`,
    when: () => when(activePane(panes)),
    run: (/** @type {KeyboardEvent} */ event) => {
      const [u, v] = arrowDirection(event);
      nudge(activePane(panes), [u * step, v * step]);
    },
  });
  return [binding("", 0.1), binding("Shift+", 1), binding("Alt+", 0.02)];
}
