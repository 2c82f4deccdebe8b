"""The published method as its text reads, step by step over whole frames: what the engine's speed is compared with.

Undistort the frame, detect SIFT features in all of it, match them by brute force against the reference frame, fit a
homography, orthorectify the frame, run Canny in three regions of interest, pair edge points, fit lines, intersect.
SIFT stands in for SURF, which OpenCV's wheels do not carry.

Source: the paper, "UAV Drift and Perspective Correction", "Roof Feature Detection and Displacement Extraction".
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from core.coordinates import Floats, invert_homography
from core.ground import ground_mask
from core.project import LINE_NAMES, Band, Target
from core.run import LoadedInputs
from core.video import Luma

RATIO = 0.8
CANNY_LOW, CANNY_HIGH = 50, 110


class PublishedMethod:
    """Measures the first target of a project.

    Args:
        inputs: of the project.
        reference: its reference frame.
    """

    def __init__(self, inputs: LoadedInputs, reference: Luma) -> None:
        self._lens = inputs.lens
        self._allowed = ground_mask(reference.shape, inputs.project.moving_regions_px).astype(np.uint8)
        fit = inputs.reference_fit
        H_plan_und = fit.H_plan_ray @ np.linalg.inv(self._lens.camera_matrix)
        self._raster = _Raster(reference.shape, H_plan_und, fit.origin_m)
        self._sift = cv2.SIFT.create()
        self._matcher = cv2.BFMatcher(cv2.NORM_L2)
        undistorted = self._undistorted(reference)
        self._places, self._descriptors = self._features(undistorted)
        self._target = inputs.project.targets[0]
        self._widths: dict[str, int] = {}
        still = self._raster.warp(undistorted, np.eye(3))
        points = self._points(still)
        assert points is not None
        self._rest = points
        distance = float(np.linalg.norm(points[0] - points[1]))
        self._scale = (self._target.p1_p2_m or distance) / distance

    def displacement(self, luma: Luma) -> Floats | None:
        """Return the displacement (2, 2) of P1 and P2 in metres at roof level, or None where it cannot be told."""
        undistorted = self._undistorted(luma)
        places, descriptors = self._features(undistorted)
        pairs = self._matcher.knnMatch(descriptors, self._descriptors, k=2)
        good = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance]
        if len(good) < 12:
            return None
        here = places[[match.queryIdx for match in good]]
        there = self._places[[match.trainIdx for match in good]]
        H_und0_und, _ = cv2.findHomography(here, there, cv2.RANSAC, 2.0)
        points = self._points(self._raster.warp(undistorted, np.asarray(H_und0_und)))
        return None if points is None else self._scale * (points - self._rest)

    def _undistorted(self, luma: Luma) -> Luma:
        return np.asarray(cv2.undistort(luma, self._lens.camera_matrix, self._lens.distortion), dtype=np.uint8)

    def _features(self, luma: Luma) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        keypoints, descriptors = self._sift.detectAndCompute(luma, self._allowed)
        places = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float32)
        return places, np.asarray(descriptors, dtype=np.float32)

    def _points(self, orthorectified: Luma) -> Floats | None:
        """Return P1 and P2 (2, 2), plan metres."""
        lines = [self._line(orthorectified, band, name) for name, band in _bands(self._target)]
        if any(line is None for line in lines):
            return None
        l1, l2, t1 = (line for line in lines if line is not None)
        return np.array([_crossing(l1, t1), _crossing(l2, t1)])

    def _line(self, orthorectified: Luma, band: Band, name: str) -> Floats | None:
        """Return normal and offset (3,) of the mid-line of a band's edge pairs, plan metres."""
        ends = self._raster.pixels(np.array([band.from_m, band.to_m]))
        half = band.width_m / self._raster.pixel_m / 2
        low = np.maximum(np.floor(ends.min(axis=0) - half).astype(int), 0)
        high = np.ceil(ends.max(axis=0) + half).astype(int) + 1
        edges = cv2.Canny(orthorectified[low[1] : high[1], low[0] : high[0]], CANNY_LOW, CANNY_HIGH, L2gradient=True)
        v, u = np.nonzero(edges)
        along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        normal = np.array([-along[1], along[0]])
        from_start = np.column_stack([u, v]) + low - ends[0]
        across, place = from_start @ normal, np.rint(from_start @ along).astype(int)
        inside = np.abs(across) <= half
        strip = self._strip(across[inside], half, name)
        if strip is None:
            return None
        middles = []
        for station in np.unique(place[inside]):
            here = across[inside & (place == station)]
            sides = [here[np.abs(here - side) <= 1.5] for side in strip]
            if all(len(side) for side in sides):
                middles.append((station, (sides[0].mean() + sides[1].mean()) / 2))
        if len(middles) < 10:
            return None
        x, y = np.array(middles).T
        slope, intercept = np.polyfit(x, y, 1)
        ends_of_fit = np.array([[0.0], [1.0]])
        fitted = self._raster.plan(ends[0] + ends_of_fit * along + (intercept + slope * ends_of_fit) * normal)
        direction = fitted[1] - fitted[0]
        n = np.array([-direction[1], direction[0]]) / np.linalg.norm(direction)
        return np.array([*n, n @ fitted[0]])

    def _strip(self, across: Floats, half: float, name: str) -> tuple[float, float] | None:
        """Return where the two edges of the strip lie across the band: at rest near its axis, later as far apart."""
        bins = int(np.ceil(half)) + 1
        votes = np.convolve(np.bincount(np.rint(across).astype(int) + bins, minlength=2 * bins + 1), np.ones(3), "same")
        width = self._widths.get(name)
        widths = range(2, int(0.8 * half)) if width is None else (width,)
        best, strip = 5.0, None
        for apart in widths:
            for first in range(len(votes) - apart):
                off = (first + apart / 2 - bins) / (0.3 * half) if width is None else 0.0
                score = min(votes[first], votes[first + apart]) * np.exp(-(off**2))
                if score > best:
                    best, strip = score, (float(first - bins), float(first + apart - bins))
        if strip is not None:
            self._widths.setdefault(name, round(strip[1] - strip[0]))
        return strip


