from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from core.coordinates import Floats
from sample_data.bound import ROUNDING_VARIANCE, patches, strips
from tests.waves import frame, pixels

SIZE = (400, 160)
NOISE = (1.5, 0.02)
LEVEL, SLOPE = 80.0, 3.0


def strip(across_px: float) -> Floats:
    """A bright strip 7 px wide along the rows, blurred by 1 px, its mid-line at a given row: grey levels (h, w)."""
    v = pixels(SIZE)[..., 1] - across_px
    return LEVEL + 45 * (erf((v + 3.5) / np.sqrt(2)) - erf((v - 3.5) / np.sqrt(2)))


def variance(grey: Floats) -> Floats:
    return NOISE[0] ** 2 + NOISE[1] * grey + ROUNDING_VARIANCE


def test_a_strip_tells_what_the_change_of_its_pixels_tells() -> None:
    """Fisher's information on a shift is the squared change of all pixels under it, by their variance."""
    row, step = 80.3, 1e-4
    change = (strip(row + step) - strip(row - step)) / (2 * step)
    between = slice(30, 371)
    exact = float((change**2 / variance(strip(row)))[:, between].sum())
    along = np.linspace(30.0, 370.0, 64)
    edges = np.stack([np.stack([along, np.full(64, row + side)], axis=1) for side in (-3.5, 3.5)], axis=1)
    told = strips(frame(strip(row)), edges[None], NOISE)
    assert told.information[:, 1, 1].sum() == pytest.approx(exact, rel=0.12)
    # A line says nothing along itself.
    assert np.abs(told.information[:, 0, 0]).max() < 1e-9 * told.information[:, 1, 1].max()


def test_a_patch_on_a_slope_tells_of_the_slope_alone() -> None:
    ramp = LEVEL + SLOPE * (pixels(SIZE)[..., 0] % 40)
    told = patches(frame(ramp), np.array([[100.0, 80.0]]), NOISE).information[0]
    assert told[0, 0] > 0
    assert abs(told[1, 1]) < 1e-9
    # 21 x 21 pixels with a gradient of 3 grey levels, each with its own noise.
    seen = ramp[70:91, 90:111]
    assert told[0, 0] == pytest.approx((SLOPE**2 / variance(seen)).sum(), rel=0.02)
