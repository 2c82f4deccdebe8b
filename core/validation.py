"""Comparison with GPS: clock lag, error history, and the rows of the paper's Table 2.

Sign of the lag: GPS time + lag = video time.

Source: the paper's "Validation of Motion-Tracking Results", Fig. 11 and Table 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar
from scipy.signal import correlate

from core.coordinates import Bools, Floats, read_only
from core.errors import InputError
from core.gps_record import GpsRecord
from core.intervals import within
from core.project import Intervals

# Velocities of the same motion correlate above 0.9; of two records of noise, below 0.3 at every lag tried.
_LEAST_CORRELATION = 0.5
# Through fewer samples than these, some stretch of the video fits by chance.
_LEAST_SHARED = 12
# Every lag that correlates with this part of the best is refined, up to so many: a slow receiver sees few samples of
# the shaking, and then a wrong lag may correlate better than the right one, though it fits worse.
_CANDIDATE = 0.6
_MOST_CANDIDATES = 12
# Of lags a period apart under heavy drift, the wrong one was taken only where it fitted within this of the right one.
_RIVAL = 1.2
# A GPS time is compared where the video was measured on both sides, not farther apart than this many frames.
_BRIDGED_FRAMES = 3.5
# Lags tried between two GPS samples, unless frames lie farther apart.
_TRIALS_PER_SAMPLE = 5
# The time in which a change stands well out of the noise of two samples, and the shaking does not yet turn round.
_LEAST_CHANGE_S = 0.1
# What people write coordinates in by mistake, how many times as large as metres, and how far from that a record of the
# same motion may be: degrees of longitude grow shorter towards the poles.
_OTHER_UNITS = (
    ("millimetres", 1000.0, 1.25),
    ("centimetres", 100.0, 1.25),
    ("feet", 1 / 0.3048, 1.25),
    ("degrees", 1 / 111_000, 5.0),
)
# No receiver on a shaken roof takes samples as seldom as this; in milliseconds they seem to lie farther apart.
_SELDOM_S = 5.0
# GPS samples farther apart than this many frames straddle peaks that the video sees.
_COARSE_FRAMES = 1.5


@dataclass(frozen=True)
class ComparisonRow:
    """One figure of Table 2: the same quantity from the video and from GPS, metres.

    `video_at_gps_m` is the video at the instant of the GPS value, for a peak: GPS takes fewer samples than the video,
    its largest one lies beside the peak, and so the two peaks differ even where the records agree.
    """

    video_m: float
    gps_m: float
    video_at_gps_m: float | None = None

    @property
    def error_m(self) -> float:
        """Video less GPS."""
        return self.video_m - self.gps_m

    @property
    def error_percent(self) -> float | None:
        """Absolute error in percent of the GPS value; None where that is zero."""
        return 100 * abs(self.error_m / self.gps_m) if self.gps_m else None

    @property
    def error_at_gps_m(self) -> float | None:
        """Video less GPS at the instant of the GPS value."""
        return None if self.video_at_gps_m is None else self.video_at_gps_m - self.gps_m


@dataclass(frozen=True)
class GpsComparison:
    """What the video and GPS say about the same motion.

    Attributes:
        lag_s: added to GPS times to get video times; 0 where it could not be told.
        lag_sigma_s: one standard deviation; None where the lag could not be told.
        correlation: of the two velocities at that lag, -1 to 1.
        message: a sentence where something could not be told, else empty.
        time_s: (N,) GPS samples that lie within the video, in video time.
        gps_m: (N, 2) GPS displacement from its mean over the pre-event.
        video_m: (N, 2) video at the same times, NaN where not measured.
        error_m: (N, 2) video less GPS.
        rms_m: (2,) of the error.
        sample_step_s, frame_step_s: how far apart the samples of GPS and the frames of the video lie, the median.
        peak_positive, peak_negative, residual: per axis x, y; None where not measured or no interval is given.
    """

    lag_s: float
    lag_sigma_s: float | None
    correlation: float
    message: str
    time_s: Floats
    gps_m: Floats
    video_m: Floats
    error_m: Floats
    rms_m: Floats
    sample_step_s: float
    frame_step_s: float
    peak_positive: tuple[ComparisonRow | None, ComparisonRow | None]
    peak_negative: tuple[ComparisonRow | None, ComparisonRow | None]
    residual: tuple[ComparisonRow | None, ComparisonRow | None]

    @property
    def is_coarse(self) -> bool:
        """Whether GPS samples lie so much farther apart than frames that a peak falls between them."""
        return self.sample_step_s > _COARSE_FRAMES * self.frame_step_s

    @property
    def spacing(self) -> str:
        """Say how far apart the samples lie, and what that does to peaks."""
        lie = f"GPS samples lie {self.sample_step_s:.3g} s apart, frames {self.frame_step_s:.3g} s"
        if not self.is_coarse:
            return f"{lie}."
        return f"{lie}: GPS misses the top of a quick peak, so peaks are also compared at the instants of the GPS ones."

    def table(self) -> list[dict[str, Any]]:
        """Return the rows of Table 2 that could be told, per quantity and axis."""
        return [
            {
                "quantity": quantity,
                "axis": axis,
                "video_m": row.video_m,
                "gps_m": row.gps_m,
                "error_m": row.error_m,
                "error_percent": row.error_percent,
                "video_at_gps_m": row.video_at_gps_m,
                "error_at_gps_m": row.error_at_gps_m,
            }
            for quantity in ("peak_positive", "peak_negative", "residual")
            for axis, row in zip("xy", getattr(self, quantity), strict=True)
            if row is not None
        ]

    def summary(self) -> dict[str, Any]:
        """Return `gps` of `summary.json`."""
        return {
            "lag_s": self.lag_s,
            "lag_sigma_s": self.lag_sigma_s,
            "correlation": self.correlation,
            "message": self.message,
            "samples": len(self.time_s),
            "sample_step_s": self.sample_step_s,
            "frame_step_s": self.frame_step_s,
            "rms_m": dict(zip("xy", self.rms_m.tolist(), strict=True)),
            **{f"{name}_m": self._rows(name) for name in ("peak_positive", "peak_negative", "residual")},
        }

    def _rows(self, quantity: str) -> dict[str, Any]:
        rows: tuple[ComparisonRow | None, ...] = getattr(self, quantity)
        return {
            axis: None
            if row is None
            else {
                "video": row.video_m,
                "gps": row.gps_m,
                "error": row.error_m,
                "error_percent": row.error_percent,
                "video_at_gps": row.video_at_gps_m,
                "error_at_gps": row.error_at_gps_m,
            }
            for axis, row in zip("xy", rows, strict=True)
        }


def compare_with_gps(
    time_s: ArrayLike, displacement_m: ArrayLike, gps: GpsRecord, intervals: Intervals
) -> GpsComparison:
    """Return how the video's displacement compares with GPS, after setting the GPS clock.

    The lag is found where the two velocities correlate best (velocities know neither baseline nor slow drift), then
    refined to the least RMS difference of the displacements or of their changes, whichever tells it better, the video
    interpolated by cubic splines. The GPS displacement is taken from its mean over the pre-event; without one, from
    the video's mean over all samples, which is said.

    Args:
        time_s: (F,) of the frames.
        displacement_m: (F, 2) at the antenna, from rest, NaN where not measured.
        gps: the record.
        intervals: of the project, in video time.

    Raises:
        InputError: the video has no measured frames, the two records share no time, or GPS is not in metres.
    """
    times = np.asarray(time_s, dtype=np.float64)
    moved = np.asarray(displacement_m, dtype=np.float64)
    video = _Video.of(times, moved)
    lag = _lag(video, gps)
    lag_s = lag.lag_s
    shared = within(gps.time_s + lag_s, (float(video.times[0]), float(video.times[-1])))
    sample_s, sample_m = gps.time_s[shared] + lag_s, gps.position_m[shared]
    video_m = video.at(sample_s)
    if not np.isfinite(video_m).any():
        raise InputError(
            f"{gps.name}: its times, {gps.time_s[0]:g} to {gps.time_s[-1]:g} s, share nothing with the measured video, "
            f"{video.times[0]:g} to {video.times[-1]:g} s, and no common motion tells the clocks' difference; "
            f"{_unit_of_time(gps)}give the record of this video, or set inputs.gps to null."
        )
    baseline_m, without_rest = _baseline(sample_s, sample_m, video_m, intervals)
    sample_m = sample_m - baseline_m
    error_m = video_m - sample_m
    return GpsComparison(
        lag_s=lag_s,
        lag_sigma_s=lag.sigma_s,
        correlation=lag.correlation,
        message=" ".join(sentence for sentence in (lag.doubt(gps), without_rest) if sentence),
        time_s=read_only(sample_s),
        gps_m=read_only(sample_m),
        video_m=read_only(video_m),
        error_m=read_only(error_m),
        rms_m=read_only(np.sqrt(np.nanmean(error_m**2, axis=0))),
        sample_step_s=float(np.median(np.diff(gps.time_s))),
        frame_step_s=float(np.median(np.diff(times))),
        peak_positive=_peak_rows(
            times, moved, sample_s=sample_s, sample_m=sample_m, video_m=video_m, intervals=intervals, sign=1
        ),
        peak_negative=_peak_rows(
            times, moved, sample_s=sample_s, sample_m=sample_m, video_m=video_m, intervals=intervals, sign=-1
        ),
        residual=_residual_rows(times, moved, sample_s=sample_s, sample_m=sample_m, intervals=intervals),
    )


@dataclass(frozen=True)
class _Video:
    """Measured frames as a curve through time."""

    times: Floats
    moved: Floats
    curve: CubicSpline
    widest_bridge_s: float

    @classmethod
    def of(cls, times: Floats, moved: Floats) -> _Video:
        measured = np.isfinite(moved).all(axis=1)
        if measured.sum() < 4:
            raise InputError(
                f"The target was measured in {int(measured.sum())} frames; a comparison with GPS needs at least four."
            )
        step_s = float(np.median(np.diff(times)))
        known_s, known_m = times[measured], moved[measured]
        return cls(known_s, known_m, CubicSpline(known_s, known_m), _BRIDGED_FRAMES * step_s)

    def at(self, time_s: Floats) -> Floats:
        """(N, 2) displacement at any times; NaN outside the video and in its gaps."""
        values = np.asarray(self.curve(time_s), dtype=np.float64)
        after = np.searchsorted(self.times, time_s).clip(1, len(self.times) - 1)
        in_gap = self.times[after] - self.times[after - 1] > self.widest_bridge_s
        outside = (time_s < self.times[0]) | (time_s > self.times[-1])
        # A sample on a frame is measured, whatever lies beside it.
        on_frame = np.minimum(np.abs(self.times[after] - time_s), np.abs(self.times[after - 1] - time_s)) < 1e-6
        values[(in_gap & ~on_frame) | outside] = np.nan
        return values


@dataclass(frozen=True)
class _Lag:
    """The clocks' difference, its standard deviation (None where it could not be told), and what else fits."""

    lag_s: float
    sigma_s: float | None
    correlation: float
    rival_s: float | None = None

    def doubt(self, gps: GpsRecord) -> str:
        """Say in a sentence what is uncertain; empty where nothing is."""
        name = Path(gps.name).name
        if self.sigma_s is None:
            return (
                f"The clock lag of {name} could not be told, because video and GPS show no motion in common "
                f"over {_LEAST_SHARED} samples or more (correlation {self.correlation:.2f}); {_unit_of_time(gps)}the "
                "records are compared as if their clocks agreed."
            )
        if self.rival_s is not None:
            return (
                f"The clock lag of {name} is in doubt: {self.rival_s:.2f} s fits nearly as well as {self.lag_s:.2f} s, "
                "because the motion repeats itself; compare a result with less drift, or a longer record."
            )
        return ""


