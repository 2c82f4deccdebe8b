from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.camera import Pose, exponential, intersect_height, project
from core.coordinates import Floats
from core.errors import InputError
from core.georeference import ReferenceFit, fit_reference, reference_pose
from core.lens import Lens
from core.project import Correspondence

LENS = Lens(
    (1920, 1080),
    np.array([[1230.0, 0.0, 950.0], [0.0, 1232.0, 548.0], [0.0, 0.0, 1.0]]),
    np.array([-0.1, 0.08, 5e-4, -1e-3, 0.0]),
)
SITE_M = np.array([481_250.0, 5_812_340.0])  # UTM
DOWN = np.diag([1.0, -1.0, -1.0])
POSE = Pose(exponential([0.08, -0.05, 0.3]) @ DOWN, np.array([2.0, -3.0, 40.0]))
PLACES = np.array(
    [(-22, -12), (-8, -13), (10, -11), (23, -10), (-20, 1), (21, 2), (-23, 13), (-7, 11), (8, 13), (22, 12), (0, -6)],
    dtype=float,
)


def clicks(
    places: Floats = PLACES,
    noise_px: float = 0.0,
    seed: int = 0,
    *,
    elevation_m: Floats | None = None,
    disabled: Sequence[int] = (),
) -> list[Correspondence]:
    heights = np.zeros(len(places)) if elevation_m is None else elevation_m
    pixels = LENS.raw_from_rays(project(POSE.R, POSE.centre_m, np.column_stack([places, heights])))
    pixels = pixels + np.random.default_rng(seed).normal(scale=noise_px or 1e-300, size=pixels.shape)
    return [
        Correspondence(id=number, ground_m=tuple(place), frame_px=tuple(pixel), enabled=number not in disabled)
        for number, (place, pixel) in enumerate(zip(places + SITE_M, pixels, strict=True), start=1)
    ]


def camera_of(fit: ReferenceFit) -> Floats:
    """The camera's place relative to the site."""
    assert fit.pose is not None
    return fit.pose.centre_m + np.append(fit.origin_m - SITE_M, 0.0)


# --- exact -----------------------------------------------------------------------------------------------------------


def test_exact_clicks_give_the_camera() -> None:
    fit = fit_reference(clicks(), LENS)
    np.testing.assert_allclose(camera_of(fit), POSE.centre_m, atol=1e-6)
    assert fit.pose is not None
    np.testing.assert_allclose(fit.pose.R, POSE.R, atol=1e-8)
    assert fit.rms_px < 1e-6
    assert fit.rms_m < 1e-7
    assert fit.left_out_rms_px is not None
    assert fit.left_out_rms_px < 1e-5
    assert np.abs(fit.origin_m - SITE_M).max() < 25  # near the clicks, whatever the site's numbers


def test_four_clicks_are_enough_but_leave_none_to_check() -> None:
    fit = fit_reference(clicks(PLACES[[0, 3, 6, 9]]), LENS)
    np.testing.assert_allclose(camera_of(fit), POSE.centre_m, atol=1e-5)
    assert fit.left_out_rms_px is None
    assert all(pair.left_out_px is None for pair in fit.pairs)


@pytest.mark.parametrize("off_m", [0.4, 2.0, 8.0])
def test_a_click_that_contradicts_the_others_is_named(off_m: float) -> None:
    pairs = clicks(noise_px=0.7)
    assert fit_reference(pairs, LENS).contradiction is None
    x, y = pairs[5].ground_m
    pairs[5] = pairs[5].model_copy(update={"ground_m": (x + 0.8 * off_m, y - 0.6 * off_m)})
    fit = fit_reference(pairs, LENS)
    assert fit.contradiction is not None
    assert f"id {pairs[5].id} lies {off_m:.0f}." in fit.contradiction or off_m < 1.0
    assert f"id {pairs[5].id} " in fit.contradiction
    assert fit.is_hopeless == (off_m > 5.0)
    pairs[5] = pairs[5].model_copy(update={"enabled": False})
    assert fit_reference(pairs, LENS).contradiction is None


@pytest.mark.parametrize("wrong", range(6))
def test_one_wrong_click_among_few_is_named_although_it_draws_the_fit_to_itself(wrong: int) -> None:
    pairs = clicks(PLACES[[0, 3, 5, 7, 9, 10]], noise_px=0.7)
    assert fit_reference(pairs, LENS).contradiction is None
    x, y = pairs[wrong].ground_m
    pairs[wrong] = pairs[wrong].model_copy(update={"ground_m": (x, y + 3.0)})
    assert f"id {pairs[wrong].id} lies " in (fit_reference(pairs, LENS).contradiction or "")


