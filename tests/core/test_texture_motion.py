from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from core.coordinates import Floats, rotation_2d
from core.measurements import Recording
from core.results import TargetHistory
from core.solve import solve
from core.texture import LEAST_PATCHES
from tests import exact_scene as scene

# Of the edges of the strips and of the patches about them; the ground is seen without noise.
STRIP_NOISE_PX, PATCH_NOISE_PX = 0.06, 0.02
# Patches lie on a roof below the strips, some on what stands on it.
COUNT, LOWEST_M, HIGHEST_M = 50, -1.4, 0.5


def places() -> Floats:
    """(COUNT, 3) patches at rest relative to the roof's middle and to the height of its strips."""
    low, high = (-2.8, -1.9, LOWEST_M), (2.8, 1.9, HIGHEST_M)
    return np.random.default_rng(8).uniform(low, high, (COUNT, 3))


@lru_cache
def recording(noise_px: float = PATCH_NOISE_PX, strip_noise_px: float = STRIP_NOISE_PX) -> Recording:
    """Noisy strips and better patches about them."""

    def on_roof(frame: int) -> Floats:
        shift, angle = scene.motion(frame)
        flat = places()[:, :2] @ rotation_2d(angle).T + scene.ROOF_M + shift
        return np.column_stack([flat, scene.HEIGHT_M + places()[:, 2]])

    seen = np.array([scene.seen(frame, on_roof(frame)) for frame in range(scene.FRAMES)])
    noisy = seen + np.random.default_rng(9).normal(scale=noise_px, size=seen.shape)
    return with_patches(seen[0], noisy, strip_noise_px)


@lru_cache
def strips(noise_px: float = STRIP_NOISE_PX) -> Recording:
    """Noisy strips with nothing about them."""
    return replace(scene.recording(noise_px), ground_raw=scene.recording().ground_raw)


def with_patches(reference_raw: Floats, raw: Floats, strip_noise_px: float = STRIP_NOISE_PX) -> Recording:
    lines = strips(strip_noise_px)
    reference = replace(lines.reference, texture_raw={"roof": reference_raw})
    return replace(lines, reference=reference, texture_raw={"roof": raw})


def history(given: Recording) -> TargetHistory:
    return solve(given, scene.project_document(), scene.LENS).histories["roof"]


def error_m(found: TargetHistory) -> Floats:
    """(F, 2) of P1, from rest."""
    true = scene.truth().p1_m
    return np.asarray(found.p1_m - (true - true[:44].mean(axis=0)))


def rms_m(found: TargetHistory) -> Floats:
    return np.sqrt((error_m(found) ** 2).mean(axis=0))


def test_patches_at_any_height_halve_the_noise_of_strips() -> None:
    alone = rms_m(history(strips()))
    both = rms_m(history(recording()))
    # 40 places of T1 with two edges each tell x to 0.06 / sqrt(80) pixels, 50 patches to 0.02 / sqrt(50): under half.
    assert (both < 0.6 * alone).all()


def test_patches_that_scatter_more_than_strips_help_as_much_as_they_know() -> None:
    alone = rms_m(history(strips()))
    both = rms_m(history(recording(noise_px=0.09)))
    # Believed as if they were as good as strips, they would drown these, and nothing would be gained along x.
    assert (both < 0.96 * alone).all()


def test_standard_deviations_follow() -> None:
    found = history(recording(noise_px=0.05))
    scatter = error_m(found)[:44].std(axis=0)
    np.testing.assert_allclose(found.p1_sigma_m[:44].mean(axis=0) / scatter, 1.0, atol=0.2)


def test_patches_far_above_and_below_take_part() -> None:
    solved = solve(recording(), scene.project_document(), scene.LENS)
    # A metre of height unaccounted for would be a thirtieth of 0.3 m of motion: 10 mm, where strips scatter by 3 mm.
    assert solved.targets["roof"].texture_used.all()
    assert np.abs(error_m(solved.histories["roof"])).max() < 1e-3


