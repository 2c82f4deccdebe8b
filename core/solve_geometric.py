"""The geometric method: poses of all frames from the ground, targets in their own plane.

Self-calibration on the stationary part and smooth flight take out what calibration and single frames get wrong.
Everything here is relative to the local origin of the reference fit, with z = 0 at the ground plane.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from core.bodies import RestBody, midpoints, rest_body, world_points
from core.calibration import Calibration, Evidence, calibrate, calibration_sigma
from core.camera import Pose, fit_poses, plan_homographies
from core.coordinates import Floats, evenly_spread
from core.errors import InputError
from core.flight import SmoothFlight, smooth_flight
from core.georeference import ReferenceFit
from core.ground_poses import fit_with_relief, solve_ground
from core.intervals import during
from core.lens import Lens
from core.measurements import Recording
from core.motion import RigidFit
from core.project import Project, Target
from core.relief import Relief
from core.results import Status, TargetHistory
from core.row_times import Readout, at_frame_times, estimated_readout, ground_speed
from core.self_calibration import SelfCalibration
from core.solution import Ground, Solution, TargetSolution, frame_status
from core.uncertainty import GROUND_PART, Sigma, combined_sigma, common_error, jitter

# Frames from which a rolling shutter is estimated.
READOUT_FRAMES = 150
# Change of the readout by which its effect is found, seconds: moves no point by more than a few pixels.
READOUT_STEP_S = 1e-3
# How far P1 and P2 may lie from their known distance: wrong by more are height, lens or bands, not the measurement.
DISTANCE_TOLERANCE = 0.02
# A building that moves by more than this in its pre-event, metres, and by so many times the noise, is not at rest or
# not where it is thought to be.
UNREST_M = 2e-3
UNREST = 3.0


def solve_geometric(recording: Recording, project: Project, lens: Lens, relief: Relief | None = None) -> Solution:
    """Return displacement by geometry.

    Args:
        recording: measurements; see `core.measurements`.
        relief: elevation of the ground; a plane where None.

    Raises:
        InputError: the clicks, the lens or the heights do not do.
    """
    reference = fit_with_relief(project, lens, relief)
    assert reference.pose is not None
    heights = {target.name: _height_of(target, reference.pose) for target in project.targets}
    start = Calibration(lens, reference.pose, heights)
    speed = ground_speed(recording, lens)
    readout = _readout(recording, speed, start, reference, relief)
    recording = at_frame_times(recording, lens, readout.readout_s, speed)
    calibration, used, slow_m = _calibrated(Evidence.of(recording, speed, project, start, reference, relief))
    caught_up = replace(recording, ground_raw=recording.ground_raw + used.lag_s * np.nan_to_num(speed))
    frame0 = project.reference_frame
    ground = solve_ground(caught_up, used.lens, used.pose0, reference.origin_m, relief, reference_frame=frame0)
    flight, ground = _smoothed(caught_up, ground, used.lens)
    targets = {
        target.name: _solve_target(
            recording,
            project,
            target,
            used,
            ground,
            flight=flight,
            slow_m=slow_m[target.name],
            origin_m=reference.origin_m,
        )
        for target in project.targets
    }
    return Solution(
        reference=reference,
        lens=used.lens,
        heights_m=used.heights_m,
        ground=ground,
        targets=targets,
        histories={name: solved.history for name, solved in targets.items()},
        self_calibration=calibration,
        flight=flight,
        readout=readout,
        warnings=(*calibration.warnings, *_warnings(project, targets, used.heights_m)),
    )


def _height_of(target: Target, camera: Pose) -> float:
    if target.height_m is None:
        raise InputError(
            f'project.json: targets.{target.name}.height_m is missing; "geometric" needs its height above '
            'the ground, "paper" does without.'
        )
    if target.height_m >= camera.centre_m[2]:
        raise InputError(
            f"project.json: targets.{target.name}.height_m is {target.height_m:g}, but by the clicks the camera hovers "
            f"{camera.centre_m[2]:.1f} m above the ground; correct the height, the clicks or the lens."
        )
    return target.height_m


def _warnings(project: Project, targets: Mapping[str, TargetSolution], heights_m: Mapping[str, float]) -> Iterator[str]:
    """Say what about the targets cannot be right."""
    for target in project.targets:
        solved = targets[target.name]
        distance_m = float(np.linalg.norm(np.subtract(*solved.rest_m)))
        given_m = target.p1_p2_m
        if given_m is not None and target.kind == "lines" and abs(distance_m / given_m - 1.0) > DISTANCE_TOLERANCE:
            yield (
                f"P1 and P2 of {target.name} lie {distance_m:.3f} m apart where it is {heights_m[target.name]:.2f} m "
                f"high, but p1_p2_m is {given_m:.3f} m; check height_m, the lens and the bands."
            )
        still = during(solved.history.time_s, project.intervals_s.pre_event) & solved.history.measured
        if project.intervals_s.pre_event is not None and not still.any():
            yield (
                f"{target.name} was not measured in pre_event, so its displacement counts from the reference frame; "
                "choose another pre_event."
            )
        moved_m = float(solved.history.p1_m[still].std(axis=0).max()) if still.any() else 0.0
        if moved_m > max(UNREST_M, UNREST * float(jitter(solved.history.p1_m[still]).max())):
            yield (
                f"P1 of {target.name} moves by {1e3 * moved_m:.1f} mm (RMS) in pre_event, steadily and not as noise: "
                "it shakes there already, or height_m, the lens or the clicks are wrong."
            )


def _readout(
    recording: Recording, speed: Floats, start: Calibration, reference: ReferenceFit, relief: Relief | None
) -> Readout:
    """Return the rolling shutter as the lens file says it, or as the ground shows it wherever the view turns."""
    if start.lens.readout_s:
        return Readout(start.lens.readout_s, None, "lens file")
    chosen = evenly_spread(len(recording.frame), READOUT_FRAMES)
    some = recording.selected(chosen)
    ground = solve_ground(some, start.lens, start.pose0, reference.origin_m, relief)
    poses = ground.known_poses
    shifted = at_frame_times(replace(some, targets_raw={}), start.lens, READOUT_STEP_S, speed[chosen])
    rays = start.lens.rays_from_raw(shifted.ground_raw)
    moved = fit_poses(rays, poses.weight, ground.points_m, poses, iterations=3, robust=False)
    change = (moved.residual - poses.residual) / READOUT_STEP_S
    return estimated_readout(poses.residual, change, np.where(ground.usable[:, None], poses.weight, 0.0))


def _calibrated(evidence: Evidence) -> tuple[SelfCalibration, Calibration, dict[str, Floats]]:
    """Return the corrections, what they make of the calibration, and what its uncertainty moves targets by."""
    found = calibrate(evidence)
    return found, evidence.corrected(found.correction), calibration_sigma(evidence, found)


def _smoothed(recording: Recording, ground: Ground, lens: Lens) -> tuple[SmoothFlight | None, Ground]:
    """Smooth the camera's path and fit each frame's rotation anew about the smoothed centre."""
    centre = np.where(ground.usable[:, None], ground.known_poses.centre_m, np.nan)
    flight = smooth_flight(recording.time_s, centre, ground.rms_px)
    if flight is None:
        return None, ground
    rays = lens.rays_from_raw(recording.ground_raw)
    poses = fit_poses(
        rays,
        ground.known_poses.weight,
        ground.points_m,
        ground.known_poses,
        iterations=3,
        robust=False,
        fixed_centre_m=flight.value_m,
    )
    poses = replace(poses, weight=ground.known_poses.weight, sigma=ground.known_poses.sigma)
    return flight, replace(ground, poses=poses, H_plan_ray=plan_homographies(poses.R, poses.centre_m))


# --- targets ---------------------------------------------------------------------------------------------------------


def _solve_target(
    recording: Recording,
    project: Project,
    target: Target,
    used: Calibration,
    ground: Ground,
    *,
    flight: SmoothFlight | None,
    slow_m: Floats,
    origin_m: Floats,
) -> TargetSolution:
    height = used.heights_m[target.name]
    body = rest_body(recording, target.name, used.lens, used.pose0, height)
    points = world_points(midpoints(recording.targets_raw[target.name]), used.lens, ground.known_poses, height)
    still = during(recording.time_s, project.intervals_s.pre_event)
    fit = body.fit(points, still & ground.usable)
    used_points = (fit.weight > 0.1).reshape(len(fit.weight), -1).sum(axis=1)
    status = frame_status(recording, project, ground, used_points, body.is_determined(fit))
    apparent = world_points(midpoints(recording.targets_raw[target.name]), used.lens, ground.known_poses, 0.0)
    flat = rest_body(recording, target.name, used.lens, used.pose0, 0.0)
    raw = flat.fit(apparent, np.zeros(len(apparent), dtype=bool))
    scale = _paper_scale(target, flat, used.pose0, height)
    measured = (status == Status.OK) | (status == Status.WEAK)
    moved = np.stack([fit.at(place, body.centre) for place in body.places], axis=1)
    at_rest = still & measured
    start_m, start_rad = (
        (moved[at_rest].mean(axis=0), fit.rotation_rad[at_rest].mean()) if at_rest.any() else (np.zeros((2, 2)), 0.0)
    )
    places, rotation = moved - start_m, fit.rotation_rad - start_rad
    part = height / used.pose0.centre_m[2]
    pixel_m = (used.pose0.centre_m[2] - height) / float(used.lens.focal_px.mean())
    centre_sigma_m = _sigma_of_centres(ground) if flight is None else flight.sigma_m
    common_m = common_error(fit.residual, recording.time_s, at_rest)
    sigma = combined_sigma(
        _sigma_of_points(fit, body),
        camera_m=part * centre_sigma_m[:, :2],
        shared_m=np.hypot(GROUND_PART * ground.rms_px * pixel_m, common_m),
        slow_m=slow_m,
        places_m=places,
        rotation_rad=rotation,
        still=at_rest,
        moving=~(still | during(recording.time_s, project.intervals_s.residual)),
    )
    history = TargetHistory(
        name=target.name,
        frame=recording.frame,
        time_s=recording.time_s,
        status=status,
        p1_m=places[:, 0],
        p2_m=places[:, 1],
        rotation_rad=rotation,
        p1_sigma_m=sigma.places_m[:, 0],
        p2_sigma_m=sigma.places_m[:, 1],
        rotation_sigma_rad=sigma.rotation_rad,
        p1_raw_m=scale * raw.at(flat.places[0], flat.centre),
        p2_raw_m=scale * raw.at(flat.places[1], flat.centre),
        rotation_raw_rad=raw.rotation_rad,
    )
    return TargetSolution(history=history, rest_m=body.places + start_m + origin_m)


def _paper_scale(target: Target, flat: RestBody, pose0: Pose, height_m: float) -> float:
    """Return metres at roof level per plan metre: from the known distance P1-P2, or else from the heights."""
    if target.p1_p2_m is not None and target.kind == "lines":
        return target.p1_p2_m / float(np.linalg.norm(flat.places[0] - flat.places[1]))
    return float((pose0.centre_m[2] - height_m) / pose0.centre_m[2])


def _sigma_of_centres(ground: Ground) -> Floats:
    """Return what the scatter of the ground makes of single camera centres (F, 3), metres, where they are usable."""
    poses = ground.known_poses
    covariance = np.linalg.pinv(np.where(ground.usable[:, None, None], poses.normal, np.eye(6)), hermitian=True)
    squared = np.nansum(poses.weight[..., None] * poses.residual**2, axis=(1, 2))
    unit_sigma = np.sqrt(squared / np.maximum(2 * np.count_nonzero(poses.weight, axis=1) - 6, 1))
    return np.asarray(unit_sigma[:, None] * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, 3:]))


def _sigma_of_points(fit: RigidFit, body: RestBody) -> Sigma:
    """Return what the scatter of a target's own points makes of its displacement and rotation."""
    covariance = np.linalg.pinv(fit.normal, hermitian=True)
    places = []
    for place in body.places:
        arm = place - body.centre
        J = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
        places.append(np.sqrt(np.diagonal(J @ covariance @ J.T, axis1=1, axis2=2)))
    return Sigma(np.stack(places, axis=1), np.sqrt(covariance[:, 2, 2]))
