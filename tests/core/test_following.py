from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from core.apparent import Apparent
from core.coordinates import Floats
from core.errors import InputError
from core.following import LinesFollower, PointsFollower, Scale
from core.ground import Regions, View
from core.lens import Lens
from core.patches import HALF_PX, SETTLED_PX
from core.video import Luma
from tests.waves import frame, pixels, waves

SIZE = (480, 360)
FOCAL_PX = 500.0
PX_PER_M = 25.0
LENS = Lens.ideal(SIZE, FOCAL_PX)
# L1 and L2 are the upper two of three equal strips, 1.2 m apart; T1 crosses them.
ROWS, COLUMN = (150.0, 180.0, 210.0), 250.0
BANDS = np.array([[[150, ROWS[0]], [350, ROWS[0]]], [[150, ROWS[1]], [350, ROWS[1]]], [[COLUMN, 100], [COLUMN, 260]]])
NEIGHBOUR = Apparent(np.array([0.0, (ROWS[1] - ROWS[0]) / FOCAL_PX]), 0.0)


@lru_cache
def roof() -> Luma:
    """Strips on a roof with some texture, which alone tells one strip from the next."""
    place = pixels(SIZE)
    across = np.minimum.reduce([np.abs(place[..., 1] - row) for row in ROWS] + [np.abs(place[..., 0] - COLUMN)])
    return frame(0.5 * waves(6)(place) + 110.0 / (1.0 + np.exp((across - 3.0) / 0.5)))


def follower(moving_regions_px: Regions = ()) -> LinesFollower:
    ends = LENS.rays_from_raw(BANDS.astype(float))
    scale = Scale(rays_per_m=PX_PER_M / FOCAL_PX, pixels_per_m=PX_PER_M)
    names = ["L1", "L2", "T1"]
    return LinesFollower(
        roof(), ends, LENS, widths_px=[14.0] * 3, scale=scale, names=names, moving_regions_px=moving_regions_px
    )


def test_bands_that_hold_nothing_but_noise_are_refused() -> None:
    noise = frame(np.random.default_rng(1).uniform(0, 255, SIZE[::-1]))
    ends = LENS.rays_from_raw(BANDS.astype(float))
    scale = Scale(rays_per_m=PX_PER_M / FOCAL_PX, pixels_per_m=PX_PER_M)
    with pytest.raises(InputError, match=r"^L1 shows a line with two edges in only \d+ of 64 places"):
        LinesFollower(noise, ends, LENS, widths_px=[14.0] * 3, scale=scale, names=["L1", "L2", "T1"])


def shift_px(apparent: Apparent | None) -> Floats:
    assert apparent is not None
    return apparent.shift * FOCAL_PX


def test_a_neighbouring_strip_is_taken_until_the_whole_picture_is_looked_at() -> None:
    unaware = follower().find(roof(), np.eye(3), NEIGHBOUR, confirm=False)
    np.testing.assert_allclose(shift_px(unaware.apparent), [0.0, 30.0], atol=0.5)
    confirmed = follower().find(roof(), np.eye(3), NEIGHBOUR, confirm=True)
    np.testing.assert_allclose(shift_px(confirmed.apparent), [0.0, 0.0], atol=0.5)


@pytest.mark.parametrize("step_m", [0.0, 0.5])
def test_a_prediction_from_no_step_or_too_long_a_one_is_made_sure_of(step_m: float) -> None:
    predicted = replace(NEIGHBOUR, step=step_m * PX_PER_M / FOCAL_PX)
    found = follower().find(roof(), np.eye(3), predicted, confirm=False)
    np.testing.assert_allclose(shift_px(found.apparent), [0.0, 0.0], atol=0.5)
    usual = replace(NEIGHBOUR, step=0.01 * PX_PER_M / FOCAL_PX)
    unaware = follower().find(roof(), np.eye(3), usual, confirm=False)
    np.testing.assert_allclose(shift_px(unaware.apparent), [0.0, 30.0], atol=0.5)


def test_a_mistaken_picture_does_not_cost_lines_that_are_seen_well(monkeypatch: pytest.MonkeyPatch) -> None:
    mistaken = follower()
    monkeypatch.setattr(mistaken._finder, "_likest", lambda *where: np.array([35.0, 4.0]) / FOCAL_PX)
    seen = mistaken.find(roof(), np.eye(3), Apparent.none(), confirm=False)
    kept = mistaken.find(roof(), np.eye(3), Apparent.none(), confirm=True)
    np.testing.assert_array_equal(kept.raw, seen.raw)
    np.testing.assert_allclose(shift_px(kept.apparent), [0.0, 0.0], atol=0.5)


def test_without_a_prediction_the_whole_picture_says_where_the_lines_are() -> None:
    moved = np.roll(roof(), (12, -20), axis=(0, 1))
    found = follower().find(moved, np.eye(3), None, confirm=False)
    np.testing.assert_allclose(shift_px(found.apparent), [-20.0, 12.0], atol=0.5)


