from __future__ import annotations

import numpy as np
import pytest

from core.coordinates import Floats
from core.results import Displacement, TargetHistory
from core.uncertainty import (
    LEAST_STILL,
    MOVING,
    combined_sigma,
    common_error,
    held_to_jitter,
    held_to_scatter,
    jitter,
    robust_jitter,
)

FRAMES = 400
STILL = np.arange(FRAMES) < 150
MOVING_FRAMES = (np.arange(FRAMES) >= 150) & (np.arange(FRAMES) < 300)
AFTER_FRAMES = np.arange(FRAMES) >= 300


def combined(places_m: Floats, *, slow_m: float = 0.0, still: Floats = STILL) -> Displacement:
    points = Displacement(np.full((FRAMES, 2, 2), 1e-4), np.full(FRAMES, 2e-5))
    return combined_sigma(
        points,
        camera_m=np.full((FRAMES, 2), 5e-5),
        shared_m=np.full(FRAMES, 5e-5),
        slow_m=np.full((FRAMES, 2, 2), slow_m),
        value=Displacement(places_m, 1e-5 * places_m[:, 0, 0] / places_m[:, 0, 0].std()),
        still=np.asarray(still, dtype=bool),
        moving=MOVING_FRAMES,
        after=AFTER_FRAMES,
    )


@pytest.fixture
def places_m() -> Floats:
    return np.random.default_rng(3).normal(scale=4e-4, size=(FRAMES, 2, 2))


def test_error_bars_are_held_against_the_scatter_at_rest(places_m: Floats) -> None:
    sigma = combined(places_m)
    np.testing.assert_allclose(sigma.places_m[STILL].mean(axis=0), places_m[STILL].std(axis=0), rtol=1e-6)
    np.testing.assert_allclose(sigma.rotation_rad[STILL].mean(), 1e-5, rtol=0.2)


@pytest.mark.parametrize("frames", [1, 3, 29, 30, 60])
def test_a_clip_of_few_frames_claims_less(frames: int) -> None:
    claimed = combined_sigma(
        Displacement(np.full((frames, 2, 2), 3e-4), np.full(frames, 2e-5)),
        camera_m=np.zeros((frames, 2)),
        shared_m=np.zeros(frames),
        slow_m=np.zeros((frames, 2, 2)),
        value=Displacement(np.zeros((frames, 2, 2)), np.zeros(frames)),
        still=np.zeros(frames, dtype=bool),
        moving=np.zeros(frames, dtype=bool),
        after=np.zeros(frames, dtype=bool),
    )
    widened = np.sqrt(max(1.0, 30 / frames))
    np.testing.assert_allclose(claimed.places_m, 3e-4 * widened)
    np.testing.assert_allclose(claimed.rotation_rad, 2e-5 * widened)


def test_noise_is_told_from_drift() -> None:
    noise = np.random.default_rng(5).normal(scale=[3e-4, 6e-4], size=(FRAMES, 2))
    drift = 0.05 * np.sin(np.arange(FRAMES) / 40)[:, None]
    np.testing.assert_allclose(jitter(noise + drift), [3e-4, 6e-4], rtol=0.1)
    held = held_to_jitter(np.full((FRAMES, 2), 1e-5), noise + drift, STILL)
    np.testing.assert_allclose(held.mean(axis=0), [3e-4, 6e-4], rtol=0.15)
    few = np.arange(FRAMES) < LEAST_STILL - 1
    np.testing.assert_array_equal(held_to_jitter(np.full((FRAMES, 2), 1e-5), noise, few), 1e-5)
    assert not jitter(noise[:2]).any()


def test_outliers_and_gaps_are_not_taken_for_noise() -> None:
    noise = np.random.default_rng(6).normal(scale=[3e-4, 6e-4], size=(FRAMES, 2))
    torn = noise.copy()
    torn[::40], torn[5::60] = 1.0, np.nan
    np.testing.assert_allclose(robust_jitter(noise), jitter(noise), rtol=0.1)
    np.testing.assert_allclose(robust_jitter(torn), jitter(noise), rtol=0.2)
    assert not robust_jitter(noise[:2]).any()