def _lag(video: _Video, gps: GpsRecord) -> _Lag:
    lags_s, correlations = _correlations(video, gps)
    best = float(correlations.max(initial=-1.0))
    if best < _LEAST_CORRELATION:
        return _Lag(0.0, None, best)
    _require_metres(video, gps, float(lags_s[np.argmax(correlations)]))
    # Regular shaking correlates nearly as well a period earlier or later: every good peak is refined, the best kept.
    higher = (correlations >= _CANDIDATE * best) & _local_maxima(correlations)
    coarse = np.flatnonzero(higher)[np.argsort(correlations[higher])[::-1][:_MOST_CANDIDATES]]
    step_s = float(lags_s[1] - lags_s[0]) if len(lags_s) > 1 else 0.1
    refined = [
        min(
            (
                _refined(video, gps, float(lags_s[place]), step_s, differenced=differenced)
                for differenced in (False, True)
            ),
            key=lambda result: result[1],
        )
        for place in coarse
    ]
    (lag_s, sigma_s), *others = sorted(refined, key=lambda result: result[1])
    rivals = [other_s for other_s, other in others if other < _RIVAL * sigma_s and abs(other_s - lag_s) > 2 * step_s]
    return _Lag(lag_s, sigma_s, best, rivals[0] if rivals else None)


