"""The reference frame on the ground.

Fit of the clicked pairs, points led from one frame of reference to another, and what the engine sees in the bands.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from app import orthoimages
from app.answers import points
from app.api.projects import Body
from app.context import Context, Folder, Here
from app.errors import ApiError, Invalid, NotYet
from app.frames import fingerprint
from app.lumas import luma_of
from app.reference import H_plan_und, grid_of_frame, lens_of, outside_frame, reference_fit
from app.store import ProjectFolder, problem_of
from core.camera import Pose
from core.coordinates import Floats, apply_homography
from core.errors import InputError
from core.georeference import COVERAGE_CELLS, ReferenceFit
from core.preview import TargetPreview, preview_bands, preview_target
from core.project import LINE_NAMES, Band, Correspondence, Project, Target
from core.results import plain

router = APIRouter(prefix="/api/projects/{project_id}")

FrameName = Literal["raw", "und", "plan", "ortho", "world"]
# Enough for every mark on a page; more would be somebody's mistake.
_MOST_POINTS = 20_000
Drawable = TypeVar("Drawable", bound=BaseModel)


class Pairs(Body):
    """Pairs to be fitted in place of the project's own."""

    correspondences: tuple[Correspondence, ...] | None = None


@router.post("/fit")
def fit(folder: Folder, here: Here, wanted: Pairs | None = None) -> dict[str, Any]:
    """Return the fit of the pairs, with every pair's residual and leave-one-out error; or why there is none."""
    project = folder.load().project
    pairs = project.correspondences
    if wanted is not None and wanted.correspondences is not None:
        pairs = wanted.correspondences
    here.sites.begin(folder, project)
    coverage = _coverage(here, folder, project, pairs)
    beside = ""
    try:
        beside = outside_frame(folder, project, pairs)
        found = reference_fit(here, folder, project, pairs)
    except (InputError, ApiError) as error:
        return _no_fit(pairs, beside or problem_of(error), coverage)
    return {
        "state": "ok",
        "message": beside,
        "rms_px": found.rms_px,
        "rms_m": found.rms_m,
        "loo_rms_px": found.left_out_rms_px,
        "pairs": [
            {
                "id": pair.id,
                "enabled": pair.enabled,
                "residual_px": plain(pair.residual_px),
                "residual_m": plain(pair.residual_m),
                "loo_px": plain(pair.left_out_px),
                "loo_m": plain(pair.left_out_m),
                "predicted_px": plain(pair.predicted_raw),
                "predicted_m": plain(pair.predicted_m),
            }
            for pair in found.pairs
        ],
        "coverage": coverage,
        "camera": _camera(found),
        "H_plan_und": plain(H_plan_und(found)),
    }


def _no_fit(pairs: tuple[Correspondence, ...], message: str, coverage: dict[str, Any] | None) -> dict[str, Any]:
    enabled = sum(pair.enabled for pair in pairs)
    state = "too_few" if enabled < 4 else "collinear" if "collinear" in message else "refused"
    nothing = ("rms_px", "rms_m", "loo_rms_px", "camera", "H_plan_und")
    message = message.removeprefix("project.json: ")
    return {"state": state, "message": message, "pairs": [], "coverage": coverage, **dict.fromkeys(nothing)}


def _coverage(
    here: Context, folder: ProjectFolder, project: Project, pairs: tuple[Correspondence, ...]
) -> dict[str, Any] | None:
    """Count the enabled clicks in each cell of the frame, rows from the top."""
    try:
        width, height = lens_of(folder, project)[0].image_size_px
    except (InputError, ApiError):
        return None
    grid = np.zeros((COVERAGE_CELLS, COVERAGE_CELLS), dtype=int)
    for pair in pairs:
        if pair.enabled:
            cell = np.clip(np.array(pair.frame_px) / [width, height] * COVERAGE_CELLS, 0, COVERAGE_CELLS - 1)
            grid[int(cell[1]), int(cell[0])] += 1
    return {"grid": grid.tolist(), "share": float((grid > 0).mean())}


def _camera(found: ReferenceFit) -> dict[str, Any] | None:
    pose: Pose | None = found.pose
    if pose is None:
        return None
    ahead = pose.R[2]
    up_in_image = -pose.R[1]
    return {
        "centre_m": [*(pose.centre_m[:2] + found.origin_m).tolist(), float(pose.centre_m[2])],
        "height_m": float(pose.centre_m[2]),
        "tilt_deg": float(np.degrees(np.arccos(np.clip(-ahead[2], -1.0, 1.0)))),
        # Clockwise from north to the direction the top of the frame points to.
        "azimuth_deg": float(np.degrees(np.arctan2(up_in_image[0], up_in_image[1])) % 360.0),
        "R": plain(pose.R),
    }


class Points(Body):
    """Points to be led from one frame of reference to another; `world` lies at `height_m` above the ground."""

    model_config = ConfigDict(extra="forbid", populate_by_name=True)

    source: FrameName = Field(alias="from")
    to: FrameName
    height_m: float | None = None
    points: Annotated[list[tuple[float, float]], Field(max_length=_MOST_POINTS)]


