// Histories, spectra and sweeps: uPlot with linked views, a play head, intervals to drag and status marks.
// Numbers stay as the server sends them (metres, seconds, hertz); only the labels are written in mm or cm.

import uPlot from "../../vendor/uplot/uPlot.esm.js";
import { fill, h, svg } from "../lib/dom.js";
import { Emitter } from "../lib/emitter.js";
import { fixed } from "../lib/format.js";
import { onTheme } from "../lib/theme.js";
import { colourOf, faded } from "./palette.js";
import { attachGestures } from "./plot-gestures.js";
import { drawIntervalNames, drawIntervals, drawStatuses, drawVerticals, IntervalHandles } from "./plot-marks.js";

/**
 * @typedef {object} Trace one curve
 * @property {string} label
 * @property {string} colour variable of the style sheet, "--trace-1"
 * @property {number[]} [dash]
 * @property {number} [width]
 * @property {boolean} [points] with a dot at every value
 * @property {boolean} [hidden] at first
 *
 * @typedef {object} Interval a named part of the x axis
 * @property {string} key
 * @property {string} label
 * @property {number} from
 * @property {number} to
 * @property {string} colour
 * @property {boolean} [editable] its ends can be dragged and moved by keys
 *
 * @typedef {{at: number, label: string, colour: string}} Vertical a labelled place on the x axis
 *
 * @typedef {object} PlotOptions
 * @property {string} title what is drawn, also its name for assistive technology
 * @property {string} [unit] "m" is written in mm or cm, whichever reads better; anything else as it stands
 * @property {string} [xUnit]
 * @property {string} [link] plots of one name share cursor and view
 * @property {"seek"|"select"|"view"} [drag] what dragging does; with Shift: select where it seeks, seek where it selects
 * @property {boolean} [logX]
 * @property {boolean} [logY]
 * @property {boolean} [zeroY] the y axis starts at 0
 * @property {number} [leastSpan] the y axis never shows less, so that noise is not mistaken for motion
 * @property {number} [seekStep] how far an arrow key moves, in the unit of x; default: one value
 */

/** Plots whose cursor and view are linked, by the name of the link. @type {Map<string, Set<Plot>>} */
const linked = new Map();

/**
 * @typedef {object} PlotEvents
 * @property {{x: number}} seek a place was pointed at
 * @property {{from: number, to: number}} select a part was drawn
 * @property {{key: string, from: number, to: number, done: boolean}} interval an end is being moved, or was
 * @property {{from: number, to: number}} view
 */

/** @extends {Emitter<PlotEvents>} */
export class Plot extends Emitter {
  /**
   * @param {HTMLElement} host
   * @param {PlotOptions} options
   */
  constructor(host, options) {
    super();
    this.options = options;
    /** @type {Trace[]} */ this.traces = [];
    /** @type {uPlot.AlignedData} */ this.data = [[]];
    /** @type {Interval[]} */ this.intervals = [];
    /** @type {Vertical[]} */ this.verticals = [];
    /** @type {string[]} */ this.statuses = [];
    /** @type {[number, number] | null} */ this.domain = null;
    /** @type {[number, number] | null} */ this.view = null;
    /** @type {number | null} */ this.head = null;
    /** Whether a curve shown has a value; without one, no number is written along y. */ this.hasY = false;
    /** @type {{factor: number, unit: string}} */ this.written = { factor: 1, unit: options.unit ?? "" };
    /** @type {Map<string, string>} */ this.colours = new Map();
    this.legend = h("span", { class: "plot-legend", role: "group", "aria-label": "Curves" });
    this.unitLabel = h("span", { class: "plot-unit" });
    this.body = h("div", {
      class: "plot-body",
      tabindex: 0,
      role: "group",
      "aria-roledescription": "plot",
      "aria-label": options.title,
    });
    const head = h(
      "figcaption",
      { class: "plot-head" },
      h("span", { class: "plot-title", title: options.title }, options.title),
      this.unitLabel,
      this.legend,
    );
    this.root = h("figure", { class: "plot" }, head, this.body);
    host.append(this.root);
    this.playHead = h("div", { class: "plot-playhead" });
    this.handles = new IntervalHandles(this);
    this.u = this.build();
    this.observer = new ResizeObserver(() => this.fitSize());
    this.observer.observe(this.body);
    onTheme(() => this.repaint());
    attachGestures(this);
    if (options.link) linked.set(options.link, (linked.get(options.link) ?? new Set()).add(this));
  }

