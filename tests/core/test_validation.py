from __future__ import annotations

import numpy as np
import pytest

from core.coordinates import Floats
from core.errors import InputError
from core.gps_record import GpsRecord
from core.project import Intervals
from core.validation import compare_with_gps

INTERVALS = Intervals(pre_event=(0.0, 9.0), event=(10.0, 24.0), residual=(27.0, 30.0))
ORIGIN_M = np.array([477_000.0, 3_637_000.0])
NOISE_M = 0.002


def roof(time_s: Floats, residual_m: float = 0.22) -> Floats:
    """Displacement of a roof: shaking between 10 and 24 s, ending away from where it began; mostly along x."""
    envelope = np.clip(np.minimum(time_s - 10, 24 - time_s) / 4, 0, 1)
    shaking = 0.3 * np.sin(2 * np.pi * 0.7 * time_s) + 0.15 * np.sin(2 * np.pi * 1.9 * time_s + 1)
    offset = residual_m * np.clip((time_s - 16) / 3, 0, 1)
    return np.column_stack([envelope * shaking + offset, 0.02 * envelope * np.cos(2 * np.pi * 1.3 * time_s)])


def video(duration_s: float = 32.0) -> tuple[Floats, Floats]:
    time_s = np.arange(round(duration_s * 30)) / 30
    return time_s, roof(time_s)


def gps_with_lag(lag_s: float, *, start_s: float = -3.0, end_s: float = 36.0, seed: int = 0) -> GpsRecord:
    """A 10 Hz record of the same roof, whose clock shows video time less the lag."""
    video_s = np.arange(start_s, end_s, 0.1)
    noise = np.random.default_rng(seed).normal(scale=NOISE_M, size=(len(video_s), 2))
    return GpsRecord("gps.csv", video_s - lag_s, ORIGIN_M + roof(video_s) + noise)


@pytest.mark.parametrize("lag_s", [0.0, 0.037, -1.234, 41.5, -302_417.66])
def test_lag_is_found_to_a_fraction_of_a_sample(lag_s: float) -> None:
    time_s, moved = video()
    comparison = compare_with_gps(time_s, moved, gps_with_lag(lag_s), INTERVALS)
    # Noise over root of the sum of squared velocities: 2 mm / 13 m/s = 0.15 ms; five of them.
    assert comparison.lag_s == pytest.approx(lag_s, abs=8e-4)
    assert comparison.lag_sigma_s is not None
    assert 5e-5 < comparison.lag_sigma_s < 5e-4
    assert comparison.message == ""
    np.testing.assert_allclose(comparison.rms_m, NOISE_M, rtol=0.2)


@pytest.mark.parametrize("first", range(0, 10, 2))
def test_a_receiver_slower_than_the_motion_tells_the_lag_all_the_same(first: int) -> None:
    time_s, moved = video()
    often = gps_with_lag(-4.3)
    once_a_second = GpsRecord("gps.csv", often.time_s[first::10], often.position_m[first::10])
    comparison = compare_with_gps(time_s, moved, once_a_second, INTERVALS)
    assert comparison.lag_sigma_s is not None
    assert comparison.lag_s == pytest.approx(-4.3, abs=5 * comparison.lag_sigma_s)
    assert abs(comparison.correlation) <= 1.0


def test_too_few_samples_tell_no_lag() -> None:
    time_s, moved = video()
    often = gps_with_lag(0.0)
    seldom = GpsRecord("gps.csv", often.time_s[::40], often.position_m[::40])
    comparison = compare_with_gps(time_s, moved, seldom, INTERVALS)
    assert comparison.lag_sigma_s is None
    assert "clock lag of gps.csv could not be told" in comparison.message


def test_times_in_milliseconds_share_nothing_with_the_video() -> None:
    time_s, moved = video()
    record = gps_with_lag(-5.0)
    for start_ms in (60e3, -5e3):
        in_ms = GpsRecord("eq7/gps.csv", 1000 * record.time_s + start_ms, record.position_m)
        try:
            told = compare_with_gps(time_s, moved, in_ms, INTERVALS).message
        except InputError as error:
            told = str(error)
            assert told.startswith("eq7/gps.csv: its times, ")
            assert "share nothing with the measured video" in told
        assert "its samples lie 100 s apart, as if times were in milliseconds: divide them by 1000; " in told
        assert "eq7" not in told or start_ms == 60e3


