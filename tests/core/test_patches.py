from __future__ import annotations

import numpy as np
import pytest

from core.coordinates import Floats, rotation_2d
from core.patches import HALF_PX, LEAST_SCORE, MARGIN_PX, MAX_WANDER_PX, Matches, PatchTracker
from tests.waves import frame, pixels, waves

SIZE = (260, 200)
TEXTURE = waves(1)
STILL = np.eye(2)


def points(count: int = 40, seed: int = 0) -> Floats:
    """Patch centres at any part of a pixel, away from the border."""
    edge = HALF_PX + MARGIN_PX + 8
    return np.random.default_rng(seed).uniform(edge, np.array(SIZE) - edge, (count, 2))


def tracker() -> PatchTracker:
    return PatchTracker(frame(TEXTURE(pixels(SIZE))), points())


def track(luma_of: Floats, predicted: Floats, ref_from_current: Floats = STILL, noise: float = 0.0) -> Matches:
    affine = np.broadcast_to(ref_from_current, (len(predicted), 2, 2)).copy()
    return tracker().track(frame(luma_of, noise), predicted, affine)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, 0.5), (0.25, -0.4), (3.3, -2.7), (-1.01, 0.98)])
def test_patches_are_found_to_a_hundredth_of_a_pixel(shift: tuple[float, float]) -> None:
    found = track(TEXTURE(pixels(SIZE) - shift), points() + np.round(shift))
    error = found.raw - points() - shift
    assert np.isfinite(error).all()
    assert np.abs(error).max() < 0.02
    # No half-pixel pull: what all patches err together is far below what one does.
    assert np.abs(error.mean(axis=0)).max() < 2e-3
    assert found.score.min() > 0.995


@pytest.mark.parametrize("wrong", [(0.9, 0.4), (-1.5, 1.2)])
def test_predictions_may_be_wrong_by_a_pixel_or_two(wrong: tuple[float, float]) -> None:
    found = track(TEXTURE(pixels(SIZE) - [0.3, 0.2]), points() + [0.3, 0.2] + wrong)
    assert np.nanmax(np.abs(found.raw - points() - [0.3, 0.2])) < 0.02
    assert np.isfinite(found.raw).all()


def test_known_turns_and_scales_are_undone() -> None:
    centre = np.array(SIZE) / 2
    A = 1.04 * rotation_2d(0.06)  # reference pixels by frame pixels
    grey = TEXTURE((pixels(SIZE) - centre) @ A.T + centre)
    expected = (points() - centre) @ np.linalg.inv(A).T + centre
    found = track(grey, expected + 0.4, A)
    assert np.abs(found.raw - expected).max() < 0.03
    untold = track(grey, expected + 0.4)
    assert np.nanmean(found.score) > np.nanmean(untold.score)


def test_light_may_change_by_a_gain_and_an_offset() -> None:
    grey = TEXTURE(pixels(SIZE) - [0.4, -0.3])
    found = track(0.6 * grey + 55, points())
    assert np.abs(found.raw - points() - [0.4, -0.3]).max() < 0.03
    assert found.score.min() > 0.99


def test_noise_moves_patches_as_far_as_it_must() -> None:
    noise, step = 6.0, 1e-3
    around = pixels((2 * HALF_PX + 1, 2 * HALF_PX + 1)).reshape(-1, 2) - HALF_PX
    information = np.zeros((40, 2, 2))
    for number, point in enumerate(points()):
        slopes = [(TEXTURE(point + around + step * u) - TEXTURE(point + around - step * u)) / (2 * step) for u in STILL]
        # An offset and a gain are estimated too.
        nuisance = np.stack([np.ones(len(around)), TEXTURE(point + around)], axis=1)
        free = np.array(slopes).T - nuisance @ np.linalg.lstsq(nuisance, np.array(slopes).T, rcond=None)[0]
        information[number] = free.T @ free / noise**2
    whitened, moved, still = [], TEXTURE(pixels(SIZE) - [0.37, 0.61]), tracker()
    for seed in range(12):
        luma = frame(moved, noise, seed)
        error = still.track(luma, points() + [0.0, 1.0], np.broadcast_to(STILL, (40, 2, 2)).copy()).raw
        error = error - points() - [0.37, 0.61]
        whitened.append(np.einsum("ni,nij,nj->n", error, information, error))
    # Chi-squared with two degrees of freedom over 480 patches: 2 +- 0.09; the reference's own rounding adds little.
    assert 1.7 < np.mean(whitened) < 2.5


def test_what_is_not_there_has_a_low_score() -> None:
    found = track(waves(99)(pixels(SIZE)), points())
    assert (np.nan_to_num(found.score) < 0.6).mean() > 0.9


def test_flat_frames_and_frames_of_one_slope_do_not_mislead() -> None:
    for grey in (np.full(SIZE[::-1], 80.0), pixels(SIZE)[..., 0] * 0.5 + 20):
        found = track(grey, points())
        assert not (np.nan_to_num(found.score) > 0.6).any()


def test_a_flat_reference_does_not_either() -> None:
    flat = PatchTracker(frame(np.full(SIZE[::-1], 80.0)), points())
    found = flat.track(frame(TEXTURE(pixels(SIZE))), points(), np.broadcast_to(STILL, (40, 2, 2)).copy())
    assert not (np.nan_to_num(found.score) > 0.6).any()