  /** @param {string} name @returns {string} the colour of a style sheet variable, remembered until the theme changes */
  colour(name) {
    const known = this.colours.get(name) ?? colourOf(this.root, name);
    this.colours.set(name, known);
    return known;
  }

  /**
   * Replace the curves.
   * @param {Trace[]} traces
   * @param {uPlot.AlignedData} data x first, then one column per trace; null where nothing was measured
   */
  setTraces(traces, data) {
    const hidden = new Map(this.traces.map((trace, i) => [trace.label, !(this.u.series[i + 1]?.show ?? true)]));
    this.traces = traces.map((trace) => ({ ...trace, hidden: hidden.get(trace.label) ?? trace.hidden ?? false }));
    this.data = data;
    this.u.destroy();
    this.u = this.build();
    this.fillLegend();
    this.place();
  }

  /** Replace the numbers, keep curves and view. @param {uPlot.AlignedData} data */
  setData(data) {
    this.data = data;
    this.u.setData(data, true);
    this.place();
  }

  /** Fix the whole extent of x, for example before all of it is measured. @param {[number, number] | null} domain */
  setDomain(domain) {
    this.domain = domain;
    this.u.setData(this.data, true);
    this.place();
  }

  /** Draw a curve faint that holds no longer, or fully again. @param {string} label @param {boolean} faint */
  setFaint(label, faint) {
    const series = this.u.series.find((entry) => entry.label === label);
    if (series) series.alpha = faint ? 0.3 : 1;
    this.u.redraw(false);
  }

  /** @param {Interval[]} intervals */
  setIntervals(intervals) {
    this.intervals = intervals;
    this.u.redraw(false);
    this.place();
  }

  /** @param {Vertical[]} verticals */
  setVerticals(verticals) {
    this.verticals = verticals;
    this.u.redraw(false);
  }

  /** One status per value: "ok", "weak", "lost" or "excluded". @param {string[]} statuses */
  setStatuses(statuses) {
    this.statuses = statuses;
    this.u.redraw(false);
  }

  /** Move the play head; null hides it. @param {number | null} x */
  setPlayHead(x) {
    this.head = x;
    const visible = x !== null && this.hasX && x >= this.extent[0] && x <= this.extent[1];
    this.playHead.hidden = !visible;
    if (visible) this.playHead.style.transform = `translateX(${this.u.valToPos(/** @type {number} */ (x), "x")}px)`;
    if (this.u.cursor.idx == null) this.writeValues();
  }

  /** Show a part of x, here and in linked plots; null shows all. @param {[number, number] | null} view */
  setView(view) {
    for (const plot of this.partners()) plot.applyView(view);
    const [from, to] = this.extent;
    this.emit("view", { from, to });
  }

  /** The part of x on the screen. @returns {[number, number]} */
  get extent() {
    const { min, max } = this.u.scales.x ?? {};
    return [min ?? 0, max ?? 1];
  }

  /** Whether any x is known; else no number is written along it, and nothing lies at a place of it. */
  get hasX() {
    return this.domain !== null || (this.data[0]?.length ?? 0) > 0;
  }

  /** All of x. @returns {[number, number]} */
  get whole() {
    if (this.domain) return this.domain;
    const x = this.data[0] ?? [];
    return x.length ? [Number(x[0]), Number(x[x.length - 1])] : [this.options.logX ? 0.01 : 0, 1];
  }

  /** The part of x that is asked for. @returns {[number, number]} */
  get shownX() {
    const wanted = this.view ?? this.whole;
    return this.options.logX ? roundedOutwards(wanted) : wanted;
  }

  /** @returns {Iterable<Plot>} this plot and those linked with it */
  partners() {
    return (this.options.link && linked.get(this.options.link)) || [this];
  }

  /** @param {[number, number] | null} view */
  applyView(view) {
    this.view = view;
    const [min, max] = this.shownX;
    this.u.setScale("x", { min, max });
  }

