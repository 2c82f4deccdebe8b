// Pairs and the halves of pairs still waiting for their counterpart. A half counts for nothing and is no part of the
// project; it is kept by the browser, so that a reload or a crash loses no click.

import { Emitter } from "../../lib/emitter.js";

/** @typedef {import("../../lib/types.js").Point} Point */
/** @typedef {import("../../lib/store.js").ProjectStore} ProjectStore */
/** @typedef {"frame_px" | "ground_m"} Side */
/** @typedef {import("../../lib/types.js").Project} Project */
/** @typedef {{id: number, frame_px: Point | null, ground_m: Point | null, on?: number}} Half  on: stamp of the project it was clicked on */

/** @param {Side} side @returns {Side} */
export const otherSide = (side) => (side === "frame_px" ? "ground_m" : "frame_px");

/** @extends {Emitter<{change: null}>} */
export class Slots extends Emitter {
  /** @type {Half[]} in the order clicked */
  halves = [];
  /** @type {number | null} id of a pair or half */
  selected = null;
  /** @type {number | null} id that was selected since the last click that placed something */
  #picked = null;
  /** @type {Half[]} taken back, newest last, until something new is done */
  #taken = [];
  /** @type {{halves: Half[], before: number, after: number} | null} halves that went with all pairs */
  #cleared = null;
  #key;

  /** @param {ProjectStore} store */
  constructor(store) {
    super();
    this.store = store;
    this.#key = `rooftrack-halves:${store.id}`;
    this.halves = JSON.parse(localStorage.getItem(this.#key) ?? "[]");
    store.on("change", (change) => this.#onProject(change));
    this.#tidy();
  }

  get pairs() {
    return this.store.project.correspondences;
  }

  /**
   * The half that the next click on a side completes: the one a person picked out, else the oldest, so that places
   * clicked one after another in one picture are completed in the same order in the other.
   * @param {Side} side
   */
  waitingFor(side) {
    const waiting = this.halves.filter((half) => half[side] === null);
    return waiting.find((half) => half.id === this.#picked) ?? waiting[0] ?? null;
  }

  /** A click on a side: fills the next free slot, or opens one. @param {Side} side @param {Point} point @returns {number} id of the pair */
  place(side, point) {
    const half = this.waitingFor(side);
    if (half === null) {
      const id = this.#nextId();
      const fresh = /** @type {Half} */ ({ id, frame_px: null, ground_m: null, on: stampOf(this.store.project) });
      fresh[side] = point;
      this.#taken = [];
      this.#setHalves([...this.halves, fresh], id);
      return id;
    }
    this.#complete(half.id, side, point);
    return half.id;
  }

  /** Move one side of a pair or half; `merge` joins nudges into one undo step. @param {number} id @param {Side} side @param {Point} point @param {boolean} [merge] */
  move(id, side, point, merge = false) {
    const half = this.halves.find((entry) => entry.id === id);
    if (half !== undefined) {
      if (half[side] === null) this.#complete(id, side, point);
      else
        this.#setHalves(
          this.halves.map((entry) => (entry.id === id ? { ...entry, [side]: point } : entry)),
          id,
        );
      return;
    }
    const change = (/** @type {import("../../lib/types.js").Project} */ draft) => {
      const pair = draft.correspondences.find((entry) => entry.id === id);
      if (pair) pair[side] = point;
    };
    void this.store.edit(`${merge ? "Nudge" : "Move"} pair ${id}`, change, { merge });
  }

  /** @param {number} id */
  remove(id) {
    if (this.halves.some((half) => half.id === id))
      return this.#setHalves(
        this.halves.filter((half) => half.id !== id),
        null,
      );
    const next = this.neighbour(1, id);
    this.select(next === id ? null : next);
    void this.store.edit(`Delete pair ${id}`, (draft) => {
      draft.correspondences = draft.correspondences.filter((pair) => pair.id !== id);
    });
  }

  /** @param {number} id */
  toggle(id) {
    const pair = this.pairs.find((entry) => entry.id === id);
    if (pair === undefined) return;
    void this.store.edit(`Switch pair ${id} ${pair.enabled ? "off" : "on"}`, (draft) => {
      for (const entry of draft.correspondences) if (entry.id === id) entry.enabled = !pair.enabled;
    });
  }

  /** All pairs, and the halves with them. @param {string} [label] @param {(draft: Project) => void} [also] */
  removeAll(label = "Delete all pairs", also = () => undefined) {
    const before = stampOf(this.store.project);
    const { halves } = this;
    this.#setHalves([], null);
    void this.store.edit(label, (draft) => {
      draft.correspondences = [];
      also(draft);
    });
    this.#cleared = { halves, before, after: stampOf(this.store.project) };
  }

  /** Give up the newest half. */
  dropNewestHalf() {
    this.#taken.push(...this.halves.slice(-1));
    this.#setHalves(this.halves.slice(0, -1), null);
  }

  /** Whether the newest half is newer than every edit of the project: then it is what undo takes back. */
  get isHalfNewest() {
    return this.halves.length > 0 && this.halves.at(-1)?.on === stampOf(this.store.project);
  }

  /** Whether the last thing undone was a half. */
  get isHalfNext() {
    return this.#taken.length > 0 && this.#taken.at(-1)?.on === stampOf(this.store.project);
  }

  /** Bring back the half taken last. */
  bringBack() {
    const half = this.#taken.pop();
    if (half !== undefined) this.#setHalves([...this.halves, half], half.id);
    this.#tidy();
  }

  /** @param {number | null} id */
  select(id) {
    this.selected = this.#picked = id;
    this.emit("change", null);
  }

  /** Next or previous pair in an order of ids. @param {number} step @param {number | null} from @param {number[]} [order] */
  neighbour(step, from, order = this.pairs.map((pair) => pair.id)) {
    if (order.length === 0) return null;
    const at = from === null ? -1 : order.indexOf(from);
    if (at === -1) return step > 0 ? order[0] : order[order.length - 1];
    return order[(at + step + order.length) % order.length];
  }

  /** @param {number} id @param {Side} side @param {Point} point */
  #complete(id, side, point) {
    const half = this.halves.find((entry) => entry.id === id);
    if (half === undefined) return;
    const pair = { id, ground_m: half.ground_m ?? point, frame_px: half.frame_px ?? point, enabled: true };
    pair[side] = point;
    this.#setHalves(
      this.halves.filter((entry) => entry.id !== id),
      id,
    );
    void this.store.edit(`Add pair ${id}`, (draft) => {
      if (draft.correspondences.some((entry) => entry.id === id))
        pair.id = Math.max(...draft.correspondences.map((entry) => entry.id)) + 1;
      draft.correspondences.push(pair);
    });
  }

