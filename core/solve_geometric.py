"""The geometric method: poses of all frames from the ground, targets in their own plane.

Self-calibration on the stationary part and smooth flight take out what calibration and single frames get wrong.
Everything here is relative to the local origin of the reference fit, with z = 0 at the ground plane.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from core.bodies import RestBody, midpoints, rest_body, world_points
from core.calibration import Calibration, Evidence, calibrate, calibration_sigma
from core.camera import fit_poses, plan_homographies
from core.coordinates import Bools, Floats, evenly_spread, finite_rows
from core.flight import SmoothFlight, smooth_flight
from core.georeference import ReferenceFit
from core.ground_poses import fit_with_relief, solve_ground
from core.intervals import during
from core.lens import Lens
from core.measurements import Recording
from core.motion import RigidFit
from core.project import Project, Target
from core.relief import Relief
from core.results import MEASURED, Displacement, TargetHistory
from core.roof_level import doubts, height_obstacle, refuse_if, scale_at_roof
from core.row_times import Readout, at_frame_times, estimated_readout, ground_speed
from core.self_calibration import SelfCalibration
from core.solution import Ground, Solution, TargetSolution, frame_status
from core.texture_motion import with_texture
from core.uncertainty import GROUND_PART, LEAST_STILL, combined_sigma, common_error, jitter, robust_jitter

# Frames from which a rolling shutter is estimated.
READOUT_FRAMES = 150
# Change of the readout by which its effect is found, seconds: moves no point by more than a few pixels.
READOUT_STEP_S = 1e-3
# A building that moves by more than this in its pre-event, metres, and by so many times the noise, is not at rest or
# not where it is thought to be.
UNREST_M = 2e-3
UNREST = 3.0
# A building that moves by more than this after the event has not come to rest: the published residual is as exact.
UNREST_AFTER_M = 0.01
# No building grows. A target that does so from one second to another by more than this part of itself, and by so many
# times the noise of a frame, tells that focal length or focus changed. (In rendered clips without, it is 0.04 %, or in
# noisy ones five times the noise; where the lens zooms by 1 %, which costs 14 mm, it is 0.8 %.)
MOST_GROWTH = 2e-3
GROWTH_NOISE = 10.0
GROWTH_S = 1.0
GROWTH_FRAMES = 5


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
    for target in project.targets:
        refuse_if(height_obstacle(target, reference.pose), target)
    heights = {target.name: target.height_m for target in project.targets if target.height_m is not None}
    start = Calibration(lens, reference.pose, heights)
    speed = ground_speed(recording, lens)
    readout = _readout(recording, speed, start, reference, relief)
    recording = at_frame_times(recording, lens, readout.readout_s, speed)
    calibration, used, slow_m = _calibrated(
        Evidence.of(recording, speed=speed, project=project, start=start, reference=reference, relief=relief)
    )
    caught_up = replace(recording, ground_raw=recording.ground_raw + used.lag_s * np.nan_to_num(speed))
    frame0 = project.reference_frame
    ground = solve_ground(
        caught_up, used.lens, used.pose0, origin_m=reference.origin_m, relief=relief, reference_frame=frame0
    )
    flight, ground = _smoothed(caught_up, ground, used.lens)
    scene = _Scene(recording, project, used=used, ground=ground, flight=flight, origin_m=reference.origin_m)
    targets = {target.name: _solve_target(scene, target, slow_m[target.name]) for target in project.targets}
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
        warnings=(
            *calibration.warnings,
            *_doubts(recording, project, used, origin_m=reference.origin_m, relief=relief),
            *_unrest(project, targets),
        ),
    )


def _doubts(
    recording: Recording, project: Project, used: Calibration, *, origin_m: Floats, relief: Relief | None
) -> Iterator[str]:
    """Say what about heights and distances cannot be right."""
    for target in project.targets:
        height_m = used.heights_m[target.name]
        body = rest_body(recording, target.name, lens=used.lens, pose0=used.pose0, z_m=height_m)
        at_rest = body.stations if body.points is None else body.points
        assert at_rest is not None
        shown_m = None if relief is None else relief.stands_at(at_rest[finite_rows(at_rest)] + origin_m)
        yield from doubts(target, body.places, height_m=height_m, shown_m=shown_m, camera=used.pose0)


def _unrest(project: Project, targets: Mapping[str, TargetSolution]) -> Iterator[str]:
    """Say what moves or changes that should not, and where there is too little to tell."""
    for target in project.targets:
        history, intervals = targets[target.name].history, project.intervals_s
        still = during(history.time_s, intervals.pre_event) & history.measured
        if intervals.pre_event is not None and not still.any():
            yield (
                f"{target.name} was not measured in pre_event, so its displacement counts from the reference frame; "
                "choose another pre_event."
            )
        elif intervals.pre_event is not None and still.sum() < LEAST_STILL:
            yield (
                f"{target.name} was measured in only {still.sum()} frames of pre_event, which tell neither its rest "
                "nor its noise well; choose a longer pre_event."
            )
        moved_m = _movement(history, still)
        if moved_m > UNREST_M:
            yield (
                f"P1 of {target.name} moves by {1e3 * moved_m:.1f} mm (RMS) in pre_event, steadily and not as noise: "
                "it shakes there already, or height_m, the lens or the clicks are wrong."
            )
        moved_m = _movement(history, during(history.time_s, intervals.residual) & history.measured)
        if moved_m > UNREST_AFTER_M:
            yield (
                f"P1 of {target.name} moves by {1e3 * moved_m:.1f} mm (RMS) in residual: it shakes there still, so "
                "their mean is no residual displacement; choose a later residual."
            )
        growth, noise = _largest_growth(targets[target.name])
        if growth > max(MOST_GROWTH, GROWTH_NOISE * noise):
            yield (
                f"{target.name} seems to grow or shrink by {100 * growth:.1f} % during the clip, as if the camera had "
                "zoomed or refocused, so its displacement is wrong; film with focal length and focus held fixed."
            )


def _movement(history: TargetHistory, frames: Bools) -> float:
    """Return how much P1 moves in some measured frames (F,), RMS along its livelier axis; 0 where it is noise."""
    places = history.p1_m[frames]
    moved_m = float(places.std(axis=0).max()) if len(places) else 0.0
    return moved_m if moved_m > UNREST * float(jitter(places).max()) else 0.0


def _largest_growth(solved: TargetSolution) -> tuple[float, float]:
    """Return the largest change of a target's size from one second to another, medians both, and a frame's noise."""
    assert solved.growth is not None
    seen = np.isfinite(solved.growth)
    growth, time_s = solved.growth[seen], solved.history.time_s[seen]
    seconds = np.split(growth, np.flatnonzero(np.diff(np.floor(time_s / GROWTH_S))) + 1)
    medians = [float(np.median(each)) for each in seconds if len(each) >= GROWTH_FRAMES]
    return (max(medians) - min(medians), float(robust_jitter(growth))) if medians else (0.0, 0.0)


def _readout(
    recording: Recording, speed: Floats, start: Calibration, reference: ReferenceFit, relief: Relief | None
) -> Readout:
    """Return the rolling shutter as the lens file says it, or as the ground shows it wherever the view turns."""
    if start.lens.readout_s:
        return Readout(start.lens.readout_s, None, "lens file")
    chosen = evenly_spread(len(recording.frame), READOUT_FRAMES)
    some = recording.selected(chosen)
    ground = solve_ground(some, start.lens, start.pose0, origin_m=reference.origin_m, relief=relief)
    poses = ground.known_poses
    shifted = at_frame_times(replace(some, targets_raw={}, texture_raw={}), start.lens, READOUT_STEP_S, speed[chosen])
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


@dataclass(frozen=True)
class _Scene:
    """What targets are solved from, with the camera of every frame known.

    Attributes:
        used: the calibration with its corrections.
        ground, flight: in every frame.
        origin_m: (2,) local origin.
    """

    recording: Recording
    project: Project
    _: KW_ONLY
    used: Calibration
    ground: Ground
    flight: SmoothFlight | None
    origin_m: Floats

    def on_plane(self, target: Target, z_m: float) -> tuple[RestBody, Floats]:
        """Return a target at rest on the plane z, and its points (F, L, S, 2) or (F, N, 2) there, metres."""
        body = rest_body(self.recording, target.name, lens=self.used.lens, pose0=self.used.pose0, z_m=z_m)
        raw = midpoints(self.recording.targets_raw[target.name])
        return body, world_points(raw, self.used.lens, self.ground.known_poses, z_m)


def _solve_target(scene: _Scene, target: Target, slow_m: Floats) -> TargetSolution:
    recording, ground = scene.recording, scene.ground
    z_m = scene.used.heights_m[target.name]
    body, points = scene.on_plane(target, z_m)
    still = during(recording.time_s, scene.project.intervals_s.pre_event)
    fit = body.fit(points, still & ground.usable)
    determined = body.is_determined(fit)
    used_points = (fit.weight > 0.1).reshape(len(fit.weight), -1).sum(axis=1)
    status = frame_status(recording, scene.project, ground, points_used=used_points, determined=determined)
    measured = np.isin(status, MEASURED)
    whole, texture_used = with_texture(
        fit,
        recording,
        target.name,
        body=body,
        known=determined & ground.usable,
        lens=scene.used.lens,
        pose0=scene.used.pose0,
        poses=ground.known_poses,
        z_m=z_m,
    )
    value, start_m = _from_rest(_displacement(whole, body), still & measured)
    points_sigma = _sigma_of_points(whole, body)
    history = TargetHistory.of(
        target.name,
        frame=recording.frame,
        time_s=recording.time_s,
        status=status,
        value=value,
        sigma=_sigma(scene, target, value, fit=fit, points=points_sigma, slow_m=slow_m, measured=measured),
        raw=_without_parallax_correction(scene, target),
    )
    growth = np.where(measured, body.growth(fit), np.nan)
    return TargetSolution(history, body.places + start_m + scene.origin_m, growth, texture_used)


def _displacement(motion: RigidFit, body: RestBody) -> Displacement:
    return Displacement(np.stack([motion.at(place, body.centre) for place in body.places], axis=1), motion.rotation_rad)


def _from_rest(value: Displacement, at_rest: Bools) -> tuple[Displacement, Floats]:
    """Return displacement since rest, and by how much P1 and P2 (2, 2) rest beside where the reference frame has them.

    Of what was never measured at rest, the reference frame counts as rest.
    """
    if not at_rest.any():
        return value, np.zeros((2, 2))
    start_m, start_rad = value.places_m[at_rest].mean(axis=0), value.rotation_rad[at_rest].mean()
    return Displacement(value.places_m - start_m, value.rotation_rad - start_rad), start_m


def _without_parallax_correction(scene: _Scene, target: Target) -> Displacement:
    """Return displacement as a homography of the ground alone would show it."""
    flat, apparent = scene.on_plane(target, 0.0)
    fit = flat.fit(apparent, np.zeros(len(apparent), dtype=bool))
    used = scene.used
    scale = scale_at_roof(target, flat.places, height_m=used.heights_m[target.name], camera=used.pose0)
    value = _displacement(fit, flat)
    return replace(value, places_m=scale * value.places_m)


# --- standard deviations ---------------------------------------------------------------------------------------------


def _sigma(
    scene: _Scene,
    target: Target,
    value: Displacement,
    *,
    fit: RigidFit,
    points: Displacement,
    slow_m: Floats,
    measured: Bools,
) -> Displacement:
    """Return the standard deviation of each frame's displacement.

    Args:
        fit: motion of the target's lines or points, without the texture about them.
        points: standard deviation by the scatter of the target's own points.
        slow_m: (F, 2, 2) what the uncertainty of the calibration moves P1 and P2 by.
        measured: (F,) frames.
    """
    time_s, intervals = scene.recording.time_s, scene.project.intervals_s
    still, after = during(time_s, intervals.pre_event), during(time_s, intervals.residual)
    alike_m = common_error(fit.residual, time_s, still & measured)
    return combined_sigma(
        points,
        camera_m=_camera_part(scene, target),
        shared_m=np.hypot(_ground_part(scene, target), alike_m),
        slow_m=slow_m,
        value=value,
        still=still & measured,
        moving=~(still | after),
        after=after & measured,
    )


def _camera_part(scene: _Scene, target: Target) -> Floats:
    """Return what the noise left in the camera's path moves a target by, (F, 2) metres."""
    used, flight = scene.used, scene.flight
    centre_sigma_m = _sigma_of_centres(scene.ground) if flight is None else flight.sigma_m
    return np.asarray(used.heights_m[target.name] / used.pose0.centre_m[2] * centre_sigma_m[:, :2])


