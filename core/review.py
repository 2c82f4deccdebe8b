"""Any one frame of a finished measurement, drawn where it was measured: for looking at, nothing is decided here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from core.apparent import Apparent
from core.bodies import world_points
from core.camera import Pose
from core.coordinates import Floats, apply_homography, finite_rows, rotation_2d
from core.export import fitted_lines
from core.georeference import ReferenceFit
from core.measurements import FrameMeasurement, Recording
from core.preview import band_outline
from core.project import LINE_NAMES, Project, Target
from core.solution import Solution

# A ground feature that weighs less than this took no part in the frame's geometry.
_USED_WEIGHT = 0.1
# Stations a line needs before it is drawn.
_LEAST_STATIONS = 4


@dataclass(frozen=True, eq=False)
class TargetOverlay:
    """One target in one frame, raw pixels.

    Attributes:
        edges_raw: by line, (N, 2) the edge points that were found.
        lines_raw: by line, (33, 2) the fitted mid-line.
        bands_raw: by line, (M, 2) outline of where it was looked for, moved along with the target.
        points_raw: (N, 2) patches of a points target, or those about lines that move with them.
        points_rejected_raw: (N, 2) those that do not.
        p1_raw, p2_raw: (2,) where the lines cross; None where they do not.
    """

    edges_raw: Mapping[str, Floats]
    lines_raw: Mapping[str, Floats]
    bands_raw: Mapping[str, Floats]
    points_raw: Floats
    points_rejected_raw: Floats
    p1_raw: Floats | None
    p2_raw: Floats | None


@dataclass(frozen=True, eq=False)
class FrameOverlay:
    """What was measured in one frame.

    Attributes:
        frame, time_s: of the frame.
        status: of each target.
        ground_used, ground_rejected: (N, 2) features that did and did not agree with the frame's geometry.
        targets: by name.
        pose: of the camera, centre in absolute world metres above the ground; None where it is not known.
    """

    frame: int
    time_s: float
    status: Mapping[str, str]
    ground_used: Floats
    ground_rejected: Floats
    targets: Mapping[str, TargetOverlay]
    pose: Pose | None


def frame_overlay(
    recording: Recording, solution: Solution, project: Project, *, number: int, measured: FrameMeasurement | None
) -> FrameOverlay | None:
    """Return what was measured in a frame, or None where the recording does not have it.

    Args:
        number: of the frame.
        measured: the frame's record, which also tells where the targets were looked for.
    """
    place = int(np.searchsorted(recording.frame, number))
    if place >= len(recording.frame) or recording.frame[place] != number:
        return None
    ground = recording.ground_raw[place]
    seen = np.isfinite(ground).all(axis=1)
    used = seen & (solution.ground.weight[place] > _USED_WEIGHT)
    return FrameOverlay(
        frame=number,
        time_s=float(recording.time_s[place]),
        status={name: str(solved.history.status[place]) for name, solved in solution.targets.items()},
        ground_used=ground[used],
        ground_rejected=ground[seen & ~used],
        targets={
            target.name: _target_overlay(recording, solution, target, place=place, measured=measured)
            for target in project.targets
        },
        pose=camera_at(solution, place),
    )


def camera_at(solution: Solution, place: int) -> Pose | None:
    """Return the camera of the frame at a place of the recording, centre in absolute metres; None where unknown."""
    poses = solution.ground.poses
    if poses is None or not solution.ground.usable[place]:
        return None
    return Pose(poses.R[place], poses.centre_m[place] + np.append(solution.reference.origin_m, 0.0))


def camera_path(solution: Solution) -> Floats | None:
    """Return the camera's centres (N, 3), absolute metres, in the frames that have one; None where none is known."""
    poses = solution.ground.poses
    if poses is None:
        return None
    return np.asarray(poses.centre_m[solution.ground.usable] + np.append(solution.reference.origin_m, 0.0))


