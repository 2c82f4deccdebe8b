"""What the 3D scene shows of a project: put together from the engine's results, part by part."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from app import orthoimages
from app.context import Context
from app.errors import ApiError, NotYet
from app.frames import fingerprint, scaled_to
from app.outcome import Solved, recorded_of
from app.reference import reference_fit
from app.scene3d import MAX_POINTS, CameraView, CloudView, DrapeView, GroundView
from app.sites import Site
from app.store import ProjectFolder, problem_of
from core.camera import Pose
from core.cloud import Cloud, pick, thin
from core.coordinates import Floats
from core.errors import InputError
from core.georeference import ReferenceFit
from core.ground_plane import height_at
from core.orthoimage import ORTHOIMAGE_FILE
from core.project import Project
from core.review import camera_at, camera_path, lines_at_rest, moved_lines
from core.run import relief_plan

Colour = Literal["rgb", "intensity", "height"]

DEFAULT_POINTS = 1_000_000
# Wide enough for a picture in space, small enough to be sent with every frame.
_PICTURE_WIDTH, _DRAPE_WIDTH = 640, 4096
# How near a point of the cloud must come to a click's ray: less than the spacing would let clicks fall through.
_PICK_RADIUS_M = 0.15


@dataclass(frozen=True)
class View:
    """What a person wants to see."""

    frame: int | None = None
    exaggeration: float = 1.0
    points: int = DEFAULT_POINTS
    colour: Colour = "rgb"
    show: Mapping[str, bool] | None = None


def show(here: Context, folder: ProjectFolder, view: View, *, take: bool = False) -> dict[str, Any]:
    """Bring the scene up to date with a project and a view; return what is shown of it, or why nothing is yet.

    Args:
        take: whether to take the one scene from another project that has it; otherwise it is left to that one.
    """
    with here.scene.turn(folder.id, take=take) as mine:
        shown = _show(here, folder, view) if mine else _nothing("")
        return shown | {"owner": here.scene.project}


def _show(here: Context, folder: ProjectFolder, view: View) -> dict[str, Any]:
    project = folder.load().project
    try:
        site = here.sites.site(folder, project) if project.inputs.cloud else None
    except NotYet as error:  # what is shown of this project stays meanwhile
        return _nothing(error.message)
    except (InputError, ApiError) as error:
        here.scene.clear(folder.id)
        return _nothing(problem_of(error))
    fit, problem = _fit(here, folder, project)
    if site is None and (fit is None or fit.pose is None):
        here.scene.clear(folder.id)
        return _nothing("There is no point cloud to show; choose one in the inputs.")
    origin = site.cloud.origin_m if site is not None else np.array([*_origin_of(fit), 0.0])
    here.scene.open(folder.id, origin, lambda start, along: _picked(here, folder, start, along))
    if site is not None:
        _show_site(here, folder, site, view)
    if fit is not None and fit.pose is not None:
        _show_flight(here, folder, project, site=site, fit=fit, view=view)
    else:
        here.scene.drop("camera")
        here.scene.drop("lines")
    here.scene.show(view.show or {})
    total = len(site.cloud) if site is not None else 0
    return {"ready": True, "points_shown": here.scene.points, "points_total": total, "message": problem}


def _nothing(message: str) -> dict[str, Any]:
    return {"ready": False, "points_shown": 0, "points_total": 0, "message": message}


def _fit(here: Context, folder: ProjectFolder, project: Project) -> tuple[ReferenceFit | None, str]:
    try:
        return reference_fit(here, folder, project), ""
    except (InputError, ApiError) as error:
        return None, problem_of(error)


def _origin_of(fit: ReferenceFit | None) -> list[float]:
    return [0.0, 0.0] if fit is None else fit.origin_m.tolist()


def _show_site(here: Context, folder: ProjectFolder, site: Site, view: View) -> None:
    count = max(1000, min(view.points, MAX_POINTS))
    key = (site.key, count, view.colour)
    if not here.scene.has("cloud", key):
        thinned = thin(site.cloud, count)
        span = np.ptp(thinned.points_m[:, :2], axis=0)
        spacing = float(np.sqrt(max(span[0] * span[1], 1e-6) / len(thinned)))
        colours = _colours(thinned, site, view.colour)
        here.scene.set_cloud(CloudView(thinned.points_m.astype(np.float32), colours, spacing), key)
        lowest, highest = site.cloud.extent_m
        here.scene.look(np.array(site.plane.at_m), float(np.max(highest - lowest)) * 0.6)
    if not here.scene.has("ground", site.key):
        here.scene.set_ground(_ground(site), site.key)
    _show_orthoimage(here, folder, site)


def _colours(cloud: Cloud, site: Site, wanted: Colour) -> NDArray[np.uint8]:
    """Return (N, 3): the cloud's own colours where wanted and there; else intensity; else height, dark to bright."""
    if wanted == "rgb" and cloud.colour is not None:
        return np.asarray(cloud.colour)
    shown = cloud.intensity if wanted != "height" else None
    values = site.plane.height_of(cloud) if shown is None else np.asarray(shown, dtype=np.float64)
    low, high = np.percentile(values, [2, 98])
    grey = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0)[:, None]
    # From deep blue to light yellow: even in brightness, so that it reads without its hue.
    ramp = grey * np.array([250.0, 230.0, 120.0]) + (1.0 - grey) * np.array([30.0, 40.0, 90.0])
    return np.asarray(ramp if shown is None else np.repeat(30 + 225 * grey, 3, axis=1), dtype=np.uint8)


