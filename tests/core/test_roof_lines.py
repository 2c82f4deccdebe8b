from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.special import erf

from core.coordinates import Floats
from core.errors import InputError
from core.roof_lines import NOT_FOUND, STATIONS, LineMatch, LineTracker
from core.video import Luma
from tests.waves import frame, pixels

SIZE = (320, 220)
# A strip 6 px wide that runs 4 degrees off the rows, and the axis of its band, drawn by hand a little beside it.
START, END, WIDTH_PX = np.array([30.0, 92.3]), np.array([290.0, 110.4]), 6.0
DRAWN = np.array([[40.0, 95.0], [280.0, 108.0]])
BLUR_PX = 0.9


def strip(
    start: Floats = START,
    end: Floats = END,
    *,
    width_px: float = WIDTH_PX,
    blur_px: float = BLUR_PX,
    light: tuple[float, float] = (90.0, 180.0),
) -> Floats:
    """A straight strip, known exactly, as a blurred camera sees it: grey levels (height, width)."""
    along = (end - start) / np.linalg.norm(end - start)
    across = np.array([-along[1], along[0]])
    distance = (pixels(SIZE) - start) @ across
    edges = (
        erf((distance + width_px / 2) / (blur_px * np.sqrt(2))),
        erf((distance - width_px / 2) / (blur_px * np.sqrt(2))),
    )
    return light[0] + (light[1] - light[0]) * (edges[0] - edges[1]) / 2


def moved_by(shift: tuple[float, float] | Floats = (0.0, 0.0)) -> Callable[[Floats], Floats]:
    return lambda points: np.asarray(points + np.asarray(shift))


def tracker(luma: Luma | None = None, ends: Floats = DRAWN, width_px: float = 40.0) -> LineTracker:
    return LineTracker(frame(strip()) if luma is None else luma, ends, moved_by(), width_px=width_px, name="roof.L1")


def off_line(found: LineMatch, start: Floats, end: Floats) -> Floats:
    """Signed distances (STATIONS,) of the mid-line points from a line."""
    along = (end - start) / np.linalg.norm(end - start)
    return (found.midline_raw - start) @ np.array([-along[1], along[0]])


# --- one strip -------------------------------------------------------------------------------------------------------


def test_the_strip_of_a_band_is_described() -> None:
    profile = tracker().profile
    assert profile.width_px == pytest.approx(WIDTH_PX, abs=0.3)
    assert profile.polarity == 1.0
    # At the middle of the drawn axis, (160, 101.5), the strip's mid-line lies at 101.35; its ends 2 px apart.
    assert profile.offset_px == pytest.approx(-0.15, abs=0.5)
    assert np.linalg.norm(profile.signature) == pytest.approx(1.0, abs=1e-5)
    assert tracker(frame(strip(light=(180.0, 90.0)))).profile.polarity == -1.0


def test_mid_line_is_found_to_hundredths_of_a_pixel() -> None:
    found = tracker().find(frame(strip()), moved_by())
    assert found.measured == STATIONS
    assert found.correlation > 0.98
    error = off_line(found, START, END)
    # 8-bit rounding alone: 0.29 grey levels against edges of 40 a pixel, over four columns.
    assert np.abs(error).max() < 0.02
    assert abs(error.mean()) < 3e-3
    width = np.linalg.norm(found.edges_raw[:, 1] - found.edges_raw[:, 0], axis=1)
    np.testing.assert_allclose(width, WIDTH_PX, atol=0.15)


@pytest.mark.parametrize("shift", [(0.0, 0.37), (3.0, -5.4), (-8.0, 11.2)])
def test_a_moved_strip_is_found_where_it_is(shift: tuple[float, float]) -> None:
    found = tracker().find(frame(strip(START + shift, END + shift)), moved_by())
    assert found.measured > 0.8 * STATIONS
    assert np.nanmax(np.abs(off_line(found, START + shift, END + shift))) < 0.03


def test_predictions_carry_the_stations_along() -> None:
    shift = np.array([17.3, -22.8])
    found = tracker().find(frame(strip(START + shift, END + shift)), moved_by(shift), search_px=4)
    still = tracker().find(frame(strip()), moved_by())
    assert found.measured == STATIONS
    # The same piece of roof is measured, to a pixel along the strip.
    assert np.abs(found.midline_raw - still.midline_raw - shift).max() < 1.0
    assert np.abs(off_line(found, START + shift, END + shift)).max() < 0.03


def test_strips_along_columns_and_backwards_are_the_same() -> None:
    turned = np.ascontiguousarray(frame(strip()).T)
    along_v = tracker(turned, DRAWN[:, ::-1]).find(turned, moved_by())
    along_u = tracker().find(frame(strip()), moved_by())
    np.testing.assert_allclose(along_v.edges_raw, along_u.edges_raw[..., ::-1], atol=1e-9)
    backwards = tracker(ends=DRAWN[::-1]).find(frame(strip()), moved_by())
    # Which of two stations a column between them counts to may differ.
    np.testing.assert_allclose(backwards.midline_raw[:, 0], along_u.midline_raw[::-1, 0], atol=0.6)
    np.testing.assert_allclose(off_line(backwards, START, END), 0.0, atol=0.02)


