"""The ground: natural features of the reference frame, followed through the video, and the homography they give.

Features are chosen once, in the reference frame, outside the moving regions, evenly spread. The homography of every
frame serves to predict where to look; the camera poses of the result are solved later, from the recorded positions.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.coordinates import Bools, Floats, apply_homography, finite_rows, homography_jacobian, invert_2x2
from core.errors import InputError
from core.lens import Lens
from core.patches import HALF_PX, MARGIN_PX, Matches, PatchTracker, Singles
from core.video import Luma

# Polygons, raw pixels of the reference frame.
Regions = Sequence[Sequence[tuple[float, float]]]

# More give no better pose: what compression gets wrong, it gets wrong for all of them alike.
FEATURES = 180
# Correlation from which two noisy views are alike by more than chance.
ALIKE_SCORE = 0.15
# With a noisy reference the search for a patch stops short of its place and stays near where it began. Repeated this
# often, each time from where it ended, it no longer depends on where it began, and a chunk measured by itself equals an
# uninterrupted pass.
NOISY_ROUNDS = 2
# Where a prediction is no further off than this, every patch comes home from it; from further off in a few rounds.
NEAR_PX = 1.5
MOST_ROUNDS = 6
# Ground points needed before a frame's homography is believed.
LEAST_POINTS = 12
# Widths of the reduced pictures in which features are chosen and a lost camera is found again, pixels.
CHOOSING_WIDTH = 1920
SEARCH_WIDTH = 960


@dataclass(frozen=True)
class GroundMatch:
    """The ground in one frame.

    Attributes:
        matches: of the features, in raw pixels.
        H_ray_ray0: (3, 3) from rays of the reference frame to rays of this frame.
        inliers: number of features that agree with it.
    """

    matches: Matches
    H_ray_ray0: Floats
    inliers: int


@dataclass(frozen=True)
class View:
    """A frame near the reference frame.

    Attributes:
        luma: (height, width).
        H_ray_ray0: (3, 3) as in `GroundMatch`.
        score: the usual correlation of its patches with the reference frame's.
    """

    luma: Luma
    H_ray_ray0: Floats
    score: float


@dataclass(frozen=True)
class ExpectedFeatures:
    """Where N features should be in a frame.

    Attributes:
        rays, raw: (N, 2); raw is nan where the lens images nothing.
        J_raw_rays: (N, 2, 2) how raw pixels change with rays.
        ref_from_current: (N, 2, 2) deformation of patches, reference pixels by frame pixels.
    """

    rays: Floats
    raw: Floats
    J_raw_rays: Floats
    ref_from_current: Floats

    def rays_seen(self, raw: Floats) -> Floats:
        """Return the rays (N, 2) of raw pixels that lie a pixel or two beside, good to a thousandth of a pixel."""
        return np.asarray(self.rays + (invert_2x2(self.J_raw_rays) @ (raw - self.raw)[..., None])[..., 0])


def choose_features(luma: Luma, moving_regions_px: Regions, count: int, lens: Lens) -> Floats:
    """Return about `count` corners (N, 2) of the reference frame, raw pixels, evenly spread outside the regions.

    Where the lens model ends within the frame, none are beyond its end.

    Raises:
        InputError: too little of the ground is left to hold on to.
    """
    points = _spread_corners(luma, ground_mask(luma.shape, moving_regions_px), count, factor=_choosing_factor(luma))
    points = points[finite_rows(lens.rays_from_raw(points))]
    if len(points) < LEAST_POINTS:
        raise InputError(
            f"project.json: moving_regions_px leave only {len(points)} ground features in the reference frame; "
            "draw them closer around what moves, or choose another reference_frame."
        )
    return points


def choose_features_within(luma: Luma, region_raw: Floats, count: int, *, bounds: Regions = ()) -> Floats:
    """Return about `count` corners (N, 2) of the reference frame inside a polygon (M, 2), raw pixels.

    Args:
        bounds: polygons in one of which corners must lie too, if there are any.
    """
    corners = np.rint(np.nan_to_num(region_raw, nan=-1e4)).astype(np.int32)
    reach, size = HALF_PX + MARGIN_PX + 2, np.array(luma.shape[::-1])
    low, high = np.clip(corners.min(axis=0) - reach, 0, size), np.clip(corners.max(axis=0) + reach + 1, 0, size)
    if (high - low < 2 * reach).any():
        return np.empty((0, 2))
    box = luma[low[1] : high[1], low[0] : high[0]]
    region = _covered(box.shape, [corners - low])
    if bounds:
        region &= _covered(box.shape, [np.array(bound) - low for bound in bounds])
    inside = cv2.erode(region, np.ones((2 * HALF_PX + 1, 2 * HALF_PX + 1), np.uint8)).astype(bool)
    return _spread_corners(box, inside & ground_mask(box.shape, ()), count, factor=_choosing_factor(luma)) + low


def _choosing_factor(luma: Luma) -> int:
    """Return by how much a frame is reduced before features are chosen."""
    return max(1, round(luma.shape[1] / CHOOSING_WIDTH))


def _spread_corners(luma: Luma, allowed: NDArray[np.bool_], count: int, *, factor: int) -> Floats:
    """Return the strongest corner of each of about `count` cells of the allowed pixels, (N, 2) raw.

    Args:
        luma: a frame or part of one.
        factor: by which it is reduced first.

    Source: Shi & Tomasi (1994) for the measure of strength.
    """
    height, width = luma.shape
    small = cv2.resize(luma, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0) if factor == 1 else small
    strength = cv2.cornerMinEigenVal(smooth, blockSize=2 * (HALF_PX // factor) + 1, ksize=3)
    allowed_small = allowed[factor // 2 :: factor, factor // 2 :: factor][: small.shape[0], : small.shape[1]]
    quality = np.where(allowed_small, strength, 0.0)
    cell = max(HALF_PX, int(np.sqrt(max(int(np.count_nonzero(allowed)), 1) / count))) // factor
    points, strengths = _best_of_cells(quality, cell)
    points = points * factor + factor // 2
    # What is weaker than a hundredth of the median is plain surface; its position would be noise.
    floor = 0.01 * float(np.median(strengths)) if len(strengths) else 0.0
    points = points[strengths > max(floor, 1e-7)]
    # Corners sit on whole pixels; spread over all sub-pixel phases, interpolation errors average out.
    golden = (np.arange(len(points))[:, None] * np.array([0.7548776662, 0.5698402910])) % 1.0 - 0.5
    # In steps that a recording keeps exactly, so that a resumed run looks at the very same places.
    points = points + np.rint(golden * 1024) / 1024
    border = HALF_PX + MARGIN_PX + 1
    inside = (points >= border).all(axis=1) & (points < np.array([width, height]) - 1 - border).all(axis=1)
    return np.asarray(points[inside], dtype=np.float64)


def ground_mask(shape: tuple[int, ...], moving_regions_px: Regions) -> NDArray[np.bool_]:
    """Return the (height, width) mask of raw pixels whose patches lie inside the frame and outside what moves."""
    mask = 1 - _covered(shape[:2], moving_regions_px)
    reach = HALF_PX + MARGIN_PX + 2
    framed = cv2.copyMakeBorder(mask, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    kept = cv2.erode(framed, np.ones((2 * reach - 1, 2 * reach - 1), np.uint8))
    return np.asarray(kept[1:-1, 1:-1] > 0, dtype=np.bool_)


def _covered(shape: tuple[int, ...], polygons: Iterable[ArrayLike]) -> Luma:
    """Return the mask (height, width) of pixels that polygons of pixels cover."""
    mask: Luma = np.zeros(shape, dtype=np.uint8)
    for polygon in polygons:
        cv2.fillPoly(mask, [np.rint(np.asarray(polygon)).astype(np.int32)], 1)
    return mask


def _best_of_cells(quality: NDArray[np.float32], cell: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the strongest place of each square cell, (N, 2) as u, v, and its strength (N,)."""
    height, width = quality.shape
    rows, columns = -(-height // cell), -(-width // cell)
    padded = np.zeros((rows * cell, columns * cell), dtype=quality.dtype)
    padded[:height, :width] = quality
    cells = padded.reshape(rows, cell, columns, cell).transpose(0, 2, 1, 3).reshape(rows * columns, cell * cell)
    best = cells.argmax(axis=1)
    number = np.arange(rows * columns)
    points = np.stack([number % columns * cell + best % cell, number // columns * cell + best // cell], axis=1)
    strength = cells[number, best]
    return points[strength > 0], strength[strength > 0]


class GroundTracker:
    """Finds the reference frame's ground features in other frames.

    Args:
        luma: the reference frame.
        points_raw: (N, 2) features, raw pixels.
        lens: for predictions only; an ideal lens serves where none is known.
        allowed: (height, width) pixels of the reference frame that show the ground, as `ground_mask`.
    """

    def __init__(self, luma: Luma, points_raw: Floats, lens: Lens, allowed: NDArray[np.bool_]) -> None:
        self.patches = PatchTracker(luma, points_raw)
        self._lens = lens
        self._rays0 = lens.rays_from_raw(points_raw)
        self._J0_inverse = invert_2x2(lens.jacobian_raw_rays(self._rays0))
        self._finder = CameraFinder(luma, lens, allowed)

    def look_ahead(self, lumas: Iterable[Luma]) -> Iterator[View]:
        """Yield the frames after the reference frame as far as they can be followed, however noisy."""
        H = np.eye(3)
        for luma in lumas:
            found = self._refine(luma, H, least_score=ALIKE_SCORE)
            usual = float(np.nanmedian(found.matches.score)) if found is not None else 0.0
            if found is None or usual < ALIKE_SCORE:
                return
            H = found.H_ray_ray0
            yield View(luma, H, usual)

    def views(self, view: View) -> Singles:
        """Return the patches as a view shows them; see `PatchTracker.views`."""
        expected = self.predict(view.H_ray_ray0)
        return self.patches.views(view.luma, expected.raw, expected.ref_from_current)

    def find(self, luma: Luma, predicted_H_ray_ray0: Floats | None, *, is_view: bool = False) -> GroundMatch | None:
        """Return the ground in a frame, or None where it cannot be recognised.

        Args:
            luma: the frame.
            predicted_H_ray_ray0: from the frames before; None to search without a prediction.
            is_view: as for `PatchTracker.track`.
        """
        # A hovering camera may well see what it saw in the reference frame.
        expected = np.eye(3) if predicted_H_ray_ray0 is None else predicted_H_ray_ray0
        found = self._settled(luma, expected, is_view=is_view)
        if found is not None and found.inliers >= max(LEAST_POINTS, len(self.patches) // 4):
            return found
        searched = self._finder.search(luma)
        return None if searched is None else self._settled(luma, searched, is_view=is_view)

    def _settled(self, luma: Luma, H_ray_ray0: Floats, *, is_view: bool) -> GroundMatch | None:
        """Return the ground near where it is expected, or None where it comes to rest nowhere.

        A patch that is looked for some pixels beside its place may stop on the way there. So all are looked for again
        from where they have been found, until that is near where they were expected.
        """
        rounds = NOISY_ROUNDS if self.patches.is_averaged else 0
        for _ in range(MOST_ROUNDS):
            found = self._refine(luma, H_ray_ray0, is_view=is_view)
            if found is None:
                return None
            near = self._apart_px(found.H_ray_ray0, H_ray_ray0) < NEAR_PX
            if near and rounds == 0:
                return found
            rounds -= near
            H_ray_ray0 = found.H_ray_ray0
        return None

    def _apart_px(self, one: Floats, other: Floats) -> float:
        """Return the largest distance between where two homographies lead the features."""
        apart = apply_homography(one, self._rays0) - apply_homography(other, self._rays0)
        return float(np.abs(apart).max() * self._lens.focal_px.mean())

    def _refine(
        self, luma: Luma, H_ray_ray0: Floats, *, least_score: float | None = None, is_view: bool = False
    ) -> GroundMatch | None:
        expected = self.predict(H_ray_ray0)
        matches = self.patches.track(luma, expected.raw, expected.ref_from_current, is_view=is_view)
        good = np.flatnonzero(matches.score >= (least_score or self.patches.least_score))
        if len(good) < LEAST_POINTS:
            return None
        focal = float(self._lens.focal_px.mean())
        rays = expected.rays_seen(matches.raw)[good]
        H, inlier = fit_homography(self._rays0[good], rays, tolerance=1.0 / focal)
        if H is None or inlier.sum() < LEAST_POINTS:
            return None
        return GroundMatch(matches=matches, H_ray_ray0=H, inliers=int(inlier.sum()))

    def predict(self, H_ray_ray0: Floats) -> ExpectedFeatures:
        """Return where the features should be, and how they should look."""
        rays = apply_homography(H_ray_ray0, self._rays0)
        J_raw_rays = self._lens.jacobian_raw_rays(rays)
        J = J_raw_rays @ homography_jacobian(H_ray_ray0, self._rays0) @ self._J0_inverse
        usable: Bools = np.asarray(np.isfinite(J).all(axis=(1, 2)))
        J[~usable] = J_raw_rays[~usable] = np.eye(2)
        raw = np.where(usable[:, None], self._lens.raw_from_rays(rays), np.nan)
        return ExpectedFeatures(rays, raw, J_raw_rays, invert_2x2(J))


def fit_homography(source: Floats, target: Floats, *, tolerance: float) -> tuple[Floats | None, NDArray[np.bool_]]:
    """Return the robust homography target <- source and which of the N points agree within `tolerance`.

    Args:
        source, target: (N, 2), rays.
    """
    if len(source) < 4:
        return None, np.zeros(len(source), dtype=bool)
    H, mask = cv2.findHomography(source, target, cv2.RANSAC, 3.0 * tolerance, maxIters=300, confidence=0.999)
    # OpenCV's stubs promise a matrix, but degenerate points give none.
    found: Floats | None = None if H is None else np.asarray(H, dtype=np.float64)
    if found is None:
        return None, np.zeros(len(source), dtype=bool)
    error = np.linalg.norm(apply_homography(found, source) - target, axis=1)
    return found, (mask.ravel() > 0) & (error < 3.0 * tolerance)


class CameraFinder:
    """Recognises the ground without a prediction: after a cut, at the start of a chunk, after a gust.

    SIFT on pictures reduced to about a quarter; it serves only until the patches take over.

    Args:
        luma: the reference frame, (height, width).
        allowed: (height, width) bool, where there is ground.
    """

    def __init__(self, luma: Luma, lens: Lens, allowed: NDArray[np.bool_]) -> None:
        self._lens = lens
        self._size = luma.shape[::-1]
        factor = max(1, round(luma.shape[1] / SEARCH_WIDTH))
        self._small_size = (luma.shape[1] // factor, luma.shape[0] // factor)
        self._tolerance = factor / float(lens.focal_px.mean())
        # A roof full of features would win the vote for the homography and move the ground instead.
        kept = cv2.resize(allowed.astype(np.uint8), self._small_size, interpolation=cv2.INTER_NEAREST)
        self._allowed0: Luma = np.asarray(kept, dtype=np.uint8)
        self._small0 = self._reduced(luma)

    @cached_property
    def _features0(self) -> tuple[Floats, NDArray[np.float32]]:
        """Features of the reference frame; most clips are followed from end to end without them."""
        return self._detect(self._small0, self._allowed0)

    def search(self, luma: Luma) -> Floats | None:
        """Return H_ray_ray0 (3, 3), good to a few pixels, or None."""
        points0, descriptors0 = self._features0
        points, descriptors = self._detect(self._reduced(luma), None)
        if len(points) < LEAST_POINTS or len(points0) < LEAST_POINTS:
            return None
        both = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors, descriptors0, k=2)
        pairs = [m for m in both if len(m) == 2]
        kept = [(m.queryIdx, m.trainIdx) for m, second in pairs if m.distance < 0.8 * second.distance]
        if len(kept) < LEAST_POINTS:
            return None
        index = np.array(kept)
        source, target = points0[index[:, 1]], points[index[:, 0]]
        usable = finite_rows(source) & finite_rows(target)
        H, inlier = fit_homography(source[usable], target[usable], tolerance=self._tolerance)
        return H if inlier.sum() >= LEAST_POINTS else None

    def _reduced(self, luma: Luma) -> Luma:
        return np.asarray(cv2.resize(luma, self._small_size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def _detect(self, small: Luma, mask: Luma | None) -> tuple[Floats, NDArray[np.float32]]:
        # OpenCV's detectors differ in their defaults from build to build, so they are written out.
        detector = cv2.SIFT.create(nfeatures=1500, contrastThreshold=0.02)
        keypoints, descriptors = detector.detectAndCompute(small, mask)
        if not keypoints:
            return np.empty((0, 2)), np.empty((0, 128), dtype=np.float32)
        scale = np.array(self._size) / np.array(self._small_size)
        raw = (np.array([k.pt for k in keypoints], dtype=np.float64) + 0.5) * scale - 0.5
        return self._lens.rays_from_raw(raw), np.asarray(descriptors, dtype=np.float32)
