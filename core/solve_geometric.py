"""The geometric method: poses of all frames from the ground, targets in their own plane.

Self-calibration on the stationary part and smooth flight take out what calibration and single frames get wrong.
Everything here is relative to the local origin of the reference fit, with z = 0 at the ground plane.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.bodies import RestBody, midpoints, rest_body, world_points
from core.camera import Pose, PoseFit, fit_poses, intersect_height, plan_homographies
from core.coordinates import Bools, Floats, finite_median
from core.errors import InputError
from core.flight import SmoothFlight, smooth_flight
from core.georeference import ReferenceFit, fit_reference, reference_pose
from core.intervals import within
from core.lens import Lens
from core.measurements import Recording
from core.motion import RigidFit, is_determined
from core.project import Project, Target
from core.relief import Relief
from core.results import Status, TargetHistory
from core.self_calibration import Parameter, SelfCalibration, refused, self_calibrate
from core.solution import Ground, Solution, TargetSolution, frame_status
from core.uncertainty import SHARED_PART, Sigma, combined_sigma

# Ground points a frame needs; below half of the usual number it is weak.
LEAST_GROUND = 20
# Stationary moments used for self-calibration, each the mean of the frames around it.
MOMENTS = 48
CALIBRATION_FEATURES = 230
# Neighbouring ground features err alike, so that all together say less than their number promises.
ALIKE = 5.0
# The mean of neighbouring frames is not quite the view of their mean pose, however exact the patches are.
LEAST_GROUND_NOISE_PX = 0.1
# Parallax below which stationary frames say nothing about the calibration, in standard deviations of a moment.
LEAST_DRIFT_M = 0.02
# Uncertainty of a roof's height above the ground, one standard deviation: LiDAR, and where exactly the strip lies.
HEIGHT_SIGMA_M = 0.03
# A moment of the stationary part is not known better than this, whatever its neighbours say.
LEAST_NOISE_M = 2e-5


@dataclass(frozen=True)
class _Calibration:
    """What self-calibration may correct, as used by one evaluation."""

    lens: Lens
    pose0: Pose
    heights_m: Mapping[str, float]


def solve_geometric(recording: Recording, project: Project, lens: Lens, relief: Relief | None = None) -> Solution:
    """Return displacement by geometry.

    Args:
        recording: measurements; see `core.measurements`.
        relief: elevation of the ground; a plane where None.

    Raises:
        InputError: the clicks, the lens or the heights do not do.
    """
    heights = {target.name: _height_of(target) for target in project.targets}
    reference = fit_with_relief(project, lens, relief)
    assert reference.pose is not None
    start = _Calibration(lens, reference.pose, heights)
    calibration = _self_calibrated(recording, project, start, reference, relief)
    used = _with_correction(start, calibration.correction, project)
    ground = solve_ground(recording, used.lens, used.pose0, reference.origin_m, relief)
    flight, ground = _smoothed(recording, ground, used.lens)
    slow_m = _calibration_sigma(recording, project, start, calibration, reference, relief)
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
        warnings=calibration.warnings,
    )


def _height_of(target: Target) -> float:
    if target.height_m is None:
        raise InputError(
            f'project.json: targets.{target.name}.height_m is missing; "geometric" needs its height above '
            'the ground, "paper" does without.'
        )
    return target.height_m


def click_elevation(project: Project, relief: Relief | None) -> Floats | None:
    """Return how far the ground lies above the datum at each click (N,), or None where it is not known."""
    if relief is None or not project.correspondences:
        return None
    return relief.at(np.array([pair.ground_m for pair in project.correspondences]))


def fit_with_relief(project: Project, lens: Lens, relief: Relief | None, *, has_lens: bool = True) -> ReferenceFit:
    """Return the reference fit of the project's clicks, with the ground's own elevation below them where known."""
    elevation = click_elevation(project, relief)
    return fit_reference(project.correspondences, lens, has_lens=has_lens, elevation_m=elevation)


def ground_points(raw: Floats, lens: Lens, pose0: Pose, origin_m: Floats, relief: Relief | None) -> Floats:
    """Return the world coordinates (N, 3) of ground features seen at raw reference pixels (N, 2)."""
    rays = lens.rays_from_raw(raw)
    xy = intersect_height(pose0.R, pose0.centre_m, rays, 0.0)
    z = np.zeros(len(xy))
    for _ in range(2 if relief is not None else 0):
        assert relief is not None
        z = relief.at(xy + origin_m)
        xy = intersect_height(pose0.R, pose0.centre_m, rays, z)
    return np.column_stack([xy, z])


def solve_ground(recording: Recording, lens: Lens, pose0: Pose, origin_m: Floats, relief: Relief | None) -> Ground:
    """Return the pose of every frame from the ground features."""
    points = ground_points(recording.reference.ground_raw, lens, pose0, origin_m, relief)
    rays = lens.rays_from_raw(recording.ground_raw)
    weight = np.isfinite(points).all(axis=1) * np.ones(len(rays))[:, None]
    focal = float(lens.focal_px.mean())
    poses = fit_poses(rays, weight, np.nan_to_num(points), pose0, sigma_floor=0.01 / focal)
    return _assessed(points, poses, focal)


def _assessed(points: Floats, poses: PoseFit, focal: float) -> Ground:
    inlier = poses.weight > 0.1
    squared = np.where(inlier, (np.nan_to_num(poses.residual) ** 2).sum(axis=-1), 0.0)
    count = inlier.sum(axis=1)
    rms = np.sqrt(squared.sum(axis=1) / np.maximum(2 * count, 1)) * focal
    usable = (count >= LEAST_GROUND) & np.isfinite(poses.centre_m).all(axis=1) & (poses.centre_m[:, 2] > 0)
    return Ground(points, poses.weight, plan_homographies(poses.R, poses.centre_m), poses, rms, count, usable)


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
    used: _Calibration,
    ground: Ground,
    *,
    flight: SmoothFlight | None,
    slow_m: Floats,
    origin_m: Floats,
) -> TargetSolution:
    height = used.heights_m[target.name]
    body = rest_body(recording, target.name, used.lens, used.pose0, height)
    points = world_points(midpoints(recording.targets_raw[target.name]), used.lens, ground.known_poses, height)
    still = _stationary(recording.time_s, project)
    fit = body.fit(points, still & ground.usable)
    used_points = (fit.weight > 0.1).reshape(len(fit.weight), -1).sum(axis=1)
    status = frame_status(recording, project, ground, used_points, is_determined(fit.normal))
    apparent = world_points(midpoints(recording.targets_raw[target.name]), used.lens, ground.known_poses, 0.0)
    flat = rest_body(recording, target.name, used.lens, used.pose0, 0.0)
    raw = flat.fit(apparent, np.zeros(len(apparent), dtype=bool))
    scale = _paper_scale(target, flat, used.pose0, height)
    measured = (status == Status.OK) | (status == Status.WEAK)
    places, rotation = _from_rest(
        np.stack([fit.at(place, body.centre) for place in body.places], 1), fit.rotation_rad, still & measured
    )
    part = height / used.pose0.centre_m[2]
    pixel_m = (used.pose0.centre_m[2] - height) / float(used.lens.focal_px.mean())
    frames = len(recording.frame)
    sigma = combined_sigma(
        _sigma_of_points(fit, body),
        camera_m=np.zeros((frames, 2)) if flight is None else part * flight.sigma_m[:, :2],
        shared_m=SHARED_PART * np.hypot(ground.rms_px * pixel_m, fit.sigma.mean(axis=1)),
        slow_m=slow_m,
        places_m=places,
        rotation_rad=rotation,
        still=still & measured,
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
    return TargetSolution(history=history, rest_m=body.places + origin_m)


def _paper_scale(target: Target, flat: RestBody, pose0: Pose, height_m: float) -> float:
    """Return metres at roof level per plan metre: from the known distance P1-P2, or else from the heights."""
    if target.p1_p2_m is not None and target.kind == "lines":
        return target.p1_p2_m / float(np.linalg.norm(flat.places[0] - flat.places[1]))
    return float((pose0.centre_m[2] - height_m) / pose0.centre_m[2])


def _stationary(time_s: Floats, project: Project) -> Bools:
    """Return which frames the project says the building stood still in before the event, and nobody rejected."""
    interval = project.intervals_s.pre_event
    return within(time_s, interval) if interval is not None else np.zeros(len(time_s), dtype=bool)


def _from_rest(places: Floats, rotation_rad: Floats, still: Bools) -> tuple[Floats, Floats]:
    """Return displacements (F, 2, 2) and rotations (F,) from their mean in the stationary part, where there is one."""
    if not still.any():
        return places, rotation_rad
    return places - places[still].mean(axis=0), rotation_rad - rotation_rad[still].mean()


def _sigma_of_points(fit: RigidFit, body: RestBody) -> Sigma:
    """Return what the scatter of a target's own points makes of its displacement and rotation."""
    covariance = np.linalg.pinv(fit.normal, hermitian=True)
    places = []
    for place in body.places:
        arm = place - body.centre
        J = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
        places.append(np.sqrt(np.diagonal(J @ covariance @ J.T, axis1=1, axis2=2)))
    return Sigma(np.stack(places, axis=1), np.sqrt(covariance[:, 2, 2]))


