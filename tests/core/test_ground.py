from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import pytest

from core.camera import Pose, exponential, plan_homography
from core.coordinates import Floats, apply_homography, invert_homography
from core.errors import InputError
from core.ground import (
    CameraFinder,
    GroundTracker,
    choose_features,
    choose_features_within,
    fit_homography,
    ground_mask,
)
from core.lens import Lens
from core.patches import HALF_PX, MARGIN_PX
from core.video import Luma
from tests.waves import frame, pixels, waves

SIZE = (480, 320)
LENS = Lens(
    SIZE, np.array([[400.0, 0.0, 236.0], [0.0, 402.0, 163.0], [0.0, 0.0, 1.0]]), np.array([-0.1, 0.05, 0, 0, 0])
)
REGIONS = [[(180.0, 90.0), (320.0, 90.0), (320.0, 230.0), (180.0, 230.0)]]
DOWN = np.diag([1.0, -1.0, -1.0])
REACH = HALF_PX + MARGIN_PX + 1


@lru_cache
def _texture() -> tuple[Floats, Floats]:
    """Plane waves on the ground, 40 m below: k (2, n) per metre, phase (n,); from 5 pixels of the frame upwards."""
    random = np.random.default_rng(4)
    length_m = 0.5 * 16 ** random.uniform(0, 1, 90)
    direction = random.uniform(0, np.pi, 90)
    return 2 * np.pi / length_m * np.stack([np.cos(direction), np.sin(direction)]), random.uniform(0, 2 * np.pi, 90)


def pose(omega: tuple[float, float, float] = (0, 0, 0), moved_m: tuple[float, float, float] = (0, 0, 0)) -> Pose:
    return Pose(exponential(omega) @ DOWN, np.array([0.0, 0.0, 40.0]) + moved_m)


def seen(camera: Pose, *, moving: float = 0.0) -> Luma:
    """The ground through the lens; in the moving region a texture of its own that has moved by some pixels."""
    rays = LENS.rays_from_raw(pixels(SIZE).reshape(-1, 2))
    k, phase = _texture()
    grey = 120 + 5.0 * np.cos(apply_homography(plan_homography(camera), rays) @ k + phase).sum(axis=1)
    grey = grey.reshape(SIZE[::-1])
    inside = (np.abs(pixels(SIZE) - [250.0, 160.0]) < 66).all(axis=2)
    grey[inside] = waves(8)(pixels(SIZE)[inside] - [moving, 0.0])
    return frame(grey)


@lru_cache
def reference() -> Luma:
    return seen(pose())


@lru_cache
def features() -> Floats:
    return choose_features(reference(), REGIONS, 80, LENS)


@lru_cache
def ground_tracker() -> GroundTracker:
    return GroundTracker(reference(), features(), LENS, ground_mask(SIZE[::-1], REGIONS))


def true_homography(camera: Pose) -> Floats:
    return invert_homography(plan_homography(camera)) @ plan_homography(pose())


# --- what is looked for ----------------------------------------------------------------------------------------------


def test_mask_keeps_patches_out_of_what_moves_and_inside_the_frame() -> None:
    mask = ground_mask(SIZE[::-1], REGIONS)
    v, u = np.nonzero(mask)
    assert u.min() >= REACH
    assert u.max() <= SIZE[0] - 1 - REACH
    assert v.min() >= REACH
    assert v.max() <= SIZE[1] - 1 - REACH
    near = (u > 180 - REACH) & (u < 320 + REACH) & (v > 90 - REACH) & (v < 230 + REACH)
    assert not near.any()
    assert mask[160, 180 - REACH - 4]
    assert ground_mask(SIZE[::-1], ()).sum() > mask.sum()


def test_features_are_spread_over_the_ground() -> None:
    mask = ground_mask(SIZE[::-1], REGIONS)
    points = features()
    assert 50 <= len(points) <= 130
    rounded = np.rint(points).astype(int)
    # Moved off whole pixels by up to a half.
    near = [mask[v - 1 : v + 2, u - 1 : u + 2].any() for u, v in rounded]
    assert all(near)
    quarters = {(u > SIZE[0] / 2, v > SIZE[1] / 2) for u, v in points}
    assert len(quarters) == 4
    assert len(np.unique(np.round(points % 1, 2), axis=0)) > 0.9 * len(points)


