from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.coordinates import Floats
from core.lens import Lens
from core.measurements import Recording, Reference
from core.row_times import (
    LEAST_READOUT_S,
    SIGNIFICANT,
    at_frame_times,
    differentiated,
    estimated_readout,
    ground_speed,
    row_share,
)

SIZE = (400, 300)
LENS = Lens.ideal(SIZE, 500.0)
READOUT_S = 0.02
RATE_HZ = 30.0
TIME_S = np.arange(60) / RATE_HZ


def rolled(place: Floats, time_s: Floats) -> Floats:
    """Raw pixels (F, N, 2) of points (N, 2) in a picture that sways as a whole, each seen when its row is read."""
    seen = np.repeat(place[None], len(time_s), axis=0)
    for _ in range(20):
        moment = time_s[:, None] + READOUT_S * row_share(seen, LENS)
        seen = place + sway(moment)
    return seen


def sway(time_s: Floats) -> Floats:
    """Raw pixels (..., 2) that the picture has moved by."""
    return np.stack([8.0 * np.sin(3.0 * time_s), 5.0 * np.cos(2.0 * time_s)], axis=-1)


# --- speed -----------------------------------------------------------------------------------------------------------


def test_the_rate_of_a_parabola_is_exact_however_the_frames_are_spaced() -> None:
    time_s = np.array([0.0, 0.1, 0.15, 0.4, 0.41])
    track = np.stack([3.0 * time_s**2 - time_s, 2.0 * time_s], axis=1)
    rate = differentiated(track, time_s)
    np.testing.assert_allclose(rate[1:-1, 0], 6.0 * time_s[1:-1] - 1.0, atol=1e-9)
    np.testing.assert_allclose(rate[:, 1], 2.0, atol=1e-9)


def test_beside_a_gap_the_rate_is_one_sided_and_alone_there_is_none() -> None:
    track = np.array([0.0, 1.0, np.nan, 5.0, np.nan, 8.0, 10.0])
    assert np.isnan(differentiated(np.array([1.0]), np.array([0.0]))).all()
    np.testing.assert_array_equal(differentiated(track, np.arange(7.0)), [1.0, 1.0, np.nan, np.nan, np.nan, 2.0, 2.0])


def test_the_ground_moves_as_the_homographies_say() -> None:
    """A camera that shifts its view by 0.01 rays a frame: 500 px focal length, 30 frames a second."""
    H = np.repeat(np.eye(3)[None], len(TIME_S), axis=0)
    H[:, 0, 2] = 0.01 * np.arange(len(TIME_S))
    H[40] = np.nan
    speed = ground_speed(recording(ground=np.zeros((60, 2, 2)), H=H), LENS)
    assert speed.shape == (60, 2, 2)
    assert np.isnan(speed[40]).all()
    np.testing.assert_allclose(speed[[0, 20, 39, 41, 59]], np.broadcast_to([150.0, 0.0], (5, 2, 2)), atol=1e-6)


# --- rows ------------------------------------------------------------------------------------------------------------


def test_rows_are_read_from_top_to_bottom() -> None:
    rows = np.array([[7.0, 0.0], [7.0, (SIZE[1] - 1) / 2], [7.0, SIZE[1] - 1]])
    np.testing.assert_allclose(row_share(rows, LENS), [-0.5, 0.0, 0.5])


def test_a_rolling_shutter_is_taken_out_of_ground_and_targets() -> None:
    place = np.array([[50.0, 20.0], [200.0, 150.0], [350.0, 280.0]])
    seen = rolled(place, TIME_S)
    assert np.abs(seen - place - sway(TIME_S)[:, None]).max() > 0.15
    moment = TIME_S[:, None] + READOUT_S * row_share(seen, LENS)
    speed = np.stack([24.0 * np.cos(3.0 * moment), -10.0 * np.sin(2.0 * moment)], axis=-1)
    rolling = replace(recording(ground=seen, target=seen), texture_raw={"roof": seen})
    held = at_frame_times(rolling, LENS, READOUT_S, speed)
    true = place + sway(TIME_S)[:, None]
    # The second term of a Taylor series: a 100th of a second squared, half of 72 px/s².
    np.testing.assert_allclose(held.ground_raw, true, atol=0.005)
    for raw in (held.targets_raw["roof"], held.texture_raw["roof"]):
        np.testing.assert_allclose(raw[2:-2], true[2:-2], atol=0.01)