# --- self-calibration ------------------------------------------------------------------------------------------------


def _parameters(lens: Lens, project: Project) -> tuple[Parameter, ...]:
    sigma, (fx, fy) = lens.sigma, lens.focal_px
    return (
        Parameter("fx", "px", sigma.focal_relative * fx),
        Parameter("fy", "px", sigma.focal_relative * fy),
        Parameter("cx", "px", sigma.centre_px),
        Parameter("cy", "px", sigma.centre_px),
        Parameter("k1", "1", sigma.k1),
        Parameter("k2", "1", sigma.k2),
        *(Parameter(f"height of {target.name}", "m", HEIGHT_SIGMA_M) for target in project.targets),
    )


def _with_correction(start: _Calibration, correction: Floats, project: Project) -> _Calibration:
    K, d = start.lens.camera_matrix.copy(), start.lens.distortion.copy()
    K[[0, 1, 0, 1], [0, 1, 2, 2]] += correction[:4]
    d[:2] += correction[4:6]
    lens = replace(start.lens, camera_matrix=K, distortion=d)
    heights = {
        target.name: start.heights_m[target.name] + float(extra)
        for target, extra in zip(project.targets, correction[6:], strict=True)
    }
    return _Calibration(lens, start.pose0, heights)


def _self_calibrated(
    recording: Recording, project: Project, start: _Calibration, reference: ReferenceFit, relief: Relief | None
) -> SelfCalibration:
    parameters = _parameters(start.lens, project)
    still = _stationary(recording.time_s, project)
    if project.intervals_s.pre_event is None:
        return refused(parameters, "no pre-event interval is given")
    moments = _moments(recording, still)
    if len(moments.time_s) < 12:
        return refused(parameters, "the pre-event interval holds too few frames")
    ground = solve_ground(moments, start.lens, start.pose0, reference.origin_m, relief)
    drift = ground.known_poses.centre_m[ground.usable].std(axis=0)[:2] if ground.usable.any() else np.zeros(2)
    if float(np.hypot(*drift)) < LEAST_DRIFT_M:
        return refused(parameters, f"the camera drifted by {np.hypot(*drift) * 100:.1f} cm only, too little to tell")
    apparent_motion = _Trials(moments, project, start, reference, relief).motion
    motion = apparent_motion(np.zeros(len(parameters)))
    noise = 1.4826 * finite_median(np.abs(np.diff(motion, n=2, axis=0)).T) / np.sqrt(6.0)
    sigma = np.where(np.isfinite(motion), np.maximum(noise, LEAST_NOISE_M), np.nan)
    return self_calibrate(
        parameters, apparent_motion, sigma, _ground_misfit(recording, project, start, reference, relief)
    )