def _target_overlay(
    recording: Recording, solution: Solution, target: Target, *, place: int, measured: FrameMeasurement | None
) -> TargetOverlay:
    raw = recording.targets_raw[target.name][place]
    if raw.ndim == 2:
        return TargetOverlay({}, {}, {}, raw[finite_rows(raw)], np.empty((0, 2)), None, None)
    texture = recording.texture_of(target.name)[place]
    used = finite_rows(texture) & solution.targets[target.name].texture_used
    edges = dict(zip(LINE_NAMES, raw, strict=True))
    found = {name: edge[np.isfinite(edge).all(axis=(1, 2))] for name, edge in edges.items()}
    lines: dict[str, Floats] = {}
    crossings: dict[str, Floats] = {}
    if all(len(edge) >= _LEAST_STATIONS for edge in found.values()):
        lines, crossings = fitted_lines(raw, solution.lens)
    return TargetOverlay(
        edges_raw={name: edge.reshape(-1, 2) for name, edge in found.items()},
        lines_raw=lines,
        bands_raw=_bands(solution.reference, target, measured),
        points_raw=texture[used],
        points_rejected_raw=texture[finite_rows(texture) & ~used],
        p1_raw=crossings.get("P1"),
        p2_raw=crossings.get("P2"),
    )


def _bands(reference: ReferenceFit, target: Target, measured: FrameMeasurement | None) -> dict[str, Floats]:
    """Return the bands' outlines where the target was followed to; none where it was not found."""
    apparent: Apparent | None = measured.apparent.get(target.name) if measured is not None else None
    if measured is None or apparent is None or target.lines is None:
        return {}
    bands = {name: getattr(target.lines, name) for name in LINE_NAMES}
    ends = np.array([end for band in bands.values() for end in (band.from_m, band.to_m)])
    centre = reference.rays_from_plan(ends).mean(axis=0)
    outlines = {}
    for name, band in bands.items():
        moved = apparent.apply(reference.rays_from_plan(band_outline(band)), centre)
        outlines[name] = reference.lens.raw_from_rays(apply_homography(measured.H_ray_ray0, moved))
    return outlines


def lines_at_rest(recording: Recording, solution: Solution, target: Target) -> dict[str, Floats]:
    """Return the ends of a target's lines in the reference frame, (2, 3) world, z above the ground.

    Empty for a points target, and where no height or no pose is known.
    """
    raw, pose = recording.reference.targets_raw[target.name], solution.reference.pose
    height = solution.heights_m.get(target.name)
    if raw.ndim != 4 or pose is None or height is None:
        return {}
    middle = raw.mean(axis=2)
    at = Pose(pose.R[None], pose.centre_m[None])
    places = world_points(middle[None], solution.lens, at, height)[0] + solution.reference.origin_m
    ends = {}
    for name, line in zip(LINE_NAMES, places, strict=True):
        seen = line[np.isfinite(line).all(axis=1)]
        if len(seen) >= 2:
            ends[name] = np.column_stack([seen[[0, -1]], [height, height]])
    return ends


def moved_lines(
    rest: Mapping[str, Floats], solution: Solution, *, name: str, place: int, exaggeration: float
) -> dict[str, Floats]:
    """Return a target's lines moved as in the frame at a place of the recording, the motion exaggerated.

    Args:
        rest: as `lines_at_rest` returns them.
        name: of the target.
        exaggeration: 1 for the true motion.
    """
    history = solution.histories[name]
    moved = (history.p1_m[place] + history.p2_m[place]) / 2
    if not np.isfinite(moved).all():
        return {}
    turn = rotation_2d(exaggeration * float(history.rotation_rad[place]))
    centre = solution.targets[name].rest_m.mean(axis=0)
    return {
        line: np.column_stack([(ends[:, :2] - centre) @ turn.T + centre + exaggeration * moved, ends[:, 2]])
        for line, ends in rest.items()
    }
