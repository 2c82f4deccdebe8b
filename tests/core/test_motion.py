from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.coordinates import Floats, rotation_2d
from core.motion import (
    LineSet,
    RigidFit,
    combined_fit,
    fit_line,
    is_determined,
    is_determined_as_whole,
    rigid_from_lines,
    rigid_from_points,
)

CENTRE = np.array([3.0, -2.0])
STATIONS = 40
# L1 and L2 nearly along x, 1.2 m apart, T1 across them and not quite at right angles.
ENDS = np.array([[[0.0, -1.4], [6.0, -1.2]], [[0.0, -2.6], [6.0, -2.4]], [[3.2, -4.0], [3.5, 0.0]]])
SHIFTS = st.tuples(st.floats(-1, 1), st.floats(-1, 1)).map(np.array)


def stations() -> Floats:
    """(3, STATIONS, 2) points along the lines."""
    along = np.linspace(0, 1, STATIONS)[None, :, None]
    return ENDS[:, None, 0] + along * (ENDS[:, None, 1] - ENDS[:, None, 0])


def lines() -> LineSet:
    fits = [fit_line(points, np.ones(STATIONS), CENTRE) for points in stations()]
    return LineSet(np.array([normal for normal, _ in fits]), np.array([offset for _, offset in fits]), CENTRE)


def moved(points: Floats, shift: Floats, angle: float) -> Floats:
    return (points - CENTRE) @ rotation_2d(angle).T + CENTRE + shift


# --- one line --------------------------------------------------------------------------------------------------------


@given(st.floats(-np.pi, np.pi), st.floats(-5, 5))
def test_line_of_any_direction(direction: float, distance: float) -> None:
    along = np.array([np.cos(direction), np.sin(direction)])
    across = np.array([-along[1], along[0]])
    points = CENTRE + distance * across + np.linspace(-3, 3, 20)[:, None] * along
    normal, offset = fit_line(points, np.ones(20), CENTRE)
    np.testing.assert_allclose((points - CENTRE) @ normal, offset, atol=1e-12)
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    assert abs(normal @ across) == pytest.approx(1.0)
    assert normal[np.argmax(np.abs(normal))] > 0


def test_line_through_noise_gaps_and_strangers() -> None:
    random = np.random.default_rng(0)
    noise, count = 2e-3, 400
    x = np.linspace(-4, 4, count)
    errors = []
    for _ in range(60):
        points = CENTRE + np.column_stack([x, 0.1 * x + 0.3 + random.normal(scale=noise, size=count)])
        points[::5] += [0.0, 0.08]
        points[3::17] = np.nan
        weight = np.ones(count)
        points[7::19] -= [0.0, 3.0]
        weight[7::19] = 0.0
        normal, offset = fit_line(points, weight, CENTRE)
        errors.append((offset / normal[1] - 0.3, -normal[0] / normal[1] - 0.1))
    # About 280 good points: an intercept is good to noise / sqrt(280), a slope to that over the rms of x.
    expected = noise / np.sqrt(280) * np.array([1.0, 1 / x.std()])
    spread = np.std(errors, axis=0)
    assert (spread < 1.4 * expected).all()
    assert (np.abs(np.mean(errors, axis=0)) < 4 * expected / np.sqrt(60)).all()


def test_lines_meet_where_their_strips_cross() -> None:
    for first, second in ((0, 2), (1, 2)):
        (a, b), (c, d) = ENDS[first], ENDS[second]
        t, _ = np.linalg.solve(np.column_stack([b - a, c - d]), c - a)
        np.testing.assert_allclose(lines().intersection(first, second), a + t * (b - a), atol=1e-12)


# --- lines to motion -------------------------------------------------------------------------------------------------


@settings(max_examples=30)
@given(SHIFTS, st.floats(-0.1, 0.1))
def test_lines_give_shift_and_rotation_exactly(shift: Floats, angle: float) -> None:
    measured = moved(stations(), shift, angle)[None]
    fit = rigid_from_lines(measured, np.ones(measured.shape[:3]), lines())
    np.testing.assert_allclose(fit.shift[0], shift, atol=1e-9)
    assert fit.rotation_rad[0] == pytest.approx(angle, abs=1e-9)
    assert is_determined(fit.normal).all()
    # Any point of the body follows; P1 as much as the pivot.
    p1 = lines().intersection(0, 2)
    np.testing.assert_allclose(fit.at(p1, CENTRE)[0], moved(p1, shift, angle) - p1, atol=1e-9)
    np.testing.assert_allclose(fit.at(CENTRE, CENTRE)[0], shift, atol=1e-9)