def test_clicks_by_an_unsteady_hand_contradict_each_other_but_none_is_blamed() -> None:
    steady, unsteady = (fit_reference(clicks(noise_px=noise), LENS) for noise in (5.0, 20.0))
    assert steady.contradiction is None
    assert "miss each other by" in (unsteady.contradiction or "")
    assert not unsteady.is_hopeless


def test_a_left_out_click_lies_as_far_off_as_the_others_scatter() -> None:
    fits = [fit_reference(clicks(noise_px=3.0, seed=seed), LENS) for seed in range(40)]
    ratios = [
        pair.left_out_px / pair.left_out_sigma_px
        for fit in fits
        for pair in fit.pairs
        if pair.left_out_px is not None and pair.left_out_sigma_px is not None
    ]
    # Ten pairs less 6 unknowns leave 14 degrees of freedom, whose scatter widens the mean square by 14 / 12.
    assert np.mean(np.square(ratios)) == pytest.approx(14 / 12, rel=0.15)


def test_relief_below_the_clicks_is_taken_into_account() -> None:
    elevation = 0.3 * np.sin(np.arange(len(PLACES)))
    pairs = clicks(elevation_m=elevation)
    fit = fit_reference(pairs, LENS, elevation_m=elevation)
    np.testing.assert_allclose(camera_of(fit), POSE.centre_m, atol=1e-6)
    assert fit.rms_px < 1e-6
    assert fit_reference(pairs, LENS).rms_px > 0.5
    again = reference_pose(pairs, LENS, origin_m=fit.origin_m, elevation_m=elevation)
    assert fit.pose is not None
    np.testing.assert_allclose(again.centre_m, fit.pose.centre_m, atol=1e-8)


def test_without_a_lens_there_is_a_plane_but_no_camera() -> None:
    ideal = Lens.ideal((1920, 1080), 1230.0)
    pairs = [
        pair.model_copy(update={"frame_px": tuple(ideal.raw_from_rays(LENS.rays_from_raw(np.array(pair.frame_px))))})
        for pair in clicks()
    ]
    fit = fit_reference(pairs, Lens.ideal((1920, 1080), 1920.0), has_lens=False)
    assert fit.pose is None
    assert fit.rms_px < 1e-6
    with pytest.raises(InputError, match=r"lens\.yaml"):
        fit.world_from_plan(PLACES + SITE_M, 12.0)


# --- ways between frame, plan and world ------------------------------------------------------------------------------


@settings(max_examples=30)
@given(st.floats(-20, 20), st.floats(-12, 12), st.floats(0.0, 20.0))
def test_ways_there_and_back(x: float, y: float, height_m: float) -> None:
    fit = fit_reference(clicks(), LENS)
    world = np.array([[x, y]]) + SITE_M
    plan = fit.plan_from_world(world, height_m)
    np.testing.assert_allclose(fit.world_from_plan(plan, height_m), world, atol=1e-7)
    raw = fit.raw_from_plan(plan)
    np.testing.assert_allclose(fit.plan_from_raw(raw), plan, atol=1e-6)
    # What stands that high is seen at that very pixel.
    seen = LENS.raw_from_rays(project(POSE.R, POSE.centre_m, np.array([[x, y, height_m]])))
    np.testing.assert_allclose(raw, seen, atol=1e-4)


def test_roofs_appear_enlarged() -> None:
    fit = fit_reference(clicks(), LENS)
    plan = fit.plan_from_world(np.array([[0.0, 0.0], [1.0, 0.0]]) + SITE_M, 18.0)
    assert np.linalg.norm(plan[1] - plan[0]) == pytest.approx(40 / 22, rel=1e-6)


# --- clicks by hand --------------------------------------------------------------------------------------------------


def test_hand_clicks_scatter_as_much_as_they_say() -> None:
    noise, fits = 1.0, []
    for seed in range(40):
        fits.append(fit_reference(clicks(noise_px=noise, seed=seed), LENS))
    # 22 coordinates less 6 unknowns share the variance; rms_px is that of a pair's length, hence the root of two.
    expected = noise * np.sqrt(2 * (22 - 6) / 22)
    assert np.sqrt(np.mean([fit.rms_px**2 for fit in fits])) == pytest.approx(expected, rel=0.1)
    left_out = [fit.left_out_rms_px for fit in fits if fit.left_out_rms_px is not None]
    assert np.mean(left_out) > noise * np.sqrt(2)
    errors = np.array([camera_of(fit) - POSE.centre_m for fit in fits])
    assert (np.abs(errors.mean(axis=0)) < 4 * errors.std(axis=0) / np.sqrt(40)).all()