@pytest.mark.parametrize(
    ("unit", "in_a_metre"), [("millimetres", 1000), ("centimetres", 100), ("feet", 3.2808), ("degrees", 1 / 95_000)]
)
def test_positions_in_another_unit_are_told_by_how_much_they_move(unit: str, in_a_metre: float) -> None:
    time_s, moved = video()
    record = gps_with_lag(-5.0)
    in_unit = GpsRecord("gps.csv", record.time_s, in_a_metre * record.position_m)
    with pytest.raises(InputError, match=rf"^gps\.csv: its positions move .* as if they were in {unit}; convert them"):
        compare_with_gps(time_s, moved, in_unit, INTERVALS)


def test_lag_survives_drift_offset_and_lost_frames() -> None:
    time_s, moved = video()
    moved = moved + 0.05 * np.sin(2 * np.pi * 0.06 * time_s)[:, None] + 0.3
    moved[300:345] = np.nan
    comparison = compare_with_gps(time_s, moved, gps_with_lag(-7.77), INTERVALS)
    assert comparison.lag_s == pytest.approx(-7.77, abs=0.02)
    lost = (comparison.time_s > 10.0) & (comparison.time_s < 11.4)
    assert np.isnan(comparison.video_m[lost]).all()
    assert np.isfinite(comparison.video_m[~lost]).sum() > 500


def test_lag_of_a_small_motion_under_a_large_drift() -> None:
    """Three centimetres of shaking under ten of drift, where the displacements agree best seconds away."""
    time_s, moved = video()
    small = moved * [0.08, 1.0]
    drift = 0.1 * np.column_stack([np.sin(0.9 * time_s), np.cos(0.6 * time_s)])
    record = gps_with_lag(12.3)
    quiet = GpsRecord("gps.csv", record.time_s, (record.position_m - ORIGIN_M) * [0.08, 1.0])
    comparison = compare_with_gps(time_s, small + drift, quiet, INTERVALS)
    assert comparison.lag_sigma_s is not None
    assert comparison.lag_s == pytest.approx(12.3, abs=5 * comparison.lag_sigma_s)
    assert comparison.lag_sigma_s < 0.03


def test_doubt_between_two_periods_is_said() -> None:
    """Steady shaking all through both records looks the same a period later."""
    time_s = np.arange(900) / 30
    rng = np.random.default_rng(8)
    clock_s = np.arange(-10, 40, 0.1)
    moved, position = (
        np.column_stack([0.1 * np.sin(2 * np.pi * 0.5 * at_s), np.zeros(len(at_s))])
        + rng.normal(scale=NOISE_M, size=(len(at_s), 2))
        for at_s in (time_s, clock_s)
    )
    comparison = compare_with_gps(time_s, moved, GpsRecord("gps.csv", clock_s, position), INTERVALS)
    assert "clock lag of gps.csv is in doubt" in comparison.message
    assert comparison.lag_s % 2.0 == pytest.approx(0.0, abs=0.01) or comparison.lag_s % 2.0 == pytest.approx(
        2.0, abs=0.01
    )


def test_rows_are_those_of_table_2() -> None:
    time_s, moved = video()
    scaled = moved * 0.95
    comparison = compare_with_gps(time_s, scaled, gps_with_lag(3.0), INTERVALS)
    peak = comparison.peak_positive[0]
    assert peak is not None
    event = (time_s >= 10) & (time_s <= 24)
    assert peak.video_m == pytest.approx(scaled[event, 0].max())
    # At 10 Hz, GPS may miss the peak by 0.05 s: a tenth of the amplitude of its quickest part.
    assert peak.gps_m == pytest.approx(moved[event, 0].max(), abs=0.02)
    assert peak.error_m == peak.video_m - peak.gps_m
    assert peak.error_percent == pytest.approx(100 * abs(peak.error_m) / peak.gps_m)
    residual = comparison.residual[0]
    assert residual is not None
    assert residual.video_m == pytest.approx(0.95 * 0.22, abs=1e-9)
    assert residual.gps_m == pytest.approx(0.22, abs=0.002)
    assert residual.error_percent == pytest.approx(5, abs=1)
    assert {row["quantity"] for row in comparison.table()} == {"peak_positive", "peak_negative", "residual"}
    assert comparison.summary()["lag_s"] == comparison.lag_s
    assert comparison.summary()["residual_m"]["x"]["error"] == residual.error_m


