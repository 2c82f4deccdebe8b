from __future__ import annotations

import re
import timeit
from collections.abc import Callable

import numpy as np
import pytest

from core.coordinates import Floats
from core.drift import (
    amplitude_spectrum,
    corner_sweep,
    dominant_frequency,
    filter_warnings,
    high_pass,
)
from core.errors import InputError
from core.project import Intervals

RATE_HZ = 30.0
INTERVALS = Intervals(pre_event=(0.0, 30.0), event=(32.0, 46.0), residual=(50.0, 60.0))


def clock(duration_s: float, rate_hz: float = RATE_HZ) -> Floats:
    return np.arange(round(duration_s * rate_hz)) / rate_hz


def drift_below(limit_hz: float, time_s: Floats, seed: int, rms_m: float = 0.05) -> Floats:
    """Random motion with nothing above `limit_hz`, weaker towards it as a hovering camera's is."""
    rng = np.random.default_rng(seed)
    frequency = np.fft.rfftfreq(len(time_s), 1 / RATE_HZ)
    inside = (frequency > 0.015) & (frequency < limit_hz)
    amplitude = np.zeros(len(frequency), dtype=complex)
    amplitude[inside] = (rng.normal(size=inside.sum()) + 1j * rng.normal(size=inside.sum())) / frequency[inside]
    motion = np.fft.irfft(amplitude, len(time_s))
    return motion * rms_m / motion.std()


def burst(time_s: Floats, frequency_hz: float, amplitude_m: float) -> Floats:
    """Shaking between 32 and 46 s."""
    envelope = np.clip(np.minimum(time_s - 32, 46 - time_s) / 2, 0, 1)
    return amplitude_m * envelope * np.sin(2 * np.pi * frequency_hz * time_s)


def test_sine_shows_its_own_amplitude_and_offset_its_own_value() -> None:
    time_s = clock(20)
    spectrum = amplitude_spectrum(0.03 + 0.01 * np.sin(2 * np.pi * 2.5 * time_s), time_s)
    assert spectrum.amplitude_m[0] == pytest.approx(0.03, abs=1e-12)
    peak = int(np.argmax(spectrum.amplitude_m[1:])) + 1
    assert spectrum.frequency_hz[peak] == pytest.approx(2.5)
    assert spectrum.amplitude_m[peak] == pytest.approx(0.01, abs=1e-12)
    assert np.delete(spectrum.amplitude_m, [0, peak]).max() < 1e-12


def test_highest_frequency_of_even_record_is_not_doubled() -> None:
    time_s = clock(2)
    spectrum = amplitude_spectrum(0.01 * (-1.0) ** np.arange(len(time_s)), time_s)
    assert spectrum.frequency_hz[-1] == pytest.approx(RATE_HZ / 2)
    assert spectrum.amplitude_m[-1] == pytest.approx(0.01)


def test_spectrum_of_part_with_gap_and_uneven_times() -> None:
    rng = np.random.default_rng(1)
    time_s = np.sort(clock(40) + rng.uniform(-0.4, 0.4, 1200) / RATE_HZ)
    values = np.column_stack([0.02 * np.sin(2 * np.pi * 0.5 * time_s), np.zeros(1200)])
    values[400:403] = np.nan
    spectrum = amplitude_spectrum(values, time_s, (10.0, 30.0))
    assert spectrum.amplitude_m.shape == (len(spectrum.frequency_hz), 2)
    peak = int(np.argmax(spectrum.amplitude_m[:, 0]))
    assert spectrum.frequency_hz[peak] == pytest.approx(0.5, abs=0.03)
    # Straight lines between samples lose (pi f / rate)^2 / 3 at most; the record is no whole number of periods.
    assert spectrum.amplitude_m[peak, 0] == pytest.approx(0.02, rel=0.02)


def test_spectrum_needs_frames() -> None:
    with pytest.raises(InputError, match="at least four measured frames; choose a longer interval"):
        amplitude_spectrum(np.full(50, np.nan), clock(50 / RATE_HZ))


