from __future__ import annotations

import numpy as np
import pytest

from core.camera import Pose
from core.errors import InputError
from core.project import Band, Lines, Target
from core.roof_level import (
    distance_doubt,
    height_doubt,
    height_obstacle,
    refuse_if,
    scale_at_roof,
    scale_obstacle,
)

BAND = Band(from_m=(0.0, 0.0), to_m=(1.0, 0.0))
CAMERA = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 40.0]))
PLACES_M = np.array([[0.0, 1.0], [0.0, -1.0]])


def roof(*, height_m: float | None = None, p1_p2_m: float | None = None) -> Target:
    return Target(name="roof", height_m=height_m, p1_p2_m=p1_p2_m, lines=Lines(L1=BAND, L2=BAND, T1=BAND))


def test_geometric_needs_a_height_below_the_camera() -> None:
    assert height_obstacle(roof(height_m=39.9), CAMERA) is None
    assert height_obstacle(roof(height_m=41.0), None) is None
    assert (height_obstacle(roof(), CAMERA) or "").startswith("height_m: missing")
    assert "height_m: 40, but by the clicks the camera hovers 40.0 m" in (
        height_obstacle(roof(height_m=40), CAMERA) or ""
    )


def test_paper_needs_a_distance_or_a_height_and_a_lens() -> None:
    assert scale_obstacle(roof(p1_p2_m=1.2), None, has_lens=False) is None
    assert scale_obstacle(roof(height_m=10.0), CAMERA, has_lens=True) is None
    assert (scale_obstacle(roof(height_m=10.0), None, has_lens=False) or "").startswith("p1_p2_m: missing")
    points = Target(name="roof", kind="points", region_m=((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)), p1_p2_m=1.2)
    assert (scale_obstacle(points, CAMERA, has_lens=True) or "").startswith('kind: "points"')


def test_paper_believes_no_roof_above_the_camera() -> None:
    """Its scale would be negative: the roof would move the other way."""
    assert "the camera hovers 40.0 m" in (scale_obstacle(roof(height_m=50.0), CAMERA, has_lens=True) or "")


def test_an_obstacle_is_refused_with_its_place() -> None:
    refuse_if(None, roof())
    with pytest.raises(InputError, match=r"^project\.json: targets\.roof\.height_m: missing, .*\.$"):
        refuse_if(height_obstacle(roof(), CAMERA), roof())


def test_a_roof_half_way_to_the_camera_appears_twice_as_large() -> None:
    assert scale_at_roof(roof(), PLACES_M, height_m=20.0, camera=CAMERA) == pytest.approx(0.5)
    assert scale_at_roof(roof(p1_p2_m=1.2), PLACES_M, height_m=20.0, camera=CAMERA) == pytest.approx(0.6)


def test_a_height_is_doubted_where_the_cloud_shows_another() -> None:
    """Two percent of what lies between roof and camera, 20 m here, are two percent of every displacement."""
    assert height_doubt(roof(height_m=20.0), 20.35, CAMERA) is None
    assert height_doubt(roof(height_m=20.0), None, CAMERA) is None
    told = height_doubt(roof(height_m=20.0), 21.0, CAMERA)
    assert "height_m of roof is 20.00 m, but the point cloud shows it 21.00 m above the ground" in (told or "")


def test_a_distance_is_doubted_that_the_height_does_not_give() -> None:
    assert distance_doubt(roof(p1_p2_m=1.97), PLACES_M, height_m=20.0) is None
    assert distance_doubt(roof(), PLACES_M, height_m=20.0) is None
    told = distance_doubt(roof(p1_p2_m=1.8), PLACES_M, height_m=20.0)
    assert "P1 and P2 of roof lie 2.000 m apart where it is 20.00 m high, but p1_p2_m is 1.800 m" in (told or "")
