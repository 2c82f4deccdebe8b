"""What the drift of the camera leaves in a displacement, and the paper's way to take it out.

Fourier amplitude spectra, a zero-phase Butterworth high-pass, and the sweep by which its corner is chosen: the
building stands still before the event, so whatever motion is left there at a corner frequency is error.

Source: the paper's "Filtering of Video-Based Results", Figs. 7-9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from core.coordinates import Bools, Floats, read_only
from core.errors import InputError
from core.intervals import within
from core.project import Intervals
from core.words import with_minus_sign

# The paper's range, in steps fine enough to see its knee.
SWEEP_CORNERS_HZ = tuple((0.05 + 0.025 * np.arange(19)).round(3).tolist())
# The paper calls a filtered pre-event acceptable below this.
ACCEPTABLE_PRE_EVENT_RMS_M = 0.01
# Millisecond timestamps scatter by 3 % of a frame at 60 frames a second; below this a record counts as even.
_EVEN_WITHIN_FRAMES = 0.1
# Frames that a filter or a spectrum needs.
LEAST_FRAMES = 4
AXIS_NAMES = ("x (east)", "y (north)")


@dataclass(frozen=True)
class Spectrum:
    """One-sided Fourier amplitudes.

    Attributes:
        frequency_hz: (B,) from 0 to half the frame rate.
        amplitude_m: (B,) or (B, K) in the unit of the values: a steady sine shows its own amplitude.
    """

    frequency_hz: Floats
    amplitude_m: Floats


@dataclass(frozen=True)
class CornerSweep:
    """What remains of a motion that should be zero, at each corner frequency.

    Attributes:
        corners_hz: (C,).
        rms_m: (C, K) about zero, over the interval; NaN where the record is too short for the corner.
        knee_hz: where nine tenths of what the sweep takes away are gone, or None where the curve has no such place.
    """

    corners_hz: Floats
    rms_m: Floats
    knee_hz: float | None

    @property
    def at_knee_m(self) -> Floats | None:
        """(K,) what remains at the knee."""
        return None if self.knee_hz is None else read_only(self.rms_m[self.corners_hz == self.knee_hz][0])

    @property
    def beyond_knee_m(self) -> Floats | None:
        """(K,) the least that a corner above the knee leaves, which may be far less on one axis."""
        return None if self.knee_hz is None else read_only(self.rms_m[self.corners_hz >= self.knee_hz].min(axis=0))


def amplitude_spectrum(values: ArrayLike, time_s: ArrayLike, interval_s: tuple[float, float] | None = None) -> Spectrum:
    """Return the one-sided Fourier amplitude spectrum, scaled so that a sine of 1 cm shows 1 cm.

    Frames not measured are bridged by straight lines. Uneven timestamps are brought to their median rate first.

    Args:
        values: (F,) or (F, K), NaN where not measured.
        time_s: (F,) increasing.
        interval_s: part of the record to take; the whole record where None.

    Raises:
        InputError: fewer than four measured frames in the interval.
    """
    times = np.asarray(time_s, dtype=np.float64)
    chosen = within(times, interval_s)
    columns, single = _columns(values)
    columns, times = columns[chosen], times[chosen]
    if np.isfinite(columns).all(axis=1).sum() < 4:
        raise InputError("A spectrum needs at least four measured frames; choose a longer interval.")
    grid_s, grid = _on_even_grid(_bridged(columns, times), times)
    amplitude = np.abs(np.fft.rfft(grid, axis=0)) * (2 / len(grid))
    amplitude[0] /= 2
    if len(grid) % 2 == 0:
        amplitude[-1] /= 2
    frequency = np.fft.rfftfreq(len(grid), _step(grid_s))
    return Spectrum(read_only(frequency), read_only(amplitude[:, 0] if single else amplitude))


def high_pass(values: ArrayLike, time_s: ArrayLike, corner_hz: float, order: int = 10) -> Floats:
    """Return the values without what varies slower than the corner frequency.

    A Butterworth filter of half the order runs forwards and backwards in second-order sections (as polynomial
    coefficients, a tenth-order filter at 0.25 Hz of 15 Hz cannot be computed). The two passes cancel each other's
    phase, so no peak is delayed, and their slopes add up: the result falls off like the order asked for, an odd one
    taken as the next even one. The corner of the single pass is moved so that the result is 3 dB down
    (a factor of 0.707) at the corner asked for. With m = order/2 and g = (sqrt(2) - 1)^(1/2m) the response is
    1 / (1 + (g corner/f)^2m); at the default order, 0.94 at 1.2 times the corner and 0.01 at 0.57 times.

    Frames not measured are bridged by straight lines while filtering and stay NaN. Where timestamps are uneven,
    the slow part is found on an even grid and subtracted at the frames' own times.

    Args:
        values: (F,) or (F, K), any unit, NaN where not measured.
        time_s: (F,) increasing.
        corner_hz: where the response is down by 3 dB.
        order: of the resulting zero-phase response.

    Returns:
        Same shape as `values`.

    Raises:
        InputError: the corner is not below half the frame rate, or the record is shorter than half its period.
    """
    columns, single = _columns(values)
    times = np.asarray(time_s, dtype=np.float64)
    record = _Record.of(columns, times)
    filtered = record.without(record.slow_part(corner_hz, order))
    return filtered[:, 0] if single else filtered


def corner_sweep(
    values: ArrayLike,
    time_s: ArrayLike,
    interval_s: tuple[float, float],
    *,
    corners_hz: Sequence[float] = SWEEP_CORNERS_HZ,
    order: int = 10,
) -> CornerSweep:
    """Return what remains in an interval of rest when the whole record is filtered at each corner.

    Args:
        values: (F,) or (F, K) metres, NaN where not measured.
        time_s: (F,) increasing.
        interval_s: when the building stood still.
        corners_hz: ascending.
        order: as in `high_pass`.

    Raises:
        InputError: no measured frame lies in the interval, or no corner suits the record.

    Source: the paper's Fig. 8.
    """
    columns, _ = _columns(values)
    times = np.asarray(time_s, dtype=np.float64)
    chosen = within(times, interval_s)
    if not np.isfinite(columns[chosen]).any():
        raise InputError(
            f"intervals_s.pre_event: no measured frame between {interval_s[0]:g} and {interval_s[1]:g} s; "
            "choose an interval of the video in which the target was measured."
        )
    record = _Record.of(columns, times)
    rms = np.full((len(corners_hz), columns.shape[1]), np.nan)
    usable = [place for place, corner in enumerate(corners_hz) if record.problem_with(corner) is None]
    if not usable:
        raise InputError(record.problem_with(corners_hz[-1]) or "The sweep was given no corner frequency.")
    for place in usable:
        rms[place] = _rms(record.without(record.slow_part(corners_hz[place], order))[chosen])
    corners = np.asarray(corners_hz, dtype=np.float64)
    total = np.sqrt(np.nansum(rms[usable] ** 2, axis=1))
    return CornerSweep(read_only(corners), read_only(rms), _knee(corners[usable], total))


def corner_obstacle(corner_hz: float, time_s: ArrayLike) -> str | None:
    """Return what keeps frames at these times from being filtered at a corner, a sentence without its end; or None.

    Args:
        time_s: (F,) increasing.
    """
    times = np.asarray(time_s, dtype=np.float64)
    if len(times) < LEAST_FRAMES:
        return _too_few(len(times))
    grid_s = _even_times(times)
    rate_hz = 1 / _step(grid_s)
    duration_s = len(grid_s) / rate_hz
    if not 0 < corner_hz < rate_hz / 2:
        return (
            f"drift.corner_hz: {corner_hz:g} Hz is not between 0 and half the frame rate ({rate_hz / 2:g} Hz); "
            "choose a lower corner"
        )
    if duration_s * corner_hz < 0.5:
        return (
            f"drift.corner_hz: the record lasts {duration_s:.1f} s, less than half a period of {corner_hz:g} Hz; "
            f"choose a corner above {0.5 / duration_s:.2f} Hz or a longer video"
        )
    return None


def _too_few(frames: int) -> str:
    return f'drift.filter: the record has {frames} frames, but a filter needs at least {LEAST_FRAMES}; choose "none"'


def filter_warnings(
    unfiltered_m: ArrayLike,
    filtered_m: ArrayLike,
    time_s: ArrayLike,
    intervals: Intervals,
    *,
    corner_hz: float,
    steady_m: ArrayLike | None = None,
) -> list[str]:
    """Return, in words, what a high-pass at this corner does that an engineer would not want.

    Args:
        unfiltered_m: (F, 2) displacement before the filter, NaN where not measured.
        filtered_m: (F, 2) after it.
        time_s: (F,).
        intervals: of the project; each warning needs the intervals it speaks of.
        corner_hz: of the filter.
        steady_m: (F, 2) displacement that is free of drift without a filter, as the geometric method gives it, where it
            is known: drift that hides a residual in `unfiltered_m` does not hide it there.
    """
    before, after = np.asarray(unfiltered_m, dtype=np.float64), np.asarray(filtered_m, dtype=np.float64)
    times = np.asarray(time_s, dtype=np.float64)
    return [
        *_residual_warnings(
            before, after, times, intervals=intervals, steady=None if steady_m is None else np.asarray(steady_m)
        ),
        *_pre_event_warnings(after, times, intervals, corner_hz),
        *_frequency_warnings(before, times, intervals, corner_hz),
    ]


def _residual_warnings(
    before: Floats, after: Floats, times: Floats, *, intervals: Intervals, steady: Floats | None
) -> list[str]:
    """A residual that stands out of the drift, and does not survive."""
    source = "before it" if steady is None else "by the geometric method"
    before = before if steady is None else steady
    if intervals.residual is None:
        return []
    chosen = within(times, intervals.residual)
    if not np.isfinite(before[chosen]).all(axis=1).any():
        return []
    drift = np.zeros(2) if intervals.pre_event is None else _largest(before[within(times, intervals.pre_event)])
    eaten = []
    for axis, name in enumerate(AXIS_NAMES):
        was, remains = float(np.nanmean(before[chosen, axis])), float(np.nanmean(after[chosen, axis]))
        if abs(was) > max(0.005, 1.5 * drift[axis]) and abs(remains) < 0.7 * abs(was):
            eaten.append(f"along {name} {_centimetres(was)} {source} and {_centimetres(remains)} after it")
    if not eaten:
        return []
    return [
        f"The filter removes the residual displacement: {', '.join(eaten)}. "
        "Use the geometric method without a filter where a residual matters."
    ]


def _centimetres(value_m: float) -> str:
    """Return a length in words, with a real minus sign, and none before zero."""
    return with_minus_sign(f"{round(100 * value_m, 1) + 0.0:.1f} cm")


def _pre_event_warnings(after: Floats, times: Floats, intervals: Intervals, corner_hz: float) -> list[str]:
    """A pre-event that is not quiet yet, or too short to tell."""
    if intervals.pre_event is None:
        return []
    start, end = intervals.pre_event
    warnings = []
    if (end - start) * corner_hz < 1:
        warnings.append(
            f"The pre-event interval lasts {end - start:.1f} s, less than one period of the corner frequency "
            f"({1 / corner_hz:.1f} s); it cannot show whether the corner is high enough."
        )
    remaining = _rms(after[within(times, intervals.pre_event)])
    for axis, name in enumerate(AXIS_NAMES):
        if remaining[axis] > ACCEPTABLE_PRE_EVENT_RMS_M:
            warnings.append(
                f"The pre-event interval still moves by {100 * remaining[axis]:.1f} cm RMS along {name}, where it "
                f"should stand still; the paper accepts less than {100 * ACCEPTABLE_PRE_EVENT_RMS_M:.0f} cm."
            )
    return warnings


def _frequency_warnings(before: Floats, times: Floats, intervals: Intervals, corner_hz: float) -> list[str]:
    """A corner at which the building itself moves, or above that."""
    near: list[str] = []
    above: list[str] = []
    for axis, name in enumerate(AXIS_NAMES):
        dominant_hz = dominant_frequency(before[:, axis], times, intervals)
        if dominant_hz is None or corner_hz <= 0.5 * dominant_hz:
            continue
        (above if corner_hz > dominant_hz else near).append(f"{dominant_hz:.2f} Hz along {name}")
    corner = f"The corner frequency, {corner_hz:.2f} Hz,"
    most = "where the target moves most during the event; the filter takes away"
    warnings = []
    if near:
        warnings.append(f"{corner} comes near {' and '.join(near)}, {most} real motion.")
    if above:
        warnings.append(f"{corner} lies above {' and '.join(above)}, {most} most of the motion.")
    return warnings


def dominant_frequency(values_m: ArrayLike, time_s: ArrayLike, intervals: Intervals) -> float | None:
    """Return the frequency at which a target moves most during the event, drift left aside.

    Drift is what the pre-event shows too, and it weakens with frequency: only frequencies count at which the event
    stands three times above all that the pre-event holds from one octave lower upwards. None where the event is not
    given, not measured, or does not stand out.

    Args:
        values_m: (F,) unfiltered displacement along one axis.
        time_s: (F,).
        intervals: of the project.
    """
    values = np.asarray(values_m, dtype=np.float64)
    times = np.asarray(time_s, dtype=np.float64)
    if intervals.event is None or np.isfinite(values[within(times, intervals.event)]).sum() < 4:
        return None
    event = amplitude_spectrum(values, times, intervals.event)
    frequency, amplitude = event.frequency_hz[1:], event.amplitude_m[1:].copy()
    if intervals.pre_event is not None and np.isfinite(values[within(times, intervals.pre_event)]).sum() >= 4:
        amplitude[amplitude < 3 * _drift_level(values, times, intervals.pre_event, frequency)] = 0.0
    return float(frequency[np.argmax(amplitude)]) if amplitude.any() else None


def _drift_level(values: Floats, times: Floats, pre_event_s: tuple[float, float], frequency_hz: Floats) -> Floats:
    """Return (B,) the amplitude random drift like the pre-event's may reach in a record of other length."""
    rest = amplitude_spectrum(values, times, pre_event_s)
    highest_from_here = np.maximum.accumulate(rest.amplitude_m[:0:-1])[::-1]
    place = np.searchsorted(rest.frequency_hz[1:], frequency_hz / 2).clip(max=len(highest_from_here) - 1)
    # Amplitudes of a random motion fall with the root of the record's length; a bin is one over that length.
    return np.asarray(highest_from_here[place] * math.sqrt(frequency_hz[0] / rest.frequency_hz[1]), dtype=np.float64)


