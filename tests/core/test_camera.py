from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from core.camera import (
    BATCH,
    Pose,
    cross_matrix,
    exponential,
    fit_poses,
    intersect_height,
    jacobians,
    plan_homography,
    pose_from_homography,
    project,
)
from core.coordinates import Floats, apply_homography, invert_homography

DOWN = np.diag([1.0, -1.0, -1.0])
ANGLES = st.floats(-0.5, 0.5)
VECTORS = st.tuples(ANGLES, ANGLES, ANGLES).map(np.array)
CENTRES = st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(20, 120)).map(np.array)


def above(omega: Floats, centre_m: Floats) -> Pose:
    """A camera that looks down but for a turn of up to 50 degrees."""
    return Pose(exponential(omega) @ DOWN, centre_m)


def ground(count: int = 150, seed: int = 0) -> Floats:
    """Places on uneven ground, 48 m by 27 m."""
    return np.random.default_rng(seed).uniform((-24, -13.5, -0.2), (24, 13.5, 0.2), (count, 3))


def flight(frames: int) -> tuple[Floats, Floats]:
    """Poses that sway by 2 degrees and 0.5 m."""
    t = np.arange(frames)[:, None] / 15
    omega = 0.03 * np.sin(t * [0.9, 1.4, 0.5] + [0, 1, 2]) + [0.08, -0.05, 0.1]
    return exponential(omega) @ DOWN, np.array([1.0, -2.0, 42.0]) + 0.5 * np.sin(t * [0.5, 0.7, 0.3])


# --- rotations -------------------------------------------------------------------------------------------------------