def test_stations_may_slide_along_their_lines() -> None:
    slid = ENDS[:, None, 0] + np.linspace(0.3, 0.8, STATIONS)[None, :, None] * (ENDS[:, None, 1] - ENDS[:, None, 0])
    fit = rigid_from_lines(moved(slid, np.array([0.4, 0.1]), 0.01)[None], np.ones((1, 3, STATIONS)), lines())
    np.testing.assert_allclose(fit.shift[0], [0.4, 0.1], atol=1e-9)
    assert fit.rotation_rad[0] == pytest.approx(0.01, abs=1e-10)


def test_errors_of_lines_are_as_large_as_the_normal_matrix_says() -> None:
    random, noise, frames = np.random.default_rng(1), 1e-3, 400
    measured = stations() + random.normal(scale=noise, size=(frames, 3, STATIONS, 2))
    fit = rigid_from_lines(measured, np.ones((frames, 3, STATIONS)), lines())
    errors = np.column_stack([fit.shift, fit.rotation_rad])
    whitened = np.einsum("fi,fij,fj->f", errors, fit.normal, errors)
    # Chi-squared with 3 degrees of freedom over 400 frames: 3 +- 0.12, but for the weights (see the poses).
    assert 2.3 < whitened.mean() < 3.6
    np.testing.assert_allclose(np.median(fit.sigma, axis=0), noise, rtol=0.1)


def test_a_fifth_of_wild_stations_is_passed_over() -> None:
    random = np.random.default_rng(2)
    frames, noise = 60, 1e-3
    good = moved(stations(), np.array([0.2, -0.1]), 4e-3) + random.normal(scale=noise, size=(frames, 3, STATIONS, 2))
    wild = random.random((frames, 3, STATIONS)) < 0.2
    measured = good.copy()
    measured[wild] += random.choice([-1, 1], (wild.sum(), 1)) * random.uniform(0.05, 0.3, (wild.sum(), 1)) * [0.7, 0.7]
    fit = rigid_from_lines(measured, np.ones((frames, 3, STATIONS)), lines())
    clean = rigid_from_lines(np.where(wild[..., None], np.nan, good), np.ones((frames, 3, STATIONS)), lines())
    np.testing.assert_allclose(fit.shift, clean.shift, atol=6 * noise / np.sqrt(STATIONS))
    np.testing.assert_allclose(fit.rotation_rad, clean.rotation_rad, atol=6 * noise / np.sqrt(STATIONS) / 2)
    assert fit.weight[wild].max() < 0.2


def test_two_parallel_lines_do_not_determine_motion_along_them() -> None:
    measured = np.repeat(stations()[None], 4, axis=0)
    measured[1, 2] = np.nan  # T1 hidden
    measured[2, :2] = np.nan  # L1 and L2 hidden
    measured[3] = np.nan
    fit = rigid_from_lines(measured, np.ones((4, 3, STATIONS)), lines())
    assert is_determined(fit.normal).tolist() == [True, False, False, False]
    assert np.isfinite(fit.shift).all()
    assert np.isnan(fit.residual[3]).all()


def test_one_of_the_parallel_lines_may_be_hidden() -> None:
    measured = moved(stations(), np.array([0.3, 0.05]), 2e-3)[None].copy()
    measured[0, 0] = np.nan
    fit = rigid_from_lines(measured, np.ones((1, 3, STATIONS)), lines())
    assert is_determined(fit.normal).all()
    np.testing.assert_allclose(fit.shift[0], [0.3, 0.05], atol=1e-9)


def test_lasting_departures_are_taken_off() -> None:
    bend = 0.01 * np.sin(np.linspace(0, 3, STATIONS)) * np.array([[1.0], [-0.5], [0.7]])
    shift, angle = np.array([0.1, 0.2]), 5e-3
    bent = stations() + bend[..., None] * lines().normal[:, None, :]
    measured = moved(bent, shift, angle)[None]
    straight = rigid_from_lines(measured, np.ones((1, 3, STATIONS)), lines())
    taken_off = rigid_from_lines(measured, np.ones((1, 3, STATIONS)), lines(), pattern=bend)
    assert np.abs(straight.shift[0] - shift).max() > 1e-3
    np.testing.assert_allclose(taken_off.shift[0], shift, atol=1e-9)
    assert taken_off.rotation_rad[0] == pytest.approx(angle, abs=1e-9)


# --- points to motion ------------------------------------------------------------------------------------------------


def textured(count: int = 80) -> Floats:
    return CENTRE + np.random.default_rng(3).uniform((-3, -2), (3, 2), (count, 2))