class _Raster:
    """Orthorectified frames, as large as the frames themselves, u east, v south.

    Args:
        shape: rows and columns.
        H_plan_und: of the reference frame.
        origin_m: (2,) local origin of the plan.
    """

    def __init__(self, shape: tuple[int, ...], H_plan_und: Floats, origin_m: Floats) -> None:
        rows, columns = shape[:2]
        corners = (
            np.array([[0, 0, 1], [columns - 1, 0, 1], [columns - 1, rows - 1, 1], [0, rows - 1, 1.0]]) @ H_plan_und.T
        )
        seen = corners[:, :2] / corners[:, 2:]
        west, north = seen[:, 0].min(), seen[:, 1].max()
        self.pixel_m = float(max(np.ptp(seen[:, 0]) / columns, np.ptp(seen[:, 1]) / rows))
        self._size = (columns, rows)
        self._corner_m = np.array([west, north]) + origin_m
        H_plan_raster = np.array([[self.pixel_m, 0, west], [0, -self.pixel_m, north], [0, 0, 1]])
        self._H_raster_und0 = invert_homography(H_plan_raster) @ H_plan_und

    def warp(self, undistorted: Luma, H_und0_und: Floats) -> Luma:
        """Return a frame orthorectified."""
        return np.asarray(
            cv2.warpPerspective(undistorted, self._H_raster_und0 @ H_und0_und, self._size), dtype=np.uint8
        )

    def pixels(self, plan_m: Floats) -> Floats:
        """Return raster pixels of plan metres (N, 2)."""
        return np.asarray((plan_m - self._corner_m) / self.pixel_m * [1, -1])

    def plan(self, pixels: Floats) -> Floats:
        """Return plan metres of raster pixels (N, 2)."""
        return np.asarray(pixels * [1, -1] * self.pixel_m + self._corner_m)


def _bands(target: Target) -> list[tuple[str, Band]]:
    assert target.lines is not None
    return [(name, getattr(target.lines, name)) for name in LINE_NAMES]


def _crossing(one: Floats, other: Floats) -> Floats:
    return np.asarray(np.linalg.solve(np.array([one[:2], other[:2]]), np.array([one[2], other[2]])))