@dataclass(frozen=True)
class _Trial:
    """A calibration tried on moments: poses and points of the ground, as one set of weights makes them."""

    used: _Calibration
    pose0: Pose
    ground: PoseFit


class _Trials:
    """Tries calibrations on a few moments of a recording.

    Who counts as an outlier is decided once, under the calibration as it came: a weight that flips between two trials
    would pass for an effect of the calibration.
    """

    def __init__(
        self, moments: Recording, project: Project, start: _Calibration, reference: ReferenceFit, relief: Relief | None
    ) -> None:
        self._moments, self._project, self._start = moments, project, start
        self._origin_m, self._relief = reference.origin_m, relief
        self._elevation = click_elevation(project, relief)
        solved = solve_ground(moments, start.lens, start.pose0, reference.origin_m, relief)
        self._first = solved.known_poses
        self.usable = solved.usable
        self._weights = {}
        for target in project.targets:
            height = start.heights_m[target.name]
            body = rest_body(moments, target.name, start.lens, start.pose0, height)
            fit = body.fit(self._points(target, start.lens, self._first, height), np.zeros(len(moments.frame), bool))
            sigma = np.maximum(finite_median(fit.sigma.T), 1e-6)
            self._weights[target.name] = fit.weight / (sigma[:, None] if body.lines is not None else sigma) ** 2

    def attempt(self, correction: Floats) -> _Trial:
        """Return the poses of all moments under a correction (P,)."""
        used = _with_correction(self._start, correction, self._project)
        pose0 = reference_pose(self._project.correspondences, used.lens, self._origin_m, self._elevation)
        points = ground_points(self._moments.reference.ground_raw, used.lens, pose0, self._origin_m, self._relief)
        rays = used.lens.rays_from_raw(self._moments.ground_raw)
        weight = np.where(np.isfinite(points).all(axis=1), self._first.weight, 0.0)
        ground = fit_poses(rays, weight, np.nan_to_num(points), self._first, iterations=5, robust=False)
        return _Trial(used, pose0, ground)

    def motion(self, correction: Floats) -> Floats:
        """Return P1 and P2 of every target (moments, 4 targets), metres, under a correction (P,)."""
        trial = self.attempt(correction)
        columns = []
        for target in self._project.targets:
            height = trial.used.heights_m[target.name]
            body = rest_body(self._moments, target.name, trial.used.lens, trial.pose0, height)
            points = self._points(target, trial.used.lens, trial.ground, height)
            fit = body.fit_with(points, self._weights[target.name])
            measured = (self.usable & is_determined(fit.normal))[:, None]
            columns += [np.where(measured, fit.at(place, body.centre), np.nan) for place in body.places]
        return np.concatenate(columns, axis=1)

    def _points(self, target: Target, lens: Lens, ground: PoseFit, height_m: float) -> Floats:
        return world_points(midpoints(self._moments.targets_raw[target.name]), lens, ground, height_m)


