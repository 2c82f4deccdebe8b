// Colours of the style sheet for canvases, which cannot follow its variables by themselves.

/**
 * Return a colour variable of the style sheet as a canvas understands it.
 * @param {HTMLElement} element where the variable is looked up
 * @param {string} name for example "--trace-1"
 * @returns {string}
 */
export function colourOf(element, name) {
  const probe = document.createElement("i");
  probe.hidden = true;
  probe.style.color = `var(${name})`;
  element.append(probe);
  const colour = getComputedStyle(probe).color;
  probe.remove();
  return colour;
}

/** @type {Map<string, string>} */
const marks = new Map();

/**
 * Return a colour of marks on imagery. It is the same on any theme, so it is read once and may be asked for while drawing.
 * @param {string} name for example "--mark"
 * @returns {string}
 */
export function markColour(name) {
  const colour = marks.get(name) ?? colourOf(document.body, name);
  marks.set(name, colour);
  return colour;
}

/**
 * Return a colour of `colourOf` with another opacity.
 * @param {string} colour
 * @param {number} opacity 0 to 1
 * @returns {string}
 */
export function faded(colour, opacity) {
  return `color-mix(in srgb, ${colour} ${Math.round(opacity * 100)}%, transparent)`;
}
