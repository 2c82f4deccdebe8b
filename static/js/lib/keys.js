// One table of keys: it binds them, and it is what the help overlay lists. A key cannot be bound and not listed.

/**
 * @typedef {object} KeyBinding
 * @property {string} keys   as listed and bound: "Ctrl+Z", "Shift+ArrowLeft", "L", "?"; alternatives with " / "
 * @property {string} group  heading in the help
 * @property {string} label  what it does
 * @property {(event: KeyboardEvent) => void} [run]  absent: listed only (bound by the browser or a component)
 * @property {() => boolean} [when]  only then
 * @property {boolean} [inFields]  also while typing in a field
 */

/** @type {KeyBinding[]} */
const table = [];

/** Add bindings; where two answer to a key, the later one wins. @param {KeyBinding[]} bindings */
export function bindKeys(bindings) {
  table.push(...bindings);
}

/** @returns {readonly KeyBinding[]} */
export const keyTable = () => table;

const isMac = navigator.platform.startsWith("Mac");

/** Canonical name of what was pressed, as in the table. @param {KeyboardEvent} event */
function keyName(event) {
  const command = event.ctrlKey || event.metaKey;
  const printable = event.key.length === 1 && event.key !== " ";
  const shift = event.shiftKey && (!printable || /[a-z]/i.test(event.key));
  const key = event.key === " " ? "Space" : printable ? event.key.toUpperCase() : event.key;
  return `${command ? "Ctrl+" : ""}${event.altKey ? "Alt+" : ""}${shift ? "Shift+" : ""}${key}`;
}

/** How a key is written for people. @param {string} keys */
export function keyLabel(keys) {
  const arrows = { ArrowLeft: "←", ArrowRight: "→", ArrowUp: "↑", ArrowDown: "↓" };
  const text = keys.replace(/Arrow(Left|Right|Up|Down)/g, (name) => arrows[/** @type {keyof typeof arrows} */ (name)]);
  return isMac ? text.replaceAll("Ctrl+", "⌘").replaceAll("Alt+", "⌥") : text;
}

/** @param {EventTarget | null} target */
function isTyping(target) {
  if (!(target instanceof HTMLElement)) return false;
  if (target instanceof HTMLInputElement) return !["checkbox", "radio", "button"].includes(target.type);
  return target instanceof HTMLTextAreaElement || target instanceof HTMLSelectElement || target.isContentEditable;
}

/** Whether a command goes to the page although a field has the focus: nothing is being typed in it. @param {KeyboardEvent} event */
const isAtRest = ({ target, ctrlKey, metaKey }) =>
  (ctrlKey || metaKey) && target instanceof HTMLInputElement && target.dataset.atRest !== undefined;

/** Whether this element uses the key itself. A choice that holds already has no use for it. @param {EventTarget | null} target @param {string} name */
function isOwnKey(target, name) {
  return (
    (name === "Enter" || name === "Space") &&
    target instanceof Element &&
    target.closest("button:not([role=radio][aria-checked=true]), a, summary, [role=menuitem]") !== null
  );
}

document.addEventListener("keydown", (event) => {
  if (event.defaultPrevented || document.querySelector("dialog[open]") !== null) return;
  const name = keyName(event);
  const typing = isTyping(event.target) && !isAtRest(event);
  if (isOwnKey(event.target, name)) return;
  const binding = table.findLast(
    (entry) =>
      entry.run && entry.keys.split(" / ").includes(name) && (!typing || entry.inFields) && (entry.when?.() ?? true),
  );
  if (!binding?.run) return;
  event.preventDefault();
  binding.run(event);
});
