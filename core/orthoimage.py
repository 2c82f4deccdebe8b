"""Orthoimages: the cloud seen from straight above as a georeferenced raster, and frames laid on the same raster."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import ArrayLike, NDArray

from core.cloud import Cloud
from core.coordinates import Bools, Floats, OrthoGrid, apply_homography, batches
from core.errors import InputError
from core.ground_plane import RELIEF_REACH_M, GroundPlane
from core.lens import Lens
from core.progress import Progress, silent
from core.project import PROJECT_FILE
from core.project import Orthoimage as Settings
from core.storage import write_atomically

Pixels = NDArray[np.uint8]
Float32 = NDArray[np.float32]

ORTHOIMAGE_FILE = "orthoimage.tif"
MAX_PIXELS = 60_000_000
_LEAST_PIXELS = 16
# Finer than any scanner's beam, and coarser than what is clicked: both are another unit.
_PIXEL_SIZES_M = (0.001, 1.0)
# Larger gaps are shadows of the scanner, not spaces between neighbouring points.
MAX_FILL_M = 0.25
# A gap is filled up to this many times the spacing of the points around it.
_FILL_SPACINGS = 1.5
_SPACING_WINDOW_M = 1.0
# Fewer points than this in the window are stray: each keeps its own pixel and fills nothing.
_MIN_NEIGHBOURS = 4
# A square metre with less than this part of the usual number of ground points does not count for the extent.
_STRAY_SHARE = 0.02
# More metres than any site is wide: makes one whole number of the two of a square metre.
_FAR_M = 1 << 26
# Points this far below the surface around them are seen through its gaps.
_HIDDEN_BELOW_M = 0.5
# Points this near the highest one of their pixel belong to the same surface.
_SAME_SURFACE_M = 0.05
_STRIP_PIXELS = 6_000_000
_CHUNK_POINTS = 2_000_000


@dataclass(frozen=True, eq=False)
class Orthoimage:
    """The cloud from above.

    Attributes:
        grid: where the pixels lie in world coordinates.
        rgb: (height, width, 3) uint8, black where empty.
        empty: (height, width) True where nothing was scanned within reach.
        measured_share: part of the pixels that hold points of their own.
        filled_share: part of the pixels filled from neighbours.
        spacing_m: median spacing of the points where there are any.
        fill_limit_m: no pixel farther than this from a measured one was filled.
        notes: sentences on what was decided for the person.
    """

    grid: OrthoGrid
    rgb: Pixels
    empty: Bools
    measured_share: float
    filled_share: float
    spacing_m: float
    fill_limit_m: float
    notes: tuple[str, ...] = ()


def make_orthoimage(cloud: Cloud, plane: GroundPlane, settings: Settings, progress: Progress = silent) -> Orthoimage:
    """Look at the cloud from above: the top surface in its colours, else in its intensity, else shaded by height.

    Small gaps between neighbouring points are filled up to 1.5 times the spacing of the points around them and never
    farther than `MAX_FILL_M`; what lies beyond stays empty.

    Raises:
        InputError: the raster would be absurdly large or small, or holds no points.
    """
    grid, notes = _grid(cloud, plane, settings)
    values = _brightness(cloud, plane)
    rgb = np.zeros((grid.height, grid.width, 3), dtype=np.uint8)
    filled = np.zeros((grid.height, grid.width), dtype=np.bool_)
    measured_count, spacings = 0, list[Float32]()
    for first, last, strip in _strips(grid):
        surface = _top_surface(cloud, values, strip)
        inner = slice(first - surface.first_row, last - surface.first_row)
        spacing = _spacing_px(surface.count, grid.pixel_size_m)
        reach = np.minimum(_FILL_SPACINGS * spacing, MAX_FILL_M / grid.pixel_size_m)
        measured = surface.count > 0
        distance = cv2.distanceTransform((~measured).astype(np.uint8), cv2.DIST_L2, 5)
        within = measured | (distance <= reach)
        colour = _filled(surface.colour, measured, within & ~measured)
        rgb[first:last] = np.clip(np.round(colour[inner]), 0, 255)
        filled[first:last] = within[inner]
        measured_count += int(np.count_nonzero(measured[inner]))
        spacings.append(spacing[inner][measured[inner]][::97])
        progress("orthoimage", last, grid.height)
    if not measured_count:
        raise InputError(f"{PROJECT_FILE}: orthoimage.extent_m: holds no points of the cloud; correct it.")
    rgb[~filled] = 0
    return Orthoimage(
        grid=grid,
        rgb=rgb,
        empty=~filled,
        measured_share=measured_count / filled.size,
        filled_share=float(np.count_nonzero(filled) - measured_count) / filled.size,
        spacing_m=float(np.median(np.concatenate(spacings))) * grid.pixel_size_m,
        fill_limit_m=MAX_FILL_M,
        notes=notes,
    )


def _grid(cloud: Cloud, plane: GroundPlane, settings: Settings) -> tuple[OrthoGrid, tuple[str, ...]]:
    pixel = settings.pixel_size_m
    _refuse_if(size_obstacle(settings))
    extent, notes = (settings.extent_m, ()) if settings.extent_m else _extent_of_ground(cloud, plane, pixel)
    columns, rows = _pixels_of(extent, pixel)
    _refuse_if(_number_obstacle(columns, rows, pixel))
    return OrthoGrid(extent[0], extent[3], pixel, columns, rows), notes


def size_obstacle(settings: Settings) -> str | None:
    """Return what makes a raster absurd whatever the cloud, from its key in `project.json` on; None where nothing does.

    It has no end, as an obstacle of `core.roof_level`.
    """
    pixel, (least, most) = settings.pixel_size_m, _PIXEL_SIZES_M
    if not least <= pixel <= most:
        return (
            f"orthoimage.pixel_size_m: {pixel:g} is no size of a pixel in metres; choose one of {least:g} to {most:g}"
        )
    return None if settings.extent_m is None else _number_obstacle(*_pixels_of(settings.extent_m, pixel), pixel)


def _pixels_of(extent_m: tuple[float, float, float, float], pixel: float) -> tuple[int, int]:
    """Return how many columns and rows of pixels a raster has."""
    west, south, east, north = extent_m
    return int(np.ceil((east - west) / pixel - 1e-6)), int(np.ceil((north - south) / pixel - 1e-6))


def _number_obstacle(columns: int, rows: int, pixel: float) -> str | None:
    if columns * rows > MAX_PIXELS:
        enough = pixel * np.sqrt(columns * rows / MAX_PIXELS)
        return (
            f"orthoimage: {columns} x {rows} pixels are too many (limit {MAX_PIXELS // 1_000_000} million); "
            f"set pixel_size_m to {np.ceil(enough * 1000) / 1000:g} or more, or a smaller extent_m"
        )
    if min(columns, rows) < _LEAST_PIXELS:
        return (
            f"orthoimage: {columns} x {rows} pixels are too few (least {_LEAST_PIXELS} each way); set a smaller "
            "pixel_size_m or a larger extent_m"
        )
    return None


def _refuse_if(obstacle: str | None) -> None:
    if obstacle is not None:
        raise InputError(f"{PROJECT_FILE}: {obstacle}.")


def _extent_of_ground(
    cloud: Cloud, plane: GroundPlane, pixel: float
) -> tuple[tuple[float, float, float, float], tuple[str, ...]]:
    """Return where nearly all ground lies, each square metre counted once, on whole multiples of the pixel."""
    ground = np.abs(plane.height_of(cloud)) < RELIEF_REACH_M
    own = np.floor(cloud.points_m[ground, :2]).astype(np.int64)
    numbers, counts = np.unique(own[:, 0] * _FAR_M + own[:, 1], return_counts=True)
    east = np.round(numbers / _FAR_M)
    metres = np.stack([east, numbers - east * _FAR_M], axis=1)
    metres = metres[counts >= max(2.0, _STRAY_SHARE * float(np.median(counts)))]
    if not len(metres):
        raise InputError(
            f"{PROJECT_FILE}: orthoimage.extent_m: null, but the ground of the cloud is too thin to tell it; set it."
        )
    low, high = np.percentile(metres, 1, axis=0), np.percentile(metres, 99, axis=0) + 1
    notes: tuple[str, ...] = ()
    if np.prod((high - low) / pixel) > MAX_PIXELS:
        middle, half = (low + high) / 2, 0.999 * np.sqrt(MAX_PIXELS) * pixel / 2
        low, high = np.maximum(low, middle - half), np.minimum(high, middle + half)
        notes = (
            f"the ground reaches beyond the orthoimage, which was cut to {high[0] - low[0]:.0f} x "
            f"{high[1] - low[1]:.0f} m about its middle; set orthoimage.extent_m or a larger pixel_size_m.",
        )
    low, high = low + cloud.origin_m[:2], high + cloud.origin_m[:2]
    west, south = np.floor(low / pixel) * pixel
    east, north = np.ceil(high / pixel) * pixel
    return (float(west), float(south), float(east), float(north)), notes


def _brightness(cloud: Cloud, plane: GroundPlane) -> NDArray[Any]:
    """(N, 3) or (N, 1) what to show of each point: colour, else stretched intensity, else height."""
    if cloud.colour is not None:
        return cloud.colour
    shown = cloud.intensity
    if shown is None:
        shown = plane.height_of(cloud).astype(np.float32)
    low, high = np.percentile(shown[:: max(1, len(shown) // 500_000)], [2, 98])
    stretched = (shown - low) * np.float32(255 / max(high - low, 1e-9))
    return np.asarray(np.clip(stretched, 0, 255), dtype=np.uint8)[:, None]


@dataclass(frozen=True)
class _Strip:
    """Rows of the raster with their halo, worked on together so that memory does not grow with the image."""

    grid: OrthoGrid
    first_row: int
    last_row: int


def _strips(grid: OrthoGrid) -> Iterator[tuple[int, int, _Strip]]:
    halo = int(np.ceil((_SPACING_WINDOW_M + 2 * MAX_FILL_M) / grid.pixel_size_m))
    rows = max(64, _STRIP_PIXELS // grid.width)
    for first in range(0, grid.height, rows):
        last = min(first + rows, grid.height)
        yield first, last, _Strip(grid, max(0, first - halo), min(grid.height, last + halo))


@dataclass(frozen=True)
class _Surface:
    first_row: int
    colour: Float32
    count: NDArray[np.int32]


def _top_surface(cloud: Cloud, values: NDArray[Any], strip: _Strip) -> _Surface:
    """Mean colour (rows, width, 3) and number of points (rows, width) of the top surface of each pixel."""
    grid, rows = strip.grid, strip.last_row - strip.first_row
    top = np.full(rows * grid.width, -np.inf, dtype=np.float32)
    for cells, z, _ in _points_of(cloud, values, strip):
        np.maximum.at(top, cells, z)
    covered = _without_hidden(top.reshape(rows, grid.width), grid.pixel_size_m).ravel()
    count = np.zeros(rows * grid.width, dtype=np.int32)
    colour = np.zeros((rows * grid.width, 3), dtype=np.float32)
    for cells, z, shown in _points_of(cloud, values, strip):
        upper = z >= covered[cells] - _SAME_SURFACE_M
        cells, shown = cells[upper], shown[upper]
        np.add.at(count, cells, 1)
        for channel in range(3):
            np.add.at(colour[:, channel], cells, shown[:, channel % shown.shape[1]].astype(np.float32))
    colour /= np.maximum(count, 1)[:, None]
    return _Surface(strip.first_row, colour.reshape(rows, grid.width, 3), count.reshape(rows, grid.width))


def _points_of(
    cloud: Cloud, values: NDArray[Any], strip: _Strip
) -> Iterator[tuple[NDArray[np.int64], Float32, NDArray[Any]]]:
    """Chunks of points of a strip: flat pixel number, z, what to show."""
    grid = strip.grid
    corner = np.array([grid.west_m, grid.north_m]) - cloud.origin_m[:2]
    for batch in batches(len(cloud), _CHUNK_POINTS):
        points = cloud.points_m[batch]
        column = np.floor((points[:, 0] - corner[0]) / grid.pixel_size_m)
        row = np.floor((corner[1] - points[:, 1]) / grid.pixel_size_m) - strip.first_row
        inside = np.flatnonzero(
            (column >= 0) & (column < grid.width) & (row >= 0) & (row < strip.last_row - strip.first_row)
        )
        if len(inside):
            cells = row[inside].astype(np.int64) * grid.width + column[inside].astype(np.int64)
            yield cells, points[inside, 2].astype(np.float32), values[batch.start + inside]


def _without_hidden(top: Float32, pixel_size_m: float) -> Float32:
    """Raise pixels that show what lies below a surface with gaps, so that nothing of theirs counts.

    A closing of the height over the widest gap that is filled tells the surface that covers them.
    """
    if not np.isfinite(top).any():
        return top
    reach = max(1, round(0.5 * MAX_FILL_M / pixel_size_m))
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * reach + 1, 2 * reach + 1))
    lowest = np.float32(top[np.isfinite(top)].min() - 1.0)
    known = np.where(np.isfinite(top), top, lowest)
    closed = cv2.erode(cv2.dilate(known, kernel), kernel)
    return np.where(closed > known + _HIDDEN_BELOW_M, np.float32(np.inf), top)


def _spacing_px(count: NDArray[np.int32], pixel_size_m: float) -> Float32:
    """(rows, width) mean spacing of the points within about a metre around; 0, so no filling, where they are stray."""
    across = 2 * max(2, round(0.5 * _SPACING_WINDOW_M / pixel_size_m)) + 1
    # Points that share a pixel count once: what matters is the spacing of what is seen.
    density = cv2.blur((count > 0).astype(np.float32), (across, across), borderType=cv2.BORDER_REPLICATE)
    stray = density < (_MIN_NEIGHBOURS - 0.5) / across**2
    return np.where(stray, np.float32(0), 1 / np.sqrt(np.where(stray, np.float32(1), density)))


def _filled(colour: Float32, measured: Bools, gaps: Bools) -> Float32:
    """Fill gaps with the Gaussian-weighted mean of the measured pixels around them, each as sharply as it can be."""
    result, known, left = colour.copy(), measured.astype(np.float32), gaps.copy()
    sigma = 1.0
    while left.any():
        weight = cv2.GaussianBlur(known, (0, 0), sigma)
        # One measured pixel two sigma away is support enough.
        now = left & (weight * (2 * np.pi * sigma**2) > 0.13)
        if now.any():
            result[now] = cv2.GaussianBlur(colour, (0, 0), sigma)[now] / weight[now][:, None]
            left &= ~now
        sigma *= 2
    return result


def write_geotiff(path: Path | str, ortho: Orthoimage) -> None:
    """Write a georeferenced TIFF, atomically: red, green, blue, and opacity 0 where empty; cloud coordinates.

    Source: GeoTIFF 1.1 (OGC 19-008): pixel is area, so the tie point is the outer corner of the north-west pixel.
    """
    grid = ortho.grid
    opacity = np.where(ortho.empty, 0, 255).astype(np.uint8)
    keys = (1, 1, 0, 4, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32767, 3076, 0, 1, 9001)
    content = io.BytesIO()
    tifffile.imwrite(
        content,
        np.concatenate([ortho.rgb, opacity[..., None]], axis=2),
        photometric="rgb",
        extrasamples=["unassalpha"],
        compression="zlib",
        compressionargs={"level": 3},
        rowsperstrip=256,
        metadata=None,
        extratags=[
            (33550, "d", 3, (grid.pixel_size_m, grid.pixel_size_m, 0.0), True),
            (33922, "d", 6, (0.0, 0.0, 0.0, grid.west_m, grid.north_m, 0.0), True),
            (34735, "H", len(keys), keys, True),
        ],
    )
    write_atomically(Path(path), content.getvalue())


def read_geotiff(path: Path | str) -> tuple[OrthoGrid, Pixels]:
    """Read an orthoimage that `write_geotiff` wrote: its raster, and (height, width, 4) red, green, blue, opacity.

    Raises:
        InputError: the file is missing, damaged, or none of ours.
    """
    grid = read_grid(path)
    try:
        rgba = np.asarray(tifffile.imread(path), dtype=np.uint8)
    except (OSError, ValueError, tifffile.TiffFileError) as error:
        raise InputError(f"{path}: cannot be read ({error}); make the orthoimage again.") from None
    if rgba.shape != (grid.height, grid.width, 4):
        raise InputError(f"{path}: is no orthoimage of this program; make it again.")
    return grid, rgba


def read_grid(path: Path | str) -> OrthoGrid:
    """Return the raster of an orthoimage that `write_geotiff` wrote, without reading its pixels.

    Raises:
        InputError: as `read_geotiff`.
    """
    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages[0]
            assert isinstance(page, tifffile.TiffPage)
            scale, tie = page.tags[33550].value, page.tags[33922].value
            return OrthoGrid(float(tie[3]), float(tie[4]), float(scale[0]), page.imagewidth, page.imagelength)
    except FileNotFoundError:
        raise InputError(f"{path}: not found; make the orthoimage first.") from None
    except (OSError, ValueError, KeyError, IndexError, tifffile.TiffFileError) as error:
        raise InputError(f"{path}: is no orthoimage of this program ({error}); make it again.") from None


def origin_of(cloud_identity: str, settings: Settings) -> str:
    """Return what an orthoimage is made from, in words to compare: the cloud's content and the settings."""
    return f"{cloud_identity} {settings.model_dump_json()}"


