"""Reference patches found again in later frames, to a hundredth of a pixel.

Every patch is matched against the *reference* frame, never against the frame before, so errors cannot pile up. The
patch's predicted affine deformation (from the pose or homography) is applied to the reference, which is kept
oversampled; the later frame's pixels are used as they are. So the noisy side is never interpolated, which keeps the
estimate free of the half-pixel pull of an interpolated noise floor (Schreier & Sutton 2002), and light may change by a
gain and an offset. Where a single frame is too noisy to serve as the reference, the mean of several does.

Source: Lucas & Kanade (1981); Baker & Matthews (2004) for the forward-additive form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.coordinates import Floats, batches, invert_2x2
from core.video import Luma

Singles = NDArray[np.float32]

HALF_PX = 10  # patches of 21 x 21 pixels: 400 of them are 0.18 megapixel
MARGIN_PX = 6  # room for deformation and for the interpolation kernel
TILE_HALF_PX = HALF_PX + MARGIN_PX
OVERSAMPLING = 2  # linear interpolation between half pixels errs below the noise of 8-bit video
# A template reaches a pixel beyond its patch on all sides, for its slopes.
SIDE = 2 * HALF_PX + 1
TEMPLATE_SIDE = SIDE + 2
# Patches worked on together: what they need stays near the processor, which takes half the time.
BLOCK = 48
# Pictures that OpenCV samples are no higher than this.
MOST_ROWS = 32766
# A patch that takes more than a few steps shows something else.
MAX_ITERATIONS = 4
# Central differences see fine texture flatter than it is, and take steps too long by a seventh. Of a step shortened by
# that, what is left is a seventh at most, and nothing that patches have in common (measured on H.264 clips).
STEP_GAIN = 0.87
# A step as short as this is the last. What is left of it is each patch's own, and under two hundredths of a pixel.
SETTLED_PX = 0.12
# A patch that wanders further than this from its prediction has lost its own minimum.
MAX_WANDER_PX = 5.0
# Correlation below which a patch shows something else than in the reference frame.
LEAST_SCORE = 0.6
# An encoder copies some of a frame's noise into its neighbours, so this many views between the two halves are in
# neither mean.
VIEWS_BETWEEN = 4


@dataclass(frozen=True)
class Matches:
    """Where N reference patches were found in a frame.

    Attributes:
        raw: (N, 2) raw pixels, nan where not found.
        score: (N,) zero-mean normalised cross-correlation, nan where not found.
    """

    raw: Floats
    score: Floats


class PatchTracker:
    """N square patches of the reference frame, ready to be found in other frames.

    Args:
        luma: the reference frame, (height, width).
        points_raw: (N, 2) patch centres; at least `HALF_PX + MARGIN_PX + 1` pixels inside the frame.

    Attributes:
        least_score: correlation below which a patch shows something else.
    """

    def __init__(self, luma: Luma, points_raw: Floats) -> None:
        self.points_raw = np.array(points_raw, dtype=np.float64).reshape(-1, 2)
        self.least_score = LEAST_SCORE
        self._anchor = np.rint(self.points_raw).astype(np.int64)
        tiles = _cut_out(luma, self._anchor - TILE_HALF_PX, 2 * TILE_HALF_PX + 1)
        self._tiles: tuple[NDArray[Any], ...] = (tiles,)
        self._lay_out()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what the tiles say already: this travels to other processes."""
        return {name: getattr(self, name) for name in ("points_raw", "least_score", "_anchor", "_tiles")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lay_out()

    def _lay_out(self) -> None:
        corner = _tile_corners(len(self))
        self._mosaics = [_oversampled(_without_mean(tiles), corner) for tiles in self._tiles]
        # Pixel centres: enlarged index = OVERSAMPLING * (index + 1/2) - 1/2.
        self._tile_origin = corner + OVERSAMPLING * (TILE_HALF_PX + 0.5) - 0.5
        side = np.arange(-HALF_PX - 1, HALF_PX + 2, dtype=np.float64)
        u, v = np.meshgrid(side, side)
        self._grid = np.stack([u.ravel(), v.ravel(), np.ones(u.size)]).astype(np.float32)

    def __len__(self) -> int:
        return len(self.points_raw)

    @property
    def is_averaged(self) -> bool:
        """Whether the reference is a mean of noisy views."""
        return len(self._tiles) > 1

    def views(self, luma: Luma, raw: Floats, ref_from_current: Floats) -> Singles:
        """Return the patches as another frame shows them, laid over the reference, (N, size, size); nan beyond it.

        Args:
            luma: the frame, (height, width).
            raw: (N, 2) where the patches are in it.
            ref_from_current: (N, 2, 2) as in `track`.
        """
        side = np.arange(-TILE_HALF_PX, TILE_HALF_PX + 1, dtype=np.float64)
        grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
        offset = grid + (self._anchor - self.points_raw)[:, None]
        places = raw[:, None] + offset @ np.linalg.inv(ref_from_current).transpose(0, 2, 1)
        inside = ((places >= 0) & (places <= np.array(luma.shape[::-1]) - 1.0)).all(axis=(1, 2), keepdims=True)
        maps = np.where(inside, places, 0.0).astype(np.float32)
        sampled = cv2.remap(luma, maps[..., 0], maps[..., 1], cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
        tiles = sampled.reshape(-1, len(side), len(side)).astype(np.float32)
        return np.where(inside, tiles, np.float32(np.nan))

    def denoise(self, views: Sequence[Singles]) -> None:
        """Look for means of what several frames show from now on, instead of what the reference frame shows.

        Noise of the reference passes for fine texture, which makes steps too short: all patches alike would stay near
        where they were predicted, and the camera with them. Frames of the first half of the views, whose own noise is
        in their mean, are compared with that of the others. Without a view that shows a patch all stays as it is.

        Args:
            views: of the frames after the reference frame in turn; see `views`.
        """
        if not any(np.isfinite(view).any() for view in views):
            return
        middle, reference = len(views) // 2, self._tiles[0].astype(np.float32)
        first, second = [reference, *views[: middle - VIEWS_BETWEEN // 2]], views[middle + VIEWS_BETWEEN // 2 :]
        likeness = np.nanmedian([_correlation(reference, view) for view in views])
        # Two noisy views are as alike as the square of what a noisy one and one without noise are.
        self.least_score = LEAST_SCORE * float(np.sqrt(np.clip(likeness, 0.0, 1.0)))
        self._tiles = _mean_of_views(first, reference), _mean_of_views(second, reference)
        self._lay_out()

    def track(self, luma: Luma, predicted_raw: Floats, ref_from_current: Floats, *, is_view: bool = False) -> Matches:
        """Find the patches in a frame.

        Args:
            luma: the frame, (height, width).
            predicted_raw: (N, 2) where they should be; a pixel or two of error is corrected.
            ref_from_current: (N, 2, 2) local affine deformation, reference pixels by frame pixels.
            is_view: whether it is the reference frame or of the first half of the views, if those are averaged over.
        """
        mosaic = self._mosaics[-1 if is_view else 0]
        raw, score = np.full((len(self), 2), np.nan), np.full(len(self), np.nan)
        corner = np.rint(np.where(np.isfinite(predicted_raw), predicted_raw, -1e6)).astype(np.int64) - HALF_PX
        inside = ((corner >= 0) & (corner + SIDE <= np.array(luma.shape[::-1]))).all(axis=1)
        index = np.flatnonzero(inside)
        if not len(index):
            return Matches(raw, score)
        pixels = _cut_out(luma, corner[index], SIDE)
        found, score[index] = self._align(mosaic, index, pixels, predicted_raw[index], ref_from_current[index])
        wandered = np.abs(found - predicted_raw[index]).max(axis=1) > MAX_WANDER_PX
        found[wandered], score[index[wandered]] = np.nan, np.nan
        raw[index] = found
        return Matches(raw, score)

    def _align(
        self,
        mosaic: Singles,
        index: NDArray[np.int64],
        pixels: Luma,
        predicted_raw: Floats,
        ref_from_current: Floats,
    ) -> tuple[Floats, Floats]:
        """Return positions (n, 2) by Gauss-Newton steps and the correlation (n,) before the last step."""
        centre = np.rint(predicted_raw)
        position = predicted_raw.copy()
        score = np.zeros(len(index))
        active = np.arange(len(index))
        frame = _in_template_columns(_without_mean(pixels))
        energy = np.vecdot(frame, frame).astype(np.float64)
        for _ in range(MAX_ITERATIONS):
            offset, offset_ref = self._snapped(index[active], (centre - position)[active], ref_from_current[active])
            coefficients = self._coefficients(index[active], offset_ref, ref_from_current[active])
            step, score[active] = _step(energy, self._products(mosaic, coefficients, frame))
            position[active] = centre[active] - offset + step
            moving = (np.abs(step).max(axis=1) > SETTLED_PX) & (
                np.abs(position - predicted_raw)[active].max(axis=1) < 2 * MAX_WANDER_PX
            )
            active = active[moving]
            if not len(active):
                break
            frame, energy = frame[moving], energy[moving]
        return position, score

    def _snapped(self, index: NDArray[np.int64], offset: Floats, ref_from_current: Floats) -> tuple[Floats, Floats]:
        """Return frame offsets (n, 2) moved onto places the interpolation can reach exactly, and those places.

        `cv2.remap` knows 32 places between two samples. What it would round away is left to the step instead.
        """
        grid = 32 * OVERSAMPLING
        place = np.einsum("nij,nj->ni", ref_from_current, offset) + self.points_raw[index] - self._anchor[index]
        place = np.rint(place * grid) / grid
        within = place - self.points_raw[index] + self._anchor[index]
        return (invert_2x2(ref_from_current) @ within[..., None])[..., 0], place

    def _coefficients(self, index: NDArray[np.int64], place: Floats, ref_from_current: Floats) -> Singles:
        """Return affine maps (n, 2, 3) to the mosaic from pixels about the middles of patches, which are at `place`."""
        coefficients = np.concatenate([ref_from_current, place[..., None]], axis=2)
        coefficients *= OVERSAMPLING
        coefficients[..., 2] += self._tile_origin[index]
        return coefficients.astype(np.float32)

    def _products(self, mosaic: Singles, coefficients: Singles, frame: Singles) -> Floats:
        """Return what a step needs to know of the reference, as the frame should show it, and of the frame.

        Args:
            coefficients: (n, 2, 3) where in the mosaic to find it.
            frame: (n, SIDE * TEMPLATE_SIDE), as `_in_template_columns`.

        Returns:
            Scalar products (n, 3, 5) of the reference and of its differences over two pixels along u and v with those
            three, with the frame and with ones.
        """
        width = TEMPLATE_SIDE
        products = np.empty((len(frame), 3, 5), np.float32)
        work = np.ones((min(BLOCK, len(frame)), 5, SIDE * width), np.float32)
        for block in batches(len(frame), BLOCK):
            maps = coefficients[block] @ self._grid
            # A patch is one long row of all its rows. Differences across the seams fall into the outer columns.
            rows = cv2.remap(mosaic, maps[:, 0], maps[:, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            part = work[: len(rows)]
            np.multiply(rows[:, width:-width], _INNER_COLUMNS, out=part[:, 0])
            np.subtract(rows[:, width + 1 : 1 - width], rows[:, width - 1 : -width - 1], out=part[:, 1])
            np.subtract(rows[:, 2 * width :], rows[:, : -2 * width], out=part[:, 2])
            part[:, 1:3] *= _INNER_COLUMNS
            part[:, 3] = frame[block]
            np.matmul(part[:, :3], part.mT, out=products[block])
        return products.astype(np.float64)


def _tile_corners(count: int) -> NDArray[np.int64]:
    """Return the mosaic coordinates (N, 2), as u, v, of the first pixel of each oversampled tile."""
    number, tile = np.arange(count), (2 * TILE_HALF_PX + 1) * OVERSAMPLING
    # Below one another, pixels of a tile lie together in memory.
    below = MOST_ROWS // tile
    return np.stack([number // below, number % below], axis=1) * tile


def _oversampled(tiles: NDArray[Any], corner: NDArray[np.int64]) -> Singles:
    """Return one mosaic of oversampled tiles (N, size, size), laid out from their corners (N, 2)."""
    tile = tiles.shape[1] * OVERSAMPLING
    width, height = corner.max(axis=0, initial=0) + tile
    mosaic = np.zeros((height, width), dtype=np.float32)
    for patch, (left, top) in zip(tiles.astype(np.float32), corner, strict=True):
        large = cv2.resize(patch, (tile, tile), interpolation=cv2.INTER_LANCZOS4)
        mosaic[top : top + tile, left : left + tile] = large
    return mosaic


def _mean_of_views(views: Sequence[Singles], otherwise: Singles) -> Singles:
    """Return the mean (N, size, size) of views in which a tile is seen, or else another tile."""
    stack = np.stack(views)
    seen = np.isfinite(stack[:, :, 0, 0]).sum(axis=0)[:, None, None]
    mean = np.nansum(stack, axis=0) / np.maximum(seen, 1)
    return np.where(seen > 0, mean, otherwise).astype(np.float32)


def _cut_out(luma: Luma, corner: NDArray[np.int64], size: int) -> Luma:
    windows = np.lib.stride_tricks.sliding_window_view(luma, (size, size))
    return windows[corner[:, 1], corner[:, 0]]


def _correlation(left: Singles, right: Singles) -> Floats:
    """Return the zero-mean normalised cross-correlation (N,) of patches on two tiles each (N, size, size)."""
    within = slice(MARGIN_PX, -MARGIN_PX)
    a, b = (tiles[:, within, within].reshape(len(tiles), -1) for tiles in (left, right))
    a, b = (pixels - pixels.mean(axis=1, keepdims=True) for pixels in (a, b))
    return np.asarray(np.vecdot(a, b) / np.sqrt(np.maximum(np.vecdot(a, a) * np.vecdot(b, b), 1e-9)))


def _without_mean(tiles: NDArray[Any]) -> Singles:
    """Return tiles (N, size, size) less the mean of each."""
    return np.asarray(tiles - tiles.mean(axis=(1, 2), keepdims=True, dtype=np.float32), dtype=np.float32)


def _in_template_columns(pixels: Singles) -> Singles:
    """Return patches (n, SIDE, SIDE) as rows (n, SIDE * TEMPLATE_SIDE), 0 in the template's outer columns."""
    wide = np.zeros((len(pixels), SIDE, TEMPLATE_SIDE), np.float32)
    wide[:, :, 1:-1] = pixels
    return wide.reshape(len(pixels), -1)


_INNER_COLUMNS = _in_template_columns(np.ones((1, SIDE, SIDE), np.float32))[0]


def _step(energy: Floats, products: Floats) -> tuple[Floats, Floats]:
    """Return one Gauss-Newton step (n, 2) in pixels and the correlation (n,) before it.

    Args:
        energy: (n,) squared norm of the frame's pixels, each patch with zero mean.
        products: (n, 3, 5) as `PatchTracker._products`.
    """
    moment, frame_u, frame_v = products[:, :, 3].T
    # An offset of the light is taken out of the reference and its slopes, then its gain.
    sums = products[:, :, 4]
    free = products[:, :, :3] - sums[:, :, None] * sums[:, None, :] / SIDE**2
    energy, power = np.maximum(energy, 1e-9), np.maximum(free[:, 0, 0], 1e-9)
    score, gain = moment / np.sqrt(power * energy), moment / power
    across_u, across_v = free[:, 0, 1], free[:, 0, 2]
    # Differences over two pixels are twice the slopes.
    H_uu = 0.25 * (free[:, 1, 1] - across_u**2 / power)
    H_uv = 0.25 * (free[:, 1, 2] - across_u * across_v / power)
    H_vv = 0.25 * (free[:, 2, 2] - across_v**2 / power)
    b_u, b_v = 0.5 * (frame_u - across_u * gain), 0.5 * (frame_v - across_v * gain)
    determinant = H_uu * H_vv - H_uv**2
    usable = (determinant > 1e-6 * (H_uu + H_vv) ** 2) & (gain > 0.1)
    safe = np.where(usable, determinant * gain, 1.0)
    du = (H_vv * b_u - H_uv * b_v) / safe
    dv = (H_uu * b_v - H_uv * b_u) / safe
    step = np.where(usable[:, None], np.clip(-STEP_GAIN * np.stack([du, dv], axis=1), -2.0, 2.0), 0.0)
    return step, np.where(usable, score, 0.0)
