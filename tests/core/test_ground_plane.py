from __future__ import annotations

import numpy as np
import pytest

from core.cloud import Cloud, make_cloud
from core.errors import InputError
from core.ground_plane import fit_ground_plane, ground_elevation, height_at
from tests.scanned_site import ORIGIN, ROOF_M, SLOPE, relief, site


@pytest.fixture(scope="module")
def building() -> Cloud:
    return site()


def test_the_plane_is_the_ground_not_the_roof(building):
    plane = fit_ground_plane(building)
    places = ORIGIN[:2] + np.random.default_rng(1).uniform(-15, 15, (100, 2))
    true = (places - ORIGIN[:2]) @ SLOPE + ORIGIN[2]
    # The waves of the relief do not average out over the site to better than a few millimetres.
    np.testing.assert_allclose(plane.z_m(places), true, atol=0.008)
    assert plane.tilt_rad == pytest.approx(np.hypot(*SLOPE), abs=5e-4)
    # Standard deviation of the relief alone: 0.04 / 2.
    assert plane.elevation_std_m == pytest.approx(0.02, abs=0.004)
    assert plane.elevation_p5_m == pytest.approx(-0.035, abs=0.008)
    assert plane.elevation_p95_m == pytest.approx(0.035, abs=0.008)
    assert plane.area_m2 > 800


def test_the_plane_is_the_same_each_time_and_exact_without_noise(building):
    assert fit_ground_plane(building) == fit_ground_plane(building)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-10, 10, 0.1), np.arange(-10, 10, 0.1)))
    flat = make_cloud(np.column_stack([x, y, 0.02 * x - 0.01 * y]) + ORIGIN)
    plane = fit_ground_plane(flat)
    assert plane.slope == pytest.approx((0.02, -0.01), abs=1e-9)
    assert plane.elevation_std_m < 1e-6


def test_a_plane_can_be_set_by_hand(building):
    plane = fit_ground_plane(building, ground_z_m=113.05)
    assert plane.z_m(ORIGIN[:2] + 7) == pytest.approx(113.05)
    assert plane.tilt_rad == 0
    with pytest.raises(InputError, match=r"without ground at z = 80\.00 m; correct orthoimage\.ground_z_m"):
        fit_ground_plane(building, ground_z_m=80.0)


def test_a_cloud_without_ground_is_refused():
    random = np.random.default_rng(0)
    wall = np.column_stack([random.uniform(-9, 9, 9000), np.zeros(9000), random.uniform(0, 30, 9000)])
    steep = random.uniform(-9, 9, (9000, 2))
    steep = np.column_stack([steep, 0.7 * steep[:, 0]])
    mist = random.uniform(-15, 15, (9000, 3))
    for points in (wall, steep, mist, mist[:5]):
        with pytest.raises(InputError, match="a cloud without ground"):
            fit_ground_plane(make_cloud(points))


def test_elevation_of_the_ground_is_good_to_millimetres(building):
    plane = fit_ground_plane(building)
    places = np.random.default_rng(2).uniform(-13, 13, (1500, 2))
    places = places[(np.abs(places) > [6.7, 4.7]).any(axis=1)]
    found = ground_elevation(building, plane, places + ORIGIN[:2])
    true = relief(places) + places @ SLOPE + ORIGIN[2] - plane.z_m(places + ORIGIN[:2])
    assert np.isfinite(found).all()
    # Some ten to twenty points of 4 mm noise, the nearest of which count most.
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.0025
    assert abs(np.mean(found - true)) < 0.0003


def test_elevation_ignores_objects_and_stays_unknown_where_nothing_is(building):
    plane = fit_ground_plane(building)
    random = np.random.default_rng(5)
    # A crate of 25 cm beside the place, scanned as densely as the ground.
    crate = np.column_stack([random.uniform(9.15, 9.3, 8), random.uniform(0.0, 0.3, 8), np.full(8, 0.25)])
    objects = make_cloud(np.concatenate([building.world_m, crate + ORIGIN]))
    place = np.array([[9.05, 0.15]])
    before = ground_elevation(building, plane, place + ORIGIN[:2])
    assert ground_elevation(objects, plane, place + ORIGIN[:2]) == pytest.approx(before, abs=0.01)
    nowhere = np.array([[0.0, 0.0], [500.0, 500.0], [np.nan, 0.0]])
    assert np.isnan(ground_elevation(building, plane, nowhere + ORIGIN[:2])).all()
    assert ground_elevation(building, plane, np.empty((0, 2))).shape == (0,)


def test_height_of_a_clicked_place_is_that_of_the_upper_surface(building):
    plane = fit_ground_plane(building)
    # At the very edge of the roof most points are on the wall.
    for place in ([0.0, 0.0], [3.0, 3.95]):
        height_m, spread_m, count = height_at(building, plane, ORIGIN[:2] + place)
        true = ROOF_M + ORIGIN[2] - plane.z_m(ORIGIN[:2] + place)
        assert height_m == pytest.approx(true, abs=0.003)
        assert spread_m < 0.05
        assert count > 20
    assert height_at(building, plane, ORIGIN[:2] + [9.0, 9.0])[0] == pytest.approx(0.0, abs=0.06)
    bird = make_cloud(np.concatenate([building.world_m, ORIGIN + [[0.0, 0.0, 25.0]]]))
    assert height_at(bird, plane, ORIGIN[:2])[0] == pytest.approx(ROOF_M, abs=0.01)
    with pytest.raises(InputError, match=r"only 0 points of the cloud lie within 0\.3 m"):
        height_at(building, plane, ORIGIN[:2] + 300)
