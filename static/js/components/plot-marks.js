// What lies on a plot besides its curves: intervals with handles, labelled places, and the status of each frame.

import { decorate, h } from "../lib/dom.js";

/** @typedef {import("./plot.js").Plot} Plot */
/** @typedef {import("./plot.js").Interval} Interval */

/** @type {Record<string, string>} */
const STATUS_COLOURS = { weak: "--warn", lost: "--bad", excluded: "--text-faint" };
const STRIP_PX = 6;
/** Handles whose distances from the pointer differ by less are pointed at alike. */
const ALIKE_PX = 3;
/** How far the pointer moves before it is told which way it goes. */
const TURNED_PX = 3;

/**
 * What has a place on the x axis; nothing has while no x is known.
 * @template Mark
 * @param {Plot} plot
 * @param {Mark[]} marks
 */
const placed = (plot, marks) => (plot.hasX ? marks : []);

/**
 * Fill the intervals behind the curves.
 * @param {Plot} plot
 * @param {import("../../vendor/uplot/uPlot.esm.js")} u
 */
export function drawIntervals(plot, u) {
  const { left, top, width, height } = u.bbox;
  const g = u.ctx;
  const scale = devicePixelRatio;
  g.save();
  g.beginPath();
  g.rect(left, top, width, height);
  g.clip();
  for (const interval of placed(plot, plot.intervals)) {
    const from = u.valToPos(interval.from, "x", true);
    const to = u.valToPos(interval.to, "x", true);
    g.fillStyle = plot.faded(interval.colour, 0.08);
    g.fillRect(from, top, to - from, height);
    g.fillStyle = plot.faded(interval.colour, 0.6);
    g.fillRect(from, top, scale, height);
    g.fillRect(to - scale, top, scale, height);
  }
  g.restore();
}

/**
 * Name the intervals, over the grid.
 * @param {Plot} plot
 * @param {import("../../vendor/uplot/uPlot.esm.js")} u
 */
export function drawIntervalNames(plot, u) {
  const { left, top, width } = u.bbox;
  const scale = devicePixelRatio;
  const g = u.ctx;
  g.save();
  g.font = `600 ${11 * scale}px Inter, system-ui, sans-serif`;
  g.textBaseline = "top";
  g.textAlign = "left";
  for (const interval of placed(plot, plot.intervals)) {
    const from = Math.max(u.valToPos(interval.from, "x", true), left);
    const to = Math.min(u.valToPos(interval.to, "x", true), left + width);
    const wide = g.measureText(interval.label).width;
    if (to - from < wide + 14 * scale) continue;
    g.fillStyle = plot.colour("--surface");
    g.fillRect(from + 4 * scale, top + 3 * scale, wide + 8 * scale, 16 * scale);
    g.fillStyle = plot.colour(interval.colour);
    g.fillText(interval.label, from + 8 * scale, top + 5 * scale);
  }
  g.restore();
}

/**
 * Draw labelled places over the curves.
 * @param {Plot} plot
 * @param {import("../../vendor/uplot/uPlot.esm.js")} u
 */
export function drawVerticals(plot, u) {
  const { left, top, width, height } = u.bbox;
  const g = u.ctx;
  const scale = devicePixelRatio;
  g.save();
  g.font = `600 ${11 * scale}px Inter, system-ui, sans-serif`;
  g.textBaseline = "top";
  g.textAlign = "left";
  placed(plot, plot.verticals).forEach((vertical, i) => {
    const x = u.valToPos(vertical.at, "x", true);
    if (x < left || x > left + width) return;
    g.fillStyle = g.strokeStyle = plot.colour(vertical.colour);
    g.lineWidth = 1.5 * scale;
    g.setLineDash(i % 2 ? [4 * scale, 3 * scale] : []);
    g.beginPath();
    g.moveTo(x, top);
    g.lineTo(x, top + height);
    g.stroke();
    const wide = g.measureText(vertical.label).width + 8 * scale;
    const neighbour = plot.verticals.some(
      (other) => other.at > vertical.at && u.valToPos(other.at, "x", true) < x + wide,
    );
    const roomBefore = x - wide >= left;
    const after = (x + wide < left + width && !neighbour) || !roomBefore;
    const below = neighbour && !roomBefore; // the neighbour's label begins where this one would end
    const labelX = after ? x + 6 * scale : x - wide + 2 * scale;
    const labelY = top + (below ? 21 : 5) * scale;
    g.fillStyle = plot.faded("--surface", 0.8);
    g.fillRect(labelX - 2 * scale, labelY - 2 * scale, wide - 4 * scale, 16 * scale);
    g.fillStyle = plot.colour(vertical.colour);
    g.fillText(vertical.label, labelX, labelY);
  });
  g.restore();
}