def test_a_peak_between_two_gps_samples_is_compared_at_the_gps_instant() -> None:
    time_s, moved = video()
    # Twice a second, GPS misses the top of shaking at 1.9 Hz by centimetres; the records agree all the same.
    clock_s = np.arange(-2.8, 36.0, 0.5)
    record = GpsRecord("gps.csv", clock_s, ORIGIN_M + roof(clock_s))
    comparison = compare_with_gps(time_s, moved, record, INTERVALS)
    peak = comparison.peak_positive[0]
    assert peak is not None
    assert peak.error_m > 0.02
    assert peak.error_at_gps_m == pytest.approx(0.0, abs=0.002)
    assert (comparison.sample_step_s, comparison.frame_step_s) == (pytest.approx(0.5), pytest.approx(1 / 30))
    assert comparison.is_coarse
    assert "0.5 s apart, frames 0.0333 s" in comparison.spacing
    told = comparison.summary()
    assert told["peak_positive_m"]["x"]["video_at_gps"] == peak.video_at_gps_m
    assert told["residual_m"]["x"]["video_at_gps"] is None
    as_quick = GpsRecord("gps.csv", time_s, ORIGIN_M + roof(time_s))
    assert not compare_with_gps(time_s, moved, as_quick, INTERVALS).is_coarse


def test_without_residual_interval_there_is_no_residual_row() -> None:
    time_s, moved = video()
    comparison = compare_with_gps(time_s, moved, gps_with_lag(0.5), Intervals(pre_event=(0.0, 9.0)))
    assert comparison.residual == (None, None)
    assert comparison.summary()["residual_m"] == {"x": None, "y": None}


def test_other_earthquakes_in_a_long_record_are_not_taken() -> None:
    time_s, moved = video()
    clock_s = np.arange(0, 1800, 0.1)
    rng = np.random.default_rng(2)
    position = roof(clock_s - 900.25) + rng.normal(scale=NOISE_M, size=(len(clock_s), 2))
    other = np.exp(-(((clock_s - 300) / 6) ** 2)) * np.sin(2 * np.pi * 1.1 * clock_s)
    position[:, 0] += other
    comparison = compare_with_gps(time_s, moved, GpsRecord("gps.csv", clock_s, position), INTERVALS)
    assert comparison.lag_s == pytest.approx(-900.25, abs=1e-3)


def test_baseline_without_pre_event_is_said() -> None:
    time_s, moved = video()
    comparison = compare_with_gps(time_s, moved, gps_with_lag(0.0), Intervals())
    assert "No GPS sample lies in the pre-event interval" in comparison.message
    # Northings of millions of metres carry half a nanometre.
    np.testing.assert_allclose(comparison.error_m.mean(axis=0), 0.0, atol=2e-9)


def test_still_roof_tells_no_lag() -> None:
    rng = np.random.default_rng(5)
    time_s = np.arange(900) / 30
    moved = rng.normal(scale=3e-4, size=(900, 2))
    record = GpsRecord("gps.csv", np.arange(300) / 10, rng.normal(scale=NOISE_M, size=(300, 2)))
    comparison = compare_with_gps(time_s, moved, record, INTERVALS)
    assert comparison.lag_s == 0.0
    assert comparison.lag_sigma_s is None
    assert "clock lag of gps.csv could not be told" in comparison.message


def test_refuses_records_that_share_no_time_or_nothing_measured() -> None:
    rng = np.random.default_rng(5)
    time_s = np.arange(900) / 30
    record = GpsRecord("gps.csv", 5000 + np.arange(300) / 10, rng.normal(scale=NOISE_M, size=(300, 2)))
    with pytest.raises(InputError, match=r"gps\.csv: its times, 5000 to 5029\.9 s, share nothing with the measured"):
        compare_with_gps(time_s, rng.normal(scale=3e-4, size=(900, 2)), record, INTERVALS)
    with pytest.raises(InputError, match="measured in 0 frames; a comparison with GPS needs at least four"):
        compare_with_gps(time_s, np.full((900, 2), np.nan), record, INTERVALS)
