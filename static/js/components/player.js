// Transport of the frame player: play, step, scrub, jump. It knows frames and times, not pictures.

import { fill, h, svg } from "../lib/dom.js";
import { Emitter } from "../lib/emitter.js";
import { fixed } from "../lib/format.js";
import { icon } from "../lib/icons.js";

/**
 * @typedef {object} PlayerEvents
 * @property {{frame: number, time_s: number}} frame another frame is wanted
 * @property {{playing: boolean}} playing
 */

const SPEEDS = [0.1, 0.25, 0.5, 1, 2];

/** @extends {Emitter<PlayerEvents>} */
export class Player extends Emitter {
  /** @type {{time_s: number, clock_ms: number} | null} where and when playing began */
  #started = null;
  #timer = 0;

  /** @param {HTMLElement} host */
  constructor(host) {
    super();
    /** @type {number[]} of every frame, the container's own timestamps */
    this.times_s = [0];
    /** @type {string[]} */
    this.statuses = [];
    this.frame = 0;
    this.speed = 1;
    this.playButton = h("button", {
      type: "button",
      class: "button icon-only",
      "aria-label": "Play",
      onclick: () => this.toggle(),
    });
    this.scrubber = h("input", {
      type: "range",
      class: "player-scrubber",
      min: 0,
      max: 0,
      step: 1,
      value: 0,
      "aria-label": "Frame",
      oninput: () => this.go(Number(this.scrubber.value)),
    });
    this.readout = h("output", { class: "player-readout number" });
    this.element = h("div", { class: "player", role: "group", "aria-label": "Frame player" }, this.#controls());
    host.append(this.element);
    this.#show();
  }

  get playing() {
    return this.#started !== null;
  }

  get time_s() {
    return this.times_s[this.frame] ?? 0;
  }

  /** @param {number[]} times_s @param {string[]} statuses the worst of all targets, per frame */
  setFrames(times_s, statuses) {
    this.times_s = times_s;
    this.statuses = statuses;
    this.scrubber.max = String(Math.max(times_s.length - 1, 0));
    this.#show();
  }

  /** @param {number} frame */
  go(frame) {
    const wanted = Math.min(Math.max(Math.round(frame), 0), this.times_s.length - 1);
    if (this.playing) this.#started = { time_s: this.times_s[wanted] ?? 0, clock_ms: performance.now() };
    this.#set(wanted);
  }

  /** @param {number} time_s */
  goTo(time_s) {
    this.go(nearest(this.times_s, time_s));
  }

  /** @param {number} by */
  step(by) {
    this.pause();
    this.go(this.frame + by);
  }

  /** To the beginning of the next run of weak or lost frames. @param {1 | -1} direction @returns {boolean} whether there is one */
  jump(direction) {
    this.pause();
    const starts = this.statuses.flatMap((status, i) =>
      isDoubtful(status) && status !== this.statuses[i - 1] ? [i] : [],
    );
    const wanted =
      direction > 0 ? starts.find((start) => start > this.frame) : starts.findLast((start) => start < this.frame);
    if (wanted !== undefined) this.go(wanted);
    return wanted !== undefined;
  }

  toggle() {
    if (this.playing) this.pause();
    else this.play();
  }

  play() {
    if (this.frame >= this.times_s.length - 1) this.#set(0);
    this.#started = { time_s: this.time_s, clock_ms: performance.now() };
    this.#show();
    this.emit("playing", { playing: true });
    this.#timer = requestAnimationFrame(() => this.#tick());
  }

  pause() {
    if (!this.playing) return;
    cancelAnimationFrame(this.#timer);
    this.#started = null;
    this.#show();
    this.emit("playing", { playing: false });
  }

  #tick() {
    if (this.#started === null) return;
    const elapsed_s = ((performance.now() - this.#started.clock_ms) / 1000) * this.speed;
    const frame = nearest(this.times_s, this.#started.time_s + elapsed_s);
    if (frame !== this.frame) this.#set(frame);
    if (frame >= this.times_s.length - 1) this.pause();
    else this.#timer = requestAnimationFrame(() => this.#tick());
  }

  /** @param {number} frame */
  #set(frame) {
    this.frame = frame;
    this.#show();
    this.emit("frame", { frame, time_s: this.time_s });
  }

  #show() {
    const status = this.statuses[this.frame] ?? "ok";
    fill(this.playButton, icon(this.playing ? "pause" : "play"));
    this.playButton.setAttribute("aria-label", this.playing ? "Pause" : "Play");
    this.scrubber.value = String(this.frame);
    this.scrubber.setAttribute("aria-valuetext", `frame ${this.frame}, ${this.time_s.toFixed(3)} seconds, ${status}`);
    fill(
      this.readout,
      h("b", {}, fixed(this.time_s, 3)),
      " s",
      h("span", { class: "faint" }, `frame ${this.frame} / ${Math.max(this.times_s.length - 1, 0)}`),
    );
  }

  #controls() {
    const button = (/** @type {string} */ label, /** @type {string} */ path, /** @type {() => void} */ run) =>
      h(
        "button",
        { type: "button", class: "button quiet icon-only", "aria-label": label, title: label, onclick: run },
        transportIcon(path),
      );
    const speed = h(
      "select",
      { class: "input player-speed", "aria-label": "Speed", onchange: () => this.#changeSpeed(Number(speed.value)) },
      SPEEDS.map((value) => h("option", { value, selected: value === 1 }, `${value}×`)),
    );
    return [
      button("Previous weak or lost frame", "M8.500 3.500 4.500 8l4 4.500M13 3.500 9 8l4 4.500M2.500 3.500v9", () =>
        this.jump(-1),
      ),
      button("One frame back", "M11 3.500 5.500 8l5.500 4.500M3.500 3.500v9", () => this.step(-1)),
      this.playButton,
      button("One frame on", "M5 3.500 10.500 8 5 12.500M12.500 3.500v9", () => this.step(1)),
      button("Next weak or lost frame", "M3 3.500 7 8l-4 4.500M7.500 3.500l4 4.500-4 4.500M13.500 3.500v9", () =>
        this.jump(1),
      ),
      this.scrubber,
      this.readout,
      speed,
    ];
  }

  /** @param {number} speed */
  #changeSpeed(speed) {
    this.speed = speed;
    if (this.playing) this.#started = { time_s: this.time_s, clock_ms: performance.now() };
  }
}

/** @param {string} path */
const transportIcon = (path) =>
  svg("svg", { class: "icon", viewBox: "0 0 16 16", "aria-hidden": "true" }, svg("path", { d: path }));

/** @param {string} status */
const isDoubtful = (status) => status === "weak" || status === "lost";

/** Index of the ascending value closest to another. @param {number[]} values @param {number} wanted */
export function nearest(values, wanted) {
  let low = 0;
  let high = values.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (values[middle] <= wanted) low = middle;
    else high = middle;
  }
  return wanted - values[low] <= (values[high] ?? Infinity) - wanted ? low : high;
}