@dataclass(frozen=True)
class _Record:
    """A displacement made ready for filtering: gaps bridged, on an even grid.

    Attributes:
        columns: (F, K) as measured, NaN in the gaps.
        times: (F,) of the frames.
        grid: (G, K) bridged, on an even grid.
        grid_s: (G,) its times; the frames' own where these are even.
        even: whether the frames lie on the grid.
    """

    columns: Floats
    times: Floats
    grid: Floats
    grid_s: Floats
    even: bool

    @classmethod
    def of(cls, columns: Floats, times: Floats) -> _Record:
        if len(times) < LEAST_FRAMES:
            raise InputError(f"{_too_few(len(times))}.")
        grid_s, grid = _on_even_grid(_bridged(columns, times), times)
        return cls(columns, times, grid, grid_s, even=grid_s is times)

    def problem_with(self, corner_hz: float) -> str | None:
        """Say why this record cannot be filtered at this corner, if so."""
        obstacle = corner_obstacle(corner_hz, self.grid_s)
        return None if obstacle is None else f"{obstacle}."

    def slow_part(self, corner_hz: float, order: int) -> Floats:
        """(G, K) what the high-pass takes away."""
        problem = self.problem_with(corner_hz)
        if problem is not None:
            raise InputError(problem)
        rate_hz = 1 / _step(self.grid_s)
        passes_order = max(1, math.ceil(order / 2))
        single_pass_hz = corner_hz * (math.sqrt(2) - 1) ** (1 / (2 * passes_order))
        sections = butter(passes_order, single_pass_hz, btype="highpass", fs=rate_hz, output="sos")
        # Continued by its own mirror image through the end point for two periods, in which the filter settles.
        padding = min(len(self.grid) - 1, math.ceil(2 * rate_hz / corner_hz))
        return np.asarray(self.grid - sosfiltfilt(sections, self.grid, axis=0, padlen=padding), dtype=np.float64)

    def without(self, slow: Floats) -> Floats:
        """(F, K) the measured values less a slow part given on the grid."""
        return self.columns - (slow if self.even else CubicSpline(self.grid_s, slow)(self.times))


