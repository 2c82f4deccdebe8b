"""Smooth flight: a hovering camera's position cannot jump, although its rotation can.

Each coordinate of the camera centre is a body pushed by random jerks and seen through noisy poses. How strongly it is
pushed, and how noisy the poses are, comes from the record's own spectrum; a fixed strength would follow noise in calm
air and cut corners in gusts. The smoothest path for these two numbers is a banded least-squares problem.

Source: Whittaker (1923) for the smoother; Whittle (1953) for the likelihood of a spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded
from scipy.optimize import minimize

from core.coordinates import Floats

# Beyond this many standard deviations of its frame, a pose is trusted less instead of followed.
OUTLYING = 3.5
# Columns of the inverse computed to learn how much noise the smoothed path keeps.
PROBES = 48


@dataclass(frozen=True)
class SmoothFlight:
    """A smoothed record of K coordinates.

    Attributes:
        value_m: (F, K) smoothed.
        sigma_m: (F, K) one standard deviation of what noise remains.
        noise_m: (K,) estimated noise of a median frame's pose.
        jerk: (K,) estimated root spectral density of the jerk, m s^-2.5.
    """

    value_m: Floats
    sigma_m: Floats
    noise_m: Floats
    jerk: Floats


def smooth_flight(time_s: Floats, centre_m: Floats, sigma_m: Floats) -> SmoothFlight:
    """Return the camera's path freed of the noise of single poses.

    Args:
        time_s: (F,) increasing.
        centre_m: (F, K) coordinates; nan where a frame gave none.
        sigma_m: (F, K) relative size of each frame's noise; its common scale is estimated.
    """
    columns = [_smooth_column(time_s, centre_m[:, k], sigma_m[:, k]) for k in range(centre_m.shape[1])]
    values, sigmas, noises, jerks = zip(*columns, strict=True)
    return SmoothFlight(np.stack(values, 1), np.stack(sigmas, 1), np.array(noises), np.array(jerks))


def _smooth_column(time_s: Floats, value: Floats, sigma: Floats) -> tuple[Floats, Floats, float, float]:
    seen = np.isfinite(value) & np.isfinite(sigma)
    if seen.sum() < 24:
        return value.copy(), sigma.copy(), float("nan"), float("nan")
    noise, jerk = estimate_noise(time_s[seen], value[seen])
    each = np.where(seen, noise * sigma / float(np.median(sigma[seen])), np.inf)
    centred = np.where(seen, value, 0.0) - float(value[seen].mean())
    smooth, kept = _whittaker(time_s, np.where(seen, centred, 0.0), each, jerk)
    return smooth + float(value[seen].mean()), kept, noise, jerk


def estimate_noise(time_s: Floats, value: Floats) -> tuple[float, float]:
    """Return the white noise (standard deviation) and the root spectral density of the jerk of one coordinate.

    Third differences turn the path's steep spectrum into a mild one: white jerk becomes white, white noise becomes
    blue; the two are told apart by maximum likelihood of the periodogram.
    """
    step_s = float(np.median(np.diff(time_s)))
    even = np.arange(time_s[0], time_s[-1] + step_s / 2, step_s)
    differences = np.diff(np.interp(even, time_s, value), n=3)
    scale = 1.4826 * float(np.median(np.abs(differences))) + 1e-15
    differences = np.clip(differences, -6.0 * scale, 6.0 * scale)  # a single wild pose must not decide
    window = np.hanning(len(differences) + 2)[1:-1]
    power = np.abs(np.fft.rfft(differences * window))[1:] ** 2 / (window**2).sum()
    frequency = np.fft.rfftfreq(len(differences), step_s)[1:]
    white = (2.0 * np.sin(np.pi * frequency * step_s)) ** 6
    # A sampled triple integral of white jerk, differenced three times, has the variance 11/20 step^5 and is nearly
    # white; sinc^6 is its shape.
    pushed = step_s**5 * np.sinc(frequency * step_s) ** 6

    def cost(logs: Floats) -> float:
        model = np.exp(2 * logs[0]) * white + np.exp(2 * logs[1]) * pushed
        return float((np.log(model) + power / model).sum())

    high = frequency > 0.6 * frequency[-1]
    first_noise = np.sqrt(max(float((power[high] / white[high]).mean()), 1e-18))
    low = frequency < 0.1 * frequency[-1]
    first_jerk = np.sqrt(max(float((power[low] / pushed[low]).mean()), 1e-18))
    start = np.log([first_noise, first_jerk])
    best = minimize(cost, start, method="Nelder-Mead", options={"xatol": 0.01, "fatol": 0.01}).x
    return float(np.exp(best[0])), float(np.exp(best[1]))


def _whittaker(time_s: Floats, value: Floats, sigma: Floats, jerk: float) -> tuple[Floats, Floats]:
    """Return the most probable path under white jerk and the noise it keeps, both (F,)."""
    penalty = _jerk_penalty(time_s, jerk)
    weight = 1.0 / sigma**2
    robust = np.ones_like(weight)
    smooth = value
    for _ in range(4):
        banded = penalty.copy()
        banded[-1] += weight * robust
        smooth = solveh_banded(banded, weight * robust * value)
        ratio = np.abs(value - smooth) / sigma
        robust = np.minimum(1.0, OUTLYING / np.maximum(ratio, 1e-12)) ** 2
    return smooth, _kept_noise(banded)


def _jerk_penalty(time_s: Floats, jerk: float) -> Floats:
    """Return sum of (third derivative)^2 step / jerk^2 as an upper banded matrix (4, F)."""
    count = len(time_s)
    rows = np.arange(count - 3)
    nodes = time_s[rows[:, None] + np.arange(4)]
    gaps = nodes[:, :, None] - nodes[:, None, :] + np.eye(4)
    coefficients = 6.0 / gaps.prod(axis=2)  # third derivative of the cubic through four points
    coefficients *= np.sqrt((nodes[:, 3] - nodes[:, 0]) / 3.0)[:, None] / jerk
    banded = np.zeros((4, count))
    for i in range(4):
        for j in range(i, 4):
            np.add.at(banded[3 - (j - i)], rows + j, coefficients[:, i] * coefficients[:, j])
    return banded


def _kept_noise(banded: Floats) -> Floats:
    """Return the square root of the inverse's diagonal, from probes that lie closer at the ends."""
    count = banded.shape[1]
    ends = np.arange(min(12, count))
    probes = np.unique(np.concatenate([ends, count - 1 - ends, np.linspace(0, count - 1, PROBES).astype(int)]))
    unit = np.zeros((count, len(probes)))
    unit[probes, np.arange(len(probes))] = 1.0
    variance = solveh_banded(banded, unit)[probes, np.arange(len(probes))]
    return np.asarray(np.interp(np.arange(count), probes, np.sqrt(np.maximum(variance, 0.0))))