def _ground_part(scene: _Scene, target: Target) -> Floats:
    """Return what the ground errs by as a whole, (F,) metres at a target's height."""
    used = scene.used
    pixel_m = (used.pose0.centre_m[2] - used.heights_m[target.name]) / float(used.lens.focal_px.mean())
    return np.asarray(GROUND_PART * scene.ground.rms_px * pixel_m)


def _sigma_of_centres(ground: Ground) -> Floats:
    """Return what the scatter of the ground makes of single camera centres (F, 3), metres, where they are usable."""
    poses = ground.known_poses
    covariance = np.linalg.pinv(np.where(ground.usable[:, None, None], poses.normal, np.eye(6)), hermitian=True)
    squared = np.nansum(poses.weight[..., None] * poses.residual**2, axis=(1, 2))
    unit_sigma = np.sqrt(squared / np.maximum(2 * np.count_nonzero(poses.weight, axis=1) - 6, 1))
    return np.asarray(unit_sigma[:, None] * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, 3:]))


def _sigma_of_points(fit: RigidFit, body: RestBody) -> Displacement:
    """Return what the scatter of a target's own points makes of its displacement and rotation."""
    covariance = np.linalg.pinv(fit.normal, hermitian=True)
    places = []
    for place in body.places:
        arm = place - body.centre
        J = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
        places.append(np.sqrt(np.diagonal(J @ covariance @ J.T, axis1=1, axis2=2)))
    return Displacement(np.stack(places, axis=1), np.sqrt(covariance[:, 2, 2]))