def _columns(values: ArrayLike) -> tuple[Floats, bool]:
    """Return (F, K), and whether it was a single column without an axis of its own."""
    array = np.asarray(values, dtype=np.float64)
    return (array[:, None], True) if array.ndim == 1 else (array, False)


def _bridged(columns: Floats, times: Floats) -> Floats:
    """Return the columns with straight lines over their gaps and level ends; zero where nothing was measured."""
    measured: Bools = np.isfinite(columns)
    if measured.all():
        return columns
    bridged = np.zeros_like(columns)
    for column in np.flatnonzero(measured.any(axis=0)):
        known = measured[:, column]
        bridged[:, column] = np.interp(times, times[known], columns[known, column])
    return bridged


def _even_times(times: Floats) -> Floats:
    """Return the times where they are even, else an even grid (G,) over them at the median rate."""
    even = np.linspace(times[0], times[-1], len(times))
    if np.abs(times - even).max() < _EVEN_WITHIN_FRAMES * _step(even):
        return times
    step = float(np.median(np.diff(times)))
    return np.arange(times[0], times[-1] + step / 2, step)


def _on_even_grid(columns: Floats, times: Floats) -> tuple[Floats, Floats]:
    """Return times and values on an even grid: what was given where it is even, else resampled to the median rate."""
    grid_s = _even_times(times)
    if grid_s is times:
        return times, columns
    resampled = [np.interp(grid_s, times, columns[:, column]) for column in range(columns.shape[1])]
    return grid_s, np.stack(resampled, axis=1)


