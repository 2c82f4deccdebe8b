"""The published method's geometry: a homography per frame onto the ground plane, lines by regression, P1 and P2.

Source: the paper, "UAV Drift and Perspective Correction", "Roof Feature Detection and Displacement Extraction".
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from core.camera import intersect_height
from core.coordinates import Bools, Floats, apply_homography, finite_rows
from core.georeference import ReferenceFit
from core.ground import LEAST_POINTS, fit_homography
from core.ground_poses import fit_with_relief
from core.intervals import during
from core.lens import Lens
from core.measurements import Recording
from core.motion import regress_lines
from core.project import Project, Target
from core.relief import Relief
from core.results import Displacement, TargetHistory
from core.roof_level import doubts, refuse_if, scale_at_roof, scale_obstacle
from core.solution import Ground, Solution, TargetSolution, frame_status
from core.uncertainty import GROUND_PART, held_to_jitter


def solve_paper(
    recording: Recording, project: Project, lens: Lens, relief: Relief | None = None, *, has_lens: bool = True
) -> Solution:
    """Return displacement the published way; drift is left in, for the filter to take out.

    Args:
        recording: measurements by `core.paper`.
        lens, relief, has_lens: as in `core.solve.solve`.

    Raises:
        InputError: the clicks do not do, or neither P1-P2 nor a height tells the scale at the roof.
    """
    reference = fit_with_relief(project, lens, relief, has_lens=has_lens)
    for target in project.targets:
        refuse_if(scale_obstacle(target, reference.pose, has_lens=has_lens), target)
    ground = stabilise(recording, lens, reference.H_plan_ray)
    targets = {target.name: _solve_target(recording, project, target, reference, ground) for target in project.targets}
    return Solution(
        reference=reference,
        lens=lens,
        heights_m={target.name: target.height_m for target in project.targets},
        ground=ground,
        targets=targets,
        histories={name: solved.history for name, solved in targets.items()},
        self_calibration=None,
        readout=None,
        flight=None,
        warnings=tuple(_doubts(recording, project, reference, relief)),
    )


def _doubts(recording: Recording, project: Project, reference: ReferenceFit, relief: Relief | None) -> Iterator[str]:
    """Say what about heights and distances cannot be right, where the camera's place tells it."""
    for target in project.targets:
        if target.height_m is None or reference.pose is None:
            continue
        raw = recording.reference.targets_raw[target.name].mean(axis=-2)[None]
        plan = plan_points(raw, reference.lens, reference.H_plan_ray[None])
        lines = regress_lines(plan)
        places = _rest(target, reference, np.stack([lines.intersection(0, 2)[0], lines.intersection(1, 2)[0]]))
        at_rest = _rest(target, reference, plan[finite_rows(plan)]) + reference.origin_m
        shown_m = None if relief is None else relief.stands_at(at_rest)
        yield from doubts(target, places, height_m=target.height_m, shown_m=shown_m, camera=reference.pose)


def stabilise(recording: Recording, lens: Lens, H_plan_ray0: Floats) -> Ground:
    """Return every frame's robust homography onto the ground plane, from its matches to the reference frame."""
    rays0 = lens.rays_from_raw(recording.reference.ground_raw)
    rays = lens.rays_from_raw(recording.ground_raw)
    focal = float(lens.focal_px.mean())
    frames, points = rays.shape[:2]
    H_plan_ray = np.full((frames, 3, 3), np.nan)
    weight, rms_px = np.zeros((frames, points)), np.full(frames, np.nan)
    for number, seen in enumerate(finite_rows(rays)):
        if seen.sum() < LEAST_POINTS:
            continue
        H, inlier = fit_homography(rays0[seen], rays[number, seen], tolerance=1.0 / focal)
        if H is None or inlier.sum() < LEAST_POINTS:
            continue
        weight[number, np.flatnonzero(seen)[inlier]] = 1.0
        H_plan_ray[number] = H_plan_ray0 @ np.linalg.inv(H)
        error = apply_homography(H, rays0[seen][inlier]) - rays[number, seen][inlier]
        rms_px[number] = float(np.sqrt((error**2).mean())) * focal
    plan = apply_homography(H_plan_ray0, rays0)
    return Ground(
        points_m=np.column_stack([plan, np.zeros(points)]),
        weight=weight,
        H_plan_ray=H_plan_ray,
        poses=None,
        rms_px=rms_px,
        inliers=weight.astype(bool).sum(axis=1),
        usable=np.isfinite(H_plan_ray).all(axis=(1, 2)),
    )


