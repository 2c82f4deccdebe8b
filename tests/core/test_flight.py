from __future__ import annotations

import numpy as np
import pytest

from core.coordinates import Floats
from core.flight import LEAST_FRAMES, SmoothFlight, estimate_flight, smooth_flight

RATE_HZ = 30.0
TIME_S = np.arange(900) / RATE_HZ


def pushed(jerk: float, seed: int, count: int = 900) -> Floats:
    """A body pushed by white jerk of a root spectral density, m s^-2.5, integrated in small steps from rest."""
    fine = 8
    random = np.random.default_rng(seed)
    step_s = 1 / (RATE_HZ * fine)
    path = random.normal(scale=jerk / np.sqrt(step_s), size=count * fine)
    for _ in range(3):
        path = np.cumsum(path) * step_s
    return path[::fine]


def noisy(path: Floats, noise_m: float, seed: int = 1) -> Floats:
    return path + np.random.default_rng(seed).normal(scale=noise_m, size=path.shape)


def smoothed(value: Floats, time_s: Floats = TIME_S, sigma: Floats | None = None) -> SmoothFlight:
    columns = value if value.ndim == 2 else value[:, None]
    sizes = np.ones_like(columns) if sigma is None else sigma
    flight = smooth_flight(time_s, columns, sizes)
    assert flight is not None
    return flight


# --- what the record tells of itself ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("jerk", "noise_m"), [(0.02, 1e-3), (0.02, 1e-4), (0.3, 2e-3), (0.001, 5e-3)])
def test_noise_and_push_are_told_apart(jerk: float, noise_m: float) -> None:
    models = [estimate_flight(TIME_S, noisy(pushed(jerk, seed), noise_m, seed + 50)) for seed in range(4)]
    # 450 bins of a periodogram tell a density to 5 % and its root to 2.5 %; that the noise could be coloured widens it.
    assert np.median([model.noise_m for model in models]) == pytest.approx(noise_m, rel=0.25)


def test_how_steeply_a_path_falls_is_told() -> None:
    calm = estimate_flight(TIME_S, noisy(0.1 * np.sin(0.7 * TIME_S) + 0.05 * np.cos(0.3 * TIME_S), 1e-3))
    # A velocity that wanders at random: the second derivative is white.
    wandering = 1e-4 * np.cumsum(np.cumsum(np.random.default_rng(3).normal(size=900)))
    assert estimate_flight(TIME_S, noisy(wandering, 1e-4)).order == 2
    assert calm.order > 2


def test_noise_alike_in_neighbouring_frames_counts_by_what_it_does_to_slow_motion() -> None:
    random, memory = np.random.default_rng(3), 0.6
    noise = np.zeros(2400)
    for frame in range(1, 2400):
        noise[frame] = memory * noise[frame - 1] + 1e-3 * random.normal()
    time_s = np.arange(2400) / RATE_HZ
    model = estimate_flight(time_s, 0.2 * np.sin(0.4 * time_s) + noise)
    assert model.fastest_hz < 1.0
    # An autoregression sums up to its innovations over one less its memory.
    assert model.noise_m == pytest.approx(1e-3 / (1 - memory), rel=0.25)


def test_one_wild_pose_does_not_decide() -> None:
    value = noisy(pushed(0.02, 4), 1e-3)
    wild = value.copy()
    wild[300] += 5.0
    assert estimate_flight(TIME_S, wild).noise_m == pytest.approx(estimate_flight(TIME_S, value).noise_m, rel=0.15)


# --- the smoothed path -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("jerk", "noise_m"), [(0.02, 2e-3), (0.002, 2e-3), (0.3, 1e-3)])
def test_smoothing_takes_out_noise_and_knows_how_much_is_left(jerk: float, noise_m: float) -> None:
    ratios, gains = [], []
    for seed in range(4):
        path = pushed(jerk, seed)
        flight = smoothed(noisy(path, noise_m, seed + 50))
        error = flight.value_m[:, 0] - path
        gains.append(np.sqrt(np.mean(error**2)) / noise_m)
        ratios.append(np.mean((error / flight.sigma_m[:, 0]) ** 2))
    assert max(gains) < 0.6
    # Errors stay alike for a second, so that a record holds only some dozens of independent ones.
    assert 0.5 < np.mean(ratios) < 2.0