  /** @returns {uPlot} */
  build() {
    this.hasY = false;
    const plot = new uPlot(this.uplotOptions(), this.data, this.body);
    plot.over.append(this.playHead, this.handles.layer);
    return plot;
  }

  /** @returns {uPlot.Options} */
  uplotOptions() {
    const { link, logX, logY } = this.options;
    return {
      width: Math.max(this.body.clientWidth, 40),
      height: Math.max(this.body.clientHeight, 40),
      padding: [8, 20, 0, 0],
      legend: { show: false },
      cursor: {
        drag: { x: false, y: false, setScale: false },
        y: false,
        points: { size: 6 },
        ...(link && { sync: { key: link } }),
      },
      scales: {
        x: { time: false, distr: logX ? 3 : 1, range: () => this.shownX },
        y: { distr: logY ? 3 : 1, range: (_, low, high) => this.rangeY(low, high) },
      },
      axes: [this.axisX(), this.axisY()],
      series: [{}, ...this.traces.map((trace) => this.series(trace))],
      hooks: {
        drawClear: [(u) => drawIntervals(this, u)],
        draw: [(u) => drawStatuses(this, u), (u) => drawIntervalNames(this, u), (u) => drawVerticals(this, u)],
        setCursor: [() => this.writeValues()],
        setScale: [(_, key) => key === "x" && queueMicrotask(() => this.place())],
      },
    };
  }

  /** @returns {uPlot.Axis} */
  axisX() {
    const ink = () => this.colour("--plot-axis");
    const unit = this.options.xUnit ?? "s";
    const values = (/** @type {uPlot} */ _, /** @type {number[]} */ ticks) => {
      if (!this.hasX) return ticks.map(() => "");
      const last = ticks.findLastIndex((tick) => tick != null); // a logarithmic axis writes only some of its ticks
      return ticks.map((tick, i) => (tick == null ? "" : i === last ? `${round(tick)} ${unit}` : round(tick)));
    };
    return {
      stroke: ink,
      size: 30,
      gap: 4,
      font: AXIS_FONT,
      space: 64,
      grid: this.grid(),
      ticks: { show: false },
      values,
    };
  }

  /** @returns {uPlot.Axis} */
  axisY() {
    const values = (/** @type {uPlot} */ _, /** @type {number[]} */ ticks) =>
      ticks.map((tick) => (tick == null || !this.hasY ? "" : round(tick * this.written.factor).replace("-", "−")));
    return {
      stroke: () => this.colour("--plot-axis"),
      size: 48,
      gap: 6,
      font: AXIS_FONT,
      space: (_u, _axis, _min, _max, height) => Math.min(28, Math.max(12, height / 5)), // three ticks in a low plot too
      grid: this.grid(),
      ticks: { show: false },
      values,
    };
  }

  /** @returns {uPlot.Axis.Grid} */
  grid() {
    return { stroke: () => this.colour("--plot-grid"), width: 1 };
  }

  /** @param {Trace} trace @returns {uPlot.Series} */
  series(trace) {
    return {
      label: trace.label,
      show: !trace.hidden,
      stroke: () => this.colour(trace.colour),
      width: trace.width ?? 1.5,
      dash: trace.dash,
      points: { show: trace.points ?? false, size: 5 },
    };
  }

  /** @param {number} low @param {number} high @returns {[number, number]} with air above and below */
  rangeY(low, high) {
    this.hasY = low != null && high != null;
    if (!this.hasY) return this.rangeOfNothing();
    if (this.options.logY) return this.rangeLog(low, high);
    const lacking = ((this.options.leastSpan ?? 1e-9) - (high - low)) / 2;
    const air = Math.max((high - low) * 0.08, lacking);
    const range = /** @type {[number, number]} */ ([this.options.zeroY ? 0 : low - air, high + air]);
    this.chooseUnit(range);
    return range;
  }

  /** @returns {[number, number]} for a grid without numbers */
  rangeOfNothing() {
    if (this.options.unit === "m") this.unitLabel.textContent = "";
    return this.options.logY ? [1e-4, 1e-2] : [-0.01, 0.01];
  }