def read_origin(orthoimage: Path) -> str | None:
    """Return what an orthoimage was made from; None where there is none, or nobody knows."""
    try:
        return _origin_file(orthoimage).read_text(encoding="utf-8") if orthoimage.exists() else None
    except OSError:
        return None


def write_origin(orthoimage: Path, origin: str) -> None:
    """Note beside an orthoimage what it was made from; see `origin_of`."""
    write_atomically(_origin_file(orthoimage), origin.encode())


def _origin_file(orthoimage: Path) -> Path:
    return orthoimage.with_suffix(".made-from")


def rectify_frame(frame: Pixels, lens: Lens, H_plan_und: ArrayLike, grid: OrthoGrid) -> tuple[Pixels, Bools]:
    """Lay a raw frame on the raster of an orthoimage; for pictures, nothing is measured in it.

    Args:
        frame: (rows, columns) or (rows, columns, 3) uint8, raw.
        lens: of the camera.
        H_plan_und: (3, 3) from undistorted pixels to plan metres.
        grid: the raster.

    Returns:
        The rectified frame of the raster's size, and a mask that is True where the frame does not reach.
    """
    H_und_ortho = np.linalg.inv(np.asarray(H_plan_und, dtype=np.float64)) @ grid.H_world_ortho
    frame = _softened(frame, lens, H_und_ortho, grid)
    rectified = np.zeros((grid.height, grid.width, *frame.shape[2:]), dtype=np.uint8)
    outside = np.ones((grid.height, grid.width), dtype=np.bool_)
    rows, last_pixel = max(1, 1_000_000 // grid.width), np.array([frame.shape[1] - 1, frame.shape[0] - 1])
    for first in range(0, grid.height, rows):
        last = min(first + rows, grid.height)
        raw = _raw_of_rows(lens, H_und_ortho, grid, first=first, last=last)
        with np.errstate(invalid="ignore"):
            inside = np.asarray(((raw >= 0) & (raw <= last_pixel)).all(axis=-1))
        places = np.where(inside[..., None], raw, 0.0).astype(np.float32)
        sampled = np.asarray(cv2.remap(frame, places[..., 0], places[..., 1], cv2.INTER_LINEAR))
        rectified[first:last][inside] = sampled[inside]
        outside[first:last] = ~inside
    return rectified, outside


def _raw_of_rows(lens: Lens, H_und_ortho: Floats, grid: OrthoGrid, *, first: int, last: int) -> Floats:
    u, v = np.meshgrid(np.arange(grid.width, dtype=np.float64), np.arange(first, last, dtype=np.float64))
    ortho = np.stack([u, v], axis=-1)
    raw = lens.distort(apply_homography(H_und_ortho, ortho))
    # Behind the camera the homography comes out of the other side of the horizon; what its axis meets lies ahead.
    met = np.linalg.solve(H_und_ortho, np.append(lens.centre_px, 1.0))
    ahead = (ortho @ H_und_ortho[2, :2] + H_und_ortho[2, 2]) * np.sign(met[2])
    raw[ahead <= 0] = np.nan
    return raw


def _softened(frame: Pixels, lens: Lens, H_und_ortho: Floats, grid: OrthoGrid) -> Pixels:
    """Blur a frame that will be shown smaller, as an area filter would, so that it does not alias."""
    middle = np.array([[grid.width / 2, grid.height / 2]])
    around = lens.distort(apply_homography(H_und_ortho, middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])))
    smaller = float(np.linalg.norm(around[1:] - around[0], axis=1).mean())
    if not smaller > 1.5:
        return frame
    return np.asarray(cv2.GaussianBlur(frame, (0, 0), min(0.4 * smaller, 20.0)), dtype=np.uint8)
