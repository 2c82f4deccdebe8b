"""The ground in a point cloud: its plane, its relief, and how high above it anything stands.

Places are in the cloud's own coordinates (`world`, metres, right-handed, z up).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from core.cloud import Cloud
from core.coordinates import Floats, batches
from core.errors import InputError
from core.robust import BY_MEDIAN, robust_sigma

# A site's ground may fall towards a drain, but a plane steeper than this is a roof, a ramp or a wall.
_MAX_TILT_RAD = np.radians(12.0)
# Half the thickness of the slab in which the first search counts ground: grass, kerbs and relief fit in.
_SLAB_M = 0.15
# A surface must cover this part of the largest one's area to count as dominant.
_DOMINANT_SHARE = 0.25
_GROUND_CELL_M = 0.5
# A plane over half-metre cells gains nothing from more points than this.
_PLANE_POINTS = 1_000_000
# How far above or below the plane a point may lie and still be ground relief, not an object.
RELIEF_REACH_M = 0.35
_RELIEF_RADII_M = (0.15, 0.3, 0.6)
_RELIEF_MIN_POINTS = 6
_RELIEF_MAX_POINTS = 200
# Points looked at in one go.
PASS_POINTS = 2_000_000
# Thickness of the layer that is taken for one surface about a click.
_CLICK_SLAB_M = 0.2


@dataclass(frozen=True)
class GroundPlane:
    """The plane of the ground, z = slope_x (x - x0) + slope_y (y - y0) + z0, and how well the ground keeps to it.

    Attributes:
        at_m: (x0, y0, z0) world coordinates of a point on the plane amid the ground.
        slope: (2,) rise per metre east and north.
        elevation_std_m: standard deviation of the ground about the plane, each place counted once.
        elevation_p5_m, elevation_p95_m: 5 and 95 per cent of it lie below.
        ground_points: points of the cloud taken as ground.
        area_m2: ground covered by them.
    """

    at_m: tuple[float, float, float]
    slope: tuple[float, float]
    elevation_std_m: float
    elevation_p5_m: float
    elevation_p95_m: float
    ground_points: int
    area_m2: float

    @property
    def tilt_rad(self) -> float:
        """Angle between the plane and the horizontal."""
        return float(np.arctan(np.hypot(*self.slope)))

    def z_m(self, xy: ArrayLike) -> Floats:
        """World z of the plane at world places (..., 2)."""
        offset = np.asarray(xy, dtype=np.float64) - self.at_m[:2]
        z: Floats = offset @ np.array(self.slope) + self.at_m[2]
        return z

    def height_of(self, cloud: Cloud) -> Floats:
        """(N,) height of each point of a cloud above the plane."""
        base = float(self.z_m(cloud.origin_m[:2])) - float(cloud.origin_m[2])
        points = cloud.points_m
        heights: Floats = points[:, 2] - (points[:, 0] * self.slope[0] + points[:, 1] * self.slope[1] + base)
        return heights


def fit_ground_plane(cloud: Cloud, ground_z_m: float | None = None) -> GroundPlane:
    """Find the ground: the lowest of the dominant, nearly horizontal surfaces.

    Each half-metre cell counts once, however densely it was scanned, so a scanner's surroundings and a large roof do
    not outvote the ground. `ground_z_m` (world) sets a horizontal plane by hand instead.

    Raises:
        InputError: a cloud without ground.
    """
    if ground_z_m is not None:
        x, y, _ = cloud.origin_m
        return _described(cloud, (float(x), float(y), float(ground_z_m)), (0.0, 0.0))
    points = cloud.points_m[:: len(cloud) // _PLANE_POINTS + 1]
    cells = _lowest_of_cells(points)
    surfaces = _horizontal_surfaces(cells)
    if not surfaces:
        raise InputError(
            "the point cloud is a cloud without ground: no surface in it is nearly horizontal over "
            f"{_min_cells(cells)} or more cells of {_GROUND_CELL_M} m; "
            f"give the whole site, in metres with z up ({_spans(points)}), or set orthoimage.ground_z_m."
        )
    largest = max(count for _, count in surfaces)
    dominant = [plane for plane, count in surfaces if count >= _DOMINANT_SHARE * largest]
    middle = np.median(cells[:, :2], axis=0)
    a, b, c = min(dominant, key=lambda plane: float(plane[:2] @ middle + plane[2]))
    a, b, c = _refined(points, (a, b, c))
    z0 = a * middle[0] + b * middle[1] + c
    at = np.array([*middle, z0]) + cloud.origin_m
    return _described(cloud, (float(at[0]), float(at[1]), float(at[2])), (float(a), float(b)))


def _spans(points: Floats) -> str:
    """Say how large a cloud is, which betrays another unit and swapped axes."""
    return "it spans " + " x ".join(f"{length:.3g}" for length in np.ptp(points, axis=0))


def _min_cells(cells: Floats) -> int:
    return max(12, len(cells) // 20)


def _cell_numbers(points: Floats, size_m: float) -> NDArray[np.int64]:
    """One whole number per horizontal cell, (N,), by row and column."""
    columns = np.floor(points[:, :2] / size_m).astype(np.int64)
    columns -= columns.min(axis=0)
    numbers: NDArray[np.int64] = columns[:, 0] * (columns[:, 1].max() + 1) + columns[:, 1]
    return numbers


def _lowest_of_cells(points: Floats) -> Floats:
    """(M, 3) a low point of each cell: the tenth percentile, so that a stray echo from below is not taken."""
    numbers = _cell_numbers(points, _GROUND_CELL_M)
    order = np.lexsort((points[:, 2], numbers))
    starts = np.flatnonzero(np.r_[True, np.diff(numbers[order]) != 0])
    counts = np.diff(np.r_[starts, len(order)])
    return np.asarray(points[order[starts + counts // 10]])


def _horizontal_surfaces(cells: Floats) -> list[tuple[Floats, int]]:
    """Planes (3,) z = a x + b y + c that hold the most cells, one after the other, with their number of cells."""
    random = np.random.default_rng(20)
    surfaces, left = list[tuple[Floats, int]](), cells
    for _ in range(5):
        if len(left) < _min_cells(cells):
            break
        plane = _best_plane(left, random)
        off = np.abs(left[:, 2] - left[:, :2] @ plane[:2] - plane[2])
        inside = off < _SLAB_M
        count, around = int(np.count_nonzero(inside)), int(np.count_nonzero(off < 3 * _SLAB_M))
        if count < _min_cells(cells):
            break
        # A cut through something thick has twice as much beside it as within; a surface has little.
        if 2 * count >= around and np.hypot(plane[0], plane[1]) < np.tan(_MAX_TILT_RAD):
            surfaces.append((plane, count))
        left = left[~inside]
    return surfaces


def _best_plane(cells: Floats, random: np.random.Generator) -> Floats:
    """RANSAC over nearly horizontal planes through three cells, plus the level plane through each elevation."""
    judges = cells if len(cells) <= 4000 else cells[random.choice(len(cells), 4000, replace=False)]
    corners = cells[random.integers(len(cells), size=(2000, 3))]
    xy1 = np.concatenate([corners[..., :2], np.ones((len(corners), 3, 1))], axis=2)
    usable = np.abs(np.linalg.det(xy1)) > 4.0
    planes = np.linalg.solve(xy1[usable], corners[usable, :, 2:])[..., 0]
    planes = planes[np.hypot(planes[:, 0], planes[:, 1]) < np.tan(_MAX_TILT_RAD)][:600]
    levels = np.arange(judges[:, 2].min(), judges[:, 2].max() + _SLAB_M, _SLAB_M)[:2000]
    planes = np.concatenate([planes, np.stack([0 * levels, 0 * levels, levels], axis=1)])
    ones = np.concatenate([judges[:, :2], np.ones((len(judges), 1))], axis=1)
    votes = [int(np.count_nonzero(np.abs(judges[:, 2] - ones @ plane) < _SLAB_M)) for plane in planes]
    best: Floats = planes[int(np.argmax(votes))]
    for _ in range(3):
        inside = np.abs(cells[:, 2] - cells[:, :2] @ best[:2] - best[2]) < _SLAB_M
        if np.count_nonzero(inside) < 3:
            break
        best = _least_squares_plane(cells[inside])
    return best


def _least_squares_plane(points: Floats) -> Floats:
    middle = points.mean(axis=0)
    slope = np.linalg.lstsq(points[:, :2] - middle[:2], points[:, 2] - middle[2], rcond=1e-6)[0]
    return np.array([*slope, middle[2] - slope @ middle[:2]])


def _refined(points: Floats, plane: tuple[float, float, float]) -> tuple[float, float, float]:
    """Fit the median elevation of each cell near the plane, leaving out cells that stand off from the others."""
    a, b, c = plane
    near = np.abs(points[:, 2] - (a * points[:, 0] + b * points[:, 1] + c)) < 1.5 * _SLAB_M
    cells = _medians_of_cells(points[near])
    kept = cells
    for _ in range(4):
        a, b, c = _least_squares_plane(kept)
        off = cells[:, 2] - (a * cells[:, 0] + b * cells[:, 1] + c)
        scatter = float(robust_sigma(off - np.median(off)))
        kept = cells[np.abs(off) <= max(3.0 * scatter, 0.01)]
    return float(a), float(b), float(c)


def _medians_of_cells(points: Floats, size_m: float = _GROUND_CELL_M) -> Floats:
    numbers = _cell_numbers(points, size_m)
    order = np.lexsort((points[:, 2], numbers))
    starts = np.flatnonzero(np.r_[True, np.diff(numbers[order]) != 0])
    counts = np.diff(np.r_[starts, len(order)])
    middles: Floats = np.add.reduceat(points[order], starts, axis=0) / counts[:, None]
    middles[:, 2] = points[order[starts + counts // 2], 2]
    return middles


def _described(cloud: Cloud, at_m: tuple[float, float, float], slope: tuple[float, float]) -> GroundPlane:
    plane = GroundPlane(at_m, slope, 0.0, 0.0, 0.0, 0, 0.0)
    heights = plane.height_of(cloud)
    near = np.abs(heights) < RELIEF_REACH_M
    if np.count_nonzero(near) < 3:
        raise InputError(
            f"the point cloud is without ground at z = {at_m[2]:.2f} m; correct orthoimage.ground_z_m or leave it out."
        )
    some = np.flatnonzero(near)
    some = some[:: len(some) // _PLANE_POINTS + 1]
    places = cloud.points_m[some]
    places[:, 2] = heights[some]
    relief = _medians_of_cells(places, 0.1)[:, 2]
    middle = float(np.median(relief))
    scatter = float(robust_sigma(relief - middle))
    relief = relief[np.abs(relief - middle) <= max(4.0 * scatter, 0.02)]
    p5, p95 = np.percentile(relief, [5, 95])
    return replace(
        plane,
        elevation_std_m=float(relief.std()),
        elevation_p5_m=float(p5),
        elevation_p95_m=float(p95),
        ground_points=int(np.count_nonzero(near)),
        area_m2=len(np.unique(_cell_numbers(places, _GROUND_CELL_M))) * _GROUND_CELL_M**2,
    )


def ground_elevation(cloud: Cloud, plane: GroundPlane, xy: ArrayLike) -> Floats:
    """Return how far the ground itself lies above the plane at world places.

    A local plane is fitted to the ground points around each place, near ones counting more, stray ones (objects,
    feet of people) less; from a wider neighbourhood where points are few.

    Args:
        cloud, plane: the site.
        xy: (M, 2) world.

    Returns:
        (M,) metres; nan where no ground was scanned.
    """
    places = np.asarray(xy, dtype=np.float64).reshape(-1, 2) - cloud.origin_m[:2]
    elevation = np.full(len(places), np.nan)
    sought = np.flatnonzero(np.isfinite(places).all(axis=1))
    for radius in _RELIEF_RADII_M:
        near = cloud.select(_near_places(cloud.points_m, places[sought], radius))
        heights = plane.height_of(near)
        ground = np.abs(heights) < RELIEF_REACH_M
        points, heights = near.points_m[ground, :2], heights[ground]
        if len(points) < _RELIEF_MIN_POINTS:
            continue
        tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
        for some in np.array_split(sought, len(sought) // 2000 + 1):
            elevation[some] = _local_elevations(tree, heights, places[some], radius)
        sought = sought[np.isnan(elevation[sought])]
    return elevation


def _near_places(points: Floats, places: Floats, radius_m: float) -> NDArray[np.int64]:
    """Indices of the points that may lie within a radius of any of the places: a quick pass over a raster."""
    if not len(places):
        return np.empty(0, dtype=np.int64)
    low = places.min(axis=0) - 2 * radius_m
    size = np.floor((places.max(axis=0) - low) / radius_m).astype(np.int64) + 3
    if size.prod() > 100_000_000:
        raise InputError(
            f"places {size.max() * radius_m:.0f} m apart were sought in the point cloud; "
            "correct the correspondences, they are no coordinates of one site."
        )
    wanted = np.zeros(size, dtype=np.bool_)
    own = np.floor((places - low) / radius_m).astype(np.int64)
    for east in (-1, 0, 1):
        for north in (-1, 0, 1):
            wanted[own[:, 0] + east, own[:, 1] + north] = True
    parts = []
    for batch in batches(len(points), PASS_POINTS):
        cell = np.floor((points[batch, :2] - low) / radius_m)
        inside = np.flatnonzero(((cell >= 0) & (cell < size)).all(axis=1))
        cell = cell[inside].astype(np.int64)
        parts.append(batch.start + inside[wanted[cell[:, 0], cell[:, 1]]])
    return np.concatenate(parts)


def _local_elevations(tree: cKDTree, heights: Floats, places: Floats, radius_m: float) -> Floats:
    """(M,) elevation at places from the nearest ground points within a radius; nan where they are too few."""
    elevation = np.full(len(places), np.nan)
    distance, index = map(np.asarray, tree.query(places, k=_RELIEF_MAX_POINTS, distance_upper_bound=radius_m))
    found = np.isfinite(distance)
    enough = np.flatnonzero(found.sum(axis=1) >= _RELIEF_MIN_POINTS)
    if len(enough):
        number, column = np.nonzero(found[enough])
        chosen = index[enough][number, column]
        offsets = np.asarray(tree.data)[chosen] - places[enough][number]
        elevation[enough] = _local_planes(offsets, heights[chosen], number, radius_m)
    return elevation


def _local_planes(offsets: Floats, heights: Floats, owner: NDArray[np.int64], radius_m: float) -> Floats:
    """Height at the centre of each neighbourhood by iterated least squares.

    Args:
        offsets: (K, 2) of each point from its place.
        heights: (K,) of each point.
        owner: (K,) number of its place, ascending.
        radius_m: where the weight of a point has fallen to zero.

    Source: Tukey's biweight about the local plane; scale from the median deviation of all neighbourhoods.
    """
    count = int(owner[-1]) + 1
    nearness = (1.0 - (offsets**2).sum(axis=1) / (radius_m * 1.001) ** 2) ** 2
    design = np.concatenate([np.ones((len(offsets), 1)), offsets / radius_m], axis=1)
    middle = _group_medians(heights, owner)
    off = heights - middle[owner]
    for _ in range(5):
        scale = np.maximum(BY_MEDIAN * _group_medians(np.abs(off), owner), 0.002)
        weight = nearness * np.clip(1.0 - (off / (4.7 * scale[owner])) ** 2, 0.0, None) ** 2
        products = weight[:, None, None] * design[:, :, None] * design[:, None, :]
        sums = [np.bincount(owner, product, count) for product in products.reshape(-1, 9).T]
        normal: Floats = np.asarray(np.stack(sums, axis=1), dtype=np.float64).reshape(-1, 3, 3)
        right = np.stack([np.bincount(owner, weight * d * heights, count) for d in design.T], axis=1)
        # Points on one side or in one line do not tell the slope: a little stiffness keeps it level there.
        normal = normal + np.diag([0.0, 0.02, 0.02]) * normal[:, :1, :1] + 1e-12 * np.eye(3)
        solution = np.linalg.solve(normal, right[..., None])[..., 0]
        off = heights - np.einsum("ki,ki->k", design, solution[owner])
    return np.asarray(solution[:, 0])


def _group_medians(values: Floats, owner: NDArray[np.int64]) -> Floats:
    order = np.lexsort((values, owner))
    counts = np.bincount(owner)
    starts = np.cumsum(counts) - counts
    ordered = values[order]
    return np.asarray(0.5 * (ordered[starts + (counts - 1) // 2] + ordered[starts + counts // 2]))


def height_at(cloud: Cloud, plane: GroundPlane, xy: ArrayLike, radius_m: float = 0.3) -> tuple[float, float, int]:
    """Return height above the ground plane, its spread and the number of points of the upper surface at a place.

    Args:
        cloud, plane: the site.
        xy: (2,) world.
        radius_m: of the neighbourhood.

    Raises:
        InputError: nothing was scanned there.
    """
    xy = np.asarray(xy, dtype=np.float64)
    offsets = cloud.points_m[:, :2] - (xy - cloud.origin_m[:2])
    near = np.flatnonzero((offsets**2).sum(axis=1) <= radius_m**2)
    if len(near) < 3:
        raise InputError(
            f"only {len(near)} points of the cloud lie within {radius_m:g} m of ({xy[0]:.2f}, {xy[1]:.2f}); "
            "click where it is denser or take a larger radius."
        )
    heights = plane.height_of(cloud.select(near))
    level = _upper_surface(heights, np.floor(offsets[near] / (radius_m / 4)).astype(np.int64) @ np.array([64, 1]))
    for _ in range(5):
        level = float(np.median(heights[np.abs(heights - level) <= _CLICK_SLAB_M / 2]))
    surface = heights[np.abs(heights - level) <= _CLICK_SLAB_M]
    return level, float(surface.std()), len(surface)


def _upper_surface(heights: Floats, cells: NDArray[np.int64]) -> float:
    """Height of a point amid the highest layer that covers a fair part of the cells around a click.

    Counted in cells, not in points: a wall below a roof's edge may hold most of the points, but stands on few cells,
    and so does a wire; a bird holds one.
    """
    enough = max(2.0, 0.25 * len(np.unique(cells)))
    for top in np.arange(heights.max(), heights.min(), -_CLICK_SLAB_M / 4):
        layer = (heights <= top) & (heights > top - _CLICK_SLAB_M)
        if len(np.unique(cells[layer])) >= enough:
            return float(np.median(heights[layer]))
    return float(np.sort(heights)[len(heights) // 2])