def test_error_bars_widen_where_the_roof_moves_and_not_after(places_m: Floats) -> None:
    sigma = combined(places_m)
    at_rest, moving, after = (sigma.places_m[part].mean(axis=0) for part in (STILL, MOVING_FRAMES, slice(300, None)))
    np.testing.assert_allclose(moving, MOVING * at_rest)
    np.testing.assert_allclose(after, at_rest, rtol=0.15)  # of a hundred frames' scatter, seven per cent are chance
    np.testing.assert_allclose(sigma.rotation_rad[200], MOVING * sigma.rotation_rad[0])


def test_error_bars_widen_where_values_scatter_more_after_the_event_but_not_by_motion(places_m: Floats) -> None:
    usual = combined(places_m).places_m
    restless = places_m.copy()
    restless[AFTER_FRAMES, 1, 0] *= 2.0
    sigma = combined(restless).places_m
    np.testing.assert_allclose(sigma[AFTER_FRAMES, 1, 0].mean(), restless[AFTER_FRAMES, 1, 0].std(), rtol=1e-6)
    np.testing.assert_allclose(sigma[~AFTER_FRAMES], usual[~AFTER_FRAMES])
    swinging = places_m.copy()
    swinging[AFTER_FRAMES, 0, 1] += 0.01 * np.sin(np.arange(100.0))
    np.testing.assert_allclose(combined(swinging).places_m, usual, rtol=0.1)


def test_what_the_calibration_leaves_open_is_never_scaled_down(places_m: Floats) -> None:
    sigma = combined(0.1 * places_m, slow_m=1e-3)
    assert (sigma.places_m >= 1e-3).all()


def test_few_frames_at_rest_say_nothing(places_m: Floats) -> None:
    sigma = combined(places_m, still=np.arange(FRAMES) < LEAST_STILL - 1)
    np.testing.assert_allclose(sigma.places_m[0], np.sqrt(1e-8 + 2 * 25e-10))


def test_a_target_whose_pieces_wander_errs_as_a_whole() -> None:
    rng = np.random.default_rng(4)
    time_s = np.arange(FRAMES) / 30
    own = rng.normal(scale=1.0, size=(FRAMES, 3, 64))
    wandering = np.repeat(rng.normal(scale=1.0, size=(FRAMES, 3, 8)), 8, axis=2)
    wandering[~MOVING_FRAMES] *= 0.3
    error = common_error(own + wandering, time_s, STILL)
    assert np.median(error[170:280]) > 1.8 * np.median(error[:130])


def test_what_target_and_base_share_is_no_error_of_their_difference() -> None:
    random = np.random.default_rng(4)
    places = random.normal(scale=[4e-4, 1e-4], size=(FRAMES, 2))
    relative = TargetHistory(
        name="storey",
        frame=np.arange(FRAMES),
        time_s=np.arange(FRAMES) / 30,
        status=np.where(np.arange(FRAMES) == 7, "lost", "ok"),
        p1_m=places,
        p2_m=places + 1.0,
        rotation_rad=places[:, 0],
        p1_sigma_m=np.full((FRAMES, 2), 3e-4),
        p2_sigma_m=np.full((FRAMES, 2), 3e-4),
        rotation_sigma_rad=np.full(FRAMES, 3e-4),
        p1_raw_m=places,
        p2_raw_m=places,
        rotation_raw_rad=places[:, 0],
    )
    held = held_to_scatter(relative, STILL)
    # Too small a standard deviation stays: something else than what is shared is at work.
    np.testing.assert_allclose(held.p1_sigma_m[STILL & held.measured, 0], 3e-4)
    np.testing.assert_allclose(held.p2_sigma_m[held.measured, 1], 1e-4, rtol=0.2)
    np.testing.assert_allclose(held.rotation_sigma_rad[held.measured], 3e-4)
    assert held_to_scatter(relative, np.arange(FRAMES) < LEAST_STILL - 1) is relative


@pytest.mark.filterwarnings("error")
def test_frames_behind_lost_ones_and_a_rough_one_still_have_a_common_error() -> None:
    residual = np.full((200, 1, 16), np.nan)
    residual[:60] = np.random.default_rng(3).normal(size=(60, 1, 16))
    residual[59] *= 1e3
    found = common_error(residual, np.arange(200) / 30.0, np.arange(200) < 50)
    assert np.isfinite(found).all()
    assert (found > 0).all()
