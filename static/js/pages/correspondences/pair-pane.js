// One of the two panes: shows one side of every pair, takes clicks, drags and nudges, and draws ghosts and residuals.

import { Pane } from "../../components/pane.js";
import { Loupe } from "../../components/loupe.js";
import { paneChrome } from "../../components/pane-chrome.js";
import { toast, toastError } from "../../components/toast.js";
import { add, distance, times } from "../../lib/coordinates.js";
import { Emitter } from "../../lib/emitter.js";
import { fixed } from "../../lib/format.js";
import { setView, viewNumbers } from "../../lib/view-state.js";
import { otherSide } from "./slots.js";

/** @typedef {import("../../lib/types.js").Point} Point */
/** @typedef {import("./slots.js").Side} Side */
/** @typedef {import("./slots.js").Slots} Slots */
/** @typedef {import("./slots.js").Half} Half */
/** @typedef {import("./transform.js").FrameName} FrameName */

/**
 * How what is stored (raw px, or metres on the ground) relates to px of the picture shown. Promises where the server
 * must be asked (the undistorted picture); it knows no place, null, where the lens has no image of one.
 * @typedef {object} Mapping
 * @property {(stored: Point[]) => Point[] | Promise<(Point | null)[]>} shown
 * @property {(shown: Point) => Point | Promise<Point | null>} stored
 */

export const ARROW_PX = 26; // CSS px for a residual of one px of the video

/** @type {Mapping} */
export const identity = { shown: (points) => points, stored: (point) => point };

/** @extends {Emitter<{moving: {id: number, side: Side, point: Point}}>} */
export class PairPane extends Emitter {
  mapping = identity;
  /** @type {Map<number, Point>} pair or half to px shown */
  shown = new Map();
  /** @type {Map<number, Point>} predicted places of counterparts, px shown */
  ghosts = new Map();
  /** @type {Map<number, Point>} from mark to where the fit wants it, px shown */
  residuals = new Map();
  /** CSS px for a residual of one px of the picture shown. */
  arrowPx = ARROW_PX;
  #frameName;
  #aims = false;
  /** @type {Promise<void>} */
  #nudges = Promise.resolve();
  #asked = 0;
  /** Where the URL says to look, until there is a picture to look at. */
  #restored;

  /**
   * @param {HTMLElement} element
   * @param {Slots} slots
   * @param {object} options
   * @param {Side} options.side
   * @param {string} options.view  name of the view in the URL
   * @param {string} options.label
   * @param {string} options.title
   * @param {() => FrameName} options.frameName  of the picture shown
   * @param {(point: Point) => string} options.readout
   */
  constructor(element, slots, { side, view, label, title, frameName, readout }) {
    super();
    this.side = side;
    this.slots = slots;
    this.viewName = view;
    this.pane = new Pane(element, { label });
    this.loupe = new Loupe(this.pane);
    this.chrome = paneChrome(this.pane, { title, readout: (point) => [readout(point)] });
    this.#frameName = frameName;
    this.#restored = viewNumbers(view, 3);
    this.#listen();
  }

  /** Frame of reference of the picture shown. */
  get frameName() {
    return this.#frameName();
  }

  /** @param {Half[]} halves @param {(Point | null)[]} places  px shown; null where there is none */
  setGhosts(halves, places) {
    this.ghosts = new Map();
    places.forEach((place, i) => place !== null && this.ghosts.set(halves[i].id, place));
    this.draw();
  }

  /** Look where another view looks, without leading it in turn. @param {Point} middle px shown @param {number} scale */
  follow(middle, scale) {
    this.pane.setView(this.pane.view.centredOn(middle, this.pane.size, scale), { silent: true });
    this.chrome.refresh();
    this.draw();
    this.rememberView();
  }

  /** Put the view into the URL. */
  rememberView() {
    const { centre, view } = this.pane;
    const [u, v] = centre.map((value) => value.toFixed(1));
    setView({ [this.viewName]: `${u},${v},${view.scale.toPrecision(4)}` });
  }

  #restoreView() {
    if (this.#restored === null || this.pane.image === null) return;
    const [u, v, scale] = this.#restored;
    this.#restored = null;
    this.pane.lookAt([u, v], scale);
  }

  /** The place of a pair in this pane, or of its ghost. @param {number} id */
  placeOf(id) {
    return this.shown.get(id) ?? this.ghosts.get(id) ?? null;
  }