def test_three_coordinates_are_smoothed_each_by_its_own() -> None:
    paths = np.stack([pushed(0.02, 1), pushed(0.005, 2), np.full(900, 40.0)], axis=1)
    flight = smoothed(paths + np.random.default_rng(3).normal(scale=[1e-3, 2e-3, 5e-4], size=(900, 3)))
    assert flight.value_m.shape == flight.sigma_m.shape == (900, 3)
    noises = [model.noise_m for model in flight.models]
    np.testing.assert_allclose(noises, [1e-3, 2e-3, 5e-4], rtol=0.3)
    assert (np.abs(flight.value_m - paths).max(axis=0) < 3 * np.array([1e-3, 2e-3, 5e-4])).all()


@pytest.mark.parametrize("path", [np.full(900, 12.5), 0.3 * TIME_S, 4200.0 + 0.1 * TIME_S - 0.01 * TIME_S**2])
def test_straight_flight_without_noise_passes_as_it_is(path: Floats) -> None:
    np.testing.assert_allclose(smoothed(path).value_m[:, 0], path, atol=2e-6)


def test_smooth_flight_without_noise_passes_as_it_is() -> None:
    path = 0.3 * np.sin(0.5 * TIME_S) + 0.1 * np.cos(1.7 * TIME_S)
    np.testing.assert_allclose(smoothed(path).value_m[:, 0], path, atol=5e-6)


def test_gaps_are_crossed_and_said_to_be_less_certain() -> None:
    path, value = pushed(0.02, 5), noisy(pushed(0.02, 5), 1e-3)
    value[400:430] = np.nan
    flight = smoothed(value)
    assert np.isfinite(flight.value_m).all()
    assert np.isfinite(flight.sigma_m).all()
    assert flight.sigma_m[415, 0] > 2 * flight.sigma_m[200, 0]
    assert abs(flight.value_m[415, 0] - path[415]) < 5 * flight.sigma_m[415, 0]


@pytest.mark.parametrize("lost", [slice(0, 90), slice(800, 900), slice(300, 600)])
def test_a_camera_lost_at_either_end_or_for_long(lost: slice) -> None:
    value = noisy(pushed(0.02, 5), 1e-3)
    value[lost] = np.nan
    flight = smoothed(value)
    seen = np.isfinite(value)
    assert np.isfinite(flight.value_m).all()
    assert np.abs(flight.value_m[seen, 0] - pushed(0.02, 5)[seen]).max() < 3e-3


def test_a_camera_on_a_tripod() -> None:
    for seed in range(6):
        for count in (LEAST_FRAMES, 100, 900):  # a record of 24 frames still holds a parabola
            value = noisy(np.full(count, 40.0), 1e-3, seed)
            flight = smoothed(value, TIME_S[:count])
            assert np.std(flight.value_m) < 0.8e-3


def test_wild_poses_are_not_followed() -> None:
    path, value = pushed(0.02, 6), noisy(pushed(0.02, 6), 1e-3)
    clean = smoothed(value).value_m[:, 0]
    value[[200, 500, 501]] += [0.5, -0.3, -0.3]
    found = smoothed(value).value_m[:, 0]
    assert np.abs(found - clean).max() < 3e-3
    assert np.abs(found - path).max() < 5e-3


def test_frames_known_better_count_more() -> None:
    path = pushed(0.02, 7)
    sigma = np.where(np.arange(900) % 2, 1.0, 6.0)[:, None]
    value = path + np.random.default_rng(8).normal(size=900) * 1e-3 * sigma[:, 0]
    told, untold = smoothed(value, sigma=sigma).value_m[:, 0], smoothed(value).value_m[:, 0]
    assert np.std(told - path) < 0.7 * np.std(untold - path)


def test_uneven_timestamps() -> None:
    time_s = TIME_S + np.random.default_rng(9).uniform(-0.4, 0.4, 900) / RATE_HZ
    path = 0.2 * np.sin(0.8 * time_s)
    flight = smoothed(noisy(path, 1e-3), time_s)
    assert np.std(flight.value_m[:, 0] - path) < 0.5e-3


def test_too_short_a_record_is_not_smoothed() -> None:
    value = np.full((200, 3), np.nan)
    value[: LEAST_FRAMES - 1] = 0.0
    assert smooth_flight(TIME_S[:200], value, np.ones((200, 3))) is None
    value[: LEAST_FRAMES + 6] = np.random.default_rng(0).normal(scale=1e-3, size=(LEAST_FRAMES + 6, 3))
    flight = smooth_flight(TIME_S[:200], value, np.ones((200, 3)))
    assert flight is not None
    assert np.isfinite(flight.value_m[: LEAST_FRAMES + 6]).all()
