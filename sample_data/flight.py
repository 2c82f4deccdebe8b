"""How the hovering camera moves: a pose for any instant, never only for a frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Wandering:
    """A smooth random signal: a sum of sinusoids whose amplitudes fall with frequency, zero at time zero.

    Attributes:
        frequency_hz, phase_rad: (n,).
        amplitude: (channels, n).
    """

    frequency_hz: Floats
    phase_rad: Floats
    amplitude: Floats

    @classmethod
    def random(
        cls, rng: np.random.Generator, *, reach: ArrayLike, band_hz: tuple[float, float], duration_s: float
    ) -> Wandering:
        """Return a signal that goes as far as `reach` (channels,) from its start within the duration."""
        reach = np.atleast_1d(np.asarray(reach, dtype=np.float64))
        count = 9
        frequency = np.geomspace(*band_hz, count) * rng.uniform(0.93, 1.07, count)
        amplitude = rng.uniform(0.4, 1.0, (len(reach), count)) * (frequency[0] / frequency)
        phase = rng.uniform(0, 2 * np.pi, (len(reach), count))
        unscaled = cls(frequency, phase, amplitude)
        farthest = np.abs(unscaled(np.linspace(0, duration_s, 2000))).max(axis=0)
        return cls(frequency, phase, amplitude * (reach / np.maximum(farthest, 1e-12))[:, None])

    def __call__(self, time_s: ArrayLike) -> Floats:
        """Return the signal (times, channels)."""
        angle = 2 * np.pi * self.frequency_hz * np.atleast_1d(np.asarray(time_s, dtype=np.float64))[:, None, None]
        return (self.amplitude * (np.sin(angle + self.phase_rad) - np.sin(self.phase_rad))).sum(axis=-1)


@dataclass(frozen=True)
class Gust:
    """A push of the wind that turns the view away and lets it come back.

    Attributes:
        start_s: when it begins.
        rise_s: time from rest to the largest turn.
        turn_rad: largest turn about the image's y axis and x axis.
        push_m: largest displacement east, north and up.
    """

    start_s: float
    rise_s: float
    turn_rad: tuple[float, float]
    push_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def share(self, time_s: Floats) -> Floats:
        """Return (times,) how much of the push is felt, 0 to 1, smooth in its second derivative."""
        rise = np.clip((time_s - self.start_s) / self.rise_s, 0, 1)
        fall = np.clip((time_s - self.start_s - 1.6 * self.rise_s) / (2.2 * self.rise_s), 0, 1)
        return _smooth_step(rise) - _smooth_step(fall)


@dataclass(frozen=True, eq=False)
class Flight:
    """The camera's pose at any time.

    Attributes:
        centre_m: (3,) where it hovers; world metres.
        off_nadir_rad: angle of the optical axis from straight down.
        heading_rad: direction of the image's top, clockwise from north.
        drift: 3 channels, metres east, north, up.
        turning: 3 channels, radians about the camera's x, y and z axis.
        gusts: pushes on top.
    """

    centre_m: Floats
    off_nadir_rad: float
    heading_rad: float
    drift: Wandering
    turning: tuple[Wandering, ...]
    gusts: tuple[Gust, ...] = field(default=())

    def pose(self, time_s: ArrayLike) -> tuple[Floats, Floats]:
        """Return R (times, 3, 3) camera <- world and C (times, 3) in world metres: x_cam = R (X - C)."""
        time = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
        centre = self.centre_m + self.drift(time)
        angles = np.sum([part(time) for part in self.turning], axis=0)
        for gust in self.gusts:
            share = gust.share(time)[:, None]
            centre = centre + share * np.array(gust.push_m)
            angles = angles + share * np.array([gust.turn_rad[1], gust.turn_rad[0], 0.0])
        return _small_rotation(angles) @ self._resting_rotation(), centre

    def _resting_rotation(self) -> Floats:
        """(3, 3) camera <- world of the undisturbed view: x right, y down in the image, z forward."""
        s, c = np.sin(self.heading_rad), np.cos(self.heading_rad)
        right = np.array([c, -s, 0.0])
        top = np.array([s, c, 0.0])
        down = np.array([0.0, 0.0, -1.0])
        tilt_s, tilt_c = np.sin(self.off_nadir_rad), np.cos(self.off_nadir_rad)
        forward = tilt_c * down + tilt_s * top
        return np.stack((right, np.cross(forward, right), forward))


def _smooth_step(share: Floats) -> Floats:
    return share**3 * (10 - 15 * share + 6 * share**2)


def _small_rotation(angles_rad: Floats) -> Floats:
    """Return (n, 3, 3) rotations about x, then y, then z by angles (n, 3)."""
    cx, cy, cz = np.cos(angles_rad).T
    sx, sy, sz = np.sin(angles_rad).T
    zero, one = np.zeros_like(cx), np.ones_like(cx)
    about_x = np.array([[one, zero, zero], [zero, cx, -sx], [zero, sx, cx]])
    about_y = np.array([[cy, zero, sy], [zero, one, zero], [-sy, zero, cy]])
    about_z = np.array([[cz, -sz, zero], [sz, cz, zero], [zero, zero, one]])
    turn = np.einsum("ijn,jkn,kln->nil", about_z, about_y, about_x)
    return np.ascontiguousarray(turn)
