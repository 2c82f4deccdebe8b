"""Smooth flight: a hovering camera's position cannot jump, although its rotation can.

Each coordinate of the camera centre is a smooth path seen through noisy poses. How fast the path can move is found by
cross-validation: runs of frames are left out and predicted from their neighbours. A fixed limit would follow noise in
calm air or cut corners in gusts. Runs, not single frames, since compression gives neighbouring frames like errors.

Source: Eilers & Marx (1996) for the splines; Stone (1974) for the validation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded

from core.coordinates import Floats
from core.robust import robust_sigma

DEGREE = 5
# The derivative of the path that is taken as white: the path sinks into the noise within half an octave.
ORDER = 5
# Speeds of motion among which the record chooses, Hz: the frequency at which the path sinks below the noise.
CUTOFFS_HZ = (0.4, 0.5, 0.65, 0.8, 1.0, 1.3, 1.7, 2.3, 3.2)
KNOTS_PER_PERIOD = 4.0
# Length of the runs left out, seconds, and the share of the record left out at a time.
RUN_S = 0.25
FOLDS = 4
# The choice is made on at most so many frames, from the middle of the record.
MOST_FRAMES = 1500
# Beyond this many standard deviations of its frame, a pose is trusted less instead of followed.
OUTLYING = 3.5
LEAST_FRAMES = 24
# A record must hold so many of the runs that are left out, or none of them has neighbours on both sides.
LEAST_RUNS = 3
# Least misfit of a frame, as part of the usual one: that the reference frame fits itself says nothing about its pose.
LEAST_MISFIT = 0.6
# A pose's error grows with the misfit of its points, and faster where their errors are alike; more is not credible.
MOST_GROWTH = 3.0
# Weight of the mean position against all else: moves no frame by a nanometre, but keeps the equations soluble.
RIDGE = 1e-11
# No pose is better than a micrometre; the equations of a record without any noise could not be solved.
LEAST_NOISE_M = 1e-6


@dataclass(frozen=True)
class FlightModel:
    """How one coordinate of the path moves and how noisily it is seen.

    Attributes:
        cutoff_hz: where the path sinks below the noise.
        noise_m: of a frame of average quality, one standard deviation.
        memory: correlation of the noise of neighbouring frames.
    """

    cutoff_hz: float
    noise_m: float
    memory: float


@dataclass(frozen=True)
class SmoothFlight:
    """A smoothed record of K coordinates.

    Attributes:
        value_m: (F, K) smoothed.
        sigma_m: (F, K) one standard deviation of what noise remains.
        models: of the K coordinates.
    """

    value_m: Floats
    sigma_m: Floats
    models: tuple[FlightModel, ...]

    @property
    def noise_m(self) -> Floats:
        """(K,) noise of a single frame's pose."""
        return np.array([model.noise_m for model in self.models])


def smooth_flight(time_s: Floats, centre_m: Floats, misfit_px: Floats) -> SmoothFlight | None:
    """Return the camera's path freed of the noise of single poses, or None where the record is too short to tell.

    Args:
        time_s: (F,) increasing.
        centre_m: (F, K) coordinates; nan where a frame gave none.
        misfit_px: (F,) RMS of what each frame's ground points left over. How the pose's error grows with it is learnt
            from the record: compressed video has runs of frames several times worse than their neighbours.
    """
    seen = np.isfinite(centre_m).all(axis=1) & (misfit_px > 0)
    if seen.sum() < LEAST_FRAMES or np.ptp(time_s[seen]) < LEAST_RUNS * RUN_S:
        return None
    moments, centre = time_s[seen], centre_m[seen]
    relative = np.maximum(misfit_px[seen] / float(np.median(misfit_px[seen])), LEAST_MISFIT)
    size = relative / np.sqrt((relative**2).mean())
    cutoff_hz = choose_cutoff(moments, centre, size)
    spline = _Spline(moments, moments, cutoff_hz)
    departure = centre - np.column_stack([spline.fit(x, size)[0] for x in centre.T])
    size = relative ** _growth(relative, departure / (np.median(np.abs(departure), axis=0) + LEAST_NOISE_M))
    size = size / np.sqrt((size**2).mean())
    columns = [_smooth(time_s, moments, x, size=size, cutoff_hz=cutoff_hz) for x in centre.T]
    values, sigmas, models = zip(*columns, strict=True)
    return SmoothFlight(np.stack(values, 1), np.stack(sigmas, 1), tuple(models))