@settings(max_examples=30)
@given(SHIFTS, st.floats(-0.1, 0.1))
def test_points_give_shift_and_rotation_exactly(shift: Floats, angle: float) -> None:
    fit = rigid_from_points(moved(textured(), shift, angle)[None], np.ones((1, 80)), textured(), CENTRE)
    np.testing.assert_allclose(fit.shift[0], shift, atol=1e-9)
    assert fit.rotation_rad[0] == pytest.approx(angle, abs=1e-9)


def test_errors_of_points_are_as_large_as_the_normal_matrix_says() -> None:
    frames, noise = 400, 1e-3
    measured = textured() + np.random.default_rng(4).normal(scale=noise, size=(frames, 80, 2))
    measured[:, ::7] = np.nan
    fit = rigid_from_points(measured, np.ones((frames, 80)), textured(), CENTRE)
    errors = np.column_stack([fit.shift, fit.rotation_rad])
    whitened = np.einsum("fi,fij,fj->f", errors, fit.normal, errors)
    # As for lines; the squared median scale of 68 distances scatters by 16 % and lifts the mean by a tenth.
    assert 2.3 < whitened.mean() < 3.8
    assert np.median(fit.sigma) == pytest.approx(noise, rel=0.05)


def test_wild_points_are_passed_over_and_none_is_no_motion() -> None:
    random = np.random.default_rng(5)
    measured = np.repeat(moved(textured(), np.array([0.3, -0.2]), 5e-3)[None], 3, axis=0)
    measured += random.normal(scale=1e-3, size=measured.shape)
    measured[0, ::3] += random.uniform(-0.5, 0.5, (27, 2))
    measured[1] = np.nan
    measured[2, 1:] = np.nan
    fit = rigid_from_points(measured, np.ones((3, 80)), textured(), CENTRE)
    np.testing.assert_allclose(fit.shift[0], [0.3, -0.2], atol=6e-3 / np.sqrt(50))
    assert is_determined(fit.normal).tolist() == [True, False, False]
    assert np.isfinite(fit.shift).all()


def test_a_glimpse_of_a_line_determines_nothing() -> None:
    points = np.stack([stations()] * 6)
    points[3, 2, 2:] = np.nan  # of T1 two places are left
    points[4, 0] = np.nan  # L2 does for L1
    points[5, 2, STATIONS // 2 :] = np.nan
    normal = rigid_from_lines(points, np.ones(points.shape[:3]), lines()).normal
    assert is_determined(normal)[3]
    np.testing.assert_array_equal(is_determined_as_whole(normal, normal[0]), [True, True, True, False, True, True])


# --- two fits --------------------------------------------------------------------------------------------------------


def fit_of(x: float, y: float, rotation_rad: float, information: tuple[float, float, float]) -> RigidFit:
    return RigidFit(
        shift=np.array([[x, y]]),
        rotation_rad=np.array([rotation_rad]),
        residual=np.zeros((1, 3, 4)),
        weight=np.ones((1, 3, 4)),
        normal=np.diag(information)[None],
        sigma=np.ones((1, 3)),
    )


def test_two_fits_are_weighed_by_what_they_know() -> None:
    one, other = fit_of(0.0, 0.0, 0.0, (1.0, 4.0, 8.0)), fit_of(3.0, 3.0, 0.3, (2.0, 2.0, 4.0))
    both = combined_fit(one, other, np.array([1.0]))
    np.testing.assert_allclose(both.shift, [[2.0, 1.0]])
    np.testing.assert_allclose(both.rotation_rad, [0.1])
    np.testing.assert_allclose(both.normal, np.diag([3.0, 6.0, 12.0])[None])
    np.testing.assert_allclose(combined_fit(one, other, np.array([0.5])).shift, [[1.5, 0.6]])
    np.testing.assert_array_equal(combined_fit(one, other, np.array([0.0])).shift, one.shift)


def test_what_one_fit_does_not_know_the_other_tells() -> None:
    blind = fit_of(7.0, 1.0, 0.0, (0.0, 4.0, 8.0))
    both = combined_fit(blind, fit_of(3.0, 1.0, 0.0, (2.0, 2.0, 4.0)), np.array([1.0]))
    np.testing.assert_allclose(both.shift, [[3.0, 1.0]], atol=1e-6)


def test_a_body_carries_its_points_along() -> None:
    fit = fit_of(0.3, -0.2, 0.1, (1.0, 1.0, 1.0))
    points = np.array([[1.0, 2.0], [-4.0, 0.5]])
    np.testing.assert_allclose(fit.carried(points, CENTRE)[0], moved(points, np.array([0.3, -0.2]), 0.1))
    np.testing.assert_allclose(fit.at(points[1], CENTRE), fit.carried(points, CENTRE)[:, 1] - points[1])