def _unit_of_time(gps: GpsRecord) -> str:
    """Say in a part of a sentence that times look like milliseconds; empty where they do not."""
    apart_s = float(np.median(np.diff(gps.time_s)))
    if apart_s < _SELDOM_S:
        return ""
    return f"its samples lie {apart_s:g} s apart, as if times were in milliseconds: divide them by 1000; "


def _correlations(video: _Video, gps: GpsRecord) -> tuple[Floats, Floats]:
    """Return (L,) lags and, at each, the correlation of the changes from one GPS sample on.

    The video's change over the same time is looked up at every lag, so that a receiver slower than the motion takes
    none of it for another. All lags are tried at which the records touch, and each is measured against all of the
    video's motion, so that a short stretch that happens to fit does not win.
    """
    apart_s = float(np.median(np.diff(gps.time_s)))
    step_s = max(float(np.median(np.diff(video.times))), apart_s / _TRIALS_PER_SAMPLE)
    change_s = max(apart_s, step_s, _LEAST_CHANGE_S)
    grid_s = np.arange(video.times[0], video.times[-1] + step_s / 2, step_s)
    video_change = _moved_in(video.times, video.moved, grid_s, change_s)
    place, first = np.unique(np.rint((gps.time_s - gps.time_s[0]) / step_s).astype(np.int64), return_index=True)
    sampled = np.zeros((int(place[-1]) + 1, 1))
    sampled[place] = 1.0
    gps_change = np.zeros((len(sampled), 2))
    gps_change[place] = _moved_in(gps.time_s, gps.position_m, gps.time_s[first], change_s)
    everywhere = np.ones((len(grid_s), 1))
    video_energy = _summed(video_change**2 @ [[1.0], [1.0]], sampled)
    video_energy = np.maximum(video_energy, np.sum(video_change**2) * step_s / max(apart_s, step_s))
    gps_energy = _summed(everywhere, gps_change**2 @ [[1.0], [1.0]])
    # What a quiet stretch of GPS would divide by is noise; a hundredth of the mean energy keeps it from counting.
    gps_energy = np.maximum(gps_energy, 0.01 * np.sum(gps_change**2) * len(grid_s) / len(sampled))
    scale = np.sqrt(video_energy * gps_energy)
    enough = (scale > 0) & (_summed(everywhere, sampled) > _LEAST_SHARED - 0.5)
    correlations = np.divide(_summed(video_change, gps_change), scale, out=np.zeros_like(scale), where=enough)
    shifts = np.arange(len(scale)) - (len(sampled) - 1)
    return shifts * step_s + video.times[0] - gps.time_s[0], correlations