  /** Recompute where everything is, after an edit or another mapping. */
  refresh() {
    const entries = [...this.slots.pairs, ...this.slots.halves].filter((entry) => entry[this.side] !== null);
    const ids = entries.map((entry) => entry.id);
    const ask = (this.#asked += 1);
    const take = (/** @type {(Point | null)[]} */ points) => {
      if (ask !== this.#asked || this.pane.isDragging) return;
      this.shown = new Map();
      points.forEach((point, i) => point !== null && this.shown.set(ids[i], point));
      this.draw();
    };
    const answer = this.mapping.shown(entries.map((entry) => /** @type {Point} */ (entry[this.side])));
    if (answer instanceof Promise) answer.then(take, () => undefined);
    else take(answer);
  }

  draw() {
    const { pairs, halves, selected } = this.slots;
    /** @type {import("../../components/shapes.js").Shape[]} */
    const shapes = this.#arrows();
    const mark = (/** @type {number} */ id, /** @type {string} */ look) => {
      const point = this.shown.get(id);
      if (point === undefined) return;
      shapes.push({
        id: `pair-${id}`,
        kind: "mark",
        class: `${look} ${id === selected ? "selected" : ""}`,
        label: String(id),
        points: [point],
        grab: true,
      });
    };
    for (const pair of pairs) mark(pair.id, pair.enabled ? "" : "off");
    for (const half of halves) {
      const ghost = this.ghosts.get(half.id);
      if (half[this.side] !== null) mark(half.id, "pending");
      else if (ghost !== undefined)
        shapes.push({ id: `ghost-${half.id}`, kind: "mark", class: "ghost", label: `${half.id}?`, points: [ghost] });
    }
    if (this.#aims && this.pane.image !== null)
      shapes.push({ id: "aim", kind: "aim", points: [this.pane.centre] });
    this.pane.setShapes(shapes);
    const half = this.slots.waitingFor(this.side);
    this.chrome.setHint(half === null ? "" : `Click completes pair ${half.id}`);
    const scale = fixed(this.#arrowScale, this.#arrowScale < 10 ? 1 : 0);
    this.chrome.setLegend(this.residuals.size === 0 || this.pane.image === null ? "" : `→ residuals × ${scale}`);
  }

  /** Residuals, below all marks and their numbers. @returns {import("../../components/shapes.js").Shape[]} */
  #arrows() {
    return this.slots.pairs.flatMap(({ id, enabled }) => {
      const point = this.shown.get(id);
      const offset = this.residuals.get(id);
      if (point === undefined || offset === undefined || !enabled) return [];
      const points = [point, add(point, times(offset, this.#arrowScale))];
      return [{ id: `residual-${id}`, kind: /** @type {const} */ ("arrow"), class: "residual", points }];
    });
  }

  /** How much residuals are enlarged: as long on the screen at any zoom, but never shorter than they are. */
  get #arrowScale() {
    return Math.max(1, this.arrowPx / this.pane.view.scale);
  }

  /** Zoom to a pair. @param {number} id @param {number} scale */
  goTo(id, scale) {
    const place = this.placeOf(id);
    if (place !== null) this.pane.lookAt(place, Math.max(scale, this.pane.view.scale));
  }

  /** Take the keys, without aiming. */
  focus() {
    this.pane.element.focus({ preventScroll: true });
    this.#setAim(false);
  }

  /** Move the selected mark a little. @param {Point} delta px shown */
  nudge(delta) {
    const id = this.slots.selected;
    const from = id === null ? undefined : this.shown.get(id);
    if (id === null || from === undefined) return;
    const to = this.#within(add(from, delta));
    this.shown.set(id, to);
    this.loupe.show(to);
    this.#store(to, (stored) => this.slots.move(id, this.side, stored, true));
  }

  /** Place at the middle of the pane: the keyboard's click. */
  placeAtAim() {
    this.#place(this.pane.centre);
  }

  #listen() {
    const { pane } = this;
    const idOf = (/** @type {string} */ shapeId) => Number(shapeId.slice("pair-".length));
    pane.on("click", ({ point }) => this.#place(point));
    pane.on("select", ({ id }) => this.slots.select(idOf(id)));
    pane.on("drag", ({ id, point: at }) => {
      const point = this.#within(at);
      this.shown.set(idOf(id), point);
      if (this.slots.selected !== idOf(id)) this.slots.select(idOf(id));
      this.draw();
      const stored = this.mapping.stored(point);
      if (!(stored instanceof Promise)) this.emit("moving", { id: idOf(id), side: this.side, point: stored });
    });
    pane.on("drop", ({ id, point }) =>
      this.#store(this.#within(point), (stored) => this.slots.move(idOf(id), this.side, stored)),
    );
    pane.on("cancel", () => this.refresh());
    pane.on("view", () => this.draw());
    pane.on("picture", () => this.#restoreView());
    pane.element.addEventListener("keydown", ({ key }) => this.#aimsBy(key) && this.#setAim(true));
    pane.element.addEventListener("focus", () => this.#setAim(pane.element.matches(":focus-visible")));
    pane.element.addEventListener("blur", () => this.#setAim(false));
    for (const name of ["pointerdown", "pointermove"])
      pane.element.addEventListener(name, () => this.#setAim(false));
  }

  /** Whether a key moves the view, and so the aim, or places there. @param {string} key */
  #aimsBy(key) {
    const pans = key.startsWith("Arrow") && this.slots.selected === null;
    return pans || ["+", "=", "-", "0", "1", "Enter", " "].includes(key);
  }

  /** @param {Point} point px shown */
  #place(point) {
    if (this.pane.image === null) return;
    if (distance(point, this.#within(point)) > 0) return void toast("Nothing was placed: click within the picture.");
    this.#store(point, (stored) => this.slots.place(this.side, stored));
  }

  /** The place in the picture nearest to a point. @param {Point} point px shown @returns {Point} */
  #within([u, v]) {
    const { width, height } = this.pane.image ?? { width: Infinity, height: Infinity };
    return [Math.min(Math.max(u, -0.5), width - 0.5), Math.min(Math.max(v, -0.5), height - 0.5)];
  }

  /** In the order made, though the server may have to be asked. @param {Point} shown @param {(stored: Point) => void} use */
  #store(shown, use) {
    const stored = this.mapping.stored(shown);
    if (!(stored instanceof Promise)) return use(stored);
    const place = async () => {
      const found = await stored;
      if (found !== null) return use(found);
      toast("Nothing was placed: the lens has no image of this place. Choose one nearer to the middle of the picture.");
      this.refresh();
    };
    this.#nudges = this.#nudges.then(place).catch((error) => {
      toastError(error);
      this.refresh();
    });
  }

  /** @param {boolean} aims */
  #setAim(aims) {
    if (aims === this.#aims) return;
    this.#aims = aims;
    this.draw();
  }
}

/** Halves that need a ghost on a side: clicked on the other side only. @param {Slots} slots @param {Side} side */
export const halvesWithout = (slots, side) =>
  slots.halves.filter((half) => half[side] === null && half[otherSide(side)] !== null);