  #nextId() {
    return Math.max(0, ...this.pairs.map((pair) => pair.id), ...this.halves.map((half) => half.id)) + 1;
  }

  /** @param {Half[]} halves @param {number | null} selected */
  #setHalves(halves, selected) {
    this.halves = halves;
    this.selected = selected;
    this.#picked = null;
    localStorage.setItem(this.#key, JSON.stringify(halves));
    this.emit("change", null);
  }

  /** @param {{project: Project, previous: Project, origin: string}} change */
  #onProject({ project, previous, origin }) {
    if (origin === "edit") this.#taken = [];
    if (origin === "saved") this.#restamp(stampOf(previous), stampOf(project));
    if (origin === "undo" && this.#cleared !== null) {
      const now = stampOf(project);
      if (now === this.#cleared.before) this.halves = [...this.#cleared.halves, ...this.halves];
      if (now === this.#cleared.after) this.halves = [];
    }
    this.#tidy();
  }

  /** What is saved may be written otherwise than it was edited, and is the same. @param {number} before @param {number} after */
  #restamp(before, after) {
    const led = (/** @type {number | undefined} */ stamp) => (stamp === before ? after : stamp);
    this.halves = this.halves.map((half) => ({ ...half, on: led(half.on) }));
    if (this.#cleared !== null) this.#cleared.after = led(this.#cleared.after) ?? after;
  }

  /** After edits from anywhere: no half under a pair's number, no selection of what is gone. */
  #tidy() {
    const taken = new Set(this.pairs.map((pair) => pair.id));
    const halves = this.halves.filter((half) => !taken.has(half.id));
    const known =
      this.selected === null || taken.has(this.selected) || halves.some((half) => half.id === this.selected);
    this.#setHalves(halves, known ? this.selected : null);
  }
}

/** A short name for what a project says: two with the same say the same. @param {Project} project */
function stampOf(project) {
  let stamp = 0;
  for (const character of JSON.stringify(project)) stamp = (Math.imul(stamp, 31) + character.charCodeAt(0)) | 0;
  return stamp;
}