def _step(times: Floats) -> float:
    """Return the spacing of an even grid, s."""
    return float(times[-1] - times[0]) / (len(times) - 1)


def _rms(columns: Floats) -> Floats:
    """Return (K,) about zero; NaN where nothing was measured."""
    measured = np.isfinite(columns)
    with np.errstate(invalid="ignore"):
        mean_square = np.sum(np.where(measured, columns, 0.0) ** 2, axis=0) / measured.sum(axis=0)
    return np.asarray(np.sqrt(mean_square), dtype=np.float64)


def _knee(corners_hz: Floats, rms_m: Floats) -> float | None:
    """Return the lowest corner that takes away nine tenths of what the whole sweep can take away.

    Breakpoint fits and the point farthest from the chord scattered two to four times as much over random drifts of
    known bandwidth. There is no knee where the sweep takes away less than a third (no drift to speak of), or where
    the nine tenths are reached only at the end of the sweep (the drift is faster than any of its corners).
    """
    first, last = float(rms_m[0]), float(rms_m[-1])
    if len(rms_m) < 4 or last > first * 2 / 3:
        return None
    knee_hz = float(corners_hz[np.argmax(rms_m <= last + 0.1 * (first - last))])
    return knee_hz if knee_hz < corners_hz[0] + 0.85 * (corners_hz[-1] - corners_hz[0]) else None


def _largest(columns: Floats) -> Floats:
    """Return (K,) of absolute values; zero where nothing was measured."""
    return np.asarray(np.abs(np.where(np.isfinite(columns), columns, 0.0)).max(axis=0, initial=0.0), dtype=np.float64)