@pytest.mark.parametrize("order", [2, 4, 9, 10, 20])
@pytest.mark.parametrize("corner_hz", [0.25, 0.5])
def test_response_is_three_decibels_down_at_the_corner_without_delay(order: int, corner_hz: float) -> None:
    time_s = clock(120)
    middle = slice(1200, 2400)
    sine = np.sin(2 * np.pi * corner_hz * time_s)
    filtered = high_pass(sine, time_s, corner_hz, order)
    np.testing.assert_allclose(filtered[middle], sine[middle] / np.sqrt(2), atol=2e-3)


@pytest.mark.parametrize("times_corner", [0.57, 0.8, 1.2, 2.0])
def test_response_is_the_documented_one(times_corner: float) -> None:
    time_s = clock(120)
    sine = np.sin(2 * np.pi * times_corner * 0.25 * time_s)
    kept = high_pass(sine, time_s, 0.25)[1200:2400].std() / sine[1200:2400].std()
    g = (np.sqrt(2) - 1) ** 0.1
    assert kept == pytest.approx(1 / (1 + (g / times_corner) ** 10), abs=2e-3)


def test_fast_motion_passes_and_constants_vanish() -> None:
    time_s = clock(60)
    fast = burst(time_s, 2.0, 0.1)
    filtered = high_pass(np.column_stack([fast + 0.4, np.full(len(time_s), 0.4)]), time_s, 0.25)
    np.testing.assert_allclose(filtered[:, 0], fast, atol=1e-4)
    np.testing.assert_allclose(filtered[:, 1], 0.0, atol=1e-12)


def test_filter_erases_a_residual_as_the_paper_says() -> None:
    time_s = clock(60)
    step = np.where(time_s > 30, 0.22, 0.0)
    assert np.abs(high_pass(step, time_s, 0.25)[-300:]).max() < 1e-3


def test_gap_stays_a_gap_and_does_not_spoil_its_neighbours() -> None:
    time_s = clock(60)
    slow = 0.05 * np.sin(2 * np.pi * 0.04 * time_s)
    whole = high_pass(slow, time_s, 0.3)
    broken = slow.copy()
    broken[900:912] = np.nan
    filtered = high_pass(broken, time_s, 0.3)
    assert np.isnan(filtered[900:912]).all()
    kept = np.isfinite(filtered)
    assert kept.sum() == len(time_s) - 12
    # A straight line over 0.4 s of this sine is at most (2 pi 0.04 0.4)^2 / 8 of its amplitude off.
    np.testing.assert_allclose(filtered[kept], whole[kept], atol=0.05 * (2 * np.pi * 0.04 * 0.4) ** 2 / 8)


def test_column_without_measurements_stays_empty() -> None:
    time_s = clock(20)
    values = np.column_stack([np.sin(time_s), np.full(len(time_s), np.nan)])
    filtered = high_pass(values, time_s, 0.25)
    assert np.isfinite(filtered[:, 0]).all()
    assert np.isnan(filtered[:, 1]).all()


def test_uneven_times_give_the_even_result() -> None:
    rng = np.random.default_rng(3)
    time_s = np.sort(clock(60) + rng.uniform(-0.45, 0.45, 1800) / RATE_HZ)
    slow, fast = 0.05 * np.sin(2 * np.pi * 0.05 * time_s), 0.02 * np.sin(2 * np.pi * 1.0 * time_s)
    filtered = high_pass(slow + fast, time_s, 0.25)
    np.testing.assert_allclose(filtered[150:-150], fast[150:-150], atol=2e-4)


def test_short_records_and_impossible_corners_are_refused() -> None:
    time_s = clock(3)
    with pytest.raises(
        InputError, match=r"lasts 3\.0 s, less than half a period of 0\.1 Hz; choose a corner above 0\.17"
    ):
        high_pass(np.zeros(len(time_s)), time_s, 0.1)
    with pytest.raises(InputError, match=r"15 Hz is not between 0 and half the frame rate \(15 Hz\)"):
        high_pass(np.zeros(len(time_s)), time_s, 15.0)
    with pytest.raises(InputError, match='has 2 frames, but a filter needs at least 4; choose "none"'):
        high_pass(np.zeros(2), time_s[:2], 1.0)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("limit_hz", [0.15, 0.25, 0.35])