@router.post("/transform")
def transform(wanted: Points, folder: Folder, here: Here) -> dict[str, Any]:
    """Return points of the reference frame in another frame of reference; null where one has no image there."""
    project = folder.load().project
    given = np.array(wanted.points, dtype=np.float64).reshape(-1, 2)
    if wanted.source == wanted.to:
        return {"points": points(given)}
    if {wanted.source, wanted.to} == {"raw", "und"}:
        lens = lens_of(folder, project)[0]
        return {"points": points(lens.undistort(given) if wanted.to == "und" else lens.distort(given))}
    with np.errstate(all="ignore"):
        return {
            "points": points(_from_plan(here, folder, project, wanted, _to_plan(here, folder, project, wanted, given)))
        }


def _fit_for_points(here: Context, folder: ProjectFolder, project: Project) -> ReferenceFit:
    try:
        return reference_fit(here, folder, project)
    except InputError as error:
        raise NotYet(str(error), path="correspondences") from None


def _height(wanted: Points) -> float:
    if wanted.height_m is None:
        raise Invalid("height_m is missing; world points lie at a height above the ground.", path="height_m")
    return wanted.height_m


def _to_plan(here: Context, folder: ProjectFolder, project: Project, wanted: Points, given: Floats) -> Floats:
    if wanted.source == "plan":
        return given
    if wanted.source == "ortho":
        return apply_homography(_ortho_grid(here, folder, project).H_world_ortho, given)
    found = _fit_for_points(here, folder, project)
    if wanted.source == "world":
        return found.plan_from_world(given, _height(wanted))
    return found.plan_from_raw(given if wanted.source == "raw" else found.lens.distort(given))


def _from_plan(here: Context, folder: ProjectFolder, project: Project, wanted: Points, plan: Floats) -> Floats:
    if wanted.to == "plan":
        return plan
    if wanted.to == "ortho":
        return apply_homography(_ortho_grid(here, folder, project).H_ortho_world, plan)
    found = _fit_for_points(here, folder, project)
    if wanted.to == "world":
        return found.world_from_plan(plan, _height(wanted))
    rays = found.rays_from_plan(plan)
    return found.lens.raw_from_rays(rays) if wanted.to == "raw" else found.lens.und_from_rays(rays)


def _ortho_grid(here: Context, folder: ProjectFolder, project: Project) -> Any:
    grid = orthoimages.state_of(folder, project).grid
    return grid if grid is not None else grid_of_frame(_fit_for_points(here, folder, project), project)


class Drawn(Body):
    """A target as it is being drawn: some of its bands may still be missing."""

    target: dict[str, Any]


@router.post("/lines/preview")
def preview(wanted: Drawn, folder: Folder, here: Here) -> dict[str, Any]:
    """Return the edges, lines and points the engine finds in a target's bands in the reference frame."""
    project = folder.load().project
    found = _fit_for_points(here, folder, project)
    luma = luma_of(fingerprint(folder.require_video(project)), project.reference_frame)
    lines = wanted.target.get("lines")
    if isinstance(lines, dict) and 0 < sum(lines.get(name) is not None for name in LINE_NAMES) < len(LINE_NAMES):
        bands = {name: _valid(Band, lines[name], f"lines.{name}") for name in LINE_NAMES if lines.get(name)}
        return _previewed(preview_bands(luma, bands, found, name=str(wanted.target.get("name", "target"))))
    return _previewed(preview_target(luma, _valid(Target, wanted.target, "target"), found))


def _valid(model: type[Drawable], given: Any, path: str) -> Drawable:
    try:
        return model.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join([path, *(str(part) for part in first["loc"])])
        raise Invalid(f"{place}: {first['msg'].removeprefix('Value error, ')}.", path=place) from None


def _previewed(seen: TargetPreview) -> dict[str, Any]:
    lines = {}
    for name, line in seen.lines.items():
        lines[name] = {
            "band_plan": plain(line.band_plan),
            "band_raw": points(line.band_raw),
            "edges_plan": [plain(line.edges_plan[:, side]) for side in (0, 1)],
            "edges_raw": [plain(line.edges_raw[:, side]) for side in (0, 1)],
            "midline_plan": plain(line.midline_plan),
            "midline_raw": plain(line.midline_raw),
            "rms_px": line.rms_px,
            "points": 2 * len(line.edges_raw),
            "message": line.message,
        }
    ends = {
        name: None if point is None else {
            "plan": plain(point.plan_m), "raw": plain(point.raw_px), "world": plain(point.world_m)
        }
        for name, point in (("p1", seen.p1), ("p2", seen.p2))
    }  # fmt: skip
    patches = {
        "points_plan": points(seen.points_plan),
        "points_raw": points(seen.points_raw),
        "region_raw": points(seen.region_raw),
    }
    return {"lines": lines, **ends, **patches, "message": seen.message, "p1_p2_error": seen.p1_p2_error}