def test_one_wrong_click_stands_out_when_left_out() -> None:
    pairs = clicks(noise_px=0.5)
    u, v = pairs[4].frame_px
    pairs[4] = pairs[4].model_copy(update={"frame_px": (u + 30, v)})
    fit = fit_reference(pairs, LENS)
    worst = max(fit.pairs, key=lambda pair: pair.left_out_px or 0.0)
    assert worst.id == 5
    assert worst.left_out_px == pytest.approx(30, abs=4)
    assert worst.left_out_m == pytest.approx(30 * 40 / 1230, rel=0.25)


def test_a_disabled_pair_takes_no_part_but_is_told() -> None:
    pairs = clicks(disabled=(3,))
    u, v = pairs[2].frame_px
    pairs[2] = pairs[2].model_copy(update={"frame_px": (u + 20.0, v - 10.0)})
    fit = fit_reference(pairs, LENS)
    assert fit.rms_px < 1e-6
    off = fit.pairs[2]
    assert not off.enabled
    und = LENS.undistort(np.array([pairs[2].frame_px, (u, v)]))
    np.testing.assert_allclose(off.residual_px, und[0] - und[1], atol=1e-5)
    np.testing.assert_allclose(off.predicted_raw, (u, v), atol=1e-5)
    on_ground = intersect_height(POSE.R, POSE.centre_m, LENS.rays_from_raw(np.array([pairs[2].frame_px])), 0.0)
    np.testing.assert_allclose(np.array(off.predicted_m) - SITE_M, on_ground[0], atol=1e-5)


def test_coverage_counts_the_cells_of_the_frame() -> None:
    corners = clicks(PLACES[[0, 3, 6, 9]])
    assert fit_reference(corners, LENS).coverage == pytest.approx(4 / 16)
    assert fit_reference(clicks(), LENS).coverage > 0.5


# --- hopeless clicks -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        ([], "no correspondence is enabled, at least four"),
        (clicks()[:1], "one correspondence is enabled"),
        (clicks(disabled=range(4, 12)), "3 correspondences are enabled"),
        (clicks(np.column_stack([np.linspace(-20, 20, 8), np.linspace(-5, 5, 8)])), "collinear in ground_m"),
        (
            clicks(np.vstack([np.column_stack([np.linspace(-20, 20, 8), np.linspace(-5, 5, 8)]), [[0.0, 10.0]]])),
            "all correspondences but one are collinear",
        ),
    ],
)
def test_too_little_is_refused_with_a_remedy(pairs: list[Correspondence], words: str) -> None:
    with pytest.raises(InputError, match=words) as refusal:
        fit_reference(pairs, LENS)
    assert "project.json" in str(refusal.value)


def test_a_mistyped_coordinate_is_named_and_not_called_a_line() -> None:
    pairs = clicks()
    pairs[3] = pairs[3].model_copy(update={"ground_m": (1e8, pairs[3].ground_m[1])})
    with pytest.raises(InputError, match=f"correspondence {pairs[3].id} lies so far from all others in ground_m"):
        fit_reference(pairs, LENS)


def test_clicks_all_on_one_line_of_the_frame() -> None:
    pairs = [pair.model_copy(update={"frame_px": (100.0 * pair.id, 500.0)}) for pair in clicks()]
    with pytest.raises(InputError, match="collinear in frame_px"):
        fit_reference(pairs, LENS)


def test_a_click_where_the_lens_model_ends() -> None:
    barrel = Lens(LENS.image_size_px, LENS.camera_matrix, np.array([-0.6, 0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(InputError, match="correspondence 1 lies where the lens model ends"):
        fit_reference(clicks(), barrel)


@pytest.mark.parametrize("wrong", [[[0, 1], [1, 0]], [[-1, 0], [0, 1]], [[1, 0], [0, -1]]])
def test_mirrored_ground_is_refused_although_it_fits(wrong: list[list[int]]) -> None:
    mirrored = clicks(PLACES @ np.array(wrong))
    pixels = [pair.frame_px for pair in clicks()]
    pairs = [pair.model_copy(update={"frame_px": px}) for pair, px in zip(mirrored, pixels, strict=True)]
    with pytest.raises(InputError, match="mirrored pairs, east and north exchanged"):
        fit_reference(pairs, LENS)


def test_turned_ground_is_another_heading() -> None:
    turned = clicks(PLACES @ np.array([[0, 1], [-1, 0]]))
    pixels = [pair.frame_px for pair in clicks()]
    pairs = [pair.model_copy(update={"frame_px": px}) for pair, px in zip(turned, pixels, strict=True)]
    fit = fit_reference(pairs, LENS)
    assert fit.rms_px < 1e-6
    assert camera_of(fit)[2] == pytest.approx(40.0, abs=1e-6)
