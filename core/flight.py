"""Smooth flight: a hovering camera's position cannot jump, although its rotation can.

Each coordinate of the camera centre is a smooth path seen through noisy poses. How smooth the path is (how steeply its
spectrum falls), how strongly it is pushed, and how noisy the poses are come from the record's own spectrum; a fixed
strength would follow noise in calm air and cut corners in gusts. The most probable path is a penalised spline.

Source: Whittle (1953) for the likelihood of a spectrum; Eilers & Marx (1996) for the splines.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize

from core.coordinates import Floats

# The derivative of the path that may be white: 3 for a path pushed by random jerks, more for calmer air.
ORDERS = (2, 3, 4, 5)
DEGREE = 5
# Knots to a period of the fastest motion that stands out of the noise: more would say nothing, and could not be solved.
KNOTS_PER_PERIOD = 8
# Knots this far apart follow motion up to 4 Hz, far above what a hovering drone's position does.
CLOSEST_KNOT_S = 0.125
# Beyond this many standard deviations of its frame, a pose is trusted less instead of followed.
OUTLYING = 3.5
LEAST_FRAMES = 24
# A gap of so many frames may be bridged by a straight line where the model is estimated.
BRIDGED_FRAMES = 5.5
# No pose is better than a micrometre; the equations of a record without any noise could not be solved.
LEAST_NOISE_M = 1e-6


@dataclass(frozen=True)
class FlightModel:
    """How one coordinate of the path moves and how noisily it is seen.

    Attributes:
        noise_m: of one frame, as it acts on slow motion: the square root of its spectral density times the frame rate.
        order: of the derivative that is white.
        push: root spectral density of that derivative, m s^-order Hz^-1/2.
        fastest_hz: where the path sinks below the noise.
    """

    noise_m: float
    order: int
    push: float
    fastest_hz: float


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


def smooth_flight(time_s: Floats, centre_m: Floats, sigma_m: Floats) -> SmoothFlight | None:
    """Return the camera's path freed of the noise of single poses, or None where the record is too short to tell.

    Args:
        time_s: (F,) increasing.
        centre_m: (F, K) coordinates; nan where a frame gave none.
        sigma_m: (F, K) relative size of each frame's noise; its common scale is estimated.
    """
    seen = np.isfinite(centre_m).all(axis=1) & np.isfinite(sigma_m).all(axis=1)
    unbroken = np.flatnonzero(seen)[_longest_run(time_s[seen])]
    if len(unbroken) < LEAST_FRAMES:
        return None
    values, sigmas, models = [], [], []
    for coordinate, sigma in zip(centre_m.T, sigma_m.T, strict=True):
        model = estimate_flight(time_s[unbroken], coordinate[unbroken])
        each = model.noise_m * sigma[seen] / float(np.median(sigma[seen]))
        value, kept = _smooth(time_s, time_s[seen], coordinate[seen], each, model)
        values.append(value)
        sigmas.append(kept)
        models.append(model)
    return SmoothFlight(np.stack(values, 1), np.stack(sigmas, 1), tuple(models))


def _longest_run(time_s: Floats) -> slice:
    """Return the longest part without a gap: a straight line over many frames would pass for a calm flight."""
    if len(time_s) < 2:
        return slice(0, len(time_s))
    breaks = np.flatnonzero(np.diff(time_s) > BRIDGED_FRAMES * np.median(np.diff(time_s))) + 1
    edges = np.concatenate([[0], breaks, [len(time_s)]])
    longest = int(np.argmax(np.diff(edges)))
    return slice(int(edges[longest]), int(edges[longest + 1]))


def estimate_flight(time_s: Floats, value_m: Floats) -> FlightModel:
    """Return the model under which a coordinate's record is most likely.

    Third differences turn the path's steep spectrum into a mild one, so that little leaks from slow motion into fast.
    Compression and gimbal make the noise of neighbouring frames alike: it is a first-order autoregression.
    """
    step_s = float(np.median(np.diff(time_s)))
    even = np.arange(time_s[0], time_s[-1] + step_s / 2, step_s)
    differences = np.diff(np.interp(even, time_s, value_m), n=3)
    scale = 1.4826 * float(np.median(np.abs(differences))) + 1e-15
    differences = np.clip(differences, -6.0 * scale, 6.0 * scale)  # a single wild pose must not decide
    window = np.hanning(len(differences) + 2)[1:-1]
    power = np.abs(np.fft.rfft(differences * window))[1:] ** 2 / (window**2).sum() + 1e-30
    frequency = np.fft.rfftfreq(len(differences), step_s)[1:]
    turn = 2.0 * np.pi * frequency * step_s
    difference = (2.0 * np.sin(turn / 2.0)) ** 6

    def noise_shape(memory: float) -> Floats:
        return np.asarray((1.0 - memory) ** 2 / (1.0 - 2.0 * memory * np.cos(turn) + memory**2))

    def fit(order: int) -> tuple[float, FlightModel]:
        path = (2.0 * np.pi * frequency) ** (-2.0 * order) / step_s

        def cost(unknown: Floats) -> float:
            noise = np.exp(2.0 * unknown[0]) * noise_shape(0.95 / (1.0 + np.exp(-unknown[2])))
            model = difference * (noise + np.exp(2.0 * unknown[1]) * path)
            return float((np.log(model) + power / model).sum())

        fast = frequency > 0.3 * frequency[-1]
        noise = 0.5 * np.log(max(float((power[fast] / difference[fast]).mean()), 1e-20))
        slow = frequency <= max(0.5, frequency[1])
        push = 0.5 * np.log(max(float(np.median((power / difference / path)[slow])), 1e-20))
        # The memory goes from 0.1 to 0.3 in the first step; from zero the method would hardly move it.
        simplex = np.array([noise, push, -2.0]) + np.vstack([np.zeros(3), np.diag([0.5, 0.5, 1.5])])
        best: Any = minimize(
            cost,
            simplex[0],
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 0.02, "fatol": 0.02, "maxiter": 400},
        )
        return float(best.fun), _model(order, best.x, step_s, float(even[-1] - even[0]))

    return min((fit(order) for order in ORDERS), key=lambda found: found[0])[1]


def _model(order: int, logarithms: Floats, step_s: float, duration_s: float) -> FlightModel:
    """Return the model of an order; what moves slower than once in a record cannot be told from rest."""
    noise = max(float(np.exp(logarithms[0])), LEAST_NOISE_M)
    density = noise * np.sqrt(step_s)
    fastest_hz = float(np.exp((logarithms[1] - np.log(density)) / order) / (2.0 * np.pi))
    fastest_hz = max(fastest_hz, 1.0 / duration_s)
    return FlightModel(noise, order, float(density * (2.0 * np.pi * fastest_hz) ** order), fastest_hz)


def _smooth(
    time_s: Floats, seen_s: Floats, value_m: Floats, sigma_m: Floats, model: FlightModel
) -> tuple[Floats, Floats]:
    """Return the most probable path at `time_s` (F,) and the noise it keeps, from values (N,) at `seen_s`."""
    widest_s = max(CLOSEST_KNOT_S, 1.0 / (KNOTS_PER_PERIOD * model.fastest_hz))
    spans = max(DEGREE + 2, int(np.ceil((time_s[-1] - time_s[0]) / widest_s)))
    knot_s = float(time_s[-1] - time_s[0]) / spans
    knots = time_s[0] + knot_s * np.arange(-DEGREE, spans + DEGREE + 1)
    mean = float(value_m.mean())
    penalty = _difference_penalty(spans + DEGREE, model.order) * (knot_s / (model.push * knot_s**model.order) ** 2)
    # The last time may come to lie beyond the last knot by rounding.
    within = np.clip(time_s, knots[DEGREE], knots[-DEGREE - 1])
    every: Any = BSpline.design_matrix(within, knots, DEGREE)
    basis = every[np.searchsorted(time_s, seen_s)]
    weight, coefficients = 1.0 / sigma_m**2, np.zeros(spans + DEGREE)
    factor = penalty
    for _ in range(4):
        normal = (basis.T @ basis.multiply(weight[:, None])).todia()
        banded = penalty.copy()
        for offset, diagonal in zip(normal.offsets, normal.data, strict=True):
            if 0 <= offset <= DEGREE:
                banded[DEGREE - offset, : len(diagonal)] += diagonal  # shorter where the last frames were not seen
        factor = cholesky_banded(banded)
        coefficients = cho_solve_banded((factor, False), basis.T @ (weight * (value_m - mean)))
        ratio = np.abs(value_m - mean - basis @ coefficients) / sigma_m
        weight = np.minimum(1.0, OUTLYING / np.maximum(ratio, 1e-12)) ** 2 / sigma_m**2
    return every @ coefficients + mean, _kept_noise(factor, every)


def _difference_penalty(count: int, order: int) -> Floats:
    """Return D'D of the differences of an order as an upper banded matrix (DEGREE + 1, count)."""
    D = np.diff(np.eye(min(count, 4 * DEGREE + 1)), n=order, axis=0)
    small = D.T @ D
    middle = len(small) // 2
    banded = np.zeros((DEGREE + 1, count))
    for offset in range(order + 1):
        diagonal = np.diagonal(small, offset)
        full = np.full(count - offset, diagonal[middle])
        ends = min(len(diagonal) // 2, len(full) // 2)
        full[:ends], full[len(full) - ends :] = diagonal[:ends], diagonal[len(diagonal) - ends :]
        banded[DEGREE - offset, offset:] = full
    return banded


def _kept_noise(factor: Floats, basis: Any) -> Floats:
    """Return the standard deviation of the path at the rows of a basis, from a few probes interpolated between."""
    count = basis.shape[0]
    ends = np.arange(min(15, count))
    probes = np.unique(np.concatenate([ends, count - 1 - ends, np.linspace(0, count - 1, 64).astype(int)]))
    chosen = basis[probes].toarray()
    variance = (chosen * cho_solve_banded((factor, False), chosen.T).T).sum(axis=1)
    return np.asarray(np.interp(np.arange(count), probes, np.sqrt(np.maximum(variance, 0.0))))