def test_noisy_points_are_compared_with_a_mean_of_views() -> None:
    texture, noise = waves(9, shortest_px=6.0, contrast=6.0), np.random.default_rng(4)

    def seen(shift: tuple[float, float]) -> Luma:
        return frame(texture(pixels(SIZE) - np.array(shift)) + noise.normal(scale=8.0, size=SIZE[::-1]))

    region = LENS.rays_from_raw(np.array([[120.0, 90.0], [360.0, 90.0], [360.0, 270.0], [120.0, 270.0]]))
    scale = Scale(rays_per_m=PX_PER_M / FOCAL_PX, pixels_per_m=PX_PER_M)
    points = PointsFollower(seen((0.0, 0.0)), region, LENS, scale=scale, name="targets.roof")
    unaware = points.find(seen((3.4, -2.2)), np.eye(3), Apparent(np.array([3.0, -2.0]) / FOCAL_PX, 0.0), confirm=False)
    assert unaware.apparent is None
    shifts = np.random.default_rng(5).uniform(-6.0, 6.0, (16, 2))
    points.texture.patches.denoise([points.views(View(seen(tuple(shift)), np.eye(3), 0.4)) for shift in shifts])
    found = points.find(seen((3.4, -2.2)), np.eye(3), Apparent(np.array([3.0, -2.0]) / FOCAL_PX, 0.0), confirm=False)
    np.testing.assert_allclose(shift_px(found.apparent), [3.4, -2.2], atol=0.1)
    assert np.isfinite(found.raw).all(axis=1).mean() > 0.8


def test_a_region_without_texture_is_refused() -> None:
    region = LENS.rays_from_raw(np.array([[120.0, 90.0], [360.0, 90.0], [360.0, 270.0], [120.0, 270.0]]))
    scale = Scale(rays_per_m=PX_PER_M / FOCAL_PX, pixels_per_m=PX_PER_M)
    with pytest.raises(InputError, match=r"targets\.roof\.region_m shows too little texture"):
        PointsFollower(frame(np.full(SIZE[::-1], 128.0)), region, LENS, scale=scale, name="targets.roof")


def test_what_lies_about_lines_is_found_where_they_are() -> None:
    lines = follower()
    within = lines.reference_texture_raw
    assert len(within) >= 12
    low, high = BANDS.min(axis=(0, 1)), BANDS.max(axis=(0, 1))
    assert ((within < low) | (within > high)).any(), "the roof goes on beyond the lines"
    reach = 0.25 * (high - low)
    assert ((within >= low - reach) & (within <= high + reach)).all()
    moved = np.roll(roof(), (3, -2), axis=(0, 1))
    found = lines.find(moved, np.eye(3), Apparent(np.array([-1.0, 2.0]) / FOCAL_PX, 0.0), confirm=False)
    np.testing.assert_allclose(found.texture_raw - within, np.broadcast_to([-2.0, 3.0], within.shape), atol=SETTLED_PX)


def test_what_lies_beyond_what_moves_is_not_followed() -> None:
    low, high = (190.0, 110.0), (360.0, 280.0)
    within = follower([[low, (high[0], low[1]), high, (low[0], high[1])]]).reference_texture_raw
    assert len(within) >= 12
    inner = HALF_PX - 0.5
    assert ((within >= np.array(low) + inner) & (within <= np.array(high) - inner)).all()


def test_without_lines_nothing_is_looked_for_about_them() -> None:
    plain = frame(np.full(SIZE[::-1], 110.0))
    found = follower().find(plain, np.eye(3), Apparent.none(), confirm=False)
    assert found.apparent is None
    assert np.isnan(found.texture_raw).all()


def test_where_what_moves_leaves_little_room_nothing_is_followed_about_lines() -> None:
    lines = follower([[(235.0, 150.0), (265.0, 150.0), (265.0, 180.0), (235.0, 180.0)]])
    assert lines.reference_texture_raw.shape == (0, 2)
    found = lines.find(np.roll(roof(), 2, axis=0), np.eye(3), Apparent.none(), confirm=False)
    np.testing.assert_allclose(shift_px(found.apparent), [0.0, 2.0], atol=0.2)
    assert found.texture_raw.shape == (0, 2)


def test_lines_partly_hidden_or_mistaken_still_say_where_to_look_next() -> None:
    covered = np.roll(roof(), (3, -2), axis=(0, 1)).copy()
    covered[140:165, 170:205] = 90
    found = follower().find(covered, np.eye(3), Apparent.none(), confirm=False)
    assert np.isnan(found.raw[0]).any()
    np.testing.assert_allclose(shift_px(found.apparent), [-2.0, 3.0], atol=0.3)
    without = roof().copy()
    without[:, 225:275] = roof()[:, 285:335]  # nothing of T1: what happens along L1 and L2 is not known
    assert follower().find(without, np.eye(3), Apparent.none(), confirm=False).apparent is None
