// Building and finding elements. The content security policy allows no style attribute in markup:
// colours and sizes belong to the style sheets; what changes by the moment is set on `element.style`.

/** @typedef {Node | string | number | null | undefined | false} Child */
/** @typedef {Record<string, string | number | boolean | null | undefined | ((event: any) => void)>} Attributes */

const SVG = "http://www.w3.org/2000/svg";

/**
 * Make an HTML element. `onclick: fn` listens, `true` sets an empty attribute, `false`/null leaves it out.
 * @template {keyof HTMLElementTagNameMap} Tag
 * @param {Tag} tag
 * @param {Attributes} [attributes]
 * @param {...(Child | Child[])} children
 * @returns {HTMLElementTagNameMap[Tag]}
 */
export function h(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  decorate(element, attributes);
  element.append(...nodes(children));
  return element;
}

/**
 * Make an SVG element.
 * @template {keyof SVGElementTagNameMap} Tag
 * @param {Tag} tag
 * @param {Attributes} [attributes]
 * @param {...(Child | Child[])} children
 * @returns {SVGElementTagNameMap[Tag]}
 */
export function svg(tag, attributes = {}, ...children) {
  const element = document.createElementNS(SVG, tag);
  decorate(element, attributes);
  element.append(...nodes(children));
  return element;
}

/** Set, change or (null, false) remove attributes and listeners. @param {Element} element @param {Attributes} attributes */
export function decorate(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(name.replace(/^on/, ""), value);
    else if (value === null || value === undefined || value === false) element.removeAttribute(name);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
}

/** Replace everything inside. @param {Element} element @param {...(Child | Child[])} children */
export function fill(element, ...children) {
  element.replaceChildren(...nodes(children));
}

/**
 * Replace what changes inside. What looks the same stays, with its focus and its listeners: it must do the same, too.
 * A press and its release are a click only on what has stayed, and the press itself may bring news: it takes the focus
 * out of a field whose number is then saved.
 * @param {Element} element
 * @param {...(Child | Child[])} children
 */
export function refill(element, ...children) {
  const present = [...element.childNodes];
  const wanted = nodes(children)
    .map((child) => (child instanceof Node ? child : new Text(child)))
    .map((node, i) => (node.isEqualNode(present[i] ?? null) ? present[i] : node));
  for (const node of present) if (!wanted.includes(node)) node.remove();
  wanted.forEach((node, i) => {
    const there = element.childNodes[i] ?? null;
    if (there !== node) element.insertBefore(node, there);
  });
}

/**
 * The element a page must have; its absence is our mistake, so it throws.
 * @template {Element} [Kind=HTMLElement]
 * @param {string} selector
 * @param {new () => Kind} [kind]
 * @param {ParentNode} [root]
 * @returns {Kind}
 */
export function find(selector, kind = /** @type {any} */ (HTMLElement), root = document) {
  const element = root.querySelector(selector);
  if (!(element instanceof kind)) throw new Error(`page has no ${kind.name} at "${selector}"`);
  return element;
}

/** @param {(Child | Child[])[]} children @returns {(Node | string)[]} */
function nodes(children) {
  return children
    .flat()
    .filter((child) => child !== null && child !== undefined && child !== false)
    .map((child) => (child instanceof Node ? child : String(child)));
}
