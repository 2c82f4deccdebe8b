"""What is shown while bands are drawn: strips known exactly, seen by a camera straight above them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.special import erf

from core.coordinates import Floats
from core.georeference import ReferenceFit, fit_reference
from core.lens import Lens
from core.preview import band_outline, preview_bands, preview_target
from core.project import Band, Correspondence, Lines, Target
from core.video import Luma
from tests.waves import frame, pixels, waves

SIZE = (480, 360)
LENS = Lens.ideal(SIZE, 480.0)
CAMERA_M, HEIGHT_M = 12.0, 3.0
PX_PER_M = 480.0 / CAMERA_M  # on the ground
SITE_M = np.array([5000.0, 8000.0])
STRIP_M = 0.15
# Where the strips appear on the ground: L1 and L2 run east, T1 north; the camera is above the site's origin.
NORTH_M, EAST_M = {"L1": 0.8, "L2": -0.8}, 0.4
BANDS = {
    "L1": Band(from_m=(4998.0, 8000.83), to_m=(5002.0, 8000.78), width_m=0.6),
    "L2": Band(from_m=(4998.0, 7999.2), to_m=(5002.0, 7999.2), width_m=0.6),
    "T1": Band(from_m=(5000.4, 7998.0), to_m=(5000.4, 8002.0), width_m=0.6),
}


def raw(plan_m: Floats) -> Floats:
    """Raw pixels (..., 2) of places on the ground (..., 2)."""
    return LENS.centre_px + (plan_m - SITE_M) * PX_PER_M * np.array([1.0, -1.0])


def strips(width_m: float = STRIP_M) -> Luma:
    east, north = np.moveaxis((pixels(SIZE) - LENS.centre_px) / PX_PER_M * [1.0, -1.0], -1, 0)

    def strip(off_m: Floats) -> Floats:
        half, blur = width_m / 2 * PX_PER_M, 0.9 * np.sqrt(2)
        off_px = off_m * PX_PER_M
        return (erf((off_px + half) / blur) - erf((off_px - half) / blur)) / 2

    white = [strip(east - EAST_M), *(strip(north - at_m) for at_m in NORTH_M.values())]
    return frame(80.0 + 100.0 * np.max(white, axis=0))


@pytest.fixture(scope="module")
def luma() -> Luma:
    return strips()


def fitted(*, has_lens: bool = True) -> ReferenceFit:
    places = SITE_M + np.array([(-5, -4), (5, -4), (5, 4), (-5, 4), (0, 3), (-3, 0)], dtype=float)
    pairs = [
        Correspondence(id=number, ground_m=tuple(place), frame_px=tuple(raw(place)))
        for number, place in enumerate(places, 1)
    ]
    return fit_reference(pairs, LENS, has_lens=has_lens)


def roof(**changes: Any) -> Target:
    return Target.model_validate({"name": "roof", "height_m": HEIGHT_M, "lines": Lines(**BANDS), **changes})


def test_lines_and_points_are_shown_where_they_are(luma: Luma) -> None:
    seen = preview_target(luma, roof(), fitted())
    assert {name: line.message for name, line in seen.lines.items()} == {"L1": "", "L2": "", "T1": ""}
    for name, at_m in NORTH_M.items():
        line = seen.lines[name]
        assert line.midline_plan is not None
        assert line.midline_raw is not None
        assert line.rms_px is not None
        # A hundredth of a pixel on the line, 40 px/m.
        np.testing.assert_allclose(line.midline_plan[:, 1], SITE_M[1] + at_m, atol=5e-4)
        np.testing.assert_allclose(line.midline_raw, raw(line.midline_plan), atol=1e-3)
        assert line.rms_px < 0.05
        width_m = np.linalg.norm(line.edges_plan[:, 1] - line.edges_plan[:, 0], axis=-1)
        assert float(np.median(width_m)) == pytest.approx(STRIP_M, abs=0.01)
    for point, at_m in ((seen.p1, NORTH_M["L1"]), (seen.p2, NORTH_M["L2"])):
        assert point is not None
        assert point.world_m is not None
        np.testing.assert_allclose(point.plan_m, SITE_M + [EAST_M, at_m], atol=1e-3)
        np.testing.assert_allclose(point.raw_px, raw(point.plan_m), atol=1e-3)
        # Three metres up of twelve, all is seen a third larger than it is, about the point below the camera.
        np.testing.assert_allclose(point.world_m, SITE_M + 0.75 * np.array([EAST_M, at_m]), atol=1e-3)


def test_the_distance_of_p1_and_p2_is_held_against_the_given_one(luma: Luma) -> None:
    seen = preview_target(luma, roof(p1_p2_m=1.0), fitted())
    assert seen.message == "P1–P2 measures 1.200 m; 1.000 m is given."
    assert seen.p1_p2_error == pytest.approx(0.2, abs=2e-3)
    assert preview_target(luma, roof(), fitted()).message == ""


@pytest.mark.parametrize(("has_lens", "height_m"), [(False, HEIGHT_M), (True, None)])
def test_without_lens_or_height_points_have_no_place_in_the_world(
    luma: Luma, has_lens: bool, height_m: float | None
) -> None:
    seen = preview_target(luma, roof(height_m=height_m, p1_p2_m=1.0), fitted(has_lens=has_lens))
    assert seen.p1 is not None
    assert seen.p1.world_m is None
    assert (seen.message, seen.p1_p2_error) == ("", None)


def test_bands_may_still_be_missing(luma: Luma) -> None:
    fit = fitted()
    alone = preview_bands(luma, {"L1": BANDS["L1"]}, fit, name="roof")
    assert alone.lines["L1"].midline_plan is not None
    assert (alone.p1, alone.p2) == (None, None)
    half = preview_bands(luma, {"L2": BANDS["L2"], "T1": BANDS["T1"]}, fit, name="roof")
    assert half.p1 is None
    assert half.p2 is not None


def test_a_band_without_a_strip_or_outside_the_frame_says_so(luma: Luma) -> None:
    empty = Band(from_m=(4998.0, 8002.0), to_m=(5000.0, 8002.0), width_m=0.5)
    beyond = Band(from_m=(5090.0, 8000.0), to_m=(5092.0, 8000.0), width_m=0.5)
    seen = preview_bands(luma, {"L1": empty, "L2": beyond, "T1": BANDS["T1"]}, fitted(), name="roof")
    for name in ("L1", "L2"):
        line = seen.lines[name]
        assert line.midline_plan is None
        assert line.message.startswith(f"targets.roof.lines.{name}")
        assert line.message.endswith(".")
        assert len(line.band_raw) == 34
    assert seen.lines["T1"].midline_plan is not None
    assert (seen.p1, seen.p2) == (None, None)


def test_of_a_dragged_band_the_others_are_not_looked_for_again(luma: Luma) -> None:
    fit = fitted()
    before = preview_bands(luma, BANDS, fit, name="roof")
    dragged = Band(from_m=(4998.0, 8000.8), to_m=(5002.0, 8000.8), width_m=0.6)
    after = preview_bands(luma, {**BANDS, "L1": dragged}, fit, name="roof")
    assert after.lines["T1"] is before.lines["T1"]
    assert after.lines["L1"] is not before.lines["L1"]
    assert preview_bands(luma, BANDS, fitted(), name="roof").lines["T1"] is not before.lines["T1"]


def test_patches_of_a_textured_region_are_shown() -> None:
    texture = frame(waves(4)(pixels(SIZE)))
    region = ((4997.0, 7998.0), (5003.0, 7998.0), (5003.0, 8002.0), (4997.0, 8002.0))
    target = Target(name="roof", kind="points", height_m=HEIGHT_M, region_m=region)
    seen = preview_target(texture, target, fitted())
    assert seen.message == ""
    assert len(seen.points_raw) > 20
    np.testing.assert_allclose(raw(seen.points_plan), seen.points_raw, atol=1e-3)
    lowest, highest = seen.region_raw.min(axis=0), seen.region_raw.max(axis=0)
    assert ((seen.points_raw > lowest) & (seen.points_raw < highest)).all()
    plain = preview_target(frame(np.full(SIZE[::-1], 90.0)), target, fitted())
    assert "shows too little texture" in plain.message
    assert not len(plain.points_raw)


def test_the_outline_of_a_band_goes_round_it() -> None:
    outline = band_outline(Band(from_m=(0.0, 0.0), to_m=(4.0, 0.0), width_m=1.0))
    assert outline.shape == (34, 2)
    np.testing.assert_allclose(outline[[0, 16, 17, 33]], [[0, 0.5], [4, 0.5], [4, -0.5], [0, -0.5]])
    np.testing.assert_allclose(np.abs(outline[:, 1]), 0.5)