def choose_cutoff(time_s: Floats, value_m: Floats, size: Floats) -> float:
    """Return the cutoff in Hz under which runs of frames are predicted best from their neighbours.

    One body moves along all coordinates, so they choose together.

    Args:
        time_s: (N,) and value_m (N, K), the record.
        size: (N,) relative size of each frame's noise.
    """
    middle, half = len(time_s) // 2, MOST_FRAMES // 2
    part = slice(max(0, middle - half), middle + half)
    t, x, size = time_s[part], value_m[part], size[part]
    errors = np.array([_prediction_errors(_Spline(t, t, cutoff), t, x, size) for cutoff in CUTOFFS_HZ])
    errors = errors + LEAST_NOISE_M**2
    return CUTOFFS_HZ[int(np.argmin((errors / errors.min(axis=0)).sum(axis=1)))]


def _prediction_errors(spline: _Spline, time_s: Floats, value_m: Floats, size: Floats) -> Floats:
    """Return the mean square (K,) by which left-out runs miss their prediction, in units of their noise."""
    fold = ((time_s - time_s[0]) / RUN_S).astype(np.int64) % FOLDS
    inner = (time_s > time_s[0] + RUN_S) & (time_s < time_s[-1] - RUN_S)
    means = []
    for x in value_m.T:
        error = np.zeros(len(x))
        for run in range(FOLDS):
            out = fold == run
            error[out] = (x - spline.fit(x, np.where(out, np.inf, size))[0])[out] / size[out]
        # A single wild pose must not decide, but a path that cuts corners must pay for it.
        limit = 6.0 * float(robust_sigma(error.ravel())) + LEAST_NOISE_M
        means.append(float((np.clip(error[inner], -limit, limit) ** 2).mean()))
    return np.array(means)


def _growth(relative: Floats, departure: Floats) -> float:
    """Return the power by which departures (N, K) from the path grow with the frames' relative misfit (N,)."""
    size, x = np.log(np.abs(departure).mean(axis=1) + 1e-3), np.log(relative)
    spread = float(((x - x.mean()) ** 2).mean())
    if spread < 1e-3:
        return 1.0
    return float(np.clip(((x - x.mean()) * (size - size.mean())).mean() / spread, 0.0, MOST_GROWTH))


def _smooth(
    time_s: Floats, seen_s: Floats, value_m: Floats, *, size: Floats, cutoff_hz: float
) -> tuple[Floats, Floats, FlightModel]:
    """Return the path at `time_s` (F,), the noise it keeps, and its model, from values (N,) at `seen_s`."""
    spline = _Spline(time_s, seen_s, cutoff_hz)
    path, factor = spline.fit(value_m, size)
    departure = (value_m - path[np.searchsorted(time_s, seen_s)]) / size
    noise = max(float(robust_sigma(departure.ravel())), LEAST_NOISE_M)
    limited = np.clip(departure, -OUTLYING * noise, OUTLYING * noise)
    noise = max(float(limited.std()), LEAST_NOISE_M)
    memory = float(np.clip((limited[1:] * limited[:-1]).mean() / noise**2, 0.0, 0.9))
    # A mean of frames that err alike errs more than one of frames that err independently.
    kept = noise * np.sqrt((1.0 + memory) / (1.0 - memory)) * spline.kept(factor)
    return path, kept, FlightModel(cutoff_hz, noise, memory)