/**
 * Mark weak, lost and excluded frames: a strip along the foot, and a faint column where there is nothing to draw.
 * Told apart by height and hatching as well as by colour.
 * @param {Plot} plot
 * @param {import("../../vendor/uplot/uPlot.esm.js")} u
 */
export function drawStatuses(plot, u) {
  const { left, top, width, height } = u.bbox;
  const x = u.data[0] ?? [];
  const g = u.ctx;
  const strip = STRIP_PX * devicePixelRatio;
  g.save();
  g.beginPath();
  g.rect(left, top, width, height);
  g.clip();
  for (const run of statusRuns(plot.statuses, x.length)) {
    const from = u.valToPos(Number(x[run.first]), "x", true);
    const to = u.valToPos(Number(x[Math.min(run.last + 1, x.length - 1)]), "x", true);
    if (to < left || from > left + width) continue;
    const wide = Math.max(to - from, 2 * devicePixelRatio);
    const name = STATUS_COLOURS[run.status];
    if (!name) continue;
    g.fillStyle = plot.colour(name);
    g.fillRect(from, top + height - strip, wide, run.status === "weak" ? strip / 2 : strip);
    if (run.status === "weak") continue;
    g.fillStyle = plot.faded(name, 0.12);
    g.fillRect(from, top, wide, height);
    if (run.status === "excluded") hatch(g, { from, wide, top, height, colour: plot.faded(name, 0.45) });
  }
  g.restore();
}

/**
 * @param {string[]} statuses
 * @param {number} count
 * @returns {{status: string, first: number, last: number}[]} runs of equal status other than "ok"
 */
export function statusRuns(statuses, count = statuses.length) {
  /** @type {{status: string, first: number, last: number}[]} */
  const runs = [];
  for (let i = 0; i < Math.min(statuses.length, count); i++) {
    const status = /** @type {string} */ (statuses[i]);
    const last = runs.at(-1);
    if (last && last.status === status && last.last === i - 1) last.last = i;
    else if (status !== "ok") runs.push({ status, first: i, last: i });
  }
  return runs;
}

/**
 * @param {CanvasRenderingContext2D} g
 * @param {{from: number, wide: number, top: number, height: number, colour: string}} area
 */
function hatch(g, { from, wide, top, height, colour }) {
  const step = 7 * devicePixelRatio;
  g.save();
  g.beginPath();
  g.rect(from, top, wide, height);
  g.clip();
  g.strokeStyle = colour;
  g.lineWidth = devicePixelRatio;
  g.beginPath();
  for (let x = from - height; x < from + wide; x += step) {
    g.moveTo(x, top + height);
    g.lineTo(x + height, top);
  }
  g.stroke();
  g.restore();
}

/** @typedef {{key: string, end: "from"|"to", handle: HTMLElement}} End of an interval */

/**
 * The ends of editable intervals as sliders: dragged by the pointer, moved by the arrow keys.
 * Where several lie in one place, the pointer takes that one for which there is room where it goes.
 */
export class IntervalHandles {
  /** @param {Plot} plot */
  constructor(plot) {
    this.plot = plot;
    this.layer = h("div", { class: "plot-handles" });
    /** @type {Map<string, End>} */ this.handles = new Map();
    /** What the pointer may have hold of, since where, and what it may change. @type {{ends: End[], px: number, intervals: Interval[]} | null} */ this.held = null;
  }

  place() {
    const wanted = new Set();
    for (const interval of placed(this.plot, this.plot.intervals)) {
      if (!interval.editable) continue;
      for (const end of /** @type {const} */ (["from", "to"])) {
        wanted.add(`${interval.key}/${end}`);
        this.placeOne(interval, end);
      }
    }
    for (const [name, { handle }] of this.handles) {
      if (wanted.has(name)) continue;
      handle.remove();
      this.handles.delete(name);
    }
  }

  /** @param {Interval} interval @param {"from"|"to"} end */
  placeOne(interval, end) {
    const name = `${interval.key}/${end}`;
    const { handle } = this.handles.get(name) ?? this.make(interval.key, end);
    const [min, max] = this.plot.extent;
    handle.hidden = interval[end] < min || interval[end] > max;
    handle.style.transform = `translateX(${this.plot.u.valToPos(interval[end], "x")}px)`;
    handle.style.setProperty("--handle-colour", `var(${interval.colour})`);
    const [low, high] = this.plot.whole;
    decorate(handle, {
      "aria-label": `${end === "from" ? "Start" : "End"} of ${interval.label}`,
      "aria-valuenow": interval[end].toFixed(2),
      "aria-valuetext": `${interval[end].toFixed(2)} ${this.plot.options.xUnit ?? "s"}`,
      "aria-valuemin": low,
      "aria-valuemax": high,
    });
  }