def test_patches_that_wander_off_are_dropped() -> None:
    far = MAX_WANDER_PX + 4
    found = track(TEXTURE(pixels(SIZE) - [far, 0.0]), points())
    kept = np.isfinite(found.raw).all(axis=1)
    assert np.abs(found.raw - points())[kept].max(initial=0.0) <= MAX_WANDER_PX
    good = np.nan_to_num(found.score) > 0.8
    assert not good.any()


def test_patches_outside_the_frame_and_without_a_prediction_are_not_found() -> None:
    predicted = points().copy()
    predicted[0] = [HALF_PX - 1.0, 100.0]
    predicted[1] = [SIZE[0] - 4.0, 100.0]
    predicted[2] = np.nan
    predicted[3] = [1e7, -1e7]
    found = track(TEXTURE(pixels(SIZE)), predicted)
    assert np.isnan(found.raw[:4]).all()
    assert np.isnan(found.score[:4]).all()
    assert np.isfinite(found.raw[4:]).all()


def test_no_patches_at_all_and_none_inside() -> None:
    luma = frame(TEXTURE(pixels(SIZE)))
    assert len(PatchTracker(luma, np.empty((0, 2)))) == 0
    found = tracker().track(luma, np.full((40, 2), np.nan), np.broadcast_to(STILL, (40, 2, 2)).copy())
    assert np.isnan(found.raw).all()


def test_a_noisy_reference_is_averaged_over_views_of_it() -> None:
    faint, noise, still = waves(5, contrast=3.0), 7.0, np.broadcast_to(STILL, (40, 2, 2))
    alone, averaged = (PatchTracker(frame(faint(pixels(SIZE)), noise, seed=1), points()) for _ in range(2))
    shifts = np.random.default_rng(2).uniform(-1.5, 1.5, (32, 2))
    lumas = [frame(faint(pixels(SIZE) - shift), noise, seed=10 + n) for n, shift in enumerate(shifts)]
    averaged.denoise([averaged.views(luma, points() + s, still) for luma, s in zip(lumas, shifts, strict=True)])
    assert 0.3 * alone.least_score < averaged.least_score < 0.6 * alone.least_score

    def errors(tracker: PatchTracker) -> Floats:
        predicted = points() + [0.37 + 0.6, 0.0]
        later = [frame(faint(pixels(SIZE) - [0.37, 0.0]), noise, seed=100 + n) for n in range(6)]
        return np.array([tracker.track(luma, predicted, still).raw - points() - [0.37, 0.0] for luma in later])

    # Compared with one noisy frame, all patches stay behind on the way from where they were predicted.
    assert np.nanmedian(errors(alone)[..., 0]) > 0.1
    assert abs(np.nanmedian(errors(averaged)[..., 0])) < 0.04
    # What is left is the noise of the frame itself, whatever direction it has.
    assert np.nanmedian(np.abs(errors(averaged)[..., 1])) < 0.65 * np.nanmedian(np.abs(errors(alone)[..., 1]))


def test_a_frame_is_not_compared_with_its_own_noise() -> None:
    faint, still = waves(5, contrast=6.0), np.broadcast_to(STILL, (40, 2, 2))
    lumas = [frame(faint(pixels(SIZE)), 7.0, seed=n) for n in range(9)]
    patches = PatchTracker(lumas[0], points())
    patches.denoise([patches.views(luma, points(), still) for luma in lumas[1:]])
    scatter = [
        np.nanstd(patches.track(lumas[2], points(), still, is_view=is_view).raw - points()) for is_view in (False, True)
    ]
    assert scatter[0] < 0.7 * scatter[1]


def test_what_views_do_not_show_stays_as_the_reference_frame_shows_it() -> None:
    patches, still = tracker(), np.broadcast_to(STILL, (40, 2, 2))
    beside = np.where(np.arange(40)[:, None] < 20, points(), np.nan)
    beside[19] = 2.0, 2.0
    views = patches.views(frame(TEXTURE(pixels(SIZE)), 3.0, seed=3), beside, still)
    assert np.isfinite(views[:19]).all()
    assert np.isnan(views[19:]).all()
    patches.denoise([views] * 8)
    found = patches.track(frame(TEXTURE(pixels(SIZE))), points(), still)
    assert np.abs(found.raw - points())[20:].max() < 0.02


def test_without_views_patches_stay_as_they_are() -> None:
    patches, still = tracker(), np.broadcast_to(STILL, (40, 2, 2))
    nothing = patches.views(frame(TEXTURE(pixels(SIZE))), np.full((40, 2), np.nan), still)
    patches.denoise([nothing] * 16)
    assert patches.least_score == LEAST_SCORE
    assert not patches.is_averaged


def test_more_patches_than_fit_below_one_another_are_found_too() -> None:
    many = points(1489)
    crowd = PatchTracker(frame(TEXTURE(pixels(SIZE))), many)
    found = crowd.track(frame(TEXTURE(pixels(SIZE) - [0.3, 0.2])), many, np.broadcast_to(STILL, (1489, 2, 2)).copy())
    assert np.abs(found.raw - many - [0.3, 0.2]).max() < 0.03