def _ground(site: Site) -> GroundView:
    plane = site.plane
    size = float(np.sqrt(max(plane.area_m2, 1.0))) * 1.2
    label = (
        f"Ground plane z = {round(plane.at_m[2], 2) + 0.0:.2f} m, tilt {np.degrees(plane.tilt_rad):.2f}°, "
        f"spread {1000 * plane.elevation_std_m:.0f} mm"
    )
    return GroundView(np.array(plane.at_m), plane.slope, size, label)


def _show_orthoimage(here: Context, folder: ProjectFolder, site: Site) -> None:
    try:
        key = fingerprint(folder.results / ORTHOIMAGE_FILE)
    except InputError:
        here.scene.drop("orthoimage")
        return
    if here.scene.has("orthoimage", key):
        return
    grid, rgba = orthoimages.pixels(folder)
    here.scene.set_orthoimage(DrapeView(grid, site.plane.at_m[2], scaled_to(rgba, _DRAPE_WIDTH)), key)


def _show_flight(
    here: Context, folder: ProjectFolder, project: Project, *, site: Site | None, fit: ReferenceFit, view: View
) -> None:
    """Show the camera at a frame, its path, and the roof lines as they have moved."""
    frame = project.reference_frame if view.frame is None else view.frame
    solved = _solved_if_measured(here, folder, project)
    above = np.array([0.0, 0.0, _ground_z_m(folder, project, site)])
    place = None if solved is None else _place_of(solved, frame)
    pose, path = _pose_and_path(fit, solved, place)
    video = fingerprint(folder.require_video(project))
    key = (video, frame, pose.centre_m.tobytes(), pose.R.tobytes(), None if path is None else path.tobytes())
    if not here.scene.has("camera", key):
        moved = Pose(pose.R, pose.centre_m + above)
        camera = _camera(here, folder, project, frame=frame, fit=fit, pose=moved)
        here.scene.set_camera(camera, None if path is None else path + above, key)
    if solved is None or place is None:
        here.scene.drop("lines")
        return
    lines_key = (solved, place, view.exaggeration)
    if not here.scene.has("lines", lines_key):
        _show_lines(here, solved, place, exaggeration=view.exaggeration, above=above, key=lines_key)