  /** @param {string} key @param {"from"|"to"} end @returns {End} */
  make(key, end) {
    const handle = h("div", { class: "plot-handle", tabindex: 0, role: "slider", "data-end": end });
    handle.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      event.preventDefault();
      handle.setPointerCapture(event.pointerId);
      this.held = { ends: this.endsAt(event.clientX), px: event.clientX, intervals: this.plot.intervals };
      this.held.ends[0]?.handle.focus();
    });
    handle.addEventListener("pointermove", (event) => {
      if (!handle.hasPointerCapture(event.pointerId)) return;
      event.stopPropagation();
      const taken = this.takenBy(event.clientX);
      const x = this.plot.u.posToVal(event.clientX - this.plot.u.over.getBoundingClientRect().left, "x");
      if (taken) this.move(taken.key, taken.end, x, false);
    });
    handle.addEventListener("pointerup", (event) => {
      event.stopPropagation();
      const taken = this.takenBy(event.clientX);
      if (taken) this.move(taken.key, taken.end, this.value(taken.key, taken.end), true);
      this.held = null;
    });
    // The browser or the system has taken the drag over, so nobody meant where it is now.
    handle.addEventListener("pointercancel", (event) => {
      event.stopPropagation();
      this.putBack();
    });
    handle.addEventListener("keydown", (event) => this.key(event, key, end));
    this.layer.append(handle);
    const made = { key, end, handle };
    this.handles.set(`${key}/${end}`, made);
    return made;
  }

  /** What lies under a pointer, the nearest first; what is clearly farther than that is left out. @param {number} px CSS px of the window @returns {End[]} */
  endsAt(px) {
    const found = [...this.handles.values()]
      .map((end) => ({ end, box: end.handle.getBoundingClientRect() }))
      .filter(({ box }) => box.left <= px && px <= box.right)
      .map(({ end, box }) => ({ end, apart: Math.abs((box.left + box.right) / 2 - px) }))
      .sort((one, other) => one.apart - other.apart);
    return found.filter(({ apart }) => apart < (found[0]?.apart ?? 0) + ALIKE_PX).map(({ end }) => end);
  }

  /** The end that the pointer has hold of, null while it has not gone one way. @param {number} px CSS px of the window @returns {End | null} */
  takenBy(px) {
    if (this.held === null) return null;
    const { ends, px: from } = this.held;
    if (ends.length > 1 && Math.abs(px - from) < TURNED_PX) return null;
    const [taken = null] = ends.length > 1 ? roomiest(ends, Math.sign(px - from)) : ends;
    if (ends.length > 1) taken?.handle.focus();
    this.held.ends = taken ? [taken] : [];
    return taken;
  }

  /** Let go as if nothing had been moved. */
  putBack() {
    if (this.held === null) return;
    const { ends, intervals } = this.held;
    this.held = null;
    this.plot.setIntervals(intervals);
    for (const { key, from, to } of intervals)
      if (ends.some((end) => end.key === key)) this.plot.emit("interval", { key, from, to, done: false });
  }

  /** @param {KeyboardEvent} event @param {string} key @param {"from"|"to"} end */
  key(event, key, end) {
    const direction = /** @type {Record<string, number>} */ ({
      ArrowLeft: -1,
      ArrowDown: -1,
      ArrowRight: 1,
      ArrowUp: 1,
    })[event.key];
    if (!direction) return;
    event.preventDefault();
    event.stopPropagation();
    const step = event.shiftKey ? 1 : event.altKey ? 0.02 : 0.1;
    this.move(key, end, this.value(key, end) + direction * step, true);
  }

  /** @param {string} key @param {"from"|"to"} end @returns {number} */
  value(key, end) {
    return this.plot.intervals.find((interval) => interval.key === key)?.[end] ?? 0;
  }

  /** @param {string} key @param {"from"|"to"} end @param {number} x @param {boolean} done */
  move(key, end, x, done) {
    const [low, high] = this.plot.whole;
    const least = 0.02;
    this.plot.setIntervals(
      this.plot.intervals.map((interval) => {
        if (interval.key !== key) return interval;
        const from = end === "from" ? Math.min(Math.max(x, low), interval.to - least) : interval.from;
        const to = end === "to" ? Math.max(Math.min(x, high), interval.from + least) : interval.to;
        this.plot.emit("interval", { key, from, to, done });
        return { ...interval, from, to };
      }),
    );
  }
}

/**
 * Those of several ends in one place that a drag can move: an interval too short to see is pulled open, and of two
 * that meet the one behind the pointer is made shorter, since they must not share time.
 * @param {End[]} ends
 * @param {number} direction -1 to the left, 1 to the right
 * @returns {End[]}
 */
function roomiest(ends, direction) {
  const opens = ends.some(({ key }, i) => ends.some((other, j) => j > i && other.key === key));
  const wanted = direction < 0 === opens ? "from" : "to";
  const found = ends.filter(({ end }) => end === wanted);
  return found.length > 0 ? found : ends;
}