class _Spline:
    """Penalised splines over one set of times: the most probable path for a cutoff.

    Args:
        time_s: (F,) where the path is wanted.
        seen_s: (N,) where it is observed.
        cutoff_hz: where its density equals the noise's.
    """

    def __init__(self, time_s: Floats, seen_s: Floats, cutoff_hz: float) -> None:
        duration = float(time_s[-1] - time_s[0])
        spans = max(DEGREE + 2, int(np.ceil(duration * cutoff_hz * KNOTS_PER_PERIOD)))
        knot_s = duration / spans
        knots = time_s[0] + knot_s * np.arange(-DEGREE, spans + DEGREE + 1)
        # The last time may come to lie beyond the last knot by rounding.
        within = np.clip(time_s, knots[DEGREE], knots[-DEGREE - 1])
        self._every: Any = BSpline.design_matrix(within, knots, DEGREE)
        self._seen: Any = self._every[np.searchsorted(time_s, seen_s)]
        step_s = float(np.median(np.diff(seen_s)))
        density = step_s * (2.0 * np.pi * cutoff_hz) ** (2 * ORDER)
        self._penalty = _difference_penalty(spans + DEGREE) * (knot_s ** (1 - 2 * ORDER) / density)

    def fit(self, value_m: Floats, size: Floats) -> tuple[Floats, Floats]:
        """Return the path (F,) through values (N,) of relative noise `size` (N,), and the factored equations."""
        mean = float(np.median(value_m[np.isfinite(size)]))
        trust = 1.0 / size**2
        weight, path, factor = trust, np.zeros(0), self._penalty
        for _ in range(2):
            factor = cholesky_banded(self._normal(weight))
            coefficients: Floats = cho_solve_banded((factor, False), self._seen.T @ (weight * (value_m - mean)))
            path = self._every @ coefficients + mean
            departure = np.abs(value_m - mean - self._seen @ coefficients) / size
            limit = OUTLYING * max(float(robust_sigma(departure[trust > 0].ravel())), LEAST_NOISE_M)
            weight = trust * np.minimum(1.0, limit / np.maximum(departure, 1e-12)) ** 2
        return path, factor

    def _normal(self, weight: Floats) -> Floats:
        normal: Any = (self._seen.T @ self._seen.multiply(weight[:, None])).todia()
        banded = self._penalty.copy()
        for offset, diagonal in zip(normal.offsets, normal.data, strict=True):
            if 0 <= offset <= DEGREE:
                banded[DEGREE - offset, : len(diagonal)] += diagonal  # shorter where the last frames were not seen
        # Where the camera was lost for long, the penalty alone leaves more freedom than rounding can bear.
        banded[DEGREE] += RIDGE * banded[DEGREE].max()
        return banded

    def kept(self, factor: Floats) -> Floats:
        """Return the part (F,) of independent unit noise that stays in the path, from probes interpolated between."""
        count = self._every.shape[0]
        ends = np.arange(min(15, count))
        probes = np.unique(np.concatenate([ends, count - 1 - ends, np.linspace(0, count - 1, 64).astype(int)]))
        chosen = self._every[probes].toarray()
        variance = (chosen * cho_solve_banded((factor, False), chosen.T).T).sum(axis=1)
        return np.asarray(np.interp(np.arange(count), probes, np.sqrt(np.maximum(variance, 0.0))))


def _difference_penalty(count: int) -> Floats:
    """Return D'D of the differences of `ORDER` as an upper banded matrix (DEGREE + 1, count)."""
    D = np.diff(np.eye(min(count, 4 * DEGREE + 1)), n=ORDER, axis=0)
    small = D.T @ D
    middle = len(small) // 2
    banded = np.zeros((DEGREE + 1, count))
    for offset in range(ORDER + 1):
        diagonal = np.diagonal(small, offset)
        full = np.full(count - offset, diagonal[middle])
        ends = min(len(diagonal) // 2, len(full) // 2)
        full[:ends], full[len(full) - ends :] = diagonal[:ends], diagonal[len(diagonal) - ends :]
        banded[DEGREE - offset, offset:] = full
    return banded
