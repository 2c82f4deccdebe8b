"""How the table and the building on it move, exact at any instant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import bilinear, lfilter

Floats = NDArray[np.float64]
Motion = Callable[[Floats], Floats]
"""(times,) -> (times, 3): displacement east and north in metres, rotation counter-clockwise in radians."""

_STEP_S = 1 / 500


def at_rest(time_s: ArrayLike) -> Floats:
    """Return the motion of something that does not move: (times, 3) zeros."""
    return np.zeros((np.size(np.asarray(time_s)), 3))


@dataclass(frozen=True)
class Earthquake:
    """What an earthquake does to a building, as an engineer would say it.

    Attributes:
        start_s, duration_s: of the strong shaking.
        peak_m: largest displacement of the roof east-west.
        transverse: largest displacement north-south, as a part of the peak.
        residual_m: east-west and north-south displacement that stays.
        rotation_rad: largest rotation of the roof.
        table_peak_m: largest displacement of the table.
        natural_hz: first natural frequency of the building.
        damping: of that mode, as a part of critical.
        ringing_s: how long it rings on after the strong shaking; infinite if it never quite stands still.
    """

    start_s: float
    duration_s: float
    peak_m: float
    transverse: float = 0.12
    residual_m: tuple[float, float] = (0.0, 0.0)
    rotation_rad: float = 2e-3
    table_peak_m: float = 0.1
    natural_hz: float = 1.1
    damping: float = 0.06
    ringing_s: float = 2.0


@dataclass(frozen=True, eq=False)
class Shaking:
    """The motion of table and roof at rest before and settling after an earthquake."""

    table: Motion
    roof: Motion

    @classmethod
    def of(cls, quake: Earthquake, clip_s: float, rng: np.random.Generator) -> Shaking:
        """Return one random course of the earthquake, scaled to its stated peaks."""
        time = np.arange(-1.0, clip_s + 1.0, _STEP_S)
        table = np.stack([_ground_motion(time, quake, rng) for _ in range(2)], axis=-1)
        table *= quake.table_peak_m * np.array([1.0, quake.transverse]) / np.abs(table).max(axis=0)
        response = np.stack([_oscillator(table[:, axis], quake) for axis in range(2)], axis=-1)
        end = quake.start_s + quake.duration_s
        silent = _after(time, end, quake.ringing_s) if np.isfinite(quake.ringing_s) else np.zeros_like(time)
        response *= (1 - silent)[:, None]
        settled = _after(time, quake.start_s + 0.55 * quake.duration_s, 0.35 * quake.duration_s)[:, None]
        residual = settled * np.array(quake.residual_m)
        wanted = np.array([quake.peak_m, quake.transverse * quake.peak_m])
        roof = table + residual + response * _scale_to_peak(table + residual, response, wanted)
        turn = _oscillator(_ground_motion(time, quake, rng), quake, detune=1.4) * (1 - silent)
        turn *= quake.rotation_rad / np.abs(turn).max()
        turn += 0.3 * quake.rotation_rad * settled[:, 0] * bool(np.any(quake.residual_m))
        return cls(
            _spline(time, np.column_stack((table, np.zeros(len(time))))), _spline(time, np.column_stack((roof, turn)))
        )


def _spline(time_s: Floats, motion: Floats) -> Motion:
    curve = CubicSpline(time_s, motion)
    return lambda when: np.asarray(curve(np.atleast_1d(when)), dtype=np.float64)


def _after(time_s: Floats, start_s: float, rise_s: float) -> Floats:
    """Return 0 before the start, 1 a rise later, smooth between."""
    share = np.clip((time_s - start_s) / rise_s, 0, 1)
    return share**3 * (10 - 15 * share + 6 * share**2)


def _ground_motion(time_s: Floats, quake: Earthquake, rng: np.random.Generator) -> Floats:
    """Return (times,) a random band-limited motion within the strong shaking, zero outside, unscaled."""
    since = (time_s - quake.start_s) / quake.duration_s
    envelope = np.where((since > 0) & (since < 1), np.clip(since, 0, 1) * np.clip(1 - since, 0, 1) ** 1.5, 0.0) ** 1.5
    frequency = np.geomspace(0.35, 5.0, 16) * rng.uniform(0.9, 1.1, 16)
    amplitude = rng.uniform(0.3, 1.0, 16) / (0.6 + frequency**1.7)
    phase = rng.uniform(0, 2 * np.pi, 16)
    return envelope * (amplitude * np.sin(2 * np.pi * frequency * time_s[:, None] + phase)).sum(axis=-1)


def _oscillator(base_m: Floats, quake: Earthquake, detune: float = 1.0) -> Floats:
    """Return the relative displacement of a damped oscillator on a moving base (average acceleration)."""
    omega = 2 * np.pi * quake.natural_hz * detune
    b, a = bilinear([-1.0, 0.0, 0.0], [1.0, 2 * quake.damping * omega, omega**2], fs=1 / _STEP_S)
    return np.asarray(lfilter(b, a, base_m), dtype=np.float64)


def _scale_to_peak(base: Floats, response: Floats, peak: Floats) -> Floats:
    """Return (2,) factors with which base + factor * response just reaches the peak on each axis, by bisection."""
    factors = np.zeros(2)
    for axis in range(2):
        low, high = 0.0, 4 * peak[axis] / max(np.abs(response[:, axis]).max(), 1e-12)
        for _ in range(50):
            middle = (low + high) / 2
            reached = np.abs(base[:, axis] + middle * response[:, axis]).max()
            low, high = (middle, high) if reached < peak[axis] else (low, middle)
        factors[axis] = (low + high) / 2
    return factors
