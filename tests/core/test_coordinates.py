from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.coordinates import (
    Floats,
    OrthoGrid,
    apply_homography,
    batches,
    evenly_spread,
    finite_rows,
    homography_jacobian,
    invert_2x2,
    invert_homography,
    read_only,
    rotation_2d,
)

# A tilted view: north-east is farther away.
H = np.array([[0.9, 0.1, 12.0], [-0.2, 1.1, -7.0], [1e-3, 2e-3, 1.0]])
POINTS = np.array([[0.0, 0.0], [30.0, -12.0], [-40.0, 55.0]])


def shift(east: float, north: float) -> Floats:
    return np.array([[1.0, 0.0, east], [0.0, 1.0, north], [0.0, 0.0, 1.0]])


def test_a_homography_leads_there_and_back_whatever_its_scale() -> None:
    there = apply_homography(-3.0 * H, POINTS)
    np.testing.assert_allclose(there, apply_homography(H, POINTS))
    np.testing.assert_allclose(apply_homography(invert_homography(H), there), POINTS, atol=1e-9)
    assert invert_homography(H)[2, 2] == 1.0


def test_inner_names_of_a_right_chain_cancel() -> None:
    """`H_c_a = H_c_b @ H_b_a`: the right one is applied first."""
    chained = apply_homography(H @ shift(5.0, 6.0), POINTS)
    np.testing.assert_allclose(chained, apply_homography(H, POINTS + [5.0, 6.0]))


@pytest.mark.filterwarnings("error")
def test_the_horizon_is_no_place() -> None:
    horizon = np.array([[-1000.0, 0.0]])
    assert not np.isfinite(apply_homography(H, horizon)).all()


def test_homographies_keep_the_shape_of_points() -> None:
    assert apply_homography(H, np.zeros((4, 3, 5, 2))).shape == (4, 3, 5, 2)


def test_rotations_turn_counter_clockwise() -> None:
    np.testing.assert_allclose(rotation_2d(np.pi / 2) @ [1.0, 0.0], [0.0, 1.0], atol=1e-15)


def test_only_whole_points_are_finite() -> None:
    points = np.array([[[1.0, 2.0], [np.nan, 2.0]], [[1.0, np.inf], [3.0, 4.0]]])
    assert finite_rows(points).tolist() == [[True, False], [False, True]]


def test_what_is_frozen_is_a_copy() -> None:
    given_m = np.array([1.0, 2.0])
    frozen = read_only(given_m)
    given_m[0] = 9.0
    assert frozen[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        frozen[0] = 9.0


@given(st.integers(0, 500), st.integers(1, 90))
def test_batches_cover_everything_once(count: int, size: int) -> None:
    numbers = np.arange(count)
    parts = [numbers[batch] for batch in batches(count, size)]
    assert np.concatenate(parts).tolist() == numbers.tolist()
    assert max(len(part) for part in parts) <= size
    assert len(parts) == max(1, -(-count // size))


@given(st.integers(1, 500), st.integers(2, 90))
def test_few_of_many_are_spread_from_end_to_end(count: int, most: int) -> None:
    chosen = evenly_spread(count, most)
    assert len(chosen) == min(count, most)
    assert (chosen[0], chosen[-1]) == (0, count - 1)
    steps = np.diff(chosen)
    assert len(steps) == 0 or steps.max() - steps.min() <= 1


def test_an_orthoimage_is_north_up_and_counted_from_pixel_centres() -> None:
    grid = OrthoGrid(west_m=100.0, north_m=250.0, pixel_size_m=0.5, width=40, height=20)
    assert grid.extent_m == (100.0, 240.0, 120.0, 250.0)
    corners = apply_homography(grid.H_world_ortho, [[0.0, 0.0], [39.0, 19.0]])
    np.testing.assert_allclose(corners, [[100.25, 249.75], [119.75, 240.25]])
    np.testing.assert_allclose(grid.H_ortho_world @ grid.H_world_ortho, np.eye(3), atol=1e-12)


def test_small_matrices_are_inverted_all_at_once() -> None:
    matrices = np.random.default_rng(2).normal(size=(5, 40, 2, 2))
    np.testing.assert_allclose(invert_2x2(matrices), np.linalg.inv(matrices), rtol=1e-9)


@settings(max_examples=25)
@given(st.lists(st.floats(-0.2, 0.2), min_size=8, max_size=8))
def test_derivative_of_a_homography(entries: list[float]) -> None:
    bent = np.eye(3) + np.append(entries, 0.0).reshape(3, 3)
    points, step = np.random.default_rng(0).uniform(-0.6, 0.6, (10, 2)), 1e-6
    J = homography_jacobian(bent, points)
    for axis, unit in enumerate(np.eye(2) * step):
        numerical = (apply_homography(bent, points + unit) - apply_homography(bent, points - unit)) / (2 * step)
        np.testing.assert_allclose(J[:, :, axis], numerical, rtol=1e-6, atol=1e-6)
