"""When each row was seen: rolling shutters, and compression that drags weak texture behind the camera's motion.

A point seen a moment away from its frame's time stamp lies off by that moment times its speed in the image. The speed
of the ground is the camera's own motion and comes from the homographies of the neighbouring frames; a target also
moves by itself, so its speed comes from its own track.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from core.coordinates import Floats, apply_homography, finite_rows
from core.lens import Lens
from core.measurements import Recording

# A rolling shutter is believed from the footage where it stands out of its own noise by so many standard deviations,
# and shorter ones than this do not matter.
SIGNIFICANT = 5.0
# So many values of the ground err as one: neighbours in space share their blocks, neighbours in time their key frame.
ALIKE = 4.0
LEAST_READOUT_S = 1e-3


@dataclass(frozen=True)
class Readout:
    """Time between the exposures of the first and the last row, as used.

    Attributes:
        readout_s: 0 for a global shutter, or where nothing is known.
        sigma_s: one standard deviation of an estimate; None where the lens file says it, or nothing can be said.
        source: where it comes from, in words.
    """

    readout_s: float
    sigma_s: float | None
    source: str


def ground_speed(recording: Recording, lens: Lens) -> Floats:
    """Return how fast each ground feature moves in the image, (F, N, 2) raw pixels a second; nan where not known."""
    rays0 = lens.rays_from_raw(recording.reference.ground_raw)
    known = np.asarray(np.isfinite(recording.H_ray_ray0).all(axis=(1, 2)))
    raw = np.full((len(recording.frame), len(rays0), 2), np.nan)
    for frame in np.flatnonzero(known):
        raw[frame] = lens.raw_from_rays(apply_homography(recording.H_ray_ray0[frame], rays0))
    return differentiated(raw, recording.time_s)


def differentiated(track: Floats, time_s: Floats) -> Floats:
    """Return the rate of change of tracks (F, ...) by central differences, by one-sided ones beside a gap."""
    rate = np.full(track.shape, np.nan)
    if len(time_s) < 2:
        return rate
    span = np.diff(time_s).reshape(-1, *[1] * (track.ndim - 1))
    forward = np.diff(track, axis=0) / span
    rate[:-1] = forward
    rate[1:] = np.where(np.isfinite(rate[1:]), rate[1:], forward)
    both = np.isfinite(forward[1:]) & np.isfinite(forward[:-1])
    weight = span[:-1] / (span[1:] + span[:-1])  # exact for a parabola, however the frames are spaced
    rate[1:-1] = np.where(both, weight * forward[1:] + (1.0 - weight) * forward[:-1], rate[1:-1])
    return rate


def row_share(raw: Floats, lens: Lens) -> Floats:
    """Return when each raw pixel (..., 2) is read, as part of the readout: -1/2 in the first row, 1/2 in the last."""
    height = lens.image_size_px[1]
    return np.asarray((raw[..., 1] - (height - 1) / 2) / (height - 1))


def at_frame_times(recording: Recording, lens: Lens, readout_s: float, speed: Floats) -> Recording:
    """Return a recording as a global shutter would have made it at the frames' time stamps, the middle row's moments.

    Args:
        speed: (F, N, 2) of the ground features, as `ground_speed`.
    """
    if readout_s == 0.0:
        return recording

    def unrolled(by_target: Mapping[str, Floats]) -> dict[str, Floats]:
        return {name: _unrolled(raw, recording.time_s, lens, readout_s) for name, raw in by_target.items()}

    ground = recording.ground_raw - readout_s * row_share(recording.ground_raw, lens)[..., None] * speed
    return replace(
        recording,
        ground_raw=ground,
        targets_raw=unrolled(recording.targets_raw),
        texture_raw=unrolled(recording.texture_raw),
    )


def _unrolled(raw: Floats, time_s: Floats, lens: Lens, readout_s: float) -> Floats:
    """Return a target's positions (F, ..., 2) at the frames' time stamps.

    A shaking roof turns round within a few frames, so its speed is the derivative of a cubic spline.
    """
    flat = raw.reshape(len(raw), -1, 2)
    seen = finite_rows(flat)
    moved = flat.copy()
    for point in np.flatnonzero(seen.sum(axis=0) >= 4):
        frames = seen[:, point]
        speed = CubicSpline(time_s[frames], flat[frames, point])(time_s[frames], 1)
        moved[frames, point] -= readout_s * row_share(flat[frames, point], lens)[:, None] * speed
    return moved.reshape(raw.shape)


def estimated_readout(residual: Floats, change: Floats, weight: Floats) -> Readout:
    """Return the readout that explains what the ground leaves over, if there is one.

    Args:
        residual: (F, N, 2) of poses without a readout.
        change: (F, N, 2) of the residuals for a readout of one second.
        weight: (F, N); 0 where not to be used.
    """
    used = (weight > 0) & finite_rows(residual) & finite_rows(change)
    w = np.where(used, weight, 0.0)[..., None]
    r, d = np.where(used[..., None], residual, 0.0), np.where(used[..., None], change, 0.0)
    information = float((w * d * d).sum())
    if information == 0.0:
        return Readout(0.0, None, "left at zero: the view hardly turns, so the footage cannot tell")
    readout_s = -float((w * r * d).sum()) / information
    left = r + readout_s * d
    sigma_s = ALIKE * float(np.sqrt((w * left * left).sum() / np.maximum(2 * used.sum(), 1) / information))
    if abs(readout_s) < max(SIGNIFICANT * sigma_s, LEAST_READOUT_S):
        return Readout(0.0, sigma_s, f"left at zero: the footage shows none longer than {5e3 * sigma_s:.1f} ms")
    return Readout(readout_s, sigma_s, "estimated from the footage")
