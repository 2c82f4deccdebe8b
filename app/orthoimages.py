"""The orthoimage of a project: whether it is there, whether it still fits the project, and its pictures."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from app.errors import ApiError
from app.frames import Fingerprint, Picture, fingerprint, identity, png_of, scaled_to
from app.sites import read_site
from app.store import CACHE_FOLDER, ProjectFolder, read_json
from core.coordinates import OrthoGrid
from core.errors import InputError
from core.orthoimage import (
    ORTHOIMAGE_FILE,
    make_orthoimage,
    origin_of,
    read_geotiff,
    read_grid,
    read_origin,
    write_geotiff,
    write_origin,
)
from core.progress import CancelToken, Progress
from core.project import RESULTS_FOLDER, Project, read_project
from core.storage import write_atomically

_NOTE = "orthoimage.json"


@dataclass(frozen=True)
class OrthoState:
    """An orthoimage on the disk.

    Attributes:
        ready: whether there is one.
        stale: whether cloud or settings have changed since.
        note: what was said when it was made: shares of measured and filled pixels, sentences.
    """

    ready: bool
    stale: bool
    grid: OrthoGrid | None
    note: dict[str, Any]


def state_of(folder: ProjectFolder, project: Project) -> OrthoState:
    """Return the state of a project's orthoimage, without reading its pixels."""
    file = folder.results / ORTHOIMAGE_FILE
    try:
        grid = _grid(fingerprint(file))
    except InputError:
        return OrthoState(ready=False, stale=False, grid=None, note={})
    note = read_json(folder.results / CACHE_FOLDER / _NOTE)
    note = note if isinstance(note, dict) and note.get("made") == list(fingerprint(file)[1:]) else {}
    return OrthoState(ready=True, stale=_is_stale(folder, project, grid), grid=grid, note=note)


@lru_cache(maxsize=32)
def _grid(key: Fingerprint) -> OrthoGrid:
    return read_grid(key[0])


def _is_stale(folder: ProjectFolder, project: Project, grid: OrthoGrid) -> bool:
    settings, extent = project.orthoimage, project.orthoimage.extent_m
    if abs(settings.pixel_size_m - grid.pixel_size_m) > 1e-9:
        return True
    if extent is not None and max(abs(a - b) for a, b in zip(extent, grid.extent_m, strict=True)) > grid.pixel_size_m:
        return True
    try:
        cloud = folder.input_path("cloud", project)
    except ApiError:
        return True
    if cloud is None or not cloud.is_file():
        return True
    return read_origin(folder.results / ORTHOIMAGE_FILE) != origin_of(identity(cloud), settings)


@lru_cache(maxsize=2)
def _pixels(key: Fingerprint) -> tuple[OrthoGrid, Picture]:
    return read_geotiff(key[0])


def pixels(folder: ProjectFolder) -> tuple[OrthoGrid, Picture]:
    """Return the raster and the picture, (height, width, 4) red, green, blue, opacity.

    Raises:
        InputError: there is none yet.
    """
    return _pixels(fingerprint(folder.results / ORTHOIMAGE_FILE))


def png(folder: ProjectFolder, width: int | None) -> bytes:
    """Return the picture as PNG, transparent where the cloud is empty.

    Raises:
        InputError: there is none yet.
    """
    return _png(fingerprint(folder.results / ORTHOIMAGE_FILE), width)


@lru_cache(maxsize=4)
def _png(key: Fingerprint, width: int | None) -> bytes:
    rgba = scaled_to(_pixels(key)[1], width)
    return png_of(rgba[..., :3], rgba[..., 3])


def build(folder: Path, order: dict[str, Any], progress: Progress, cancel: CancelToken) -> dict[str, Any]:
    """Make the orthoimage (the job `orthoimage`).

    Raises:
        InputError: the cloud or the settings cannot be used.
    """
    project = read_project(folder)
    site = read_site(folder, order, progress, cancel)
    cancel.raise_if_cancelled()
    ortho = make_orthoimage(site.cloud, site.plane, project.orthoimage, progress)
    cancel.raise_if_cancelled()
    file = folder / RESULTS_FOLDER / ORTHOIMAGE_FILE
    write_geotiff(file, ortho)
    write_origin(file, origin_of(identity(Path(order["cloud"])), project.orthoimage))
    note = {
        "made": list(fingerprint(file)[1:]),
        "measured_share": ortho.measured_share,
        "filled_share": ortho.filled_share,
        "spacing_m": ortho.spacing_m,
        "fill_limit_m": ortho.fill_limit_m,
        "notes": list(ortho.notes),
    }
    write_atomically(folder / RESULTS_FOLDER / CACHE_FOLDER / _NOTE, json.dumps(note).encode())
    return {"grid": vars(ortho.grid)}
