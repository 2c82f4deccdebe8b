from __future__ import annotations

import numpy as np
import pytest

from core.apparent import Apparent
from core.camera import exponential
from core.coordinates import Floats
from core.measurements import FrameMeasurement
from core.prediction import MOST_STEPS, predict_apparent, predict_homography

TURN_RAD = np.array([0.002, -0.001, 0.0005])


def measured(time_s: float, H_ray_ray0: Floats, shift: float) -> FrameMeasurement:
    nothing = np.empty((0, 2))
    apparent = Apparent(np.array([shift, 0.0]), 0.01 * shift)
    return FrameMeasurement(0, time_s, H_ray_ray0, nothing, {"roof": nothing}, {"roof": apparent})


def before() -> list[FrameMeasurement]:
    """Two frames, 0.04 s apart, of a camera that turns and a roof that moves steadily."""
    return [measured(0.96, exponential(TURN_RAD), 0.1), measured(1.0, exponential(2 * TURN_RAD), 0.2)]


@pytest.mark.parametrize(
    ("time_s", "steps"), [(1.04, 1.0), (1.02, 0.5), (1.06, 1.5), (1.08, 2.0), (2.4, MOST_STEPS), (9.0, MOST_STEPS)]
)
def test_camera_and_roof_go_on_for_as_long_as_a_frame_lies_ahead(time_s: float, steps: float) -> None:
    H = predict_homography(before(), time_s)
    assert H is not None
    expected = exponential((2 + steps) * TURN_RAD)
    # A thousandth of what the camera turns by between two frames.
    np.testing.assert_allclose(H / H[2, 2], expected / expected[2, 2], atol=2e-5)
    apparent = predict_apparent(before(), "roof", time_s)
    assert apparent is not None
    np.testing.assert_allclose(apparent.shift, [0.2 + 0.1 * steps, 0.0], atol=1e-12)
    assert apparent.step == pytest.approx(0.1)


def test_what_was_not_seen_predicts_nothing() -> None:
    lost = FrameMeasurement(0, 1.0, np.full((3, 3), np.nan), np.empty((0, 2)), {}, {"roof": None})
    assert predict_homography([], 1.0) is None
    assert predict_homography([before()[0], lost], 1.04) is None
    assert predict_apparent([before()[0], lost], "roof", 1.04) is None
    one = predict_homography([lost, before()[1]], 1.04)
    np.testing.assert_array_equal(one, before()[1].H_ray_ray0)