def _ground_misfit(
    recording: Recording, project: Project, start: _Calibration, reference: ReferenceFit, relief: Relief | None
) -> Callable[[Floats], Floats]:
    """Return a function from corrections of the calibration to what the ground leaves over in the whole clip."""
    trials = _Trials(_moments(recording, np.ones(len(recording.frame), bool)), project, start, reference, relief)

    def left_over(correction: Floats) -> tuple[Floats, Bools]:
        ground = trials.attempt(correction).ground
        agree = (ground.weight > 0.1) & trials.usable[:, None]
        residual = np.where(agree[..., None], ground.residual, 0.0)
        # What a feature leaves over in every frame alike is its own place, not the lens.
        own = residual.sum(axis=0) / np.maximum(agree.sum(axis=0), 1)[:, None]
        return np.where(agree[..., None], residual - own, 0.0), agree

    first, agree = left_over(np.zeros(len(_parameters(start.lens, project))))
    noise = ALIKE * 1.4826 * float(np.median(np.abs(first[agree]))) if agree.any() else 1.0
    noise = max(noise, LEAST_GROUND_NOISE_PX / float(start.lens.focal_px.mean()))
    return lambda correction: left_over(correction)[0].ravel() / noise


def _calibration_sigma(
    recording: Recording,
    project: Project,
    start: _Calibration,
    calibration: SelfCalibration,
    reference: ReferenceFit,
    relief: Relief | None,
) -> dict[str, Floats]:
    """Return, per target, what the uncertainty of the calibration moves P1 and P2 by from rest, (F, 2, 2) metres.

    It changes as slowly as the camera drifts, so it is computed at some frames and interpolated.
    """
    chosen = np.unique(np.linspace(0, len(recording.frame) - 1, MOMENTS).astype(int))
    some = _selected(_thinned(recording), chosen)
    apparent_motion = _Trials(some, project, start, reference, relief).motion
    motion = apparent_motion(calibration.correction)
    steps = 0.5 * np.array([parameter.sigma for parameter in calibration.parameters])
    J = np.stack([(apparent_motion(calibration.correction + d) - motion) for d in np.diag(steps)], -1) / steps
    still = _stationary(some.time_s, project) & np.isfinite(motion).all(axis=1)
    rest = J[still].mean(axis=0) if still.any() else J[np.isfinite(motion).all(axis=1)][:1].sum(axis=0)
    variance = np.einsum("fku,uv,fkv->fk", J - rest, calibration.covariance, J - rest)
    known = np.isfinite(variance).all(axis=1)
    if not known.any():
        return {target.name: np.full((len(recording.frame), 2, 2), np.nan) for target in project.targets}
    sigma = np.sqrt(np.maximum(variance, 0.0))
    columns = [np.interp(recording.time_s, some.time_s[known], column[known]) for column in sigma.T]
    every = np.stack(columns, axis=1).reshape(len(recording.frame), -1, 2, 2)
    return {target.name: every[:, number] for number, target in enumerate(project.targets)}