def test_knee_is_found_at_the_end_of_the_drift(seed: int, limit_hz: float) -> None:
    time_s = clock(60)
    noise = np.random.default_rng(100 + seed).normal(scale=1e-3, size=(len(time_s), 2))
    moved = np.column_stack([drift_below(limit_hz, time_s, 2 * seed + axis) for axis in (0, 1)]) + noise
    sweep = corner_sweep(moved, time_s, (0.0, 30.0))
    assert sweep.rms_m.shape == (19, 2)
    assert sweep.rms_m[-1].max() < 2e-3
    # The drift weakens towards its limit, so the knee may come a little before it; 0.04 Hz is the resolution.
    assert sweep.knee_hz == pytest.approx(limit_hz, abs=0.051)


def test_what_remains_at_the_knee_is_told_and_what_lies_beyond_it() -> None:
    time_s = clock(60)
    noise = np.random.default_rng(9).normal(scale=1e-3, size=(len(time_s), 2))
    slow = drift_below(0.25, time_s, seed=3)
    # One axis falls on beyond the knee: the other's drift is a fifth as large, but reaches to 0.4 Hz.
    moved = np.column_stack([slow, 0.2 * drift_below(0.4, time_s, seed=8)]) + noise
    sweep = corner_sweep(moved, time_s, (0.0, 30.0))
    assert sweep.knee_hz is not None
    place = int(np.searchsorted(sweep.corners_hz, sweep.knee_hz))
    assert sweep.at_knee_m == pytest.approx(sweep.rms_m[place])
    assert sweep.beyond_knee_m is not None
    assert sweep.beyond_knee_m == pytest.approx(sweep.rms_m[place:].min(axis=0))
    assert sweep.beyond_knee_m[1] < 0.7 * sweep.rms_m[place, 1]


def test_no_knee_without_drift_nor_with_drift_beyond_the_sweep() -> None:
    time_s = clock(60)
    noise = np.random.default_rng(7).normal(scale=1e-3, size=(len(time_s), 2))
    none = corner_sweep(noise, time_s, (0.0, 30.0))
    assert (none.knee_hz, none.at_knee_m, none.beyond_knee_m) == (None, None, None)
    fast = 0.05 * np.sin(2 * np.pi * 0.48 * time_s)
    assert corner_sweep(fast, time_s, (0.0, 30.0)).knee_hz is None


def test_sweep_leaves_out_corners_too_slow_for_the_record() -> None:
    time_s = clock(8)
    sweep = corner_sweep(np.sin(time_s), time_s, (0.0, 4.0))
    assert np.isnan(sweep.rms_m[:1]).all()
    assert np.isfinite(sweep.rms_m[1:]).all()


def test_sweep_needs_an_interval_in_the_video() -> None:
    time_s = clock(20)
    with pytest.raises(InputError, match=r"intervals_s\.pre_event: no measured frame between 30 and 40 s"):
        corner_sweep(np.sin(time_s), time_s, (30.0, 40.0))


def test_dominant_frequency_is_the_roofs_and_not_the_drifts() -> None:
    time_s = clock(60)
    moved = drift_below(0.25, time_s, seed=4) + burst(time_s, 2.5, 0.02)
    assert dominant_frequency(moved, time_s, INTERVALS) == pytest.approx(2.5, abs=0.1)
    assert dominant_frequency(moved, time_s, Intervals(pre_event=(0.0, 30.0))) is None


def test_paper_like_event_gives_no_warning() -> None:
    time_s = clock(60)
    moved = np.column_stack([drift_below(0.25, time_s, seed=5) + burst(time_s, 2.5, 0.3), np.zeros(len(time_s))])
    assert filter_warnings(moved, high_pass(moved, time_s, 0.25), time_s, INTERVALS, corner_hz=0.25) == []


