from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from core.camera import Pose, project
from core.cloud import make_cloud
from core.coordinates import Bools, Floats
from core.errors import InputError
from core.ground_plane import fit_ground_plane
from core.project import Project
from core.relief import Relief, rasterise
from core.run import relief_plan
from tests.small_project import document

SITE_M = np.array([651_234.0, 3_872_345.0])
CAMERA = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 40.0]))
# West, south, east, north and height: a container, a pit, and a few echoes of a person.
CONTAINER, PIT, PERSON = (3.0, -1.0, 5.0, 1.0, 2.0), (-6.0, -6.0, -4.0, -4.0, -1.0), (-2.0, 4.0, -1.6, 4.4, 1.7)


def inside(xy: Floats, box: tuple[float, ...]) -> Bools:
    return np.asarray((xy >= box[:2]).all(axis=1) & (xy <= box[2:4]).all(axis=1))


@lru_cache
def site() -> Relief:
    """A slope with things on it, scanned at every five centimetres."""
    xy = np.stack(np.meshgrid(*[np.arange(-12.0, 12.0, 0.05)] * 2), axis=-1).reshape(-1, 2)
    z = 0.01 * xy[:, 0]
    for box in (CONTAINER, PIT):
        z[inside(xy, box)] = box[4] + 0.01 * xy[inside(xy, box), 0]
    person = np.random.default_rng(1).uniform([*PERSON[:2], 0.5], [*PERSON[2:4], PERSON[4]], (20, 3))
    cloud = make_cloud(np.concatenate([np.column_stack([xy, z]), person]) + [*SITE_M, 113.0])
    extent = (SITE_M[0] - 12, SITE_M[1] - 12, SITE_M[0] + 12, SITE_M[1] + 12)
    return rasterise(cloud, fit_ground_plane(cloud), extent, SITE_M)


def shown(*places: tuple[float, float, float], reach_m: float = 0.2) -> list[bool]:
    """Return whether lines of sight to places (x, y, z) show the ground there."""
    rays = project(CAMERA.R, CAMERA.centre_m, np.array(places))
    return site().shows_ground(rays, CAMERA, SITE_M, reach_m).tolist()


def test_ground_is_shown_where_nothing_stands() -> None:
    assert shown((-8.0, 3.0, 0.0), (9.0, -9.0, 0.0), (30.0, 0.0, 0.0)) == [True, True, True]
    # A person who walked through the scan covers no ground.
    assert shown((-1.8, 4.2, 0.0)) == [True]


def test_what_stands_at_a_place_has_a_height() -> None:
    def stands_at(*places: tuple[float, float]) -> float | None:
        return site().stands_at(np.array(places) + SITE_M)

    assert stands_at((3.5, 0.0), (4.0, 0.5), (9.0, 9.0)) == pytest.approx(2.0 + 0.01 * 4, abs=0.02)
    assert stands_at((-8.0, 3.0), (9.0, -9.0), (4.0, 0.5)) is None
    assert stands_at((30.0, 0.0)) is None


def test_no_ground_is_shown_on_things_behind_them_and_in_pits() -> None:
    on_top, in_the_pit = (4.0, 0.5, 2.0), (-5.0, -5.0, -1.0)
    assert shown(on_top, in_the_pit) == [False, False]
    # The line of sight to this place passes through the far side of the container.
    assert shown((5.1, 0.0, 0.0), reach_m=0.0) == [False]
    assert shown((5.6, 0.0, 0.0), reach_m=0.0) == [True]


def test_a_feature_that_reaches_onto_things_shows_no_ground() -> None:
    beside = (2.4, 0.0, 0.0)
    assert shown(beside, reach_m=0.2) == [True]
    assert shown(beside, reach_m=0.8) == [False]


def test_elevation_is_that_of_the_ground_below_things() -> None:
    places = np.array([[-8.0, 3.0], [8.0, 0.0], [4.0, 0.0]]) + SITE_M
    np.testing.assert_allclose(site().at(places)[:2], [-0.08, 0.08], atol=0.01)
    assert abs(site().at(places)[2]) < 0.1


def test_what_is_stored_is_found_again(tmp_path: Path) -> None:
    site().save(tmp_path / "relief.npz")
    again = Relief.load(tmp_path / "relief.npz")
    assert again is not None
    np.testing.assert_allclose(again.elevation_m, site().elevation_m, atol=1e-6)
    np.testing.assert_allclose(again.standing_m, site().standing_m, atol=1e-6)
    (tmp_path / "broken.npz").write_bytes((tmp_path / "relief.npz").read_bytes()[:500])
    assert Relief.load(tmp_path / "broken.npz") is None


def test_a_cloud_that_is_not_there_is_named_with_its_remedy(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"site\.csv: not found; correct inputs\.cloud"):
        relief_plan(tmp_path, Project.model_validate(document()))