def test_regions_over_everything_are_refused() -> None:
    everything = [[(0.0, 0.0), (480.0, 0.0), (480.0, 320.0), (0.0, 320.0)]]
    with pytest.raises(InputError, match="moving_regions_px leave only 0 ground features"):
        choose_features(reference(), everything, 80, LENS)


def test_no_feature_lies_beyond_the_end_of_the_lens_model() -> None:
    lens = Lens(SIZE, LENS.camera_matrix, np.array([-0.9, 0, 0, 0, 0]))
    still = reference()
    assert np.isnan(lens.rays_from_raw(features())).any()
    points = choose_features(still, REGIONS, 80, lens)
    assert len(points) > 20
    found = GroundTracker(still, points, lens, ground_mask(still.shape, REGIONS)).find(still, None)
    assert found is not None
    assert found.inliers == len(points)


def test_a_blank_reference_frame_is_refused() -> None:
    with pytest.raises(InputError, match="ground features in the reference frame"):
        choose_features(frame(np.full(SIZE[::-1], 128.0)), REGIONS, 80, LENS)


def test_features_within_a_region() -> None:
    region = np.array(REGIONS[0])
    points = choose_features_within(reference(), region, 40)
    assert len(points) >= 6
    assert (np.abs(points - [250.0, 160.0]) <= 70 - HALF_PX + 1.5).all()
    assert not len(choose_features_within(frame(np.full(SIZE[::-1], 128.0)), region, 40))


# --- homographies ----------------------------------------------------------------------------------------------------


def test_homography_among_strangers() -> None:
    random = np.random.default_rng(1)
    H = true_homography(pose((0.03, -0.02, 0.1), (1.0, -0.5, 0.3)))
    source = random.uniform(-0.5, 0.5, (120, 2))
    target = apply_homography(H, source) + random.normal(scale=2e-4, size=(120, 2))
    wild = random.random(120) < 0.3
    target[wild] += random.uniform(0.02, 0.3, (wild.sum(), 2))
    found, inlier = fit_homography(source, target, tolerance=1 / 400)
    assert found is not None
    assert not inlier[wild].any()
    assert inlier[~wild].mean() > 0.95
    np.testing.assert_allclose(apply_homography(found, source), apply_homography(H, source), atol=1e-3)


@pytest.mark.parametrize(
    "source", [np.zeros((20, 2)), np.column_stack([np.linspace(-0.5, 0.5, 20), np.zeros(20)]), np.eye(3)[:, :2]]
)
def test_no_homography_from_a_spot_a_line_or_three_points(source: Floats) -> None:
    found, inlier = fit_homography(source, source + 0.1, tolerance=1 / 400)
    assert found is None
    assert inlier.tolist() == [False] * len(source)


# --- following -------------------------------------------------------------------------------------------------------


def test_where_features_should_be_and_how_deformed() -> None:
    camera = pose((0.02, 0.03, 0.1), (0.6, -0.4, -0.5))
    H = true_homography(camera)
    found = ground_tracker().predict(H)
    predicted, ref_from_current = found.raw, found.ref_from_current
    expected = LENS.raw_from_rays(apply_homography(H, LENS.rays_from_raw(features())))
    np.testing.assert_allclose(predicted, expected, atol=1e-9)
    # A step in the frame is a step in the reference frame: the inverse way, numerically.
    for step in (np.array([0.01, 0.0]), np.array([0.0, 0.01])):
        back = apply_homography(invert_homography(H), LENS.rays_from_raw(predicted + step))
        moved = LENS.raw_from_rays(back) - features()
        np.testing.assert_allclose(np.einsum("nij,j->ni", ref_from_current, step), moved, atol=1e-5)
    # A feature found a pixel beside is seen along the ray that the lens gives, to a thousandth of a pixel.
    beside = predicted + [0.8, -0.6]
    np.testing.assert_allclose(found.rays_seen(beside), LENS.rays_from_raw(beside), atol=1e-3 / 400)


@pytest.mark.parametrize("known", [True, False])
def test_camera_is_followed_with_and_without_a_prediction(known: bool) -> None:
    camera = pose((0.02, -0.015, 0.06), (0.8, 0.5, 0.4))
    H = true_homography(camera)
    nearly = true_homography(pose((0.021, -0.0145, 0.061), (0.8, 0.5, 0.4)))
    found = ground_tracker().find(seen(camera, moving=25.0), nearly if known else None)
    assert found is not None
    expected = LENS.raw_from_rays(apply_homography(H, LENS.rays_from_raw(features())))
    error = np.linalg.norm(found.matches.raw - expected, axis=1)[found.matches.score > 0.9]
    assert len(error) > 0.7 * len(features())
    assert np.median(error) < 0.02
    corners = LENS.rays_from_raw(np.array([[20.0, 20.0], [460.0, 20.0], [460.0, 300.0], [20.0, 300.0]]))
    moved = (apply_homography(found.H_ray_ray0, corners) - apply_homography(H, corners)) * 400
    assert np.abs(moved).max() < 0.2
    assert found.inliers > 0.7 * len(features())


