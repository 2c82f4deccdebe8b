from __future__ import annotations

import numpy as np
import pytest

from core.coordinates import Floats
from core.self_calibration import Parameter, SelfCalibration, refused, self_calibrate

PARAMETERS = (Parameter("focal length", "px", 1.5), Parameter("height", "m", 0.03), Parameter("k1", "1", 1e-3))
TRUE = np.array([1.2, -0.04, 5e-4])
MOMENTS = 48
# How a target seems to move, mm, per prior of each parameter, while the camera drifts: two known paths and their mix.
T = np.linspace(0, 9, MOMENTS)
PATHS = np.stack([np.sin(0.6 * T), np.cos(0.4 * T), np.sin(0.6 * T) * np.cos(0.4 * T)], axis=1)
SENSITIVITY = 2e-3 * np.stack([PATHS, PATHS[:, [1, 2, 0]]], axis=1)  # (B, K = 2, P)
NOISE_M = 5e-5


def apparent(correction: Floats, noise: Floats | float = 0.0) -> Floats:
    """Motion (B, 2) that is gone at the true correction, but for a resting place nobody knows."""
    priors = np.array([parameter.sigma for parameter in PARAMETERS])
    return SENSITIVITY @ ((correction - TRUE) / priors) + [12.3, -4.5] + noise


def sigma() -> Floats:
    return np.full((MOMENTS, 2), NOISE_M)


def test_what_stands_still_calibrates() -> None:
    found = self_calibrate(PARAMETERS, apparent, sigma())
    # The priors pull back by their share of the information: at 2 mm per prior and 0.05 mm noise, under a thousandth.
    np.testing.assert_allclose(found.correction, TRUE, rtol=2e-3)
    assert found.refused is None
    assert found.rms_before_m > 1e-3
    assert found.rms_after_m < 5e-6
    assert (found.sigma < 0.05 * np.array([parameter.sigma for parameter in PARAMETERS])).all()
    np.testing.assert_allclose(found.in_priors, TRUE / [1.5, 0.03, 1e-3], rtol=2e-3)


def test_a_large_motion_is_found_although_far_ones_count_less() -> None:
    found = self_calibrate(PARAMETERS, lambda correction: 5 * apparent(correction), sigma())
    np.testing.assert_allclose(found.correction, TRUE, rtol=2e-3)


def test_answer_is_the_ridge_regression_of_its_priors() -> None:
    noise = np.random.default_rng(0).normal(scale=NOISE_M, size=(MOMENTS, 2))
    large = 60 * sigma()  # so noisy that the priors matter, and no moment stands out
    found = self_calibrate(PARAMETERS, lambda correction: apparent(correction, noise), large)
    centred = (SENSITIVITY - SENSITIVITY.mean(axis=0)).reshape(-1, 3) / large[0, 0]
    target = (apparent(np.zeros(3), noise) - apparent(np.zeros(3), noise).mean(axis=0)).ravel() / large[0, 0]
    normal = centred.T @ centred + np.eye(3)
    np.testing.assert_allclose(found.in_priors, np.linalg.solve(normal, -centred.T @ target), atol=1e-6)
    priors = np.array([parameter.sigma for parameter in PARAMETERS])
    np.testing.assert_allclose(found.sigma, np.sqrt(np.diag(np.linalg.inv(normal))) * priors, rtol=1e-6)
    np.testing.assert_allclose(found.sigma**2, np.diag(found.covariance))


def test_errors_are_as_large_as_the_covariance_says() -> None:
    random, whitened = np.random.default_rng(1), []
    for _ in range(200):
        noise = random.normal(scale=NOISE_M, size=(MOMENTS, 2))
        found = self_calibrate(PARAMETERS, lambda correction, noise=noise: apparent(correction, noise), sigma())
        error = found.correction - TRUE
        whitened.append(error @ np.linalg.inv(found.covariance) @ error)
    # Chi-squared with 3 degrees of freedom over 200 trials: 3 +- 0.17.
    assert 2.4 < np.mean(whitened) < 3.7


def test_what_nothing_tells_stays_as_it_was() -> None:
    blind = SENSITIVITY * [1.0, 0.0, 1.0]
    priors = np.array([parameter.sigma for parameter in PARAMETERS])
    found = self_calibrate(PARAMETERS, lambda correction: blind @ ((correction - TRUE) / priors), sigma())
    assert found.correction[1] == pytest.approx(0.0, abs=1e-12)
    assert found.sigma[1] == pytest.approx(0.03)
    np.testing.assert_allclose(found.correction[[0, 2]], TRUE[[0, 2]], rtol=5e-3)


def test_a_curved_relation_converges() -> None:
    found = self_calibrate(
        PARAMETERS, lambda correction: apparent(correction) + 20 * (apparent(correction) - [12.3, -4.5]) ** 2, sigma()
    )
    np.testing.assert_allclose(found.correction, TRUE, rtol=1e-2)


def test_moments_not_to_be_used_and_moments_not_seen() -> None:
    noisy = sigma()
    noisy[::4] = np.nan

    def with_gaps(correction: Floats) -> Floats:
        motion = apparent(correction)
        motion[::4] += 0.5  # would ruin everything if it counted
        motion[1::7] = np.nan
        return motion

    found = self_calibrate(PARAMETERS, with_gaps, noisy)
    np.testing.assert_allclose(found.correction, TRUE, rtol=5e-3)
    assert np.isfinite(found.covariance).all()
    assert found.rms_after_m < 1e-5


def test_two_wild_moments_change_little() -> None:
    def gusty(correction: Floats) -> Floats:
        motion = apparent(correction)
        motion[[9, 30]] += 2e-3
        return motion

    found = self_calibrate(PARAMETERS, gusty, sigma())
    # Two moments of 40 sigma held to 2.5 sigma each out of 48: a fraction of a prior's posterior sigma or two.
    assert (np.abs(found.correction - TRUE) < 3 * found.sigma).all()


def test_too_large_corrections_are_told() -> None:
    found = SelfCalibration(PARAMETERS, np.array([6.0, 0.0, -1e-3]), np.ones(3), 0.0, 0.0, np.eye(3))
    assert len(found.warnings) == 1
    assert "focal length by +4.0 times" in found.warnings[0]


def test_a_refusal_corrects_nothing_and_says_why() -> None:
    nothing = refused(PARAMETERS, "no pre-event interval is given")
    assert nothing.refused == "no pre-event interval is given"
    assert not nothing.correction.any()
    assert not nothing.in_priors.any()
    np.testing.assert_allclose(nothing.sigma, [1.5, 0.03, 1e-3])
    assert nothing.warnings == ()