@given(st.tuples(*[st.floats(-3, 3)] * 3).map(np.array))
def test_exponential_is_the_rotation_of_its_vector(omega: Floats) -> None:
    R = exponential(omega)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(R, Rotation.from_rotvec(omega).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(exponential(-omega), R.T, atol=1e-14)


@given(VECTORS, st.floats(1e-12, 1e-6))
def test_exponential_of_almost_nothing_is_its_first_order(omega: Floats, size: float) -> None:
    np.testing.assert_allclose(exponential(size * omega), np.eye(3) + cross_matrix(size * omega), atol=size**2)


def test_rotations_of_many_frames_at_once() -> None:
    omega = np.random.default_rng(0).normal(size=(4, 5, 3))
    np.testing.assert_array_equal(exponential(omega)[2, 3], exponential(omega[2, 3]))
    np.testing.assert_allclose(cross_matrix(omega) @ omega[..., None], 0.0, atol=1e-15)


# --- projection ------------------------------------------------------------------------------------------------------


@given(VECTORS, CENTRES, st.floats(-2, 15))
def test_what_is_projected_is_met_again_on_its_plane(omega: Floats, centre_m: Floats, z_m: float) -> None:
    pose = above(omega, centre_m)
    points = np.column_stack([centre_m[:2] + np.random.default_rng(0).uniform(-3, 3, (20, 2)), np.full(20, z_m)])
    rays = project(pose.R, pose.centre_m, points)
    np.testing.assert_allclose(intersect_height(pose.R, pose.centre_m, rays, z_m), points[:, :2], atol=1e-9)


def test_each_ray_may_meet_a_plane_of_its_own() -> None:
    R, centre_m = flight(5)
    points = ground()
    met = intersect_height(R, centre_m, project(R, centre_m, points), points[:, 2])
    np.testing.assert_allclose(met, np.broadcast_to(points[:, :2], met.shape), atol=1e-12)


@given(VECTORS, CENTRES)
def test_ground_plane_is_a_homography(omega: Floats, centre_m: Floats) -> None:
    pose = above(omega, centre_m)
    rays = np.random.default_rng(1).uniform(-0.3, 0.3, (20, 2))
    expected = intersect_height(pose.R, pose.centre_m, rays, 0.0)
    np.testing.assert_allclose(apply_homography(plan_homography(pose), rays), expected, rtol=1e-9, atol=1e-9)


@given(VECTORS, CENTRES, st.floats(0.01, 100), st.sampled_from([1, -1]))
def test_pose_comes_back_from_its_homography_of_any_scale(
    omega: Floats, centre_m: Floats, scale: float, sign: int
) -> None:
    pose = above(omega, centre_m)
    found = pose_from_homography(sign * scale * invert_homography(plan_homography(pose)))
    np.testing.assert_allclose(found.R, pose.R, atol=1e-9)
    np.testing.assert_allclose(found.centre_m, pose.centre_m, rtol=1e-9, atol=1e-7)


@settings(max_examples=20)
@given(VECTORS, CENTRES)
def test_derivatives_are_those_of_the_projection(omega: Floats, centre_m: Floats) -> None:
    R, points, step = exponential(omega)[None] @ DOWN, ground(12), 1e-5
    rays, J = jacobians(R, centre_m[None], points)
    np.testing.assert_allclose(rays, project(R, centre_m[None], points), rtol=1e-13, atol=1e-15)
    for unknown, unit in enumerate(np.eye(6) * step):
        ahead = project(exponential(unit[:3]) @ R, centre_m[None] + unit[3:], points)
        behind = project(exponential(-unit[:3]) @ R, centre_m[None] - unit[3:], points)
        numerical = (ahead - behind) / (2 * step)
        size = np.abs(J[..., unknown]).max()
        np.testing.assert_allclose(J[..., unknown], numerical, rtol=1e-6, atol=1e-6 * size + 1e-10)


# --- poses of many frames --------------------------------------------------------------------------------------------


def test_poses_are_exact_without_noise_in_more_frames_than_a_batch() -> None:
    R, centre_m = flight(BATCH + 7)
    rays = project(R, centre_m, ground())
    fit = fit_poses(rays, np.ones(rays.shape[:2]), ground(), Pose(R[0], centre_m[0]), iterations=12)
    np.testing.assert_allclose(fit.centre_m, centre_m, atol=1e-9)
    np.testing.assert_allclose(fit.R, R, atol=1e-11)
    assert np.abs(fit.residual).max() < 1e-11


def test_errors_are_as_large_as_the_normal_matrix_says() -> None:
    R, centre_m = flight(300)
    noise = 1e-4
    rays = project(R, centre_m, ground()) + np.random.default_rng(2).normal(scale=noise, size=(300, 150, 2))
    fit = fit_poses(rays, np.ones((300, 150)), ground(), Pose(R[0], centre_m[0]))
    np.testing.assert_allclose(fit.sigma, noise, rtol=0.25)  # a median of 300 values is good to 7 % of sigma
    assert np.median(fit.sigma) == pytest.approx(noise, rel=0.02)
    turned = Rotation.from_matrix(fit.R @ np.swapaxes(R, 1, 2)).as_rotvec()
    errors = np.hstack([turned, fit.centre_m - centre_m])
    covariance = noise**2 * np.linalg.inv(fit.normal)
    whitened = np.einsum("fi,fij,fj->f", errors, np.linalg.inv(covariance), errors)
    # Chi-squared with 6 degrees of freedom over 300 frames: 6 +- 0.2. Tukey's weights make the normal matrix about a
    # sixth too small and the estimate 5 % less efficient, which comes to 5.2.
    assert 4.5 < whitened.mean() < 6.6


def test_a_quarter_of_wild_points_does_not_move_the_camera() -> None:
    R, centre_m = flight(40)
    random = np.random.default_rng(3)
    rays = project(R, centre_m, ground()) + random.normal(scale=2e-5, size=(40, 150, 2))
    wild = random.random((40, 150)) < 0.25
    rays[wild] += random.uniform(-0.02, 0.02, (wild.sum(), 2))
    fit = fit_poses(rays, np.ones((40, 150)), ground(), Pose(R[0], centre_m[0]), iterations=15)
    clean = np.where(wild[..., None], np.nan, rays)
    only_good = fit_poses(clean, np.ones((40, 150)), ground(), Pose(R[0], centre_m[0]), iterations=15)
    spread = (only_good.centre_m - centre_m).std(axis=0)
    assert (np.abs(fit.centre_m - centre_m).max(axis=0) < 6 * spread).all()
    far = wild & (np.linalg.norm(rays - project(R, centre_m, ground()), axis=2) > 1e-3)
    assert fit.weight[far].max() == 0.0


def test_unseen_points_and_empty_frames_harm_nobody() -> None:
    R, centre_m = flight(4)
    rays = project(R, centre_m, ground())
    rays[0, ::2] = np.nan
    rays[1] = np.nan
    weight = np.ones((4, 150))
    weight[2] = 0.0
    start = Pose(R[3], centre_m[3])
    fit = fit_poses(rays, weight, ground(), start, iterations=12)
    np.testing.assert_allclose(fit.centre_m[[0, 3]], centre_m[[0, 3]], atol=1e-9)
    for empty in (1, 2):
        np.testing.assert_array_equal(fit.centre_m[empty], start.centre_m)
        assert np.isnan(fit.residual[empty]).all()
        assert not fit.weight[empty].any()
    assert np.isnan(fit.residual[0, ::2]).all()
    assert np.isfinite(fit.normal).all()


def test_held_centres_stay_and_rotations_follow() -> None:
    R, centre_m = flight(6)
    rays = project(R, centre_m, ground())
    weight = np.ones((6, 150))
    start = fit_poses(rays, weight, ground(), Pose(R[0], centre_m[0]))
    moved = centre_m + [0.02, 0.0, 0.0]
    fit = fit_poses(rays, weight, ground(), start, robust=False, fixed_centre_m=moved)
    np.testing.assert_array_equal(fit.centre_m, moved)
    exact = fit_poses(rays, weight, ground(), start, robust=False, fixed_centre_m=centre_m)
    np.testing.assert_allclose(exact.R, R, atol=1e-12)
    # The rotation takes up what it can of a wrong centre: a turn of 2 cm over 42 m, less towards the frame's edges.
    turn = Rotation.from_matrix(fit.R @ np.swapaxes(R, 1, 2)).magnitude()
    np.testing.assert_allclose(turn, 0.02 / 42, rtol=0.2)