def test_a_strip_at_forty_five_degrees() -> None:
    start, end = np.array([60.0, 10.0]), np.array([250.0, 203.0])
    luma = frame(strip(start, end))
    found = tracker(luma, np.array([[70.0, 22.0], [240.0, 191.0]])).find(luma, moved_by())
    assert found.measured > 0.8 * STATIONS  # the band's first corner lies outside the frame
    assert np.nanmax(np.abs(off_line(found, start, end))) < 0.04


# --- what real frames do ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("light", [(60.0, 130.0), (110.0, 240.0), (20.0, 65.0)])
def test_exposure_does_not_move_the_mid_line(light: tuple[float, float]) -> None:
    found = tracker().find(frame(strip(light=light)), moved_by())
    assert found.measured == STATIONS
    assert np.abs(off_line(found, START, END)).max() < 0.03


@pytest.mark.parametrize("blur_px", [0.6, 1.6])
def test_blur_does_not_move_the_mid_line(blur_px: float) -> None:
    found = tracker().find(frame(strip(blur_px=blur_px)), moved_by())
    assert found.measured > 0.9 * STATIONS
    assert abs(np.nanmean(off_line(found, START, END))) < 5e-3


def test_noise_moves_stations_as_far_as_it_must() -> None:
    noise, errors, still = 5.0, [], tracker()
    for seed in range(12):
        found = still.find(frame(strip(), noise, seed), moved_by())
        assert found.measured > 0.9 * STATIONS
        errors.append(off_line(found, START, END))
    # An edge of amplitude A, blurred by b, is known in one column to sqrt(2 b sqrt(pi)) noise / A at best; a station
    # has about 3.75 columns and the mid-line two edges.
    best = noise / 90.0 * np.sqrt(2 * BLUR_PX * np.sqrt(np.pi)) / np.sqrt(2 * 240 / STATIONS)
    spread = float(np.nanstd(errors))
    assert best * 0.8 < spread < 1.6 * best
    assert abs(np.nanmean(errors)) < 4 * spread / np.sqrt(12 * STATIONS)


def test_covered_stations_are_left_out_and_do_not_pull() -> None:
    luma = frame(strip()).copy()
    luma[80:130, 120:160] = 90  # someone stands on the strip
    found = tracker().find(luma, moved_by())
    covered = (np.arange(STATIONS) + 0.5) / STATIONS * 240 + 40 - 140
    inside = np.abs(covered) < 17
    assert np.isnan(found.edges_raw[inside]).all()
    outside = np.abs(covered) > 25
    assert np.isfinite(found.edges_raw[outside]).all()
    assert np.nanmax(np.abs(off_line(found, START, END)[outside])) < 0.02


def test_an_equal_strip_beside_it_is_not_taken() -> None:
    apart = np.array([0.0, 14.0])
    two = strip() + strip(START + apart, END + apart) - 90.0
    luma = frame(two)
    still = tracker(luma, width_px=56.0)
    np.testing.assert_allclose(off_line(still.find(luma, moved_by()), START, END), 0.0, atol=0.03)
    shift = np.array([0.0, 4.0])
    moved = frame(strip(START + shift, END + shift) + strip(START + apart + shift, END + apart + shift) - 90.0)
    found = still.find(moved, moved_by(), search_px=12)
    np.testing.assert_allclose(off_line(found, START + shift, END + shift), 0.0, atol=0.03)


# --- nothing there ---------------------------------------------------------------------------------------------------


def test_a_frame_without_the_strip_gives_nothing() -> None:
    found = tracker().find(frame(np.full(SIZE[::-1], 90.0), 3.0), moved_by())
    assert found.measured == 0
    assert found.correlation < 0.5
    assert NOT_FOUND.measured == 0


@pytest.mark.parametrize("shift", [(0.0, 400.0), (900.0, 0.0), (np.nan, 0.0)])
def test_a_band_outside_the_frame_gives_nothing(shift: tuple[float, float]) -> None:
    assert tracker().find(frame(strip()), moved_by(shift)).measured == 0


def test_a_band_half_outside_is_measured_where_it_is_seen() -> None:
    shift = np.array([150.0, 0.0])
    found = tracker().find(frame(strip(START + shift, END + shift)), moved_by(shift), search_px=4)
    assert 0 < found.measured < STATIONS
    assert np.nanmax(np.abs(off_line(found, START + shift, END + shift))) < 0.03


@pytest.mark.parametrize("grey", [np.full(SIZE[::-1], 90.0), 90.0 + 100.0 * (pixels(SIZE)[..., 1] > 101)])
def test_a_band_without_two_edges_is_refused(grey: Floats) -> None:
    with pytest.raises(InputError, match=r"roof\.L1 holds no line with two edges .* draw the band along a strip"):
        tracker(frame(grey))


def test_a_band_beyond_the_reference_frame_is_refused() -> None:
    with pytest.raises(InputError, match=r"roof\.L1 lies outside the reference frame or is too short"):
        tracker(ends=DRAWN + [0.0, 500.0])


def test_a_narrow_strip_is_found_wherever_it_lies_between_pixels() -> None:
    followed = tracker(frame(strip(width_px=3.0)), width_px=14.0)
    for shift in np.arange(-1.0, 1.0, 0.05):
        moved = (0.0, float(shift))
        found = followed.find(frame(strip(START + moved, END + moved, width_px=3.0)), moved_by(), search_px=4.0)
        assert found.measured == STATIONS, f"moved by {shift:.2f} px"
        assert np.abs(off_line(found, START + moved, END + moved)).max() < 0.04
