"""The figures of a measurement, the paper's Figs. 7, 8, 9 and 11 among them, in one sober style.

Each function takes plain arrays and returns a figure; `save` and `encoded` make the same bytes of the same figure.
Colours are Okabe and Ito's, which colour-blind people can tell apart. Metres become millimetres or centimetres here.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import wraps
from typing import Any, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from core.coordinates import Floats
from core.drift import AXIS_NAMES, CornerSweep, Spectrum, amplitude_spectrum, corner_sweep, high_pass
from core.errors import InputError
from core.intervals import within
from core.project import Drift, Intervals
from core.results import TargetHistory
from core.validation import GpsComparison
from core.words import with_minus_sign

BLUE, ORANGE, GREEN, RED, PURPLE, SKY, BLACK, GREY = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#56B4E9",
    "#1A1A1A",
    "#8C8C8C",
)
AXIS_COLOURS = (BLUE, RED)
LINE_COLOURS = {"L1": SKY, "L2": ORANGE, "T1": PURPLE}
PAGE_WIDTH_IN = 7.2  # an A4 page between its margins
HALF_PAGE_IN = (PAGE_WIDTH_IN / 2, 3.0)  # two of these lie side by side; none is so high that a page stays half empty

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib, so that every computer draws the same
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelcolor": BLACK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.6,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.1,
    "lines.solid_joinstyle": "round",
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.dpi": 100,
    "figure.facecolor": "white",
    "svg.hashsalt": "rooftrack",
}


P = ParamSpec("P")


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Draw in the house style, whatever the process has set for itself."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with _style():
            return draw(*args, **kwargs)

    return drawn


@contextmanager
def _style() -> Iterator[None]:
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(STYLE)
        yield


def encoded(figure: Figure, file_format: str = "png", *, dpi: int = 150) -> bytes:
    """Return the file of a figure, `png` or `svg`; the same figure gives the same bytes."""
    if file_format not in ("png", "svg"):
        raise ValueError(f"figures are written as png or svg, not {file_format!r}")
    FigureCanvasAgg(figure)
    stream = io.BytesIO()
    metadata = {"Software": None} if file_format == "png" else {"Date": None, "Creator": None}
    with _style():
        figure.savefig(stream, format=file_format, dpi=dpi, metadata=metadata)
    return stream.getvalue()


def target_figures(
    history: TargetHistory,
    intervals: Intervals,
    drift: Drift,
    *,
    comparison: GpsComparison | None = None,
    antenna_m: ArrayLike | None = None,
) -> dict[str, Figure]:
    """Return every figure one target can have, by the name of its file; what the project cannot tell is left out.

    The figures of drift show the unfiltered displacement, as the paper's do.

    Args:
        history: of the target.
        intervals: of the project.
        drift: of the project; its corner is marked, and drawn between the paper's 0.1 and 0.5 Hz.
        comparison: with GPS.
        antenna_m: (F, 2) the displacement that was compared with GPS; that of P1 where not given.
    """
    raw_m = history.p1_raw_m
    drawn = {"displacement": history_figure(history, intervals, {"unfiltered, at the paper's scale": raw_m})}
    if comparison is not None:
        moved = history.p1_m if antenna_m is None else antenna_m
        drawn["gps"] = gps_figure(history.time_s, moved, comparison, intervals)
    resting = within(history.time_s, intervals.pre_event)
    if intervals.pre_event is not None and np.isfinite(raw_m[resting]).all(axis=1).sum() >= 4:
        spectrum = amplitude_spectrum(raw_m, history.time_s, intervals.pre_event)
        drawn["pre_event"] = pre_event_figure(history.time_s[resting], raw_m[resting], spectrum)
        # A clip too short for any corner of the sweep has no such figures.
        with suppress(InputError):
            corners = sorted({0.1, drift.corner_hz, 0.5})
            filtered = {hz: high_pass(raw_m[:, 0], history.time_s, hz, drift.order) for hz in corners}
            drawn["corner_effect"] = corner_effect_figure(
                history.time_s, raw_m[:, 0], filtered, intervals=intervals, comparison=comparison
            )
        with suppress(InputError):
            sweep = corner_sweep(raw_m, history.time_s, intervals.pre_event, order=drift.order)
            drawn["corner_sweep"] = corner_sweep_figure(sweep, drift.corner_hz)
    drawn["orbit"] = orbit_figure(history)
    return drawn


@styled
def history_figure(
    history: TargetHistory,
    intervals: Intervals,
    also_m: Mapping[str, ArrayLike] | None = None,
) -> Figure:
    """Draw the displacement of P1 along x and y and the rotation, each with its band of two sigma.

    Args:
        history: of the target.
        intervals: shaded and named.
        also_m: other displacements of P1 to lay over it, name -> (F, 2), such as raw or another method's.
    """
    figure, axes = _stacked(3, height_in=4.8)
    others = {name: np.asarray(values, dtype=np.float64) for name, values in (also_m or {}).items()}
    for axis in (0, 1):
        drawn = [history.p1_m[:, axis], *(values[:, axis] for values in others.values())]
        scale, unit = length_unit(*drawn)
        for (name, values), colour in zip(others.items(), (GREY, GREEN, ORANGE, PURPLE), strict=False):
            axes[axis].plot(history.time_s, scale * values[:, axis], color=colour, lw=0.8, label=name)
        _band(
            axes[axis],
            history.time_s,
            values=scale * history.p1_m[:, axis],
            sigma=scale * history.p1_sigma_m[:, axis],
            place=axis,
        )
        axes[axis].set_ylabel(f"{AXIS_NAMES[axis]}, {unit}")
    _band(axes[2], history.time_s, values=1e3 * history.rotation_rad, sigma=1e3 * history.rotation_sigma_rad, place=2)
    axes[2].set_ylabel("rotation, mrad")
    axes[0].set_title(f"Displacement of {history.name} at P1")
    _legend(axes[0])
    axes[2].set_xlabel("time, s")
    for panel in axes:
        _shade(panel, intervals, named=panel is axes[0])
        _mark_unmeasured(panel, history)
    return figure


def _band(axes: Axes, time_s: Floats, *, values: Floats, sigma: Floats, place: int) -> None:
    colour = (*AXIS_COLOURS, GREEN)[place]
    axes.fill_between(time_s, values - 2 * sigma, values + 2 * sigma, color=colour, alpha=0.25, lw=0, label="±2 sigma")
    axes.plot(time_s, values, color=colour, label="measured")


def _mark_unmeasured(axes: Axes, history: TargetHistory) -> None:
    """Tick the times of frames without numbers at the foot of the panel."""
    unmeasured = history.time_s[~history.measured]
    axes.plot(unmeasured, np.zeros(len(unmeasured)), "|", color=BLACK, ms=5, transform=axes.get_xaxis_transform())


@styled
def pre_event_figure(
    time_s: ArrayLike, displacement_m: ArrayLike, spectrum: Spectrum, *, highest_hz: float = 3.0
) -> Figure:
    """Draw the pre-event displacement along x and y beside its Fourier amplitudes.

    Args:
        time_s: (F,) within the pre-event.
        displacement_m: (F, 2) unfiltered, NaN where not measured.
        spectrum: of the same frames.
        highest_hz: end of the frequency axis.

    Source: the paper's Fig. 7.
    """
    times, moved = np.asarray(time_s, dtype=np.float64), np.asarray(displacement_m, dtype=np.float64)
    figure = Figure(figsize=(PAGE_WIDTH_IN, 3.4), layout="constrained")
    panels = figure.subplots(2, 2, sharex="col", width_ratios=(3, 2))
    scale, unit = length_unit(moved)
    shown = (spectrum.frequency_hz > 0) & (spectrum.frequency_hz <= highest_hz)
    for axis in (0, 1):
        history, amplitudes = panels[axis]
        history.axhline(0, color=GREY, lw=0.8)
        history.plot(times, scale * moved[:, axis], color=AXIS_COLOURS[axis])
        history.set_ylabel(f"{AXIS_NAMES[axis]}, {unit}")
        frequency, amplitude = spectrum.frequency_hz[shown], scale * spectrum.amplitude_m[shown, axis]
        amplitudes.fill_between(frequency, amplitude, color=AXIS_COLOURS[axis], alpha=0.2, lw=0)
        amplitudes.plot(frequency, amplitude, color=AXIS_COLOURS[axis])
        amplitudes.set_ylabel(f"amplitude, {unit}")
        amplitudes.set_ylim(bottom=0)
    panels[0][0].set_title("Displacement before the event")
    panels[0][1].set_title("Fourier amplitudes")
    panels[1][0].set_xlabel("time, s")
    panels[1][1].set_xlabel("frequency, Hz")
    return figure


@styled
def corner_sweep_figure(sweep: CornerSweep, chosen_hz: float | None = None) -> Figure:
    """Draw what remains before the event against the corner frequency, the knee and the chosen corner marked.

    Args:
        sweep: of x and y.
        chosen_hz: corner of the project.

    Source: the paper's Fig. 8.
    """
    figure = Figure(figsize=HALF_PAGE_IN, layout="constrained")
    axes = figure.subplots()
    scale, unit = length_unit(sweep.rms_m)
    for axis, marker in zip((0, 1), "os", strict=True):
        colour = AXIS_COLOURS[axis]
        axes.plot(
            sweep.corners_hz, scale * sweep.rms_m[:, axis], color=colour, marker=marker, ms=3.5, label=AXIS_NAMES[axis]
        )
    if sweep.knee_hz is not None:
        axes.axvline(sweep.knee_hz, color=GREEN, ls="--", label=f"knee, {sweep.knee_hz:.3g} Hz")
    if chosen_hz is not None:
        axes.axvline(chosen_hz, color=BLACK, ls=":", label=f"chosen, {chosen_hz:.3g} Hz")
    axes.set(xlabel="corner frequency, Hz", ylabel=f"RMS before the event, {unit}")
    axes.set_ylim(bottom=0)
    axes.set_title("Sensitivity to the corner frequency")
    axes.legend(loc="upper right")
    return figure


@styled
def corner_effect_figure(
    time_s: ArrayLike,
    unfiltered_m: ArrayLike,
    filtered_m: Mapping[float, ArrayLike],
    *,
    intervals: Intervals,
    comparison: GpsComparison | None = None,
    axis: int = 0,
) -> Figure:
    """Draw what different corner frequencies make of the pre-event and of the event.

    Args:
        time_s: (F,).
        unfiltered_m: (F,) along one axis.
        filtered_m: corner in Hz -> (F,) along the same axis.
        intervals: the pre-event and the event each get a panel; the whole record does where one is missing.
        comparison: lays GPS over the event, where there is one.
        axis: 0 for x, 1 for y.

    Source: the paper's Fig. 9.
    """
    times, unfiltered = np.asarray(time_s, dtype=np.float64), np.asarray(unfiltered_m, dtype=np.float64)
    figure, panels = _stacked(2, height_in=3.8, share=False)
    named = (("Before the event", intervals.pre_event), ("During the event", intervals.event))
    for panel, (title, interval) in zip(panels, named, strict=True):
        chosen = within(times, interval)
        scale, unit = length_unit(unfiltered[chosen])
        panel.plot(times[chosen], scale * unfiltered[chosen], color=GREY, lw=0.9, label="unfiltered")
        for (corner_hz, filtered), colour in zip(sorted(filtered_m.items()), (ORANGE, BLUE, RED, PURPLE), strict=False):
            values = np.asarray(filtered, dtype=np.float64)[chosen]
            panel.plot(times[chosen], scale * values, color=colour, label=f"{corner_hz:g} Hz")
        panel.set_title(title)
        panel.set_ylabel(f"{AXIS_NAMES[axis]}, {unit}")
        if comparison is not None and panel is panels[1]:
            shown = within(comparison.time_s, interval)
            panel.plot(
                comparison.time_s[shown], scale * comparison.gps_m[shown, axis], ".", ms=3, color=BLACK, label="GPS"
            )
    panels[1].set_xlabel("time, s")
    _legend(panels[1])
    return figure


@styled
def gps_figure(
    time_s: ArrayLike, displacement_m: ArrayLike, comparison: GpsComparison, intervals: Intervals | None = None
) -> Figure:
    """Draw the displacement over GPS, and the error below it, along x and y.

    Args:
        time_s: (F,).
        displacement_m: (F, 2) at the antenna.
        comparison: with GPS in video time.
        intervals: shaded where given.

    Source: the paper's Fig. 11.
    """
    times, moved = np.asarray(time_s, dtype=np.float64), np.asarray(displacement_m, dtype=np.float64)
    figure = Figure(figsize=(PAGE_WIDTH_IN, 3.8), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, height_ratios=(3, 2))
    for axis in (0, 1):
        over, error = panels[:, axis]
        scale, unit = length_unit(moved[:, axis])
        over.plot(
            comparison.time_s, scale * comparison.gps_m[:, axis], color=BLACK, lw=0, marker=".", ms=3, label="GPS"
        )
        over.plot(times, scale * moved[:, axis], color=AXIS_COLOURS[axis], label="video")
        over.set_ylabel(f"{AXIS_NAMES[axis]}, {unit}")
        scale, unit = length_unit(comparison.error_m[:, axis])
        error.axhline(0, color=GREY, lw=0.8)
        rms = f"RMS {scale * comparison.rms_m[axis]:.2f} {unit}"
        error.plot(comparison.time_s, scale * comparison.error_m[:, axis], color=AXIS_COLOURS[axis], lw=0.9, label=rms)
        error.set_ylabel(f"error, {unit}")
        _legend(error)
        for panel in (over, error):
            _shade(panel, intervals or Intervals(), named=panel is over)
        error.set_xlabel("time, s")
    panels[0, 0].set_title(with_minus_sign(f"Video and GPS (clock lag {comparison.lag_s:.3f} s)"))
    _legend(panels[0, 1])
    return figure


@styled
def orbit_figure(history: TargetHistory) -> Figure:
    """Draw the path of P1 in plan, coloured by time, with north up and one scale for both axes."""
    figure = Figure(figsize=HALF_PAGE_IN, layout="constrained")
    axes = figure.subplots()
    scale, unit = length_unit(history.p1_m)
    x, y = scale * history.p1_m[history.measured].T
    axes.plot(x, y, color=GREY, lw=0.5, alpha=0.6)
    points = axes.scatter(x, y, c=history.time_s[history.measured], s=5, lw=0, cmap="cividis", zorder=3)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{AXIS_NAMES[0]}, {unit}", ylabel=f"{AXIS_NAMES[1]}, {unit}")
    axes.set_title(f"Path of {history.name} in plan")
    if len(x):
        figure.colorbar(points, ax=axes, label="time, s", shrink=0.8)
    return figure


@styled
def camera_figure(time_s: ArrayLike, centre_m: ArrayLike, roll_pitch_yaw_rad: ArrayLike | None = None) -> Figure:
    """Draw where the camera flew: its drift from the mean position over time, and its path in plan.

    Args:
        time_s: (F,).
        centre_m: (F, 3) camera centre, world, NaN where unknown.
        roll_pitch_yaw_rad: (F, 3) turns from the mean attitude, where to be shown.
    """
    times, centre = np.asarray(time_s, dtype=np.float64), np.asarray(centre_m, dtype=np.float64)
    known = np.isfinite(centre).all(axis=1)
    drift_m = centre - (centre[known].mean(axis=0) if known.any() else 0.0)
    turns = None if roll_pitch_yaw_rad is None else np.degrees(np.asarray(roll_pitch_yaw_rad, dtype=np.float64))
    figure = Figure(figsize=(PAGE_WIDTH_IN, 3.0 if turns is None else 3.6), layout="constrained")
    grid = figure.add_gridspec(1 if turns is None else 2, 2, width_ratios=(3, 2))
    history = figure.add_subplot(grid[0, 0])
    plan = figure.add_subplot(grid[:, 1])
    for axis, (name, colour) in enumerate(zip(("x (east)", "y (north)", "height"), (BLUE, RED, GREEN), strict=True)):
        history.plot(times, drift_m[:, axis], color=colour, label=name)
    history.set_ylabel("drift, m")
    history.set_title("Camera")
    _legend(history)
    last = history
    if turns is not None:
        last = figure.add_subplot(grid[1, 0], sharex=history)
        for axis, (name, colour) in enumerate(zip(("roll", "pitch", "yaw"), (BLUE, RED, GREEN), strict=True)):
            last.plot(times, turns[:, axis], color=colour, label=name)
        last.set_ylabel("turn, degrees")
        _legend(last)
    last.set_xlabel("time, s")
    plan.plot(drift_m[:, 0], drift_m[:, 1], color=GREY, lw=0.8)
    plan.scatter(drift_m[:, 0], drift_m[:, 1], c=times, s=4, lw=0, cmap="cividis", zorder=3)
    plan.set_aspect("equal", adjustable="datalim")
    plan.set(xlabel="x (east), m", ylabel="y (north), m")
    plan.set_title("Path in plan")
    return figure


@styled
def frame_figure(
    image: NDArray[np.uint8],
    *,
    lines_px: Mapping[str, ArrayLike],
    edges_px: Mapping[str, ArrayLike] | None = None,
    points_px: Mapping[str, ArrayLike] | None = None,
    ground_px: ArrayLike | None = None,
    regions_px: Sequence[ArrayLike] = (),
    title: str = "",
) -> Figure:
    """Draw what was tracked over a frame: the whole frame, and the roof enlarged beside it.

    Args:
        image: (h, w) or (h, w, 3), the raw frame.
        lines_px: name (L1, L2, T1) -> (N, 2) polyline of the fitted line, raw pixels.
        edges_px: name -> (N, 2) edge points.
        points_px: name (P1, P2) -> (2,).
        ground_px: (G, 2) ground features in use.
        regions_px: (C, 2) corners of each moving region.
    """
    lines = {name: np.asarray(points, dtype=np.float64).reshape(-1, 2) for name, points in lines_px.items()}
    height, width = image.shape[:2]
    # As high as the whole frame needs, and a little for the names.
    height_in = min(0.59 * PAGE_WIDTH_IN * height / width, 5.0) + 0.3
    figure = Figure(figsize=(PAGE_WIDTH_IN, height_in), layout="constrained")
    whole, roof = figure.subplots(1, 2, width_ratios=(3, 2))
    for panel in (whole, roof):
        panel.imshow(image, cmap="gray", interpolation="antialiased", vmin=0, vmax=255)
        panel.grid(visible=False)
        panel.set(xticks=[], yticks=[])
        _tracked(panel, lines, edges_px or {}, points_px or {}, enlarged=panel is roof)
    for region in regions_px:
        corners = np.asarray(region, dtype=np.float64)
        whole.fill(corners[:, 0], corners[:, 1], facecolor="none", edgecolor=RED, lw=0.8, ls="--")
    if ground_px is not None and len(features := np.asarray(ground_px, dtype=np.float64)):
        whole.plot(features[:, 0], features[:, 1], ".", color=GREEN, ms=2)
    whole.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    _enlarge(roof, lines, (width, height))
    whole.set_title(title)
    if lines:
        _legend(roof)
    return figure


def _tracked(
    axes: Axes,
    lines: Mapping[str, Floats],
    edges_px: Mapping[str, ArrayLike],
    points_px: Mapping[str, ArrayLike],
    *,
    enlarged: bool,
) -> None:
    for edges in edges_px.values() if enlarged else ():
        places = np.asarray(edges, dtype=np.float64).reshape(-1, 2)
        axes.plot(places[:, 0], places[:, 1], ".", color="white", ms=1.2, mew=0)
    for name, line in lines.items():
        axes.plot(line[:, 0], line[:, 1], color=LINE_COLOURS.get(name, SKY), lw=1.3 if enlarged else 0.9, label=name)
    for (name, point), marker in zip(points_px.items(), "osD^" * len(points_px), strict=False):
        u, v = np.asarray(point, dtype=np.float64)
        axes.plot(u, v, marker, mfc="none", mec="white", ms=7 if enlarged else 3, mew=1.2, ls="none")
        axes.plot(u, v, marker, mfc="none", mec=BLACK, ms=7 if enlarged else 3, mew=0.6, ls="none", label=name)


def _enlarge(axes: Axes, lines: Mapping[str, Floats], size_px: tuple[int, int]) -> None:
    """Show what lies around the lines, or the whole frame where there are none."""
    every = np.concatenate([*lines.values(), np.empty((0, 2))])
    every = every[np.isfinite(every).all(axis=1)]
    low, high = (every.min(axis=0), every.max(axis=0)) if len(every) else (np.zeros(2), np.array(size_px, dtype=float))
    margin = 0.08 * max(float((high - low).max()), 50.0)
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(high[1] + margin, low[1] - margin))


def length_unit(*values_m: ArrayLike) -> tuple[float, str]:
    """Return the factor and the name of the unit people read such lengths in: mm below 2 cm, else cm."""
    largest = 0.0
    for values in values_m:
        finite = np.asarray(values, dtype=np.float64)
        finite = finite[np.isfinite(finite)]
        largest = max(largest, float(np.abs(finite).max(initial=0.0)))
    return (1000.0, "mm") if largest < 0.02 else (100.0, "cm")


def _stacked(count: int, *, height_in: float, share: bool = True) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(PAGE_WIDTH_IN, height_in), layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(count, 1, sharex=share)))


def _legend(axes: Axes) -> None:
    """Name the curves in one line above the panel, where they cover no data."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=6, borderaxespad=0.1, handlelength=1.4)


def _shade(axes: Axes, intervals: Intervals, *, named: bool) -> None:
    """Shade the intervals lightly; their names inside at the top where asked for."""
    shades = (
        ("pre-event", intervals.pre_event, SKY),
        ("event", intervals.event, ORANGE),
        ("residual", intervals.residual, GREEN),
    )
    inside = axes.get_xaxis_transform()
    for name, interval, colour in shades:
        if interval is None:
            continue
        axes.axvspan(*interval, color=colour, alpha=0.07, lw=0)
        if named:
            axes.text(interval[0], 0.99, f" {name}", transform=inside, va="top", fontsize=7, color="#555555")