def test_warnings_name_residual_frequency_and_restless_pre_event() -> None:
    time_s = clock(60)
    residual = 0.22 * np.clip((time_s - 38) / 3, 0, 1)
    moved = np.column_stack([drift_below(0.25, time_s, seed=6, rms_m=0.06) + residual, burst(time_s, 0.4, 0.3)])
    warnings = filter_warnings(moved, high_pass(moved, time_s, 0.25), time_s, INTERVALS, corner_hz=0.25)
    assert any("removes the residual displacement: along x (east) 2" in text and "2" in text for text in warnings)
    assert any("comes near" in text and re.search(r" 0\.4\d Hz along y \(north\)", text) for text in warnings)
    slow = filter_warnings(moved, high_pass(moved, time_s, 0.05), time_s, INTERVALS, corner_hz=0.05)
    assert any("the paper accepts less than 1 cm" in text for text in slow)


def test_a_corner_above_the_frequency_of_the_motion_is_told_once_for_both_axes() -> None:
    time_s = clock(60)
    moved = np.column_stack([burst(time_s, 2.5, 0.3), burst(time_s, 2.5, 0.2)])
    event = Intervals(event=INTERVALS.event)
    (warning,) = filter_warnings(moved, high_pass(moved, time_s, 3.0), time_s, event, corner_hz=3.0)
    assert re.search(r"lies above 2\.\d+ Hz along x \(east\) and 2\.\d+ Hz along y \(north\), ", warning)
    assert warning.endswith("takes away most of the motion.")
    (near,) = filter_warnings(moved, high_pass(moved, time_s, 1.5), time_s, event, corner_hz=1.5)
    assert "comes near 2." in near


def test_a_residual_that_drift_hides_is_seen_where_the_displacement_is_free_of_drift() -> None:
    time_s = clock(60)
    still = np.zeros(len(time_s))
    steady = np.column_stack([0.085 * np.clip((time_s - 38) / 3, 0, 1) + burst(time_s, 2.5, 0.3), still])
    moved = steady + np.column_stack([drift_below(0.25, time_s, seed=6, rms_m=0.2), still])
    filtered = high_pass(moved, time_s, 0.25)
    assert filter_warnings(moved, filtered, time_s, INTERVALS, corner_hz=0.25) == []
    (warning,) = filter_warnings(moved, filtered, time_s, INTERVALS, corner_hz=0.25, steady_m=steady)
    assert "removes the residual displacement: along x (east) 8.5 cm by the geometric method and " in warning
    (mirrored,) = filter_warnings(-moved, -filtered, time_s, INTERVALS, corner_hz=0.25, steady_m=-steady)
    assert "along x (east) \u22128.5 cm" in mirrored


def test_warns_of_a_pre_event_shorter_than_a_period() -> None:
    time_s = clock(60)
    short = Intervals(pre_event=(0.0, 3.0))
    quiet = np.zeros((len(time_s), 2))
    (warning,) = filter_warnings(quiet, quiet, time_s, short, corner_hz=0.25)
    assert "lasts 3.0 s, less than one period of the corner frequency (4.0 s)" in warning


def test_sweep_of_ten_minutes_costs_some_transforms() -> None:
    """Alone 35 ms, a fifth of what the interface allows; as long as twenty transforms there and back, as a ratio."""
    time_s = clock(600)
    moved = np.cumsum(np.random.default_rng(0).normal(size=(len(time_s), 2)), axis=0) * 1e-3
    padded = np.concatenate([moved, moved])

    def sweep() -> None:
        corner_sweep(moved, time_s, (0.0, 30.0))
        high_pass(moved, time_s, 0.25)

    def transforms() -> None:
        for _ in range(20):
            np.fft.irfft(np.fft.rfft(padded, axis=0), axis=0)

    assert _quickest_s(sweep) < 5 * _quickest_s(transforms)


def _quickest_s(work: Callable[[], None]) -> float:
    return min(timeit.repeat(work, number=1, repeat=5))