@pytest.mark.parametrize("moving", [0.0, 0.5], ids=["on the ground", "half as fast"])
def test_patches_that_do_not_move_with_the_strips_are_left_out(moving: float) -> None:
    given = recording()
    raw = given.texture_raw["roof"].copy()
    others = np.arange(COUNT) % 3 == 0
    for frame in range(scene.FRAMES):
        shift, _ = scene.motion(frame)
        flat = places()[others, :2] + scene.ROOF_M + moving * shift
        raw[frame, others] = scene.seen(frame, np.column_stack([flat, np.zeros(others.sum())]))
    reference_raw = np.where(others[:, None], raw[0], given.reference.texture_raw["roof"])
    some = with_patches(reference_raw[~others], raw[:, ~others])
    np.testing.assert_allclose(history(with_patches(reference_raw, raw)).p1_m, history(some).p1_m, atol=1e-9)


def test_patches_on_a_lower_roof_are_left_out_though_they_move_alike() -> None:
    given = recording()
    raw = given.texture_raw["roof"].copy()
    others = np.arange(COUNT) % 3 == 0
    for frame in range(scene.FRAMES):
        shift, _ = scene.motion(frame)
        flat = places()[others, :2] + scene.ROOF_M + shift
        raw[frame, others] = scene.seen(frame, np.column_stack([flat, np.full(others.sum(), scene.HEIGHT_M - 2.5)]))
    reference_raw = np.where(others[:, None], raw[0], given.reference.texture_raw["roof"])
    solved = solve(with_patches(reference_raw, raw), scene.project_document(), scene.LENS)
    np.testing.assert_array_equal(solved.targets["roof"].texture_used, ~others)


def test_patches_whose_height_nothing_tells_are_left_out() -> None:
    given = recording()
    ground, roof, patches = (
        np.repeat(raw[:1], scene.FRAMES, axis=0)
        for raw in (given.ground_raw, given.targets_raw["roof"], given.texture_raw["roof"])
    )
    noisy = patches + np.random.default_rng(3).normal(scale=PATCH_NOISE_PX, size=patches.shape)
    still = replace(given, ground_raw=ground, targets_raw={"roof": roof}, texture_raw={"roof": noisy})
    solved = solve(still, scene.project_document(), scene.LENS)
    assert not solved.targets["roof"].texture_used.any()


def test_few_patches_are_not_listened_to() -> None:
    given, few = recording(), slice(LEAST_PATCHES - 1)
    reference_raw, raw = given.reference.texture_raw["roof"][few], given.texture_raw["roof"][:, few]
    alone = history(strips())
    np.testing.assert_array_equal(history(with_patches(reference_raw, raw)).p1_m, alone.p1_m)


def test_where_patches_are_not_seen_strips_tell_alone() -> None:
    given, gone = recording(), slice(60, 70)
    raw = given.texture_raw["roof"].copy()
    raw[gone] = np.nan
    found = history(replace(given, texture_raw={"roof": raw}))
    alone, whole = history(strips()), history(given)
    # Rest, from which all count, is that of strips and patches together.
    at_rest = (whole.p1_m - alone.p1_m + error_m(alone) - error_m(whole))[0]
    np.testing.assert_allclose(at_rest, 0.0, atol=1e-12)
    own, of_strips = error_m(found)[gone], error_m(alone)[gone]
    np.testing.assert_allclose(own - own.mean(axis=0), of_strips - of_strips.mean(axis=0), atol=1e-5)
    assert (found.status[gone] == "ok").all()


def test_patches_do_not_measure_what_strips_do_not() -> None:
    given, hidden = recording(), slice(60, 64)
    roof = given.targets_raw["roof"].copy()
    roof[hidden, 2] = np.nan
    found = history(replace(given, targets_raw={"roof": roof}))
    assert (found.status[hidden] == "lost").all()
    assert np.isnan(found.p1_m[hidden]).all()
