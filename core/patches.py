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

from core.coordinates import Floats
from core.video import Luma

Singles = NDArray[np.float32]

HALF_PX = 10  # patches of 21 x 21 pixels: 400 of them are 0.18 megapixel
MARGIN_PX = 6  # room for deformation and for the interpolation kernel
TILE_HALF_PX = HALF_PX + MARGIN_PX
OVERSAMPLING = 2  # linear interpolation between half pixels errs below the noise of 8-bit video
# A patch that takes more than a few steps shows something else.
MAX_ITERATIONS = 4
# Central differences see fine texture flatter than it is, and take steps too long by a seventh. Of a step shortened by
# that, what is left is a seventh at most, and nothing that patches have in common (measured on H.264 clips).
STEP_GAIN = 0.87
SETTLED_PX = 0.06
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
        self._mosaics = [_oversampled(tiles, corner) for tiles in self._tiles]
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
        in their mean, are compared with that of the others.

        Args:
            views: of the frames after the reference frame in turn; see `views`.
        """
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
        size = 2 * HALF_PX + 1
        inside = ((corner >= 0) & (corner + size <= np.array(luma.shape[::-1]))).all(axis=1)
        index = np.flatnonzero(inside)
        if not len(index):
            return Matches(raw, score)
        pixels = _cut_out(luma, corner[index], size).astype(np.float32)
        found, score[index] = self._align(mosaic, index, pixels, predicted_raw[index], ref_from_current[index])
        wandered = np.abs(found - predicted_raw[index]).max(axis=1) > MAX_WANDER_PX
        found[wandered], score[index[wandered]] = np.nan, np.nan
        raw[index] = found
        return Matches(raw, score)

    def _align(
        self,
        mosaic: Singles,
        index: NDArray[np.int64],
        pixels: Singles,
        predicted_raw: Floats,
        ref_from_current: Floats,
    ) -> tuple[Floats, Floats]:
        """Return positions (n, 2) by Gauss-Newton steps and the correlation (n,) before the last step."""
        centre = np.rint(predicted_raw)
        position = predicted_raw.copy()
        score = np.zeros(len(index))
        active = np.arange(len(index))
        frame = pixels.reshape(len(index), -1)
        frame -= frame.mean(axis=1, keepdims=True)
        energy = np.vecdot(frame, frame).astype(np.float64)
        for _ in range(MAX_ITERATIONS):
            offset, offset_ref = self._snapped(index[active], (centre - position)[active], ref_from_current[active])
            template = self._template(mosaic, index[active], offset_ref, ref_from_current[active])
            step, score[active] = _step(frame, energy, template)
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
        return np.linalg.solve(ref_from_current, within[..., None])[..., 0], place

    def _template(self, mosaic: Singles, index: NDArray[np.int64], place: Floats, ref_from_current: Floats) -> Singles:
        """Return the reference as the frame should show it, (n, size + 2, size + 2), around `place` (n, 2) of it."""
        coefficients = np.concatenate([ref_from_current, place[..., None]], axis=2)
        coefficients *= OVERSAMPLING
        coefficients[..., 2] += self._tile_origin[index]
        maps = coefficients.astype(np.float32) @ self._grid
        side = 2 * HALF_PX + 3
        sampled = cv2.remap(mosaic, maps[:, 0], maps[:, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(sampled, dtype=np.float32).reshape(len(index), side, side)


def _tile_corners(count: int) -> NDArray[np.int64]:
    """Return the mosaic coordinates (N, 2), as u, v, of the first pixel of each oversampled tile."""
    number, columns = np.arange(count), max(1, int(np.ceil(np.sqrt(count))))
    return np.stack([number % columns, number // columns], axis=1) * (2 * TILE_HALF_PX + 1) * OVERSAMPLING


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
    return _products(a, b) / np.sqrt(np.maximum(_products(a, a) * _products(b, b), 1e-9))


def _step(frame: Singles, energy: Floats, template: Singles) -> tuple[Floats, Floats]:
    """Return one Gauss-Newton step (n, 2) in pixels and the correlation (n,) before it.

    Args:
        frame: (n, pixels) the frame's pixels, each patch with zero mean.
        energy: (n,) their squared norms.
        template: (n, size + 2, size + 2) the reference around the same pixels.
    """
    n = len(frame)
    inner = np.ascontiguousarray(template[:, 1:-1, 1:-1]).reshape(n, -1)
    inner -= inner.mean(axis=1, keepdims=True)
    gradient_u = (template[:, 1:-1, 2:] - template[:, 1:-1, :-2]).reshape(n, -1)
    gradient_v = (template[:, 2:, 1:-1] - template[:, :-2, 1:-1]).reshape(n, -1)
    power, moment = _products(inner, inner), _products(inner, frame)
    energy, power = np.maximum(energy, 1e-9), np.maximum(power, 1e-9)
    score, gain = moment / np.sqrt(power * energy), moment / power
    # An offset of the light is taken out of the gradients first (the others have zero mean), then its gain.
    mean_u, mean_v = gradient_u.sum(axis=1, dtype=np.float64), gradient_v.sum(axis=1, dtype=np.float64)
    across_u, across_v = _products(gradient_u, inner), _products(gradient_v, inner)
    count = inner.shape[1]
    H_uu = 0.25 * (_products(gradient_u, gradient_u) - mean_u**2 / count - across_u**2 / power)
    H_uv = 0.25 * (_products(gradient_u, gradient_v) - mean_u * mean_v / count - across_u * across_v / power)
    H_vv = 0.25 * (_products(gradient_v, gradient_v) - mean_v**2 / count - across_v**2 / power)
    b_u = 0.5 * (_products(gradient_u, frame) - across_u * gain)
    b_v = 0.5 * (_products(gradient_v, frame) - across_v * gain)
    determinant = H_uu * H_vv - H_uv**2
    usable = (determinant > 1e-6 * (H_uu + H_vv) ** 2) & (gain > 0.1)
    safe = np.where(usable, determinant * gain, 1.0)
    du = (H_vv * b_u - H_uv * b_v) / safe
    dv = (H_uu * b_v - H_uv * b_u) / safe
    step = np.where(usable[:, None], np.clip(-STEP_GAIN * np.stack([du, dv], axis=1), -2.0, 2.0), 0.0)
    return step, np.where(usable, score, 0.0)


def _products(left: Singles, right: Singles) -> Floats:
    return np.asarray(np.vecdot(left, right), dtype=np.float64)