def _require_metres(video: _Video, gps: GpsRecord, lag_s: float) -> None:
    """Refuse a record that moves with the video, but so much more or less that it must be in another unit.

    Raises:
        InputError: it does.
    """
    seen, recorded = (
        _moved_in(times, moved, times_of_gps, _LEAST_CHANGE_S)
        for times, moved, times_of_gps in (
            (video.times, video.moved, gps.time_s + lag_s),
            (gps.time_s, gps.position_m, gps.time_s),
        )
    )
    times_as_much = float(np.sum(seen * recorded) / np.sum(seen**2))
    for unit, in_a_metre, spread in _OTHER_UNITS:
        if in_a_metre / spread < times_as_much < in_a_metre * spread:
            raise InputError(
                f"{gps.name}: its positions move {times_as_much:.4g} times as much as the video, as if they were in "
                f"{unit}; convert them to metres, or set inputs.gps to null."
            )


def _summed(video: Floats, gps: Floats) -> Floats:
    """Return (L,) the sum of products of columns (M, K) and (G, K) at every shift of the second against the first."""
    columns = [correlate(*pair, method="fft") for pair in zip(video.T, gps.T, strict=True)]
    return np.asarray(np.sum(columns, axis=0), dtype=np.float64)


def _moved_in(times: Floats, positions: Floats, from_s: Floats, duration_s: float) -> Floats:
    """Return (M, 2) by how much the position changes in a time from each of M instants on; 0 beyond the record."""
    columns = [
        np.interp(from_s + duration_s, times, column) - np.interp(from_s, times, column) for column in positions.T
    ]
    return np.stack(columns, axis=1)


def _local_maxima(values: Floats) -> Bools:
    padded = np.concatenate([[-np.inf], values, [-np.inf]])
    return np.asarray((values >= padded[:-2]) & (values >= padded[2:]), dtype=np.bool_)


