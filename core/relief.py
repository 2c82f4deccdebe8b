"""The ground's own relief as a raster: how far it lies above the datum at every place the camera may look at.

The datum is the horizontal plane at the height of the fitted ground plane below the target, so that `height_m` means
height above the ground there. A kerb of four centimetres seen askew from forty metres moves by millimetres; with the
LiDAR's own elevations it stays where it is. A container two metres high would move by centimetres: what stands on the
ground is kept as well, so that nobody takes its features for the ground's.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from scipy.ndimage import map_coordinates, maximum_filter

from core.camera import Pose, intersect_height
from core.cloud import Cloud
from core.coordinates import Bools, Floats, batches, read_only
from core.ground_plane import PASS_POINTS, RELIEF_REACH_M, GroundPlane, ground_elevation
from core.storage import write_atomically

CELL_M = 0.25
# A site larger than this is rasterised more coarsely, so that it never takes longer than a few seconds.
MOST_CELLS = 120_000
# What is seen along a line of sight is looked for at heights so far apart.
SIGHT_STEP_M = 0.25


@dataclass(frozen=True)
class Relief:
    """Elevation of the ground above the datum.

    Attributes:
        west_m, south_m: world coordinates of the first cell's centre.
        cell_m: distance of cells.
        elevation_m: (rows from south, columns from west); 0 where no ground was scanned.
        standing_m: the same of what stands on the ground or lies deep below it; 0 where there is only ground.
    """

    west_m: float
    south_m: float
    cell_m: float
    elevation_m: Floats
    standing_m: Floats

    def at(self, xy_m: Floats) -> Floats:
        """Return elevations (N,) at world places (N, 2), bilinear; 0 beyond the raster."""
        places = self._places(xy_m)
        return np.asarray(map_coordinates(self.elevation_m, places, order=1, mode="constant", cval=0.0))

    def shows_ground(self, rays: Floats, pose: Pose, origin_m: Floats, reach_m: float) -> Bools:
        """Return which rays (N, 2) of a pose meet the ground, and nothing else within a horizontal distance.

        Args:
            pose: relative to `origin_m` (2,), the datum at z = 0.
            reach_m: how far around each ray its feature reaches.
        """
        side = 2 * int(np.ceil(reach_m / self.cell_m)) + 1
        top, bottom = maximum_filter(self.standing_m, side), -maximum_filter(-self.standing_m, side)
        highest = min(float(top.max()), float(pose.centre_m[2]) - SIGHT_STEP_M)
        shown = self._of_cell(bottom, intersect_height(pose.R, pose.centre_m, rays, 0.0) + origin_m) >= 0.0
        for height in np.arange(RELIEF_REACH_M, highest + SIGHT_STEP_M, SIGHT_STEP_M):
            places = intersect_height(pose.R, pose.centre_m, rays, height) + origin_m
            shown &= self._of_cell(top, places) < height
        return np.asarray(shown, dtype=np.bool_)

    def stands_at(self, xy_m: Floats) -> float | None:
        """Return how high above the datum lies what stands at most of some places (N, 2); None where nothing does."""
        heights = self._of_cell(self.standing_m, xy_m)
        standing = heights[heights != 0.0]
        return float(np.median(standing)) if 2 * len(standing) > len(heights) else None

    def _of_cell(self, raster: Floats, xy_m: Floats) -> Floats:
        """Return the value (N,) of the cell in which each place (N, 2) lies; 0 beyond the raster."""
        return np.asarray(map_coordinates(raster, self._places(xy_m), order=0, mode="grid-constant", cval=0.0))

    def _places(self, xy_m: Floats) -> Floats:
        """Return rows and columns (2, N) of world places (N, 2), far beyond the raster where these are nan."""
        column = (xy_m[:, 0] - self.west_m) / self.cell_m
        row = (xy_m[:, 1] - self.south_m) / self.cell_m
        return np.nan_to_num(np.stack([row, column]), nan=-1e6)

    def save(self, file: Path) -> None:
        """Write the raster for the next run."""
        stream = io.BytesIO()
        place = np.array([self.west_m, self.south_m, self.cell_m])
        rasters = {name: getattr(self, name).astype(np.float32) for name in ("elevation_m", "standing_m")}
        np.savez_compressed(stream, place=place, **rasters)
        write_atomically(file, stream.getvalue())

    @staticmethod
    def load(file: Path) -> Relief | None:
        """Return an earlier raster, or None where there is none that can be read."""
        try:
            with file.open("rb") as stream, np.load(stream) as stored:
                west, south, cell = (float(value) for value in stored["place"])
                return Relief(west, south, cell, read_only(stored["elevation_m"]), read_only(stored["standing_m"]))
        except (OSError, ValueError, KeyError, BadZipFile):
            return None


def rasterise(cloud: Cloud, plane: GroundPlane, extent_m: tuple[float, float, float, float], at_m: Floats) -> Relief:
    """Return the relief within an extent.

    Args:
        extent_m: west, south, east, north.
        at_m: (2,) where the datum meets the ground plane.
    """
    west, south, east, north = extent_m
    cell = max(CELL_M, float(np.sqrt((east - west) * (north - south) / MOST_CELLS)))
    x, y = np.meshgrid(np.arange(west, east + cell, cell), np.arange(south, north + cell, cell))
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    above_plane = np.nan_to_num(ground_elevation(cloud, plane, places))
    datum = plane.z_m(places) - plane.z_m(at_m)
    standing = _standing(cloud, plane, corner_m=np.array([west, south]), cell_m=cell, shape=x.shape)
    return Relief(
        west,
        south,
        cell,
        elevation_m=read_only((datum + above_plane).reshape(x.shape)),
        standing_m=read_only(np.where(standing == 0.0, 0.0, datum.reshape(x.shape) + standing)),
    )


def _standing(cloud: Cloud, plane: GroundPlane, *, corner_m: Floats, cell_m: float, shape: tuple[int, ...]) -> Floats:
    """Return how high above the plane lies what most points of a cell show, 0 where that is ground, or nothing."""
    points, high, height = (np.zeros(shape[0] * shape[1]) for _ in range(3))
    for batch in batches(len(cloud.points_m), PASS_POINTS):
        some = cloud.select(batch)
        cells = np.rint((some.points_m[:, :2] + some.origin_m[:2] - corner_m) / cell_m).astype(np.int64)
        inside = ((cells >= 0) & (cells < np.array(shape[::-1]))).all(axis=1)
        number, above = cells[inside] @ [1, shape[1]], plane.height_of(some)[inside]
        stands = np.abs(above) >= RELIEF_REACH_M
        points += np.bincount(number, minlength=len(points))
        high += np.bincount(number[stands], minlength=len(points))
        height += np.bincount(number[stands], above[stands], len(points))
    return np.where(2 * high > points, height / np.maximum(high, 1), 0.0).reshape(shape)
