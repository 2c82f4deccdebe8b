"""The orthoimage, the rectified reference frame on its raster, and heights in the cloud."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Response

from app import orthoimages
from app.context import Context, Folder, Here
from app.errors import ApiError, NotYet
from app.frames import Picture, fingerprint, jpeg_of
from app.lumas import prepare_luma
from app.reference import H_plan_und, coarser, grid_of_frame, reference_fit
from app.sites import site_key
from app.store import ProjectFolder, problem_of
from core.coordinates import OrthoGrid
from core.errors import InputError
from core.georeference import ReferenceFit
from core.ground_plane import height_at
from core.orthoimage import rectify_frame
from core.project import Project

router = APIRouter(prefix="/api/projects/{project_id}")

_PIXELS = 8_000_000
Pixels = Annotated[int, Query(ge=10_000, le=60_000_000)]
# What lies outside the frame, as the page's own surround of pictures.
Outside = Annotated[str, Query(pattern="^[0-9a-fA-F]{6}$")]


@router.get("/orthoimage")
def orthoimage(folder: Folder, here: Here) -> dict[str, Any]:
    """Return the raster of the orthoimage and whether it still fits the project."""
    project = folder.load().project
    here.sites.begin(folder, project)
    state = orthoimages.state_of(folder, project)
    site = here.sites.site_if_read(folder, project)
    running = here.jobs.running(folder.id, "orthoimage")
    return {
        "ready": state.ready,
        "stale": state.stale,
        "grid": vars(state.grid) if state.grid else None,
        "ground_z_m": site.plane.at_m[2] if site else None,
        "spread_m": site.plane.elevation_std_m if site else None,
        "notes": state.note.get("notes", []),
        "measured_share": state.note.get("measured_share"),
        "filled_share": state.note.get("filled_share"),
        "job": running.as_json() if running and running.kind == "orthoimage" else None,
    }


@router.post("/orthoimage")
def make(folder: Folder, here: Here) -> dict[str, Any]:
    """Make the orthoimage in a job."""
    project = folder.load().project
    path = folder.require_input("cloud", project)
    order = {
        "cloud": str(path),
        "key": site_key(path, project),
        "ground_z_m": project.orthoimage.ground_z_m,
    }
    return {"job": here.jobs.start(folder, "orthoimage", order).as_json()}


@router.get("/orthoimage.png")
def picture(folder: Folder, w: Annotated[int | None, Query(ge=16, le=20_000)] = None) -> Response:
    """Return the orthoimage as PNG, transparent where the cloud is empty."""
    return _cacheable(orthoimages.png(folder, w), "image/png")


@router.get("/rectified")
def rectified(folder: Folder, here: Here, pixels: Pixels = _PIXELS) -> dict[str, Any]:
    """Return the raster of the rectified reference frame, or why there is none yet."""
    project = folder.load().project
    try:
        fit = reference_fit(here, folder, project)
    except (InputError, ApiError) as error:
        return {"ready": False, "message": problem_of(error), "grid": None}
    prepare_luma(fingerprint(folder.require_video(project)), project.reference_frame)
    return {"ready": True, "message": "", "grid": vars(coarser(plan_grid(folder, project, fit), pixels))}


@router.get("/rectified.jpg")
def rectified_picture(folder: Folder, here: Here, pixels: Pixels = _PIXELS, outside: Outside = "000000") -> Response:
    """Return the reference frame laid on the ground, on the raster of the orthoimage where there is one."""
    project = folder.load().project
    try:
        fit = reference_fit(here, folder, project)
    except InputError as error:
        raise NotYet(str(error), path="correspondences") from None
    grid = coarser(plan_grid(folder, project, fit), pixels)
    frame = here.frames.frame(folder.require_video(project), project.reference_frame)
    return _cacheable(_rectified(_Rectified(frame, fit, grid), outside), "image/jpeg")


class _Rectified:
    """A frame, a fit and a raster, equal to another where the picture would be."""

    def __init__(self, frame: Picture, fit: ReferenceFit, grid: OrthoGrid) -> None:
        self.frame, self.fit, self.grid = frame, fit, grid
        self._key = (id(frame), H_plan_und(fit).tobytes(), grid)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Rectified) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@lru_cache(maxsize=4)
def _rectified(wanted: _Rectified, outside: str) -> bytes:
    picture, beyond = rectify_frame(wanted.frame, wanted.fit.lens, H_plan_und(wanted.fit), wanted.grid)
    picture[beyond] = list(bytes.fromhex(outside))
    return jpeg_of(picture)


def plan_grid(folder: ProjectFolder, project: Project, fit: ReferenceFit) -> OrthoGrid:
    """Return the raster on which plan pictures are shown: the orthoimage's, or one around what the frame sees."""
    state = orthoimages.state_of(folder, project)
    return state.grid if state.grid is not None else grid_of_frame(fit, project)


@router.get("/height")
def height(folder: Folder, here: Here, x: float, y: float) -> dict[str, Any]:
    """Return the height of the cloud's upper surface above the ground plane."""
    return height_of_place(here, folder, x, y)


def height_of_place(here: Context, folder: ProjectFolder, x: float, y: float) -> dict[str, Any]:
    """Return the height at a place, its spread and how many points say so."""
    site = here.sites.site(folder, folder.load().project)
    height_m, spread_m, points = height_at(site.cloud, site.plane, np.array([x, y]))
    return {"height_m": height_m, "spread_m": spread_m, "points": points}


def _cacheable(content: bytes, media_type: str) -> Response:
    return Response(content, media_type=media_type, headers={"Cache-Control": "private, no-cache"})