def _refined(
    video: _Video, gps: GpsRecord, coarse_s: float, step_s: float, *, differenced: bool
) -> tuple[float, float]:
    """Return the lag of least RMS difference near a coarse one, and its standard deviation.

    Displacements tell the lag best where their difference is noise. Where it is camera drift, the change from one GPS
    sample to the next (`differenced`) tells it better, since drift is slow. The smaller standard deviation decides.
    """
    margin_s = 3 * step_s
    beside = within(gps.time_s + coarse_s, (float(video.times[0]) - margin_s, float(video.times[-1]) + margin_s))
    coarse_times, position_m = gps.time_s[beside] + coarse_s, gps.position_m[beside]

    def compared(values: Floats) -> Floats:
        change = np.diff(values, axis=0) if differenced else values
        return change[np.isfinite(change).all(axis=1)]

    # Measured from the coarse lag: clocks may differ by weeks, and the minimiser's tolerance grows with the number.
    def rms(correction_s: float) -> float:
        difference = compared(video.at(coarse_times + correction_s) - position_m)
        return float(np.sqrt(np.mean((difference - difference.mean(axis=0)) ** 2))) if len(difference) > 3 else math.inf

    trials_s = np.linspace(-1.5 * step_s, 1.5 * step_s, 13)
    start = int(np.argmin([rms(float(trial)) for trial in trials_s]))
    bounds = float(trials_s[max(start - 1, 0)]), float(trials_s[min(start + 1, 12)])
    found = minimize_scalar(rms, bounds=bounds, method="bounded", options={"xatol": 1e-6})
    best_times = coarse_times + float(found.x)
    # NaN where the video was not measured, as in the difference.
    velocity = np.asarray(video.curve(best_times, 1), dtype=np.float64) + 0 * video.at(best_times)
    sensitivity = math.sqrt(float(np.sum(compared(velocity) ** 2)))
    return coarse_s + float(found.x), float(found.fun) / max(sensitivity, 1e-12)


def _baseline(sample_s: Floats, sample_m: Floats, video_m: Floats, intervals: Intervals) -> tuple[Floats, str]:
    """Return (2,) the GPS position that counts as rest, and a sentence where the pre-event could not give it."""
    if intervals.pre_event is not None:
        resting = within(sample_s, intervals.pre_event)
        if resting.any():
            return np.asarray(sample_m[resting].mean(axis=0), dtype=np.float64), ""
    sentence = (
        "No GPS sample lies in the pre-event interval, so the GPS baseline was taken from the video; "
        "peaks and residuals are no independent check of it."
    )
    return np.asarray(np.nanmean(sample_m - video_m, axis=0), dtype=np.float64), sentence


Rows = tuple[ComparisonRow | None, ComparisonRow | None]


def _peak_rows(
    times: Floats,
    moved: Floats,
    *,
    sample_s: Floats,
    sample_m: Floats,
    video_m: Floats,
    intervals: Intervals,
    sign: int,
) -> Rows:
    """Return the extremes within the event, each record at its own rate as in the paper, and the video at GPS's."""
    window = intervals.event or (float(sample_s[0]), float(sample_s[-1]))

    def extreme(values: Floats) -> float:
        return sign * float(np.nanmax(sign * values))

    sampled = within(sample_s, window)
    x, y = _rows(moved[within(times, window)], sample_m[sampled], extreme)
    return _at_gps(x, sample_m[sampled, 0], video_m[sampled, 0]), _at_gps(y, sample_m[sampled, 1], video_m[sampled, 1])


def _at_gps(row: ComparisonRow | None, gps_m: Floats, video_m: Floats) -> ComparisonRow | None:
    """Return a row with what the video says at the sample that gave the GPS value, where it was measured there."""
    if row is None:
        return None
    then_m = float(video_m[np.flatnonzero(gps_m == row.gps_m)[0]])
    return row if math.isnan(then_m) else replace(row, video_at_gps_m=then_m)


def _residual_rows(times: Floats, moved: Floats, *, sample_s: Floats, sample_m: Floats, intervals: Intervals) -> Rows:
    if intervals.residual is None:
        return None, None
    window = intervals.residual
    return _rows(
        moved[within(times, window)], sample_m[within(sample_s, window)], lambda values: float(np.nanmean(values))
    )


def _rows(video_m: Floats, gps_m: Floats, measure: Any) -> Rows:
    if not np.isfinite(video_m).any() or not len(gps_m):
        return None, None
    x, y = (ComparisonRow(measure(video_m[:, axis]), measure(gps_m[:, axis])) for axis in (0, 1))
    return x, y
