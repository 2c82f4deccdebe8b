from __future__ import annotations

import numpy as np
import pytest

from core.coordinates import Floats
from core.flight import CUTOFFS_HZ, LEAST_FRAMES, SmoothFlight, choose_cutoff, smooth_flight

RATE_HZ = 30.0
TIME_S = np.arange(900) / RATE_HZ


def swaying(cutoff_hz: float, seed: int, count: int = 900, size_m: float = 0.1) -> Floats:
    """A random path that holds nothing above a frequency: the sway of a heavy body."""
    random = np.random.default_rng(seed)
    frequency = np.linspace(0.02, cutoff_hz, 12)
    amplitude = random.normal(size=12) / (1 + (frequency / 0.15) ** 2)
    time_s = np.arange(count) / RATE_HZ
    waves = amplitude * np.sin(2 * np.pi * time_s[:, None] * frequency + random.uniform(0, 2 * np.pi, 12))
    return size_m * waves.sum(axis=1)


def noisy(path: Floats, noise_m: float | Floats, seed: int = 1) -> Floats:
    return path + np.random.default_rng(seed).normal(scale=1.0, size=path.shape) * noise_m


def smoothed(value: Floats, time_s: Floats = TIME_S, misfit_px: Floats | None = None) -> SmoothFlight:
    columns = value if value.ndim == 2 else value[:, None]
    flight = smooth_flight(time_s, columns, np.full(len(columns), 0.1) if misfit_px is None else misfit_px)
    assert flight is not None
    return flight


# --- what the record tells of itself ---------------------------------------------------------------------------------


@pytest.mark.parametrize("noise_m", [1e-4, 1e-3, 5e-3])
def test_noise_of_a_frame_is_learnt(noise_m: float) -> None:
    flight = smoothed(noisy(swaying(0.3, 2), noise_m))
    # 900 frames tell a standard deviation to 2.4 %; clipping at 3.5 of them and the few the path takes cost a little.
    assert flight.models[0].noise_m == pytest.approx(noise_m, rel=0.1)
    assert flight.models[0].memory < 0.15


def test_gusts_are_followed_and_calm_is_not_mistaken_for_gusts() -> None:
    gusty = noisy(swaying(1.5, 3) + 0.02 * np.sin(2 * np.pi * 1.2 * TIME_S), 1e-4)[:, None]
    calm = noisy(swaying(0.2, 3), 2e-3)[:, None]
    size = np.ones(900)
    assert choose_cutoff(TIME_S, gusty, size) >= 1.3
    assert choose_cutoff(TIME_S, calm, size) <= 0.8


def test_noise_alike_in_neighbouring_frames_is_told() -> None:
    random, noise = np.random.default_rng(3), np.zeros(2400)
    for frame in range(1, 2400):
        noise[frame] = 0.5 * noise[frame - 1] + 1e-3 * random.normal()
    flight = smoothed(swaying(0.3, 4, 2400) + noise, np.arange(2400) / RATE_HZ)
    # The path takes up the slow part of such noise, so that what is left remembers a little less.
    assert 0.3 < flight.models[0].memory < 0.6
    assert flight.models[0].noise_m == pytest.approx(1e-3 / np.sqrt(1 - 0.25), rel=0.15)


@pytest.mark.parametrize(("frames", "rate_hz"), [(50, 240.0), (80, 240.0), (40, 120.0), (26, 60.0)])
def test_a_fraction_of_a_second_says_nothing_of_the_flight(frames: int, rate_hz: float) -> None:
    path = noisy(swaying(0.3, 2, frames), 1e-3)[:, None]
    assert smooth_flight(np.arange(frames) / rate_hz, path, np.full(frames, 0.1)) is None


