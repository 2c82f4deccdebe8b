"""The ground's own relief as a raster: how far it lies above the datum at every place the camera may look at.

The datum is the horizontal plane at the height of the fitted ground plane below the target, so that `height_m` means
height above the ground there. A kerb of four centimetres seen askew from forty metres moves by millimetres; with the
LiDAR's own elevations it stays where it is.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from core.cloud import Cloud, GroundPlane, ground_elevation
from core.coordinates import Floats, read_only
from core.project import write_atomically

CELL_M = 0.25
# A site larger than this is rasterised more coarsely, so that it never takes longer than a few seconds.
MOST_CELLS = 120_000


@dataclass(frozen=True)
class Relief:
    """Elevation of the ground above the datum.

    Attributes:
        west_m, south_m: world coordinates of the first cell's centre.
        cell_m: distance of cells.
        elevation_m: (rows from south, columns from west); 0 where no ground was scanned.
    """

    west_m: float
    south_m: float
    cell_m: float
    elevation_m: Floats

    def at(self, xy_m: Floats) -> Floats:
        """Return elevations (N,) at world places (N, 2), bilinear; 0 beyond the raster."""
        column = (xy_m[:, 0] - self.west_m) / self.cell_m
        row = (xy_m[:, 1] - self.south_m) / self.cell_m
        places = np.nan_to_num(np.stack([row, column]), nan=-1e6)
        return np.asarray(map_coordinates(self.elevation_m, places, order=1, mode="constant", cval=0.0))

    def save(self, file: Path) -> None:
        """Write the raster for the next run."""
        stream = io.BytesIO()
        place = np.array([self.west_m, self.south_m, self.cell_m])
        np.savez_compressed(stream, place=place, elevation_m=self.elevation_m.astype(np.float32))
        write_atomically(file, stream.getvalue())

    @staticmethod
    def load(file: Path) -> Relief | None:
        """Return an earlier raster, or None where there is none that can be read."""
        try:
            with np.load(file) as stored:
                west, south, cell = (float(value) for value in stored["place"])
                return Relief(west, south, cell, read_only(stored["elevation_m"]))
        except (OSError, ValueError, KeyError):
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
    elevation = plane.z_m(places) + above_plane - plane.z_m(at_m)
    return Relief(west, south, cell, read_only(elevation.reshape(x.shape)))
