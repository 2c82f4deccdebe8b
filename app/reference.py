"""The reference frame on the ground, as the engine fits it to the pairs of a project; kept while nothing changes."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from app.context import Context
from app.frames import Fingerprint, fingerprint
from app.store import ProjectFolder
from app.videos import video_info
from core.coordinates import Floats, OrthoGrid, is_in_frame
from core.errors import InputError
from core.georeference import ReferenceFit, fit_reference
from core.lens import Lens, read_lens, require_image_size
from core.project import Correspondence, Project

_KEPT = 64
_fits: OrderedDict[Any, ReferenceFit | InputError] = OrderedDict()
_lock = threading.Lock()


def lens_of(folder: ProjectFolder, project: Project) -> tuple[Lens, bool]:
    """Return the project's lens, and whether it is known; an ideal one stands in where none is given.

    Raises:
        InputError: the lens file cannot be used, or is another camera's.
    """
    video = folder.require_video(project)
    info = video_info(video)
    size = {"width": info.width, "height": info.height}
    if project.inputs.lens is None:
        return Lens.stand_in((info.width, info.height)), False
    path = folder.require_input("lens", project)
    lens = _lens(fingerprint(path))
    require_image_size(lens, **size, lens_file=path.name, video_file=video.name)
    return lens, True


def outside_frame(folder: ProjectFolder, project: Project, pairs: Sequence[Correspondence]) -> str:
    """Return which of the pairs that count lie beside the picture, and what to do; empty where none does.

    Raises:
        ApiError, InputError: the video or the lens cannot be used.
    """
    width, height = lens_of(folder, project)[0].image_size_px
    beside = [str(pair.id) for pair in pairs if pair.enabled and not is_in_frame(pair.frame_px, width, height)]
    if not beside:
        return ""
    frame = f"the {width} × {height} frame"
    if len(beside) == 1:
        return f"Pair {beside[0]} lies outside {frame}; move it, or switch it off."
    return f"Pairs {', '.join(beside)} lie outside {frame}; move them, or switch them off."


@lru_cache(maxsize=32)
def _lens(key: Fingerprint) -> Lens:
    return read_lens(Path(key[0]))


def reference_fit(
    here: Context, folder: ProjectFolder, project: Project, pairs: Sequence[Correspondence] | None = None
) -> ReferenceFit:
    """Return the fit of the project's pairs, or of others in their place.

    Raises:
        InputError: there is no fit, and why.
    """
    chosen = tuple(project.correspondences if pairs is None else pairs)
    lens, has_lens = lens_of(folder, project)
    elevation_m = _elevation(here, folder, project, chosen)
    key = (chosen, lens.camera_matrix.tobytes(), lens.distortion.tobytes(), has_lens, elevation_m.tobytes())
    with _lock:
        found = _fits.get(key)
    if found is None:
        try:
            found = fit_reference(chosen, lens, has_lens=has_lens, elevation_m=elevation_m)
        except InputError as error:
            found = error
        with _lock:
            _fits[key] = found
            while len(_fits) > _KEPT:
                _fits.popitem(last=False)
    if isinstance(found, InputError):
        raise InputError(str(found))
    return found


def _elevation(here: Context, folder: ProjectFolder, project: Project, pairs: tuple[Correspondence, ...]) -> Floats:
    """Return (len(pairs),) of the ground clicks above the ground, as the engine takes them from the cloud's relief."""
    relief = here.sites.relief(folder, project)
    if relief is None or not pairs:
        return np.zeros(len(pairs))
    return relief.at(np.array([pair.ground_m for pair in pairs]))


def H_plan_und(fit: ReferenceFit) -> Floats:
    """Return (3, 3) from undistorted pixels of the reference frame to absolute plan metres."""
    shift = np.array([[1.0, 0.0, fit.origin_m[0]], [0.0, 1.0, fit.origin_m[1]], [0.0, 0.0, 1.0]])
    return np.asarray(shift @ fit.H_plan_ray @ np.linalg.inv(fit.lens.camera_matrix))


def grid_of_frame(fit: ReferenceFit, project: Project) -> OrthoGrid:
    """Return a raster that holds what the reference frame sees of the ground around the clicked pairs."""
    width, height = fit.lens.image_size_px
    u, v = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 9))
    seen = fit.plan_from_raw(np.stack([u.ravel(), v.ravel()], axis=-1))
    ground = np.array([pair.ground_m for pair in project.correspondences if pair.enabled])
    # A frame that sees the horizon reaches to infinity: keep to thrice the extent of the clicked ground.
    middle, reach = (ground.min(axis=0) + ground.max(axis=0)) / 2, 1.5 * np.ptp(ground, axis=0).max() + 5.0
    seen = np.clip(seen[np.isfinite(seen).all(axis=1)], middle - reach, middle + reach)
    pixel = project.orthoimage.pixel_size_m
    west, south = np.floor(seen.min(axis=0) / pixel) * pixel
    columns, rows = np.ceil((seen.max(axis=0) - [west, south]) / pixel).astype(int)
    return OrthoGrid(float(west), float(south + rows * pixel), pixel, int(columns), int(rows))


def coarser(grid: OrthoGrid, pixels: int) -> OrthoGrid:
    """Return a raster over the same ground with no more than so many pixels."""
    factor = int(np.ceil(np.sqrt(max(1.0, grid.width * grid.height / pixels))))
    if factor == 1:
        return grid
    size = {"width": -(-grid.width // factor), "height": -(-grid.height // factor)}
    return OrthoGrid(grid.west_m, grid.north_m, grid.pixel_size_m * factor, **size)