def plan_points(raw: Floats, lens: Lens, H_plan_ray: Floats) -> Floats:
    """Return local plan metres (F, ..., 2) of raw pixels (F, ..., 2), each frame by its own homography (F, 3, 3)."""
    rays = lens.rays_from_raw(raw)
    flat = rays.reshape(len(rays), -1, 2)
    mapped = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=2) @ np.swapaxes(H_plan_ray, 1, 2)
    return np.asarray((mapped[..., :2] / mapped[..., 2:]).reshape(rays.shape))


def _solve_target(
    recording: Recording, project: Project, target: Target, reference: ReferenceFit, ground: Ground
) -> TargetSolution:
    lens = reference.lens
    raw = np.concatenate([recording.reference.targets_raw[target.name][None], recording.targets_raw[target.name]])
    H = np.concatenate([reference.H_plan_ray[None], ground.H_plan_ray])
    lines = regress_lines(plan_points(raw.mean(axis=-2), lens, H))
    places = np.stack([lines.intersection(0, 2), lines.intersection(1, 2)], axis=1)
    spread = np.stack([lines.intersection_sigma(0, 2), lines.intersection_sigma(1, 2)], axis=1)
    scale = scale_at_roof(target, places[0], height_m=target.height_m, camera=reference.pose)
    moved = scale * (places[1:] - places[0])
    angle = np.arctan2(*np.moveaxis(places[:, 0] - places[:, 1], -1, 0)[::-1])
    turned = np.angle(np.exp(1j * (angle[1:] - angle[0])))
    # What the homography errs by moves the whole roof, whose points cannot tell.
    pixel = np.array([[0.0, 0.0], [1.0 / float(lens.focal_px.mean()), 0.0]])
    pixel_m = scale * float(np.linalg.norm(np.subtract(*apply_homography(reference.H_plan_ray, pixel))))
    ground_m = GROUND_PART * ground.rms_px * pixel_m
    distance = float(np.linalg.norm(places[0, 0] - places[0, 1]))
    determined: Bools = np.isfinite(moved).all(axis=(1, 2))
    status = frame_status(recording, project, ground, points_used=lines.used[1:].sum(axis=1), determined=determined)
    still = during(recording.time_s, project.intervals_s.pre_event) & determined
    sigma = held_to_jitter(np.hypot(scale * spread[1:], ground_m[:, None, None]), moved, still)
    turned_sigma = held_to_jitter(np.sqrt((spread[1:] ** 2).sum(axis=(1, 2)) / 2) / distance, turned, still)
    displacement = Displacement(moved, turned)
    history = TargetHistory.of(
        target.name,
        frame=recording.frame,
        time_s=recording.time_s,
        status=status,
        value=displacement,
        sigma=Displacement(sigma, turned_sigma),
        raw=displacement,
    )
    return TargetSolution(history=history, rest_m=_rest(target, reference, places[0]) + reference.origin_m)


def _rest(target: Target, reference: ReferenceFit, places: Floats) -> Floats:
    """Return P1 and P2 at rest (2, 2), local: at their own height where it is known, else where they appear."""
    if target.height_m is None or reference.pose is None:
        return places
    pose = reference.pose
    rays = apply_homography(np.linalg.inv(reference.H_plan_ray), places)
    return intersect_height(pose.R, pose.centre_m, rays, target.height_m)