def _selected(recording: Recording, chosen: NDArray[np.int64]) -> Recording:
    """Return a recording of some frames only."""
    return replace(
        recording,
        frame=recording.frame[chosen],
        time_s=recording.time_s[chosen],
        H_ray_ray0=recording.H_ray_ray0[chosen],
        ground_raw=recording.ground_raw[chosen],
        targets_raw={name: raw[chosen] for name, raw in recording.targets_raw.items()},
    )


def _moments(recording: Recording, still: Bools) -> Recording:
    """Return the stationary part as at most `MOMENTS` means of neighbouring frames, each less noisy than one frame."""
    recording = _thinned(recording)
    groups = [g for g in np.array_split(np.flatnonzero(still), MOMENTS) if len(g)]

    def mean(values: Floats) -> Floats:
        return np.stack([_mean_seen(values[group]) for group in groups]) if groups else values[:0]

    return replace(
        recording,
        frame=np.arange(len(groups)),
        time_s=np.array([recording.time_s[group].mean() for group in groups]),
        H_ray_ray0=recording.H_ray_ray0[[int(group[0]) for group in groups]],
        ground_raw=mean(recording.ground_raw),
        targets_raw={name: mean(raw) for name, raw in recording.targets_raw.items()},
    )


def _thinned(recording: Recording) -> Recording:
    """Return a recording with fewer ground features: calibration shows in slow motion, which needs no more."""
    kept = slice(None, None, max(1, recording.ground_raw.shape[1] // CALIBRATION_FEATURES))
    reference = replace(recording.reference, ground_raw=recording.reference.ground_raw[kept])
    return replace(recording, reference=reference, ground_raw=recording.ground_raw[:, kept])


def _mean_seen(values: Floats) -> Floats:
    """Return the mean over frames of what was seen in all of them; a mean of some would be that of other moments."""
    return np.asarray(values.mean(axis=0))
