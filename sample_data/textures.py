"""Pictures of flat things at a known place: painted finer than the camera sees, blurred once to what a pixel sees."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal, cast

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Image = NDArray[np.float32]
Floats = NDArray[np.float64]

Colour = tuple[float, float]
"""Cb and Cr, offsets from grey."""

GREY: Colour = (0.0, 0.0)
CHROMA_STEP = 8
"""Texels of brightness per texel of colour, along each axis."""


@dataclass(frozen=True, eq=False)
class Texture:
    """What a plate looks like in its own metres (x east, y north at rest).

    Attributes:
        luma: (rows, columns) grey levels times cover; the first row is the northernmost.
        cover: (rows, columns) 0 where one looks past the plate, 1 where not; None if it has no edge.
        chroma: (rows / CHROMA_STEP, columns / CHROMA_STEP, 2) offsets of Cb and Cr from grey.
        west_m, north_m: outer corner of the first texel.
        texel_m: edge of a texel.
    """

    luma: Image
    cover: Image | None
    chroma: Image
    west_m: float
    north_m: float
    texel_m: float

    def texels(self, plan_m: Floats) -> Image:
        """Return the (..., 2) texel coordinates (column, row; 0 is a texel's centre) of plan metres (..., 2)."""
        column = (plan_m[..., 0] - self.west_m) / self.texel_m - 0.5
        row = (self.north_m - plan_m[..., 1]) / self.texel_m - 0.5
        return np.stack((column, row), axis=-1).astype(np.float32, copy=False)


class Canvas:
    """A flat area being painted; edges of boxes fall exactly where they should, also between texels."""

    def __init__(self, extent_m: tuple[float, float, float, float], texel_m: float, grey: float, colour: Colour = GREY):
        west, south, east, north = extent_m
        self.west_m, self.north_m, self.texel_m = west, north, texel_m
        rows = -(-int(np.ceil((north - south) / texel_m)) // CHROMA_STEP) * CHROMA_STEP
        columns = -(-int(np.ceil((east - west) / texel_m)) // CHROMA_STEP) * CHROMA_STEP
        self.luma = np.full((rows, columns), grey, np.float32)
        self.chroma = np.full((rows // CHROMA_STEP, columns // CHROMA_STEP, 2), colour, np.float32)

    def box(
        self, extent_m: tuple[float, float, float, float], grey: float, colour: Colour = GREY, opacity: float = 1.0
    ) -> None:
        """Paint a rectangle (west, south, east, north) with exact partial cover of the texels on its edges."""
        west, south, east, north = extent_m
        columns, across = self._overlap(west - self.west_m, east - self.west_m, self.luma.shape[1])
        rows, down = self._overlap(self.north_m - north, self.north_m - south, self.luma.shape[0])
        share = (opacity * np.outer(down, across)).astype(np.float32)
        part = self.luma[rows, columns]
        part += share * (np.float32(grey) - part)
        self._tint(rows, columns, share, colour)

    def polygon(self, corners_m: ArrayLike, grey: float, colour: Colour = GREY, opacity: float = 1.0) -> None:
        """Paint a polygon with (n, 2) corners, edges smoothed within a texel."""
        corners = (np.asarray(corners_m, dtype=np.float64) - [self.west_m, self.north_m]) / self.texel_m
        corners = corners * [1, -1] - 0.5
        low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 2, 0)
        high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 3, self.luma.shape[::-1])
        if np.any(high <= low):
            return
        mask = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
        cv2.fillPoly(mask, [np.round((corners - low) * 256).astype(np.int32)], 255, cv2.LINE_AA, 8)
        share = mask.astype(np.float32) * np.float32(opacity / 255)
        rows, columns = slice(low[1], high[1]), slice(low[0], high[0])
        part = self.luma[rows, columns]
        part += share * (np.float32(grey) - part)
        self._tint(rows, columns, share, colour)

    def line(self, points_m: ArrayLike, width_m: float, grey: float, opacity: float = 1.0) -> None:
        """Paint a polyline (n, 2) as a ribbon: a crack, a cable, a joint that runs askew."""
        points = np.asarray(points_m, dtype=np.float64)
        for start, end in itertools.pairwise(points):
            along = end - start
            across = np.array([-along[1], along[0]]) * (width_m / 2 / max(float(np.hypot(*along)), 1e-9))
            self.polygon([start + across, end + across, end - across, start - across], grey, opacity=opacity)

    def grain(self, rng: np.random.Generator, *, size_m: float, contrast: float, colour: float = 0.0) -> None:
        """Lighten and darken at random in patches of a size; `contrast` is one standard deviation, relative."""
        rows, columns = self.luma.shape
        step = max(size_m / self.texel_m, 1.0)
        coarse_shape = (int(rows / step) + 3, int(columns / step) + 3)
        coarse = rng.standard_normal(coarse_shape, dtype=np.float32)
        turn = np.array([[1 / step, 0, rng.uniform(0, 1)], [0, 1 / step, rng.uniform(0, 1)]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        fine = cast(Image, cv2.warpAffine(coarse, turn, (columns, rows), flags=flags, borderMode=cv2.BORDER_REFLECT))
        if colour:
            small = cast(Image, cv2.resize(fine, self.chroma.shape[1::-1], interpolation=cv2.INTER_AREA))
            self.chroma += small[:, :, None] * np.array([-colour, colour], np.float32)
        fine *= np.float32(contrast)
        fine += 1
        self.luma *= fine

    def finish(self, blur_m: float, *, has_edge: bool) -> Texture:
        """Return the texture as a pixel sees it: blurred by a Gaussian of one standard deviation `blur_m`."""
        sigma = blur_m / self.texel_m
        if not has_edge:
            return Texture(blurred(self.luma, sigma), None, self.chroma, self.west_m, self.north_m, self.texel_m)
        border = -(-int(np.ceil(4 * sigma) + 1) // CHROMA_STEP) * CHROMA_STEP
        cover = np.pad(np.ones_like(self.luma), border)
        chroma = np.pad(self.chroma, ((border // CHROMA_STEP,) * 2, (border // CHROMA_STEP,) * 2, (0, 0)), mode="edge")
        west, north = self.west_m - border * self.texel_m, self.north_m + border * self.texel_m
        luma = blurred(np.pad(self.luma, border), sigma)
        return Texture(luma, blurred(cover, sigma), chroma, west, north, self.texel_m)

    def _overlap(self, start_m: float, end_m: float, count: int) -> tuple[slice, Floats]:
        """Return the texels an interval touches and the share of each that it covers."""
        start, end = start_m / self.texel_m, end_m / self.texel_m
        first, last = max(int(np.floor(start)), 0), min(int(np.ceil(end)), count)
        texel = np.arange(first, max(last, first))
        return slice(first, max(last, first)), np.clip(np.minimum(texel + 1, end) - np.maximum(texel, start), 0, 1)

    def _tint(self, rows: slice, columns: slice, share: Image, colour: Colour) -> None:
        coarse_rows = slice(rows.start // CHROMA_STEP, -(-rows.stop // CHROMA_STEP))
        coarse_columns = slice(columns.start // CHROMA_STEP, -(-columns.stop // CHROMA_STEP))
        part = self.chroma[coarse_rows, coarse_columns]
        if part.size and share.size:
            weight = cv2.resize(share, part.shape[1::-1], interpolation=cv2.INTER_AREA)[:, :, None]
            part += weight * (np.array(colour, np.float32) - part)


def blurred(image: Image, sigma: float) -> Image:
    """Return the image after a Gaussian of one standard deviation `sigma`, texels; it goes on mirrored beyond."""
    return cast(Image, cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT))


Beyond = Literal["edge", "mirror", "nothing"]
_BORDERS = {"edge": cv2.BORDER_REPLICATE, "mirror": cv2.BORDER_REFLECT_101, "nothing": cv2.BORDER_CONSTANT}


def sample(image: Image, places: Image, beyond: Beyond) -> Image:
    """Return the image's values between texels: (rows, columns[, channels]) at (column, row) places (rows, columns, 2).

    `beyond` its edge one sees the nearest texel, the image mirrored, or zero.
    """
    # OpenCV's type stubs do not know that the second map may be left out.
    one_map = cast(NDArray[np.float32], None)
    return cast(Image, cv2.remap(image, places, one_map, cv2.INTER_LINEAR, borderMode=_BORDERS[beyond]))


def look_up(image: Image, places: Image) -> Floats:
    """Return the image's values (n,) at scattered (column, row) places (n, 2); beyond its edge, the nearest one's."""
    most = 30_000  # OpenCV's remap takes no longer row
    values = [sample(image, places[None, i : i + most], "edge")[0] for i in range(0, len(places), most)]
    return np.concatenate(values).astype(np.float64) if values else np.empty(0)
