// Targets as a person makes them. The project holds complete targets only (all three bands, or a region); one that is
// still being drawn is kept by the browser, and joins the project with its last click.

import { Emitter } from "./emitter.js";

/** @typedef {import("./types.js").Target} Target */
/** @typedef {import("./types.js").Lines} Lines */
/** @typedef {import("./store.js").ProjectStore} ProjectStore */
/** @typedef {Omit<Target, "lines"> & {lines: Partial<Lines> | null}} OpenTarget */

/** @type {RegExp} as in core/project.py */
export const TARGET_NAME = /^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$/;

/** @param {OpenTarget} target @returns {target is Target} */
export function isComplete(target) {
  if (target.kind === "points") return (target.region_m?.length ?? 0) >= 3;
  return target.lines?.L1 !== undefined && target.lines.L2 !== undefined && target.lines.T1 !== undefined;
}

/** @extends {Emitter<{change: null}>} */
export class Targets extends Emitter {
  /** @type {OpenTarget[]} */
  #open = [];
  /** @type {string | null} */
  #selected = null;
  #key;

  /** @param {ProjectStore} store */
  constructor(store) {
    super();
    this.store = store;
    this.#key = `rooftrack-targets:${store.id}`;
    this.#open = JSON.parse(localStorage.getItem(this.#key) ?? "[]");
    store.on("change", () => this.#keepOpen(this.#open));
  }

  /** @returns {OpenTarget[]} those of the project, then those still open */
  get all() {
    const stored = this.store.project.targets;
    return [...stored, ...this.#open.filter((target) => !stored.some((other) => other.name === target.name))];
  }

  /** @returns {OpenTarget | null} */
  get selected() {
    return this.all.find((target) => target.name === this.#selected) ?? this.all[0] ?? null;
  }

  /** @param {string} name */
  select(name) {
    this.#selected = name;
    this.emit("change", null);
  }

  /** A new open target with a free name. @param {"lines" | "points"} kind @param {Partial<OpenTarget>} [known] @returns {OpenTarget} */
  add(kind, known = {}) {
    const taken = new Set(this.all.map((target) => target.name));
    const names = ["roof", "table", ...Array.from({ length: 98 }, (_, i) => `target-${i + 3}`)];
    const name = names.find((candidate) => !taken.has(candidate)) ?? `target-${Date.now()}`;
    const target = {
      name,
      kind,
      height_m: null,
      p1_p2_m: null,
      lines: null,
      region_m: null,
      relative_to: null,
      ...known,
    };
    this.#selected = name;
    this.#keepOpen([...this.#open, target]);
    return target;
  }

  /**
   * Change a target wherever it is.
   * @param {string} name
   * @param {string} label  of the undo step
   * @param {(target: OpenTarget) => void} change
   * @param {{merge?: boolean}} [options]
   */
  change(name, label, change, { merge = false } = {}) {
    if (this.store.project.targets.some((target) => target.name === name)) {
      void this.store.edit(label, (draft) => draft.targets.filter((target) => target.name === name).forEach(change), {
        merge,
      });
      return;
    }
    const open = structuredClone(this.#open);
    open.filter((target) => target.name === name).forEach(change);
    const done = open.find((target) => target.name === name);
    if (done === undefined || !isComplete(done)) return this.#keepOpen(open);
    this.#open = open.filter((target) => target !== done);
    void this.store.edit(`Add target ${name}`, (draft) => void draft.targets.push(done));
  }

  /** Another name, also where others refer to it. @param {string} from @param {string} to */
  rename(from, to) {
    if (this.#selected === from) this.#selected = to;
    if (!this.store.project.targets.some((target) => target.name === from)) {
      return this.#keepOpen(this.#open.map((target) => (target.name === from ? { ...target, name: to } : target)));
    }
    this.#refer(from, to);
    void this.store.edit(`Rename ${from} to ${to}`, (draft) => {
      for (const target of draft.targets) {
        if (target.name === from) target.name = to;
        if (target.relative_to === from) target.relative_to = to;
      }
    });
  }

  /** @param {string} name */
  remove(name) {
    if (!this.store.project.targets.some((target) => target.name === name))
      return this.#keepOpen(this.#open.filter((target) => target.name !== name));
    this.#refer(name, null);
    void this.store.edit(`Delete target ${name}`, (draft) => {
      draft.targets = draft.targets.filter((target) => target.name !== name);
      for (const target of draft.targets) if (target.relative_to === name) target.relative_to = null;
    });
  }

  /** Have targets still being drawn follow the one they are relative to. @param {string} from @param {string | null} to */
  #refer(from, to) {
    const led = (/** @type {string | null} */ name) => (name === from ? to : name);
    this.#keepOpen(this.#open.map((target) => ({ ...target, relative_to: led(target.relative_to) })));
  }

  /** @param {OpenTarget[]} open */
  #keepOpen(open) {
    this.#open = open.filter((target) => !this.store.project.targets.some((other) => other.name === target.name));
    localStorage.setItem(this.#key, JSON.stringify(this.#open));
    this.emit("change", null);
  }
}