  /** @param {number} low @param {number} high @returns {[number, number]} at most five decades */
  rangeLog(low, high) {
    const range = roundedOutwards([Math.max(low, high / 1e5), high]);
    this.chooseUnit(range);
    return range;
  }

  /** @param {[number, number]} range */
  chooseUnit([low, high]) {
    if (this.options.unit !== "m") return;
    this.written =
      Math.max(Math.abs(low), Math.abs(high)) < 0.06 ? { factor: 1000, unit: "mm" } : { factor: 100, unit: "cm" };
    this.unitLabel.textContent = this.written.unit;
  }

  fillLegend() {
    if (this.options.unit !== "m") this.unitLabel.textContent = this.options.unit ?? "";
    fill(
      this.legend,
      this.traces.map((trace, i) => this.legendEntry(trace, i + 1)),
    );
    this.writeValues();
  }

  /** @param {Trace} trace @param {number} index @returns {HTMLElement} switches its curve on and off */
  legendEntry(trace, index) {
    const line = svg("line", { x1: 0, x2: 18, y1: 4, y2: 4 });
    line.style.stroke = `var(${trace.colour})`;
    if (trace.dash) line.style.strokeDasharray = trace.dash.join(" ");
    const swatch = svg("svg", { class: "plot-swatch", viewBox: "0 0 18 8", "aria-hidden": "true" }, line);
    const value = h("output", { class: "plot-value" });
    const button = h(
      "button",
      { type: "button", class: "plot-entry", "aria-pressed": String(!trace.hidden) },
      swatch,
      trace.label,
      " ", // for who hears both
      value,
    );
    button.addEventListener("click", () => {
      const shown = !this.u.series[index]?.show;
      this.u.setSeries(index, { show: shown });
      trace.hidden = !shown;
      button.setAttribute("aria-pressed", String(shown));
    });
    return button;
  }

  /** Write the values under the cursor, or else at the play head, into the legend. */
  writeValues() {
    const at = this.u?.cursor.idx ?? (this.head === null ? null : this.u.valToIdx(this.head));
    this.legend.querySelectorAll("output").forEach((output, i) => {
      const value = at === null ? null : this.data[i + 1]?.[at];
      output.textContent = value == null ? (at === null ? "" : "–") : this.written.unit ? this.valueText(value) : "";
    });
  }

  /** @param {number} value @returns {string} */
  valueText(value) {
    const { factor, unit } = this.written;
    const digits = unit === "cm" ? 2 : unit === "mm" ? 1 : 3;
    const { zeroY, logY } = this.options;
    return `${zeroY || logY ? fixed(value * factor, digits) : signed(value * factor, digits)} ${unit}`;
  }

  fitSize() {
    const { clientWidth: width, clientHeight: height } = this.body;
    if (width < 40 || height < 40) return;
    this.u.setSize({ width, height });
    this.place();
  }

  /** Put what lies above the canvas back in its place. */
  place() {
    this.setPlayHead(this.head);
    this.handles.place();
  }

  repaint() {
    this.colours.clear();
    this.u.redraw(false, true);
  }

  /** @param {string} colour @param {number} opacity @returns {string} */
  faded(colour, opacity) {
    return faded(this.colour(colour), opacity);
  }
}

const AXIS_FONT = "11px Inter, system-ui, sans-serif";

/** To one digit each, where the ticks of a logarithmic axis begin and end. @param {[number, number]} range @returns {[number, number]} */
function roundedOutwards([low, high]) {
  const power = (/** @type {number} */ value) => 10 ** Math.floor(Math.log10(value));
  const [least, most] = [
    Math.floor(low / power(low) + 1e-9) * power(low),
    Math.ceil(high / power(high) - 1e-9) * power(high),
  ];
  return [Number(least.toPrecision(1)), Number(most.toPrecision(1))];
}

/** @param {number} value @returns {string} without the digits of floating point */
function round(value) {
  return String(Number(value.toPrecision(6)));
}

/** @param {number} value @param {number} digits @returns {string} with its sign always written */
export function signed(value, digits) {
  const text = fixed(value, digits);
  return value > 0 && Number(text) !== 0 ? `+${text}` : text;
}