def test_a_wrong_prediction_is_overcome() -> None:
    camera = pose((0.0, 0.0, 0.05), (0.3, 0.0, 0.0))
    wrong = true_homography(pose((0.15, 0.1, -0.2), (4.0, 0.0, 0.0)))
    found = ground_tracker().find(seen(camera), wrong)
    assert found is not None
    centre = apply_homography(found.H_ray_ray0, np.zeros((1, 2)))
    np.testing.assert_allclose(centre, apply_homography(true_homography(camera), np.zeros((1, 2))), atol=1e-3)


@pytest.mark.parametrize("kick_px", [(1, 1), (2, 1), (3, -2), (-4, 3), (5, 5), (9, -6), (30, 20)])
def test_a_kick_of_the_camera_leaves_no_patch_on_the_way(kick_px: tuple[int, int]) -> None:
    # Fine texture, as of gravel, has many places that look alike a few pixels on.
    gravel = np.random.default_rng(6).normal(size=SIZE[::-1])
    still = frame(120 + 40 * cv2.GaussianBlur(gravel, (0, 0), 0.9) / 0.31)
    lens = Lens.ideal(SIZE, 400.0)
    points = choose_features(still, REGIONS, 80, LENS)
    tracker = GroundTracker(still, points, lens, ground_mask(SIZE[::-1], REGIONS))
    match = tracker.find(np.roll(still, kick_px[::-1], axis=(0, 1)), np.eye(3))
    assert match is not None
    off_px = np.linalg.norm(match.matches.raw - points - kick_px, axis=1)
    assert np.nanmax(off_px) < 0.1
    assert match.inliers > 0.8 * len(points)


def test_noise_is_no_obstacle_on_the_way_ahead() -> None:
    noise = np.random.default_rng(3)

    def noisy(camera: Pose) -> Luma:
        return frame(120 + 0.2 * (seen(camera) - 120.0) + noise.normal(scale=14.0, size=SIZE[::-1]))

    tracker = GroundTracker(noisy(pose()), features(), LENS, ground_mask(SIZE[::-1], REGIONS))
    cameras = [pose((0.0, 0.0, 0.002 * n), (0.02 * n, 0.0, 0.0)) for n in range(1, 16)]
    gone = frame(waves(77)(pixels(SIZE)))
    views = list(tracker.look_ahead([noisy(camera) for camera in cameras] + [gone, noisy(cameras[0])]))
    # As far as it is followed, and no further.
    assert len(views) == len(cameras)
    assert 0.2 < views[-1].score < 0.6
    assert tracker.find(views[-1].luma, views[-1].H_ray_ray0) is None
    corners = LENS.rays_from_raw(np.array([[20.0, 20.0], [460.0, 20.0], [460.0, 300.0], [20.0, 300.0]]))
    moved = apply_homography(views[-1].H_ray_ray0, corners) - apply_homography(true_homography(cameras[-1]), corners)
    assert np.abs(moved * 400).max() < 2.0
    tracker.patches.denoise([tracker.views(view) for view in views[:-1]])
    found = tracker.find(views[-1].luma, views[-2].H_ray_ray0)
    assert found is not None
    assert found.inliers > 0.7 * len(features())


@pytest.mark.parametrize("grey", [np.full(SIZE[::-1], 128.0), waves(77)(pixels(SIZE))])
def test_another_place_is_not_recognised(grey: Floats) -> None:
    assert ground_tracker().find(frame(grey), None) is None
    assert ground_tracker().find(frame(grey), np.eye(3)) is None


def test_the_roof_has_no_vote() -> None:
    finder = CameraFinder(reference(), LENS, ground_mask(SIZE[::-1], REGIONS))
    found = finder.search(seen(pose(), moving=20.0))
    assert found is not None
    points = np.array([[-0.4, -0.3], [0.4, 0.3], [0.0, 0.0]])
    assert np.abs(apply_homography(found, points) - points).max() * 400 < 2.0