def test_frames_that_fit_badly_count_less() -> None:
    path = swaying(0.3, 5)
    misfit = np.where(np.arange(900) // 15 % 2, 0.1, 0.5)
    value = noisy(path, 1e-3 * misfit / 0.1)
    told, untold = smoothed(value, misfit_px=misfit).value_m[:, 0], smoothed(value).value_m[:, 0]
    assert np.std(told - path) < 0.8 * np.std(untold - path)


# --- the smoothed path -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("cutoff_hz", "noise_m"), [(0.3, 2e-3), (0.3, 2e-4), (0.8, 1e-3)])
def test_smoothing_takes_out_noise_and_knows_how_much_is_left(cutoff_hz: float, noise_m: float) -> None:
    ratios, gains = [], []
    for seed in range(6):
        path = swaying(cutoff_hz, seed)
        flight = smoothed(noisy(path, noise_m, seed + 50))
        error = flight.value_m[:, 0] - path
        gains.append(np.sqrt(np.mean(error**2)) / noise_m)
        ratios.append(np.mean((error / flight.sigma_m[:, 0]) ** 2))
    # Of 30 frames a second, those of about half a period are averaged.
    assert np.mean(gains) < 0.6
    # Errors stay alike for a second, so that a record holds only some dozens of independent ones.
    assert 0.5 < np.mean(ratios) < 2.0


def test_three_coordinates_move_as_one_body_but_err_each_by_its_own() -> None:
    paths = np.stack([swaying(0.3, 1), swaying(0.3, 2), np.full(900, 40.0)], axis=1)
    flight = smoothed(noisy(paths, np.array([1e-3, 2e-3, 5e-4])))
    assert flight.value_m.shape == flight.sigma_m.shape == (900, 3)
    np.testing.assert_allclose(flight.noise_m, [1e-3, 2e-3, 5e-4], rtol=0.15)
    assert len({model.cutoff_hz for model in flight.models}) == 1
    assert (np.abs(flight.value_m - paths).max(axis=0) < 3 * np.array([1e-3, 2e-3, 5e-4])).all()


@pytest.mark.parametrize("path", [np.full(900, 12.5), 0.3 * TIME_S, 4200.0 + 0.1 * TIME_S - 0.01 * TIME_S**2])
def test_straight_flight_without_noise_passes_as_it_is(path: Floats) -> None:
    np.testing.assert_allclose(smoothed(path).value_m[:, 0], path, atol=2e-6)


def test_smooth_flight_without_noise_passes_as_it_is() -> None:
    path = 0.3 * np.sin(0.5 * TIME_S) + 0.1 * np.cos(1.7 * TIME_S)
    np.testing.assert_allclose(smoothed(path).value_m[:, 0], path, atol=5e-6)


def test_a_camera_on_a_tripod() -> None:
    for seed in range(3):
        for count in (LEAST_FRAMES, 100, 900):
            flight = smoothed(noisy(np.full(count, 40.0), 1e-3, seed), TIME_S[:count])
            # A quintic through 24 frames keeps six parts of 24 of the variance, 0.5 of the deviation.
            assert np.std(flight.value_m) < 0.8e-3


# --- frames that are missing or wrong --------------------------------------------------------------------------------


def test_gaps_are_crossed_and_said_to_be_less_certain() -> None:
    path, value = swaying(0.3, 5), noisy(swaying(0.3, 5), 1e-3)
    value[400:430] = np.nan
    flight = smoothed(value)
    assert np.isfinite(flight.value_m).all()
    assert np.isfinite(flight.sigma_m).all()
    assert flight.sigma_m[415, 0] > 1.5 * flight.sigma_m[200, 0]
    assert abs(flight.value_m[415, 0] - path[415]) < 5 * flight.sigma_m[415, 0]


@pytest.mark.parametrize("lost", [slice(0, 90), slice(800, 900), slice(300, 600), slice(100, 850)])
def test_a_camera_lost_at_either_end_or_for_long(lost: slice) -> None:
    path, value = swaying(0.3, 6), noisy(swaying(0.3, 6), 1e-3)
    value[lost] = np.nan
    flight = smoothed(value)
    seen = np.isfinite(value)
    assert np.isfinite(flight.value_m).all()
    assert np.abs(flight.value_m[seen, 0] - path[seen]).max() < 4e-3


def test_wild_poses_are_not_followed() -> None:
    path, value = swaying(0.3, 7), noisy(swaying(0.3, 7), 1e-3)
    clean = smoothed(value).value_m[:, 0]
    value[[200, 500, 501]] += [0.5, -0.3, -0.3]
    found = smoothed(value).value_m[:, 0]
    assert np.abs(found - clean).max() < 2e-3
    assert np.abs(found - path).max() < 4e-3


def test_uneven_timestamps() -> None:
    time_s = TIME_S + np.random.default_rng(9).uniform(-0.4, 0.4, 900) / RATE_HZ
    path = 0.2 * np.sin(0.8 * time_s)
    assert np.std(smoothed(noisy(path, 1e-3), time_s).value_m[:, 0] - path) < 0.5e-3


def test_too_short_a_record_is_not_smoothed() -> None:
    value = np.full((200, 3), np.nan)
    misfit = np.full(200, 0.1)
    value[: LEAST_FRAMES - 1] = 0.0
    assert smooth_flight(TIME_S[:200], value, misfit) is None
    value[: LEAST_FRAMES + 6] = noisy(np.zeros((LEAST_FRAMES + 6, 3)), 1e-3)
    flight = smooth_flight(TIME_S[:200], value, misfit)
    assert flight is not None
    assert np.isfinite(flight.value_m).all()
    assert flight.models[0].cutoff_hz in CUTOFFS_HZ
