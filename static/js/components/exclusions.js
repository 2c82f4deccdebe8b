// Frame ranges a person rejects: selected on a plot or by keys, listed, taken back.

import { fill, h, refill } from "../lib/dom.js";
import { icon } from "../lib/icons.js";
import { fixed, plural } from "../lib/format.js";
import { numberField } from "./number-field.js";
import { nearest } from "./player.js";

/** @typedef {[first: number, last: number]} Range frames, both included */

export class ExclusionEditor {
  /** @type {Range | null} */
  selection = null;
  /** @type {number[]} */
  #times_s = [];

  /**
   * @param {HTMLElement} host
   * @param {{store: import("../lib/store.js").ProjectStore, solver: import("./solver.js").Solver, onSelection: () => void, onJump: (frame: number) => void}} options
   */
  constructor(host, { store, solver, onSelection, onJump }) {
    this.store = store;
    this.solver = solver;
    this.onSelection = onSelection;
    this.onJump = onJump;
    this.list = h("div", { class: "run-list" });
    this.form = h("div", { class: "exclusion-form" });
    this.first = numberField({
      label: "From frame",
      unit: "",
      value: 0,
      decimals: 0,
      step: 1,
      min: 0,
      compact: true,
      onChange: (value) => this.#change(value ?? 0, this.selection?.[1] ?? 0),
    });
    this.last = numberField({
      label: "To frame",
      unit: "",
      value: 0,
      decimals: 0,
      step: 1,
      min: 0,
      compact: true,
      onChange: (value) => this.#change(this.selection?.[0] ?? 0, value ?? 0),
    });
    this.button = h("button", { type: "button", class: "button small", onclick: () => this.exclude(0) });
    const forget = h(
      "button",
      {
        type: "button",
        class: "button quiet small icon-only",
        "aria-label": "Forget the selection",
        onclick: () => this.forget(),
      },
      icon("close", "small"),
    );
    fill(
      this.form,
      h("div", { class: "field-row" }, this.first.element, this.last.element),
      h("div", { class: "toolbar" }, this.button, forget),
    );
    fill(
      host,
      h("header", {}, h("h2", {}, "Excluded frames")),
      this.list,
      this.form,
      (this.hint = h("p", { class: "small faint" })),
    );
  }

  /** @type {HTMLElement} */
  hint;

  /** @param {number[]} times_s of every frame */
  setFrames(times_s) {
    this.#times_s = times_s;
    this.show();
  }

  /** Seconds from the first to the last selected frame. @returns {[number, number] | null} */
  get interval() {
    return this.selection && [this.#times_s[this.selection[0]], this.#times_s[this.selection[1]]];
  }

  /** @param {number} from_s @param {number} to_s */
  select(from_s, to_s) {
    this.#change(nearest(this.#times_s, from_s), nearest(this.#times_s, to_s));
  }

  /** @param {number} frame */
  begin(frame) {
    this.#change(frame, Math.max(frame, this.selection?.[1] ?? frame));
  }

  /** @param {number} frame */
  end(frame) {
    this.#change(Math.min(frame, this.selection?.[0] ?? frame), frame);
  }

  forget() {
    this.selection = null;
    this.show();
    this.onSelection();
  }

  /** Exclude the selection, or else one frame. @param {number} frame */
  exclude(frame) {
    const [first, last] = this.selection ?? [frame, frame];
    this.selection = null;
    void this.solver.edit(`Exclude ${rangeWords([first, last])}`, (draft) => {
      draft.excluded_frames = merged([...draft.excluded_frames, [first, last]]);
    });
    this.show();
    this.onSelection();
  }

  /** @param {Range} range */
  #takeBack(range) {
    void this.solver.edit(`Take back ${rangeWords(range)}`, (draft) => {
      draft.excluded_frames = draft.excluded_frames.filter(([first, last]) => first !== range[0] || last !== range[1]);
    });
  }

  /** @param {number} a @param {number} b */
  #change(a, b) {
    const most = this.#times_s.length - 1;
    const within = (/** @type {number} */ frame) => Math.min(Math.max(frame, 0), most);
    this.selection = [within(Math.min(a, b)), within(Math.max(a, b))];
    this.show();
    this.onSelection();
  }

  show() {
    const ranges = this.store.project.excluded_frames;
    refill(
      this.list,
      ranges.map((range) => this.#row(range)),
    );
    this.list.hidden = ranges.length === 0;
    this.form.hidden = this.selection === null;
    this.hint.hidden = this.selection !== null;
    this.hint.textContent = ranges.length
      ? "Shift+drag on a plot selects more."
      : "None. Shift+drag on a plot, or [ and ], selects frames; X excludes them.";
    if (this.selection === null) return;
    this.first.set(this.selection[0]);
    this.last.set(this.selection[1]);
    const frames = this.selection[1] - this.selection[0] + 1;
    fill(this.button, icon("close", "small"), `Exclude ${plural(frames, "frame")}`);
  }

  /** @param {Range} range */
  #row(range) {
    const [first, last] = range;
    const begin = `${first === last ? "at" : "from"} ${fixed(this.#times_s[first], 2)} s`;
    return h(
      "div",
      { class: "run-row" },
      h(
        "button",
        { type: "button", class: "run-jump", onclick: () => this.onJump(first) },
        h("span", { class: "status-key excluded" }),
        h("span", { class: "number" }, rangeText(range)),
        h("span", { class: "number faint end" }, begin),
      ),
      h(
        "button",
        {
          type: "button",
          class: "button quiet small icon-only",
          "aria-label": `Take back ${rangeWords(range)}`,
          title: "Take back",
          onclick: () => this.#takeBack(range),
        },
        icon("undo", "small"),
      ),
    );
  }
}

/** @param {Range} range */
const rangeText = ([first, last]) => (first === last ? `${first}` : `${first}–${last}`);
/** @param {Range} range */
const rangeWords = (range) => `${range[0] === range[1] ? "frame" : "frames"} ${rangeText(range)}`;

/** Ranges in order, those that touch made one. @param {Range[]} ranges @returns {Range[]} */
function merged(ranges) {
  /** @type {Range[]} */
  const result = [];
  for (const [first, last] of [...ranges].sort((a, b) => a[0] - b[0])) {
    const before = result.at(-1);
    if (before && first <= before[1] + 1) before[1] = Math.max(before[1], last);
    else result.push([first, last]);
  }
  return result;
}
