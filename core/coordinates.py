"""Frames of reference, the pixel-centre rule, and homographies between planes.

| name    | meaning                                                                                     |
|---------|---------------------------------------------------------------------------------------------|
| `raw`   | decoded, upright video pixels, lens distortion in; (0, 0) is the centre of the top-left pixel |
| `und`   | undistorted pixels, same camera matrix                                                      |
| `ortho` | orthoimage pixels, u east, v south; (0, 0) is the centre of the north-west pixel             |
| `plan`  | metres as if on the ground plane: true for the ground, displaced and enlarged for the roof   |
| `world` | metres, right-handed, z up; true at the target's own height                                  |

A homography is named by where it leads and whence, `H_target_source`, so that in a right chain the inner
names cancel: `H_plan_undk = H_plan_und0 @ H_und0_undk`. (`canvas`, the browser's CSS pixels, exists only in
one JavaScript module.)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# No coordinate on Earth is larger, not even an easting with the number of its zone before it.
LARGEST_M = 1e8


def read_only(array: ArrayLike) -> Floats:
    """Return a float64 copy that cannot be written to, for use inside frozen dataclasses."""
    copy = np.array(array, dtype=np.float64)
    copy.flags.writeable = False
    return copy


def is_in_frame(place_px: tuple[float, float], width: int, height: int) -> bool:
    """Whether raw pixels lie on the frame, whose outermost pixels reach half a pixel beyond their centres."""
    u, v = place_px
    return -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5


def apply_homography(H: ArrayLike, points: ArrayLike) -> Floats:
    """Map points through a homography.

    Args:
        H: (3, 3), any scale.
        points: (..., 2).

    Returns:
        (..., 2); points on the line at infinity become inf or nan.
    """
    H = np.asarray(H, dtype=np.float64)
    points = np.asarray(points, dtype=np.float64)
    mapped = points @ H[:, :2].T + H[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return mapped[..., :2] / mapped[..., 2:]


def invert_homography(H: ArrayLike) -> Floats:
    """Return the homography that leads back, scaled so that its last element is 1."""
    inverse = np.linalg.inv(np.asarray(H, dtype=np.float64))
    return inverse / inverse[2, 2]


def homography_jacobian(H: Floats, points: Floats) -> Floats:
    """Return the derivatives (N, 2, 2) of `apply_homography(H, points)` by the points (N, 2)."""
    mapped = points @ H[:, :2].T + H[:, 2]
    xy = mapped[:, :2] / mapped[:, 2:]
    return np.asarray((H[:2, :2] - xy[:, :, None] * H[2, :2]) / mapped[:, 2, None, None])


def invert_2x2(matrices: Floats) -> Floats:
    """Return the inverses of matrices (..., 2, 2); of many small ones several times as quick as `np.linalg.inv`."""
    a, b, c, d = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 0], matrices[..., 1, 1]
    adjugate = np.empty_like(matrices)
    adjugate[..., 0, 0], adjugate[..., 0, 1], adjugate[..., 1, 0], adjugate[..., 1, 1] = d, -b, -c, a
    return np.asarray(adjugate / (a * d - b * c)[..., None, None])


def finite_rows(points: Floats) -> Bools:
    """Return which points (..., D) have all their coordinates, (...)."""
    return np.asarray(np.isfinite(points).all(axis=-1), dtype=np.bool_)


def batches(count: int, size: int) -> Iterator[slice]:
    """Yield slices of at most `size` that cover `count` places; one empty slice where there are none."""
    return (slice(first, first + size) for first in range(0, max(count, 1), size))


def evenly_spread(count: int, most: int) -> NDArray[np.int64]:
    """Return at most `most` of the numbers below `count`, ascending and evenly spread, both ends included."""
    return np.unique(np.linspace(0, count - 1, most).astype(np.int64)) if count > 0 else np.empty(0, dtype=np.int64)


def rotation_2d(angle_rad: float) -> Floats:
    """Return the (2, 2) matrix that turns plane vectors counter-clockwise by an angle."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


@dataclass(frozen=True)
class OrthoGrid:
    """The raster of an orthoimage: where its pixels lie on the ground, north up.

    Attributes:
        west_m, north_m: world coordinates of the *outer corner* of the north-west pixel.
        pixel_size_m: edge of a pixel on the ground.
        width, height: pixels.
    """

    west_m: float
    north_m: float
    pixel_size_m: float
    width: int
    height: int

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """(west, south, east, north) of the outer pixel edges, metres."""
        return (
            self.west_m,
            self.north_m - self.height * self.pixel_size_m,
            self.west_m + self.width * self.pixel_size_m,
            self.north_m,
        )

    @property
    def H_world_ortho(self) -> Floats:
        """(3, 3) from pixel centres (u east, v south) to metres (x east, y north): the one place with the mirror."""
        g = self.pixel_size_m
        return np.array([[g, 0.0, self.west_m + g / 2], [0.0, -g, self.north_m - g / 2], [0.0, 0.0, 1.0]])

    @property
    def H_ortho_world(self) -> Floats:
        """(3, 3) from metres to pixel centres."""
        return np.asarray(np.linalg.inv(self.H_world_ortho), dtype=np.float64)
