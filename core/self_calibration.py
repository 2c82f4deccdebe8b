"""Stationary self-calibration: while the building stands still, motion that geometry still shows is calibration error.

Small corrections of lens, height and reference pose, each held by a prior of the size of its own uncertainty, are
chosen so that the target stands still in the stationary part; event frames are never used. It is the paper's own
insight (the pre-event tells what is wrong) put into geometry instead of a filter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.coordinates import Bools, Floats
from core.robust import robust_sigma

# Corrections beyond this many priors mean that something else is wrong: another lens, another height.
SUSPICIOUS = 3.0
ITERATIONS = 6
# Steps for which derivatives are taken anew: the relation is all but straight.
LINEARISED = 2
# Steps after which the noise of the stationary part is, at least, what then remains of it.
INFLATING = 2


@dataclass(frozen=True)
class Parameter:
    """One quantity that may be corrected: its name, unit, the standard deviation of its calibration, and its value."""

    name: str
    unit: str
    sigma: float
    value: float = 0.0


@dataclass(frozen=True)
class SelfCalibration:
    """What the stationary part says about the calibration.

    Attributes:
        parameters: in the order of the arrays.
        correction: (P,) to be added to each parameter.
        sigma: (P,) its standard deviation afterwards.
        rms_before_m, rms_after_m: apparent motion of the target in the stationary part.
        covariance: (P, P) of the corrections.
        refused: why no correction was made, or None.
    """

    parameters: tuple[Parameter, ...]
    correction: Floats
    sigma: Floats
    rms_before_m: float
    rms_after_m: float
    covariance: Floats
    refused: str | None = None

    @property
    def in_priors(self) -> Floats:
        """(P,) corrections in units of their prior standard deviations."""
        return self.correction / np.array([parameter.sigma for parameter in self.parameters])

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about corrections that are too large to be calibration error."""
        return tuple(
            f"Self-calibration moves {parameter.name} by {value:+.1f} times its calibration's uncertainty; "
            "check the lens file, the height and the clicks."
            for parameter, value in zip(self.parameters, self.in_priors, strict=True)
            if abs(value) > SUSPICIOUS
        )


def self_calibrate(
    parameters: tuple[Parameter, ...],
    apparent_motion: Callable[[Floats], Floats],
    sigma_m: Floats,
    ground_misfit: Callable[[Floats], Floats] | None = None,
    *,
    part: NDArray[np.int64] | None = None,
) -> SelfCalibration:
    """Return the corrections under which the target stands still.

    Args:
        apparent_motion: leads from corrections (P,) to the target's coordinates (B, K) in B stationary moments, metres.
        sigma_m: (B, K) noise of these coordinates; nan where a moment is not to be used. Where the target stands less
            still than that under the best calibration, the noise is what it still moves by.
        ground_misfit: leads from corrections to what the ground leaves over in the whole clip, in units of its noise:
            the ground never moves, so a wrong lens shows wherever the view has turned far.
        part: (B,) which moments share one resting place, before the event or after it; all where None.

    Source: Gauss-Newton on the posterior; the priors make it a ridge regression with meaning.
    """
    priors = np.array([parameter.sigma for parameter in parameters])
    usable = np.isfinite(sigma_m)
    weight = np.where(usable, 1.0 / np.where(usable, sigma_m, 1.0) ** 2, 0.0)
    same = np.zeros(len(sigma_m), dtype=np.int64) if part is None else part
    together = (same[:, None] == same).astype(np.float64)

    def departure(scaled: Floats) -> Floats:
        motion = apparent_motion(scaled * priors)
        w = np.where(np.isfinite(motion), weight, 0.0)
        rest = together @ (w * np.nan_to_num(motion)) / np.maximum(together @ w, 1e-300)
        return np.where(w > 0, motion - rest, 0.0) * np.sqrt(w)

    def misfit(scaled: Floats) -> Floats:
        own = departure(scaled).ravel()
        return own if ground_misfit is None else np.concatenate([own, ground_misfit(scaled * priors)])

    scaled = np.zeros(len(priors))
    residual = misfit(scaled)
    before, J = residual[: sigma_m.size], np.empty((residual.size, len(priors)))
    scale = np.ones((residual.size, 1))
    for iteration in range(ITERATIONS):
        if iteration < LINEARISED:
            J = _derivatives(misfit, scaled, residual)
        relative, slope = residual[:, None] / scale, J / scale
        huber = _huber(relative)
        step = np.linalg.solve(
            (huber * slope).T @ slope + np.eye(len(priors)), -((huber * slope).T @ relative)[:, 0] - scaled
        )
        scaled = scaled + step
        residual = misfit(scaled)
        if iteration < INFLATING:
            spread = _spread(residual[: sigma_m.size].reshape(sigma_m.shape), usable)
            scale[: sigma_m.size, 0] = np.tile(np.maximum(1.0, spread), len(sigma_m))
        elif np.abs(step).max() < 1e-3:
            break
    slope = J / scale
    covariance: Floats = np.asarray(np.linalg.inv(slope.T @ slope + np.eye(len(priors))) * np.outer(priors, priors))
    return SelfCalibration(
        parameters=parameters,
        correction=scaled * priors,
        sigma=np.sqrt(np.diag(covariance)),
        rms_before_m=_rms_m(before, sigma_m, usable),
        rms_after_m=_rms_m(residual[: sigma_m.size], sigma_m, usable),
        covariance=covariance,
    )


def refused(parameters: tuple[Parameter, ...], reason: str) -> SelfCalibration:
    """Return a self-calibration that corrects nothing and says why."""
    zeros, priors = np.zeros(len(parameters)), np.array([parameter.sigma for parameter in parameters])
    return SelfCalibration(parameters, zeros, priors, float("nan"), float("nan"), np.diag(priors**2), reason)


def _derivatives(misfit: Callable[[Floats], Floats], at: Floats, value: Floats) -> Floats:
    """Return the derivatives (n, P) by forward differences of a fifth of a prior: far above rounding, and straight."""
    step = 0.2
    return np.stack([(misfit(at + step * unit) - value) / step for unit in np.eye(len(at))], axis=1)


def _spread(own: Floats, usable: Bools) -> Floats:
    """Return the robust standard deviation (K,) of residuals (B, K) where they are used; 1 where none is."""
    spread = robust_sigma(np.where(usable, own, np.nan).T)
    return np.where(usable.any(axis=0), spread, 1.0)


def _rms_m(own: Floats, sigma_m: Floats, usable: Bools) -> float:
    """Return what residuals (B K,) in units of their noise (B, K) come to where they are used, metres."""
    return float(np.sqrt(np.mean((own.reshape(sigma_m.shape)[usable] * sigma_m[usable]) ** 2)))


def _huber(residual: Floats) -> Floats:
    return np.asarray(np.minimum(1.0, 2.5 / np.maximum(np.abs(residual), 1e-12)))
