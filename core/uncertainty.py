"""One standard deviation for every value: what lines, ground and camera contribute, held against the scatter at rest.

Compression moves neighbouring pixels alike, so the scatter along a strip says too little; how much too little is read
off the stationary part, where every departure is error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.coordinates import Bools, Floats

# Part of their scatter that neighbouring points share, and roof and ground do not (measured on H.264 clips of 16 to
# 45 Mbit/s: 0.03 px of 0.07 to 0.1 px).
SHARED_PART = 0.3
# Stationary frames from which the scatter at rest is believed.
LEAST_STILL = 30
# Bounds of the correction by the scatter at rest: beyond them something other than random error is at work.
LEAST_FACTOR, MOST_FACTOR = 0.3, 8.0


@dataclass(frozen=True)
class Sigma:
    """One standard deviation of P1 and P2 (F, 2, 2), metres, and of the rotation (F,), radians."""

    places_m: Floats
    rotation_rad: Floats


def combined_sigma(
    points: Sigma,
    *,
    camera_m: Floats,
    shared_m: Floats,
    slow_m: Floats,
    places_m: Floats,
    rotation_rad: Floats,
    still: Bools,
) -> Sigma:
    """Return the standard deviation of each frame's values.

    Args:
        points: as the scatter of the target's own points propagates.
        camera_m: (F, 2) what the noise left in the camera's path moves the target by.
        shared_m: (F,) what neighbouring pixels err by alike, at the target.
        slow_m: (F, 2, 2) what the uncertainty of the calibration moves P1 and P2 by, from rest, as the camera drifts.
        places_m: (F, 2, 2) displacements and rotation_rad (F,) whose scatter at rest is looked at.
        still: (F,) measured frames of the stationary part.
    """
    random = np.sqrt(points.places_m**2 + camera_m[:, None, :] ** 2 + shared_m[:, None, None] ** 2)
    factor, rotation_factor = np.ones((2, 2)), 1.0
    if still.sum() >= LEAST_STILL:
        at_rest = np.sqrt((random[still] ** 2 + slow_m[still] ** 2).mean(axis=0))
        factor = np.clip(places_m[still].std(axis=0) / at_rest, LEAST_FACTOR, MOST_FACTOR)
        turning = float(np.sqrt((points.rotation_rad[still] ** 2).mean()))
        rotation_factor = float(np.clip(rotation_rad[still].std() / turning, LEAST_FACTOR, MOST_FACTOR))
    return Sigma(np.sqrt((random * factor) ** 2 + slow_m**2), points.rotation_rad * rotation_factor)