def test_a_target_seen_in_a_few_frames_only_stays_where_it_was_seen() -> None:
    seen = rolled(np.array([[50.0, 20.0], [200.0, 290.0]]), TIME_S)
    seen[3:, 0] = np.nan
    held = at_frame_times(recording(ground=seen, target=seen), LENS, READOUT_S, np.zeros_like(seen)).targets_raw["roof"]
    np.testing.assert_array_equal(held[:, 0], seen[:, 0])
    assert not np.allclose(held[:, 1], seen[:, 1], atol=0.05)


def test_a_global_shutter_needs_nothing() -> None:
    made = recording(ground=np.zeros((60, 2, 2)))
    assert at_frame_times(made, LENS, 0.0, np.zeros((60, 2, 2))) is made


# --- estimation ------------------------------------------------------------------------------------------------------


@pytest.fixture
def change() -> Floats:
    return np.random.default_rng(1).normal(scale=20.0, size=(80, 50, 2))


def test_a_readout_is_told_from_what_the_ground_leaves_over(change: Floats) -> None:
    noise = np.random.default_rng(2).normal(scale=0.1, size=change.shape)
    weight = np.ones(change.shape[:2])
    weight[:, 7] = 0.0
    residual = noise - READOUT_S * change
    residual[:, 7] += 50.0
    residual[3, 4] = np.nan
    found = estimated_readout(residual, change, weight)
    assert found.source == "estimated from the footage"
    assert found.sigma_s is not None
    # By propagation 0.1 / (20 sqrt(2 * 80 * 50)), as many values erring alike as `ALIKE` says.
    assert found.sigma_s == pytest.approx(4.0 * 0.1 / (20.0 * np.sqrt(8000)), rel=0.1)
    assert abs(found.readout_s - READOUT_S) < 3.0 * found.sigma_s


@pytest.mark.parametrize(("readout_s", "noise"), [(0.0, 0.1), (0.5 * LEAST_READOUT_S, 0.001), (READOUT_S, 20.0)])
def test_what_does_not_stand_out_is_left_at_zero(change: Floats, readout_s: float, noise: float) -> None:
    residual = np.random.default_rng(3).normal(scale=noise, size=change.shape) - readout_s * change
    found = estimated_readout(residual, change, np.ones(change.shape[:2]))
    assert found.readout_s == 0.0
    assert found.sigma_s is not None
    assert (
        found.source == f"left at zero: the footage shows none longer than {1e3 * SIGNIFICANT * found.sigma_s:.1f} ms"
    )


def test_a_view_that_does_not_turn_says_nothing(change: Floats) -> None:
    found = estimated_readout(change, np.zeros_like(change), np.ones(change.shape[:2]))
    assert (found.readout_s, found.sigma_s) == (0.0, None)


def recording(ground: Floats, target: Floats | None = None, H: Floats | None = None) -> Recording:
    """A recording (F, ...) that began with what its first frame shows."""
    targets = {} if target is None else {"roof": target}
    made = Recording(
        method="geometric",
        finished=True,
        reference=Reference(ground[0], {name: raw[0] for name, raw in targets.items()}),
        frame=np.arange(len(TIME_S)),
        time_s=TIME_S,
        H_ray_ray0=np.repeat(np.eye(3)[None], len(TIME_S), axis=0),
        ground_raw=ground,
        targets_raw=targets,
    )
    return made if H is None else replace(made, H_ray_ray0=H)
