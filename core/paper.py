"""The published method's measurements, step by step: SIFT matches to the reference frame and Canny edge pairs.

Features are matched by the least sum of squared differences; lines are found on the orthorectified band by Canny's
detector as pairs of opposite edges. What is recorded are raw pixels, as for the geometric method, so that clicks and
lens can change without reading the video again.

Only those parts of a frame are looked at that the result depends on: SIFT runs on windows around the places where the
reference features are expected, and the warp onto the ground plane is made for the three bands alone.

Source: the paper, "UAV Drift and Perspective Correction" (second sub-step) and "Roof Feature Detection and Displacement
Extraction"; SIFT (Lowe 2004) stands for SURF, which OpenCV's packages do not carry.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from core.apparent import Apparent
from core.coordinates import Floats, apply_homography
from core.errors import InputError
from core.following import Scale, TargetFinder
from core.ground import CameraFinder, fit_homography, ground_mask
from core.lens import Lens
from core.measurements import FrameMeasurement, Reference
from core.motion import LineSet, fit_line, is_determined, rigid_from_lines
from core.parallel import on_all_cores
from core.prediction import MeasureSetup, nothing_measured, predict_apparent, predict_homography
from core.project import LINE_NAMES, Band, Target
from core.roof_level import kind_obstacle, refuse_if
from core.video import Luma

# Matches per frame of the paper: 300-500.
FEATURES = 500
LEAST_MATCHES = 20
LARGEST_SIZE_PX = 5.0
# Half the side of the windows SIFT looks into around expected features, pixels. A feature takes the first that is as
# many times its size: there a descriptor's weight lies, and what a match may lie off. Wider ones match no more.
WINDOWS_PX = (10, 12, 14, 16, 18, 20)
WINDOW_BY_SIZE = 5.0
# Windows are laid out in squares of about this side, pixels: what SIFT makes of one stays near the processor.
MOSAIC_PX = 160
# The reference frame is searched for features in tiles of this side, and so far beyond them as small features depend on
# pixels: of a whole 4K frame SIFT takes two gigabytes.
TILE_PX, BEYOND_TILE_PX = 1024, 64
# How far from its expected place a match may lie, pixels.
NEAR_PX = 4.0
# Difference of two descriptors beyond which they show different places, out of 512.
MOST_DIFFERENCE = 250.0
# Lowe's ratio between the best and the second-best sum of squared differences.
RATIO = 0.8
# The orthorectified band is sampled about as finely as the camera saw it.
CANNY_LOW, CANNY_HIGH = 40, 110
# Stations along a band at which an edge pair may be found; the paper reports 600-1,000 edge points.
STATIONS = 500
LEAST_STATIONS = 40


# An edge along a band: its row, and the sign of the gradient across it.
_Edge = tuple[float, float]


@dataclass(frozen=True)
class Candidates:
    """M features of a frame that may be one of the reference frame's.

    Attributes:
        number: (M,) of the feature of the reference frame that each of them may be.
        places: (M, 2) raw pixels.
        descriptors: (M, 128).
    """

    number: NDArray[np.int64]
    places: Floats
    descriptors: NDArray[np.float32]


@dataclass(frozen=True)
class _Mosaic:
    """W square windows of a frame side by side, a row of them after the other.

    Attributes:
        picture: of all of them.
        side: of a window, pixels.
        number: (W,) of the feature expected in the middle of each.
        corner: (W, 2) each one's first pixel in the frame.
    """

    picture: Luma
    side: int
    number: NDArray[np.int64]
    corner: NDArray[np.int64]


class PaperMeasurer:
    """Measures frames the published way; see `core.measure.Measurer`.

    Args:
        luma: the reference frame, (height, width).

    Attributes:
        reference: where the features are in the reference frame, raw pixels.

    Raises:
        InputError: the frame shows too little ground, or no line where a target should be, or a target has no lines.
    """

    def __init__(self, luma: Luma, setup: MeasureSetup) -> None:
        allowed = ground_mask(luma.shape, setup.moving_regions_px)
        self._ground = SiftGround(luma, setup.lens, allowed)
        self._targets = {target.name: _lines_target(luma, target, setup) for target in setup.targets}
        targets_raw = {name: target.reference_raw for name, target in self._targets.items()}
        self.reference = Reference(self._ground.points_raw, targets_raw)

    def measure(self, luma: Luma, *, frame: int, time_s: float, before: Sequence[FrameMeasurement]) -> FrameMeasurement:
        """Return what a frame shows; see `core.measure.Measurer`."""
        found = self._ground.find(luma, predict_homography(before, time_s))
        if found is None:
            return nothing_measured(self.reference, frame, time_s)
        H_ray_ray0, ground_raw = found
        targets_raw: dict[str, Floats] = {}
        apparent: dict[str, Apparent | None] = {}
        for name, target in self._targets.items():
            targets_raw[name], apparent[name] = target.find(luma, H_ray_ray0, predict_apparent(before, name, time_s))
        return FrameMeasurement(frame, time_s, H_ray_ray0, ground_raw, targets_raw, apparent)


class SiftGround:
    """SIFT features of the reference frame's ground, matched in other frames.

    Args:
        luma: the reference frame, (height, width).
        allowed: (height, width) bool, where there is ground.

    Attributes:
        points_raw: (N, 2) of the features in the reference frame, raw pixels.

    Raises:
        InputError: too few features are found.
    """

    def __init__(self, luma: Luma, lens: Lens, allowed: NDArray[np.bool_]) -> None:
        self._lens = lens
        keypoints, descriptors = _features_by_tiles(luma, allowed.astype(np.uint8))
        kept = _spread_strongest(keypoints, luma.shape, FEATURES)
        if len(kept) < LEAST_MATCHES:
            raise InputError(
                f"project.json: moving_regions_px leave only {len(kept)} SIFT features on the ground of the reference "
                "frame; draw them closer around what moves, or choose another reference_frame."
            )
        self._descriptors = descriptors[kept]
        self.points_raw = np.array([keypoints[i].pt for i in kept], dtype=np.float64)
        self._rays0 = lens.rays_from_raw(self.points_raw)
        sizes = np.array([keypoints[i].size for i in kept])
        fitting = np.searchsorted(WINDOWS_PX, WINDOW_BY_SIZE * sizes).clip(max=len(WINDOWS_PX) - 1)
        self._half_px = np.array(WINDOWS_PX)[fitting]
        self._finder = CameraFinder(luma, lens, allowed)

    def find(self, luma: Luma, predicted_H_ray_ray0: Floats | None) -> tuple[Floats, Floats] | None:
        """Return H_ray_ray0 and the matched features' raw pixels (N, 2), nan where unmatched; None if lost."""
        if predicted_H_ray_ray0 is None:
            # A hovering camera may well see what it saw in the reference frame; by chance few features seem to match.
            found = self._fit(luma, np.eye(3), max(LEAST_MATCHES, len(self._rays0) // 2))
        else:
            found = self._fit(luma, predicted_H_ray_ray0)
        if found is None and (searched := self._finder.search(luma)) is not None:
            found = self._fit(luma, searched)
        return found

    def _fit(self, luma: Luma, H_ray_ray0: Floats, least: int = LEAST_MATCHES) -> tuple[Floats, Floats] | None:
        """Return what `find` does from where a homography leads one to expect the features, or None."""
        matched = self._match(luma, self._lens.raw_from_rays(apply_homography(H_ray_ray0, self._rays0)))
        good = np.isfinite(matched).all(axis=1)
        if good.sum() < least:
            return None
        rays = self._lens.rays_from_raw(matched[good])
        H, inlier = fit_homography(self._rays0[good], rays, tolerance=1.0 / float(self._lens.focal_px.mean()))
        return None if H is None or inlier.sum() < least else (H, matched)

    def _match(self, luma: Luma, expected_raw: Floats) -> Floats:
        """Return each feature's match (N, 2): near its expected place, of the least sum of squared differences.

        That must be small, and clearly less than any other's.
        """
        windows = int(((2 * self._half_px) ** 2).sum())
        look = self._seen_in_windows if luma.size > 1.5 * windows else self._seen_in_all
        seen = look(luma, expected_raw)
        difference = ((seen.descriptors - self._descriptors[seen.number]) ** 2).sum(axis=1)
        best, second = _two_least(seen.number, difference)
        clear = (difference[best] < MOST_DIFFERENCE**2) & (second > difference[best] / RATIO**2)
        matched = np.full_like(expected_raw, np.nan)
        matched[seen.number[best[clear]]] = seen.places[best[clear]]
        return matched

    def _detect(self, picture: Luma, near: Luma) -> tuple[Floats, NDArray[np.float32]]:
        """Return the features of a picture where `near` is not zero, and their descriptors; the others get none."""
        keypoints, descriptors = _sift().detectAndCompute(picture, near)
        if not keypoints:
            return np.empty((0, 2)), np.empty((0, 128), dtype=np.float32)
        return np.array([keypoint.pt for keypoint in keypoints]), np.asarray(descriptors, dtype=np.float32)

    def _seen_in_all(self, luma: Luma, expected_raw: Floats) -> Candidates:
        """Return what SIFT finds in the whole frame near each expected feature."""
        places, descriptors = self._detect(luma, _around(luma.shape, expected_raw))
        near: Any = cKDTree(places).query_ball_point(np.nan_to_num(expected_raw, nan=-1e6), NEAR_PX)
        number = np.repeat(np.arange(len(near)), [len(each) for each in near])
        found = np.fromiter(itertools.chain.from_iterable(near), dtype=np.int64)
        return Candidates(number, places[found], descriptors[found])

    def _seen_in_windows(self, luma: Luma, expected_raw: Floats) -> Candidates:
        """Return what SIFT finds in windows around each expected feature."""
        seen = on_all_cores(self._seen_in_mosaic, list(self._mosaics(luma, expected_raw)))
        if not seen:
            return Candidates(np.empty(0, dtype=np.int64), np.empty((0, 2)), np.empty((0, 128), dtype=np.float32))
        number = np.concatenate([each.number for each in seen])
        places = np.concatenate([each.places for each in seen])
        descriptors = np.concatenate([each.descriptors for each in seen])
        near = np.linalg.norm(places - expected_raw[number], axis=1) < NEAR_PX
        return Candidates(number[near], places[near], descriptors[near])

    def _mosaics(self, luma: Luma, expected_raw: Floats) -> Iterator[_Mosaic]:
        """Return the windows around expected features that lie in the frame, those of one size side by side."""
        middles = np.rint(np.nan_to_num(expected_raw, nan=-1e6)).astype(np.int64)
        for half in WINDOWS_PX:
            corners = middles - half
            inside = (corners >= 0).all(axis=1) & (corners + 2 * half <= np.array(luma.shape[::-1])).all(axis=1)
            numbers = np.flatnonzero(inside & (self._half_px == half))
            together = (MOSAIC_PX // (2 * half)) ** 2
            for first in range(0, len(numbers), together):
                some = numbers[first : first + together]
                yield _mosaic(luma, some, corners[some], half)

    def _seen_in_mosaic(self, mosaic: _Mosaic) -> Candidates:
        """Return what SIFT finds near the middles of the windows of a mosaic."""
        columns = mosaic.picture.shape[1] // mosaic.side
        middles = np.stack(np.divmod(np.arange(len(mosaic.number)), columns)[::-1], axis=1) + 0.5
        places, descriptors = self._detect(mosaic.picture, _around(mosaic.picture.shape, middles * mosaic.side))
        tile = (places // mosaic.side).astype(np.int64)
        window = tile[:, 1] * columns + tile[:, 0]
        return Candidates(mosaic.number[window], places - tile * mosaic.side + mosaic.corner[window], descriptors)


def _two_least(number: NDArray[np.int64], value: NDArray[np.float32]) -> tuple[NDArray[np.int64], Floats]:
    """Return, for each number there is, where its least value (K,) lies and its second-least (K,); inf where none."""
    order = np.lexsort((value, number))
    _, first = np.unique(number[order], return_index=True)
    after = np.append(first[1:], len(order))
    next_values = np.append(value[order], np.inf)[first + 1]
    return order[first], np.where(first + 1 < after, next_values, np.inf)


def _sift() -> cv2.SIFT:
    return cv2.SIFT.create(nfeatures=0, contrastThreshold=0.02)


def _features_by_tiles(luma: Luma, allowed: Luma) -> tuple[list[cv2.KeyPoint], NDArray[np.float32]]:
    """Return the SIFT features of a frame wherever a mask of its size is not zero, and their descriptors (N, 128)."""
    keypoints: list[cv2.KeyPoint] = []
    descriptors = [np.empty((0, 128), dtype=np.float32)]
    for top, left in itertools.product(*(range(0, side, TILE_PX) for side in luma.shape)):
        first_row, first_column = max(0, top - BEYOND_TILE_PX), max(0, left - BEYOND_TILE_PX)
        reach = TILE_PX + BEYOND_TILE_PX
        within = np.zeros_like(allowed)
        within[top : top + TILE_PX, left : left + TILE_PX] = allowed[top : top + TILE_PX, left : left + TILE_PX]
        part = slice(first_row, top + reach), slice(first_column, left + reach)
        found, described = _sift().detectAndCompute(luma[part], within[part])
        for keypoint in found:
            keypoint.pt = keypoint.pt[0] + first_column, keypoint.pt[1] + first_row
        if found:
            keypoints.extend(found)
            descriptors.append(np.asarray(described, dtype=np.float32))
    return keypoints, np.concatenate(descriptors)


def _spread_strongest(keypoints: Sequence[cv2.KeyPoint], shape: tuple[int, ...], count: int) -> list[int]:
    """Return the strongest features of small size, at most a fair share from each cell of the frame."""
    cells = 12
    taken: dict[tuple[int, int], int] = {}
    kept = []
    for number in sorted(range(len(keypoints)), key=lambda i: -keypoints[i].response):
        keypoint = keypoints[number]
        if keypoint.size > LARGEST_SIZE_PX:
            continue
        cell = int(keypoint.pt[0] * cells // shape[1]), int(keypoint.pt[1] * cells // shape[0])
        if taken.get(cell, 0) < max(1, 3 * count // cells**2):
            taken[cell] = taken.get(cell, 0) + 1
            kept.append(number)
        if len(kept) == count:
            break
    return kept


def _around(shape: tuple[int, ...], places: Floats) -> Luma:
    """Return a mask (height, width) of the pixels no further than `NEAR_PX` from any of the places (N, 2)."""
    mask: Luma = np.zeros(shape, dtype=np.uint8)
    reach = int(np.ceil(NEAR_PX)) + 1
    for u, v in np.rint(places[np.isfinite(places).all(axis=1)]).astype(np.int64).tolist():
        mask[max(0, v - reach) : max(0, v + reach + 1), max(0, u - reach) : max(0, u + reach + 1)] = 1
    return mask


def _mosaic(luma: Luma, number: NDArray[np.int64], corner: NDArray[np.int64], half: int) -> _Mosaic:
    """Return the windows of some features side by side, given each one's first pixel (W, 2)."""
    side = 2 * half
    columns = MOSAIC_PX // side
    picture = np.zeros((-(-len(number) // columns) * side, columns * side), dtype=np.uint8)
    for place, (u, v) in enumerate(corner.tolist()):
        top, left = place // columns * side, place % columns * side
        picture[top : top + side, left : left + side] = luma[v : v + side, u : u + side]
    return _Mosaic(picture, side, number, corner)


class CannyLines:
    """L1, L2 and T1 of a target by Canny edge pairs on the orthorectified bands.

    Args:
        luma: the reference frame, (height, width).
        bands: L1, L2 and T1.
        name: of the target, for messages.

    Attributes:
        reference_raw: (3, STATIONS, 2, 2) edges in the reference frame, raw pixels; nan where not found.

    Raises:
        InputError: a band shows no line.
    """

    def __init__(self, luma: Luma, bands: list[Band], setup: MeasureSetup, name: str) -> None:
        self._lens = setup.lens
        corners = np.array([[band.from_m, band.to_m] for band in bands])
        ends = setup.rays_from_plan(corners.reshape(-1, 2)).reshape(-1, 2, 2)
        self._centre = ends.reshape(-1, 2).mean(axis=0)
        self._grids = [_band_grid(band, setup) for band in bands]
        span_m = float(np.linalg.norm(corners[0, 1] - corners[0, 0]))
        span_ray = float(np.linalg.norm(ends[0, 1] - ends[0, 0]))
        pixels = float(setup.lens.focal_px.mean()) * span_ray / span_m
        self._finder = TargetFinder(luma, ends.reshape(-1, 2), setup.lens, Scale(span_ray / span_m, pixels))
        self.reference_raw = np.stack([self._edges(luma, np.eye(3), Apparent.none(), i) for i in range(len(bands))])
        found = np.isfinite(self.reference_raw).all(axis=(2, 3)).sum(axis=1)
        for line, count in zip(LINE_NAMES, found, strict=True):
            if count < LEAST_STATIONS:
                raise InputError(
                    f"project.json: targets.{name}.lines.{line} holds no line with two edges in the reference frame; "
                    "draw the band along a strip or joint that stands out from the roof."
                )
        rays = setup.lens.rays_from_raw(self.reference_raw.mean(axis=2))
        lines = [fit_line(points, np.ones(len(points)), self._centre) for points in rays]
        self._lines = LineSet(np.array([n for n, _ in lines]), np.array([o for _, o in lines]), self._centre)

    def find(self, luma: Luma, H_ray_ray0: Floats, predicted: Apparent | None) -> tuple[Floats, Apparent | None]:
        """Return edges (3, STATIONS, 2, 2) in raw pixels and the apparent motion they show."""
        if predicted is not None:
            edges, apparent = self._measure(luma, H_ray_ray0, predicted)
            if apparent is not None:
                return edges, apparent
        seen = self._finder.search(luma, H_ray_ray0)
        if seen is None:
            return np.full_like(self.reference_raw, np.nan), None
        return self._measure(luma, H_ray_ray0, Apparent(seen, predicted.rotation_rad if predicted else 0.0))

    def _measure(self, luma: Luma, H_ray_ray0: Floats, predicted: Apparent) -> tuple[Floats, Apparent | None]:
        edges = np.stack([self._edges(luma, H_ray_ray0, predicted, i) for i in range(len(self._grids))])
        enough = np.isfinite(edges).all(axis=(2, 3)).sum(axis=1) >= LEAST_STATIONS
        edges[~enough] = np.nan
        rays0 = apply_homography(np.linalg.inv(H_ray_ray0), self._lens.rays_from_raw(edges.mean(axis=2)))
        fit = rigid_from_lines(rays0[None], np.ones((1, *rays0.shape[:2])), self._lines)
        if not is_determined(fit.normal)[0]:
            return edges, None
        return edges, Apparent(fit.shift[0], float(fit.rotation_rad[0]))

    def _edges(self, luma: Luma, H_ray_ray0: Floats, predicted: Apparent, number: int) -> Floats:
        moved = predicted.apply(self._grids[number], self._centre)
        raw = self._lens.raw_from_rays(apply_homography(H_ray_ray0, moved))
        maps = np.nan_to_num(raw, nan=-1e4).astype(np.float32)
        band = cv2.remap(luma, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        pairs = canny_pairs(np.asarray(band, dtype=np.uint8))
        return _raw_of_rows(pairs, raw)


def _lines_target(luma: Luma, target: Target, setup: MeasureSetup) -> CannyLines:
    refuse_if(kind_obstacle(target), target)
    assert target.lines is not None
    return CannyLines(luma, [getattr(target.lines, name) for name in LINE_NAMES], setup, target.name)


def _band_grid(band: Band, setup: MeasureSetup) -> Floats:
    """Return the rays (rows, STATIONS, 2) of a band's samples on the orthorectified reference frame."""
    start, end = np.array(band.from_m), np.array(band.to_m)
    along = end - start
    across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    rays = setup.rays_from_plan(np.stack([start, start + across * 0.01]))
    per_m = float(np.linalg.norm(rays[1] - rays[0])) / 0.01 * float(setup.lens.focal_px.mean())
    rows = max(16, round(band.width_m * per_m))
    s = (np.arange(rows) - (rows - 1) / 2) / per_m
    t = (np.arange(STATIONS) + 0.5) / STATIONS
    plan = start + t[None, :, None] * along + s[:, None, None] * across
    return setup.rays_from_plan(plan.reshape(-1, 2)).reshape(plan.shape)


def canny_pairs(band: NDArray[np.uint8]) -> Floats:
    """Return, for each column of an orthorectified band, the rows (columns, 2) of the edge pair nearest its middle.

    Each of Canny's edge pixels is refined to the vertex of the gradient across the line; nan where a column shows no
    two opposite edges.

    Source: Canny (1986); Devernay (1995) for the vertex.
    """
    smooth = cv2.GaussianBlur(band, (0, 0), 1.0)
    edges = cv2.Canny(smooth, CANNY_LOW, CANNY_HIGH, L2gradient=True) > 0
    gradient = cv2.Sobel(smooth, cv2.CV_64F, 0, 1, ksize=3)
    rows, columns = band.shape
    found = np.full((columns, 2), np.nan)
    typical = _pair_of(np.where(edges, gradient, 0.0).mean(axis=1))
    if typical is None:
        return found
    number = np.arange(rows)[:, None]
    reach = max(2.0, 0.35 * abs(typical[1][0] - typical[0][0]))
    for side, (place, sign) in enumerate(typical):
        near = edges & (np.abs(number - place) <= reach) & (gradient * sign > 0)
        row = np.where(near, np.abs(number - place), np.inf).argmin(axis=0)
        seen = near.any(axis=0) & (row > 0) & (row < rows - 1)
        column = np.flatnonzero(seen)
        r = row[column]
        size = np.abs(gradient)
        before, at, after = size[r - 1, column], size[r, column], size[r + 1, column]
        curvature = before - 2 * at + after
        shift = np.where(curvature < 0, 0.5 * (before - after) / np.where(curvature < 0, curvature, -1.0), 0.0)
        found[column, side] = r + np.clip(shift, -1.0, 1.0)
    found[~np.isfinite(found).all(axis=1)] = np.nan
    return found


def _pair_of(gradient: Floats) -> tuple[_Edge, _Edge] | None:
    """Return rows and signs of the two opposite edges that run along the whole band, nearest its middle.

    Args:
        gradient: (rows,) across the band, the mean of each row's edge pixels.
    """
    rows = len(gradient)
    pooled = np.convolve(gradient, np.ones(3), mode="same")
    peaks = [
        r
        for r in range(1, rows - 1)
        if abs(pooled[r]) >= abs(pooled[r - 1]) and abs(pooled[r]) > abs(pooled[r + 1]) and abs(pooled[r]) > 8.0
    ]
    middle, score = (rows - 1) / 2, 0.0
    best: tuple[_Edge, _Edge] | None = None
    for number, first in enumerate(peaks):
        for second in peaks[number + 1 :]:
            if pooled[first] * pooled[second] >= 0 or not 2 <= second - first <= 0.4 * rows:
                continue
            offset = ((first + second) / 2 - middle) / (0.22 * rows)
            value = min(abs(pooled[first]), abs(pooled[second])) * np.exp(-0.5 * offset**2)
            value /= 1.0 + ((second - first) / (0.3 * rows)) ** 2
            if value > score:
                one, other = ((float(row), float(np.sign(pooled[row]))) for row in (first, second))
                best, score = (one, other), value
    return best


def _raw_of_rows(pairs: Floats, raw: Floats) -> Floats:
    """Return raw pixels (columns, 2, 2) of sub-pixel rows (columns, 2) of a band whose samples lie at `raw`."""
    rows = raw.shape[0]
    low = np.clip(np.floor(np.nan_to_num(pairs)).astype(int), 0, rows - 2)
    part = (pairs - low)[..., None]
    column = np.arange(len(pairs))[:, None]
    return np.asarray(raw[low, column] * (1 - part) + raw[low + 1, column] * part)