def _solved_if_measured(here: Context, folder: ProjectFolder, project: Project) -> Solved | None:
    """Return the solution of a finished measurement; the scene waits for no running one."""
    if not recorded_of(folder, project, project.method).finished:
        return None
    try:
        return here.outcomes.solved(folder, project)
    except (InputError, ApiError):
        return None


def _ground_z_m(folder: ProjectFolder, project: Project, site: Site | None) -> float:
    """Return the world height from which the engine counts heights."""
    plan = relief_plan(folder.folder, project)
    return 0.0 if site is None or plan is None else float(site.plane.z_m(plan.at_m))


def _place_of(solved: Solved, frame: int) -> int | None:
    place = int(np.searchsorted(solved.recording.frame, frame))
    found = place < len(solved.recording.frame) and solved.recording.frame[place] == frame
    return place if found else None


def _pose_and_path(fit: ReferenceFit, solved: Solved | None, place: int | None) -> tuple[Pose, Floats | None]:
    """Return the camera, centre in absolute metres above the ground, and its path; the reference's where unknown."""
    assert fit.pose is not None
    pose = Pose(fit.pose.R, fit.pose.centre_m + np.append(fit.origin_m, 0.0))
    if solved is None:
        return pose, None
    measured = camera_at(solved.solution, place) if place is not None else None
    return measured or pose, camera_path(solved.solution)


def _show_lines(here: Context, solved: Solved, place: int, *, exaggeration: float, above: Floats, key: Any) -> None:
    moved: dict[str, Floats] = {}
    resting: dict[str, Floats] = {}
    for target in solved.inputs.project.targets:
        rest = lines_at_rest(solved.recording, solved.solution, target)
        now = moved_lines(rest, solved.solution, name=target.name, place=place, exaggeration=exaggeration)
        resting |= {f"{target.name}/{line}": ends + above for line, ends in rest.items()}
        moved |= {f"{target.name}/{line}": ends + above for line, ends in now.items()}
    here.scene.set_lines(moved, resting, key)


def _camera(
    here: Context, folder: ProjectFolder, project: Project, *, frame: int, fit: ReferenceFit, pose: Pose
) -> CameraView:
    picture = scaled_to(here.frames.frame(folder.require_video(project), frame), _PICTURE_WIDTH)
    width, height = fit.lens.image_size_px
    return CameraView(
        R=pose.R,
        centre_m=pose.centre_m,
        vertical_fov_rad=float(2.0 * np.arctan(height / 2.0 / fit.lens.focal_px[1])),
        aspect=width / height,
        picture=picture,
        reach_m=float(pose.centre_m[2]) / 6.0,
    )


def _picked(here: Context, folder: ProjectFolder, start: Floats, along: Floats) -> None:
    """Tell the tabs what a click into the scene met."""
    try:
        here.hub.publish(folder.id, "pick", what_is_there(here, folder, start, along))
    except (InputError, ApiError) as error:
        here.hub.publish(folder.id, "pick", {"message": problem_of(error)})


def what_is_there(here: Context, folder: ProjectFolder, start: Floats, along: Floats) -> dict[str, Any]:
    """Return where a ray first meets the cloud, and how high that is.

    Raises:
        InputError: it meets nothing.
    """
    site = here.sites.site(folder, folder.load().project)
    place = pick(site.cloud, start, along, radius_m=_PICK_RADIUS_M)
    if place is None:
        raise InputError("The click met no point of the cloud; click on a denser part of it.")
    height_m, spread_m, points = height_at(site.cloud, site.plane, place[:2])
    own_height_m = float(place[2] - site.plane.z_m(place[:2]))
    on_top = abs(own_height_m - height_m) < 0.3
    return {
        "xyz_m": place.tolist(),
        "height_m": height_m if on_top else own_height_m,
        "spread_m": spread_m if on_top else None,
        "points": points if on_top else 1,
    }
