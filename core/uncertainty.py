"""One standard deviation for every value: what lines, ground and camera contribute, held against the scatter at rest.

Compression moves neighbouring pixels alike, so the scatter along a strip says too little; how much too little is read
off the stationary part, where every departure is error.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from core.coordinates import Bools, Floats
from core.results import Displacement, TargetHistory
from core.robust import BY_MEDIAN, finite_median, robust_sigma

# What the ground errs by as a whole, as part of its features' scatter (measured on H.264 clips with exact truth).
GROUND_PART = 0.05
# Pieces of a strip, each a few blocks of the compression long, and the time over which their wandering is averaged.
PIECES = 8
AVERAGED_S = 1.0
# How much faster the error of a whole target grows than the wandering of its pieces (measured likewise), and the least
# wandering that is believed, as part of the usual one.
GROWTH = 1.5
LEAST_WANDERING = 0.7
# An encoder predicts a moving roof worse than one at rest, and not all of that shows in its pieces: what was held
# against the scatter at rest is widened by this where the roof moves (measured likewise: 2 sigma then hold 90 to 98 %).
MOVING = 1.3
# By how much a second difference a - 2 b + c scatters more than the values: the root of 1 + 4 + 1.
SECOND_DIFFERENCE = np.sqrt(6.0)
# Stationary frames from which the scatter at rest is believed. A whole clip of fewer frames shows too little of its own
# noise: standard deviations are then widened by the root of what is missing (2 sigma held 66 % in clips of 2 frames and
# 85 % in clips of 14; widened they hold 90 to 97 %).
LEAST_STILL = 30
# After the event light and encoder may err more than before it: standard deviations there are widened up to this by
# their own scatter. What scatters more than that is no error but motion.
MOST_AFTER = 3.0
# Bounds of the correction by the scatter at rest: beyond them something other than random error is at work.
LEAST_FACTOR, MOST_FACTOR = 0.3, 8.0


def common_error(residual: Floats, time_s: Floats, still: Bools) -> Floats:
    """Return what a target errs by as a whole, (F,) in the residuals' unit, as its disagreement with itself tells.

    Compression redraws a moving roof in every frame, and one standing still less and less. An error of the whole roof
    cannot be seen; but the pieces of its strips then also wander against each other, though less than they err alike.

    Args:
        residual: (F, L, K) of lines or (F, N, 2) of points, nan where not observed.
        time_s: (F,).
        still: (F,) frames of the stationary part, which say what is usual; all frames if there are few.
    """
    frames, rows, count = residual.shape
    usual = still if still.sum() >= LEAST_STILL else np.ones(frames, dtype=bool)
    own = residual - finite_median(np.moveaxis(np.where(usual[:, None, None], residual, np.nan), 0, -1))
    if count % PIECES == 0:
        own = _mean_where_mostly_seen(own.reshape(frames, rows, PIECES, count // PIECES))
    square = finite_median(np.abs(own).reshape(frames, -1)) ** 2
    window = max(1, round(AVERAGED_S / float(np.median(np.diff(time_s))))) if frames > 1 else 1
    # A running sum keeps, of what has left it, a rounding error of either sign.
    wandering = BY_MEDIAN * np.sqrt(np.maximum(uniform_filter1d(square, window, mode="nearest"), 0.0))
    at_rest = max(float(np.median(wandering[usual])), 1e-12)
    return np.asarray(at_rest * np.maximum(wandering / at_rest, LEAST_WANDERING) ** GROWTH)


def _mean_where_mostly_seen(values: Floats) -> Floats:
    """Return the mean along the last axis where at least half is finite, else nan."""
    count = np.isfinite(values).sum(axis=-1)
    mean = np.nansum(values, axis=-1) / np.maximum(count, 1)
    return np.where(2 * count >= values.shape[-1], mean, np.nan)


def combined_sigma(
    points: Displacement,
    *,
    camera_m: Floats,
    shared_m: Floats,
    slow_m: Floats,
    value: Displacement,
    still: Bools,
    moving: Bools,
    after: Bools,
) -> Displacement:
    """Return the standard deviation of each frame's values.

    Args:
        points: standard deviation as the scatter of the target's own points propagates.
        camera_m: (F, 2) what the noise left in the camera's path moves the target by.
        shared_m: (F,) what ground and target err by as a whole.
        slow_m: (F, 2, 2) what the uncertainty of the calibration moves P1 and P2 by, from rest, as the camera drifts.
        value: whose scatter at rest is looked at.
        still: (F,) measured frames of the stationary part.
        moving: (F,) frames in no part in which the building stands still.
        after: (F,) measured frames of the part in which it stands still again.
    """
    random = np.sqrt(points.places_m**2 + camera_m[:, None, :] ** 2 + shared_m[:, None, None] ** 2)
    factor, rotation_factor = np.ones((2, 2)), 1.0
    if still.sum() >= LEAST_STILL:
        factor = _by_scatter(np.hypot(random, slow_m)[still], value.places_m[still], MOST_FACTOR)
        rotation_factor = float(_by_scatter(points.rotation_rad[still], value.rotation_rad[still], MOST_FACTOR))
    wider = np.where(moving, MOVING, 1.0) * np.sqrt(max(1.0, LEAST_STILL / len(moving)))
    places_sigma = np.sqrt((random * factor) ** 2 + slow_m**2) * wider[:, None, None]
    rotation_sigma = points.rotation_rad * rotation_factor * wider
    return Displacement(
        _widened_after(places_sigma, value.places_m, after),
        _widened_after(rotation_sigma, value.rotation_rad, after),
    )


def _widened_after(sigma: Floats, value: Floats, after: Bools) -> Floats:
    """Return standard deviations (F, ...) of values, no smaller than what they scatter by where the building rests."""
    if after.sum() < LEAST_STILL:
        return sigma
    factor = _by_scatter(sigma[after], value[after], np.inf)
    widened = sigma.copy()
    widened[after] *= np.where(factor <= MOST_AFTER, np.maximum(factor, 1.0), 1.0)
    return widened


def _by_scatter(sigma: Floats, value: Floats, most: float) -> Floats:
    """Return by what values (M, ...) at rest scatter more than their standard deviations say, within bounds."""
    return np.asarray(np.clip(value.std(axis=0) / np.sqrt((sigma**2).mean(axis=0)), LEAST_FACTOR, most))


def jitter(values: Floats) -> Floats:
    """Return the noise (...) of values (M, ...) in M frames, from how unevenly they follow each other; 0 of a few."""
    if len(values) < 3:
        return np.zeros(values.shape[1:])
    return np.asarray(np.diff(values, n=2, axis=0).std(axis=0) / SECOND_DIFFERENCE)


def robust_jitter(values: Floats) -> Floats:
    """Return the noise (...) of values (M, ...) as `jitter`, but outliers do not move it and nan are passed over."""
    if len(values) < 3:
        return np.zeros(values.shape[1:])
    return robust_sigma(np.moveaxis(np.diff(values, n=2, axis=0), 0, -1)) / SECOND_DIFFERENCE


def held_to_jitter(sigma: Floats, value: Floats, still: Bools) -> Floats:
    """Return standard deviations (F, ...) of values that drift, as large as their noise at rest says.

    Args:
        still: (F,) measured frames of the stationary part.
    """
    if still.sum() < LEAST_STILL:
        return sigma
    return np.asarray(sigma * jitter(value[still]) / np.sqrt((sigma[still] ** 2).mean(axis=0)))


def held_to_scatter(relative: TargetHistory, still: Bools) -> TargetHistory:
    """Return relative motion with standard deviations no larger than what it scatters by at rest says.

    Added as if independent, the errors of target and base make too much of what both share, the camera first of all.

    Args:
        relative: of a target against another.
        still: (F,) frames of the stationary part.
    """
    still = still & relative.measured
    if still.sum() < LEAST_STILL:
        return relative

    def held(sigma: Floats, value: Floats) -> Floats:
        return np.asarray(sigma * _by_scatter(sigma[still], value[still], 1.0))

    return replace(
        relative,
        p1_sigma_m=held(relative.p1_sigma_m, relative.p1_m),
        p2_sigma_m=held(relative.p2_sigma_m, relative.p2_m),
        rotation_sigma_rad=held(relative.rotation_sigma_rad, relative.rotation_rad),
    )
