"""What self-calibration may correct, and how corrections are tried on a recording.

A trial evaluates single frames; what it finds is added to means over the frames around each, so that noise is that of
the mean and the way corrections act is that of one sharp view.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from core.bodies import midpoints, rest_body, world_points
from core.camera import Pose, PoseFit, fit_poses
from core.coordinates import Bools, Floats, evenly_spread, finite_rows
from core.georeference import ReferenceFit, reference_centre_sigma, reference_pose
from core.ground_poses import click_elevation, ground_points, solve_ground
from core.intervals import during, within
from core.lens import Lens
from core.measurements import Recording
from core.motion import is_determined
from core.project import Project, Target
from core.relief import Relief
from core.robust import finite_median, robust_sigma
from core.row_times import ALIKE
from core.self_calibration import Parameter, SelfCalibration, refused, self_calibrate
from core.solution import Ground
from core.uncertainty import robust_jitter

# Moments at which corrections are tried, and the fewest that say anything.
MOMENTS = 48
LEAST_MOMENTS = 12
# How well people know the distance P1-P2: as a tape tells it, metres.
DISTANCE_SIGMA_M = 1e-3
# Drift below which stationary frames say nothing about the calibration, metres.
LEAST_DRIFT_M = 0.02
# Uncertainty of a roof's height above the ground, one standard deviation: LiDAR, and where exactly the strip lies.
HEIGHT_SIGMA_M = 0.03
# A moment of the stationary part is not known better than this, whatever its neighbours say.
LEAST_NOISE_M = 2e-5
# A residual part in which the building still trembles so many times more than before the event is left out.
TREMBLING = 2.0
TRIAL_ITERATIONS = 3
LAG = "lag of the ground"


@dataclass(frozen=True)
class Calibration:
    """The quantities that self-calibration corrects.

    Attributes:
        heights_m: of each target above the ground plane.
        lag_s: by which the decoded picture of the ground hangs behind the targets'.
        shift_m: (3,) of the reference frame's camera, beside where the clicks alone put it.
    """

    lens: Lens
    pose0: Pose
    heights_m: Mapping[str, float]
    lag_s: float = 0.0
    shift_m: Floats = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class Evidence:
    """A recording with what a calibration is tried against.

    Attributes:
        recording: at the frames' time stamps.
        speed: (F, N, 2) of its ground features in the image, raw pixels a second.
        ground: poses under the calibration as it came.
    """

    recording: Recording
    speed: Floats
    project: Project
    start: Calibration
    reference: ReferenceFit
    relief: Relief | None
    ground: Ground

    @classmethod
    def of(
        cls,
        recording: Recording,
        *,
        speed: Floats,
        project: Project,
        start: Calibration,
        reference: ReferenceFit,
        relief: Relief | None,
    ) -> Evidence:
        """Return the evidence a recording holds; `speed` as `core.row_times.ground_speed`."""
        frame0 = project.reference_frame
        ground = solve_ground(
            recording, start.lens, start.pose0, origin_m=reference.origin_m, relief=relief, reference_frame=frame0
        )
        return cls(recording, speed, project, start, reference, relief, ground)

    @cached_property
    def _groups(self) -> dict[str, tuple[Parameter, ...]]:
        """What may be corrected, by what it is part of, in the order of all corrections (P,)."""
        lens = self.start.lens
        sigma, (fx, fy), (cx, cy), (k1, k2) = lens.sigma, lens.focal_px, lens.centre_px, lens.distortion[:2]
        return {
            "focal_px": (
                Parameter("fx", "px", sigma.focal_relative * fx, fx),
                Parameter("fy", "px", sigma.focal_relative * fy, fy),
            ),
            "centre_px": (Parameter("cx", "px", sigma.centre_px, cx), Parameter("cy", "px", sigma.centre_px, cy)),
            "radial": (Parameter("k1", "1", sigma.k1, k1), Parameter("k2", "1", sigma.k2, k2)),
            "heights_m": tuple(
                Parameter(f"height of {name}", "m", HEIGHT_SIGMA_M, height)
                for name, height in self.start.heights_m.items()
            ),
            "shift_m": tuple(
                Parameter(f"{axis} of the reference camera", "m", max(float(shift), 1e-6), float(centre))
                for axis, shift, centre in zip("xy", self._centre_sigma_m, self._centre_m, strict=False)
            ),
            "lag_s": (Parameter(LAG, "s", self._lag_sigma_s),),
        }

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """What may be corrected; in the order of all corrections (P,)."""
        return tuple(parameter for group in self._groups.values() for parameter in group)

    @cached_property
    def _elevation(self) -> Floats | None:
        return click_elevation(self.project, self.relief)

    @property
    def _centre_sigma_m(self) -> Floats:
        return reference_centre_sigma(self.reference, self.project.correspondences, self._elevation)

    @property
    def _centre_m(self) -> Floats:
        return self.start.pose0.centre_m[:2] + self.reference.origin_m

    @property
    def _lag_sigma_s(self) -> float:
        """Prior of the lag: on its way the ground lags by no more than its features scatter."""
        speed = np.sqrt(np.nanmean(self.speed**2)) if np.isfinite(self.speed).any() else 0.0
        usual_s = float(np.median(np.diff(self.recording.time_s))) if len(self.recording.time_s) > 1 else 0.0
        usable = self.ground.usable
        scatter = float(np.median(self.ground.rms_px[usable])) if usable.any() else 0.0
        return float(np.clip(scatter / max(speed, 1e-9), 1e-6, 2.0 * usual_s + 1e-6))

    def corrected(self, correction: Floats) -> Calibration:
        """Return the calibration with a correction (P,); the reference pose follows from lens and clicks."""
        start = self.start
        ends = np.cumsum([len(group) for group in self._groups.values()])
        by = dict(zip(self._groups, np.split(correction, ends[:-1]), strict=True))
        K, d = start.lens.camera_matrix.copy(), start.lens.distortion.copy()
        K[[0, 1], [0, 1]] += by["focal_px"]
        K[:2, 2] += by["centre_px"]
        d[:2] += by["radial"]
        heights = {
            name: height + float(extra)
            for (name, height), extra in zip(start.heights_m.items(), by["heights_m"], strict=True)
        }
        lens = replace(start.lens, camera_matrix=K, distortion=d)
        shift = start.shift_m + np.append(by["shift_m"], 0.0)
        clicks = self.project.correspondences
        pose0 = reference_pose(
            clicks, lens, origin_m=self.reference.origin_m, elevation_m=self._elevation, shift_m=shift
        )
        return Calibration(lens, pose0, heights, start.lag_s + float(by["lag_s"][0]), shift)


def calibrate(evidence: Evidence) -> SelfCalibration:
    """Return the corrections under which targets stand still while the building does, and the ground always."""
    parameters, intervals = evidence.parameters, evidence.project.intervals_s
    time_s = evidence.recording.time_s
    parts = [within(time_s, part) for part in (intervals.pre_event, intervals.residual) if part is not None]
    if not parts:
        return refused(parameters, "no interval is given in which the building stands still")
    still = np.any(parts, axis=0) & evidence.ground.usable
    if still.sum() < LEAST_MOMENTS:
        return refused(parameters, "the stationary intervals hold too few frames")
    drift = evidence.ground.known_poses.centre_m[still].std(axis=0)[:2]
    if float(np.hypot(*drift)) < LEAST_DRIFT_M:
        return refused(parameters, f"the camera drifted by {np.hypot(*drift) * 100:.1f} cm only, too little to tell")
    groups, part = _stationary_groups(parts, evidence.ground.usable)
    motion = target_motion(evidence, groups)
    at_start = motion(np.zeros(len(parameters)))
    noise = {int(number): _noise(at_start[part == number]) for number in np.unique(part)}
    usual = noise[int(part[0])]
    calm = [number for number, own in noise.items() if (own <= TREMBLING * usual + LEAST_NOISE_M).all()]
    sigma = np.stack([noise[int(number)] for number in part])
    sigma[~(np.isfinite(at_start) & np.isin(part, calm)[:, None])] = np.nan
    if not np.isfinite(sigma).any():
        return refused(parameters, "no target was measured while the building stands still")
    ground, distances = ground_misfit(evidence), distance_misfit(evidence)

    def misfit(correction: Floats) -> Floats:
        return np.concatenate([ground(correction), distances(correction)])

    return self_calibrate(parameters, motion, sigma, misfit, part=part)


def _stationary_groups(parts: Sequence[Bools], usable: Bools) -> tuple[list[NDArray[np.int64]], NDArray[np.int64]]:
    """Return groups of neighbouring frames in which the building stands still, and the part each belongs to."""
    frames = [np.flatnonzero(part & usable) for part in parts]
    total = sum(len(part) for part in frames)
    groups, numbers = [], []
    for number, part in enumerate(frames):
        count = max(1, round(MOMENTS * len(part) / total))
        cut = [group for group in np.array_split(part, count) if len(group)]
        groups += cut
        numbers += [number] * len(cut)
    return groups, np.array(numbers)


def _noise(motion: Floats) -> Floats:
    """Return the noise (K,) of moments (B, K), metres; boundless if they are too few to tell."""
    if len(motion) < 3:
        return np.full(motion.shape[1], np.inf)
    return np.maximum(robust_jitter(motion), LEAST_NOISE_M)


@dataclass(frozen=True)
class _Trial:
    """A calibration tried on single frames: the poses that follow from it."""

    used: Calibration
    poses: PoseFit


class _Trials:
    """Tries corrections on one frame of each group.

    Who counts as an outlier is decided once, under the calibration as it came: a weight that flips between two trials
    would pass for an effect of the calibration.
    """

    def __init__(self, evidence: Evidence, groups: Sequence[NDArray[np.int64]]) -> None:
        chosen = np.array([int(group[len(group) // 2]) for group in groups])
        self._evidence = evidence
        self._frames = evidence.recording.selected(chosen)
        self._speed = np.nan_to_num(np.stack([_mean_over_frames(evidence.speed[group]) for group in groups]))
        self._start = evidence.ground.known_poses.selected(chosen)
        self._weight = {target.name: self._target_weight(target) for target in evidence.project.targets}

    def attempt(self, correction: Floats) -> _Trial:
        """Return the poses of all frames under a correction (P,)."""
        evidence, raw = self._evidence, self._frames.reference.ground_raw
        used = evidence.corrected(correction)
        origin_m, relief = evidence.reference.origin_m, evidence.relief
        points = ground_points(raw, used.lens, used.pose0, origin_m=origin_m, relief=relief)
        rays = used.lens.rays_from_raw(self._frames.ground_raw + used.lag_s * self._speed)
        poses = fit_poses(rays, self._start.weight, points, self._start, iterations=TRIAL_ITERATIONS, robust=False)
        return _Trial(used, poses)

    def motion(self, correction: Floats) -> Floats:
        """Return sum and difference of P1 and P2, over the root of two, of every target (B, 4 targets), metres."""
        trial = self.attempt(correction)
        columns = []
        for target in self._evidence.project.targets:
            height = trial.used.heights_m[target.name]
            body = rest_body(self._frames, target.name, lens=trial.used.lens, pose0=trial.used.pose0, z_m=height)
            fit = body.fit_with(self._points(target, trial.used.lens, trial.poses, height), self._weight[target.name])
            p1, p2 = (fit.at(place, body.centre) for place in body.places)
            measured = is_determined(fit.normal)[:, None]
            columns += [np.where(measured, mix, np.nan) / np.sqrt(2.0) for mix in (p1 + p2, p1 - p2)]
        return np.concatenate(columns, axis=1)

    def _target_weight(self, target: Target) -> Floats:
        start = self._evidence.start
        height = start.heights_m[target.name]
        body = rest_body(self._frames, target.name, lens=start.lens, pose0=start.pose0, z_m=height)
        fit = body.fit(self._points(target, start.lens, self._start, height), np.zeros(len(self._frames.frame), bool))
        sigma = np.maximum(finite_median(fit.sigma.T), 1e-6)
        return fit.weight / (sigma[:, None] if body.lines is not None else sigma) ** 2

    def _points(self, target: Target, lens: Lens, poses: PoseFit, height_m: float) -> Floats:
        return world_points(midpoints(self._frames.targets_raw[target.name]), lens, poses, height_m)


def target_motion(evidence: Evidence, groups: Sequence[NDArray[np.int64]]) -> Callable[[Floats], Floats]:
    """Return a function from corrections (P,) to the targets' mean coordinates in groups of frames, (B, K) metres."""
    trials = _Trials(evidence, groups)
    single = trials.motion(np.zeros(len(evidence.parameters)))
    every = _Trials(evidence, [np.array([frame]) for group in groups for frame in group])
    by_frame = every.motion(np.zeros(len(evidence.parameters)))
    ends = np.cumsum([len(group) for group in groups])
    mean = np.stack([_mean_over_frames(rows) for rows in np.split(by_frame, ends[:-1])])
    return lambda correction: mean + trials.motion(correction) - single


def ground_misfit(evidence: Evidence) -> Callable[[Floats], Floats]:
    """Return a function from corrections (P,) to what the ground leaves over in the whole clip, over its noise."""
    groups = [group for group in np.array_split(np.flatnonzero(evidence.ground.usable), MOMENTS) if len(group)]
    trials = _Trials(evidence, groups)
    weight = np.stack([evidence.ground.known_poses.weight[group].mean(axis=0) for group in groups])
    agree = np.stack([(evidence.ground.weight[group] > 0.1).mean(axis=0) > 0.5 for group in groups])
    residual = np.where(evidence.ground.weight[..., None] > 0.1, evidence.ground.known_poses.residual, np.nan)
    mean = np.stack([_mean_over_frames(residual[group]) for group in groups])
    agree &= finite_rows(mean)
    single = trials.attempt(np.zeros(len(evidence.parameters))).poses.residual

    def left_over(correction: Floats) -> Floats:
        found = mean + trials.attempt(correction).poses.residual - single
        known = agree & finite_rows(found)
        found = np.where(known[..., None], found, 0.0)
        # What a feature leaves over in every frame alike is its own place, not the lens.
        own = found.sum(axis=0) / np.maximum(known.sum(axis=0), 1)[:, None]
        return np.where(known[..., None], found - own, 0.0) * np.sqrt(weight)[..., None]

    first = left_over(np.zeros(len(evidence.parameters)))
    noise = ALIKE * float(robust_sigma(first[agree].ravel())) if agree.any() else 1.0
    return lambda correction: left_over(correction).ravel() / max(noise, 1e-9)


def distance_misfit(evidence: Evidence) -> Callable[[Floats], Floats]:
    """Return a function from corrections (P,) to what known distances P1-P2 are missed by, over their uncertainty."""
    known = [target for target in evidence.project.targets if target.kind == "lines" and target.p1_p2_m is not None]

    def missed_by(correction: Floats) -> Floats:
        used = evidence.corrected(correction)
        bodies = [
            rest_body(
                evidence.recording, target.name, lens=used.lens, pose0=used.pose0, z_m=used.heights_m[target.name]
            )
            for target in known
        ]
        measured_m = np.array([np.linalg.norm(body.places[0] - body.places[1]) for body in bodies])
        return (measured_m - np.array([target.p1_p2_m for target in known])) / DISTANCE_SIGMA_M

    return missed_by


def calibration_sigma(evidence: Evidence, calibration: SelfCalibration) -> dict[str, Floats]:
    """Return, per target, what the uncertainty of the calibration moves P1 and P2 by from rest, (F, 2, 2) metres.

    It changes as slowly as the camera drifts, so it is computed at some frames and interpolated.
    """
    recording, targets = evidence.recording, evidence.project.targets
    usable = np.flatnonzero(evidence.ground.usable)
    if not len(usable):
        return {target.name: np.full((len(recording.frame), 2, 2), np.nan) for target in targets}
    chosen = usable[evenly_spread(len(usable), MOMENTS)]
    trials = _Trials(evidence, [np.array([frame]) for frame in chosen])
    motion = trials.motion(calibration.correction)
    steps = 0.5 * np.array([parameter.sigma for parameter in calibration.parameters])
    J = np.stack([trials.motion(calibration.correction + d) - motion for d in np.diag(steps)], -1) / steps
    sums, differences = J.reshape(len(chosen), len(targets), 2, 2, -1).transpose(2, 0, 1, 3, 4)
    J = np.stack([sums + differences, sums - differences], axis=2) / np.sqrt(2.0)  # (B, targets, P1 P2, x y, P)
    still = during(recording.time_s, evidence.project.intervals_s.pre_event)[chosen]
    moments_s = recording.time_s[chosen]
    return {
        target.name: _sigma_from_rest(
            J[:, number], calibration.covariance, still=still, moments_s=moments_s, time_s=recording.time_s
        )
        for number, target in enumerate(targets)
    }


def _sigma_from_rest(J: Floats, covariance: Floats, *, still: Bools, moments_s: Floats, time_s: Floats) -> Floats:
    """Return what an uncertain calibration moves P1 and P2 by from rest, (F, 2, 2); nan where no moment tells.

    Args:
        J: (B, 2, 2, P) derivatives of P1 and P2 at some moments; nan where the target was not measured.
        covariance: (P, P) of the corrections.
        still: (B,) moments of the stationary part.
        moments_s: (B,) and time_s (F,), seconds.
    """
    known = np.isfinite(J).all(axis=(1, 2, 3))
    if not known.any():
        return np.full((len(time_s), 2, 2), np.nan)
    rest = J[known & still].mean(axis=0) if (known & still).any() else J[known][0]
    moved = J[known] - rest
    sigma = np.sqrt(np.maximum(np.einsum("...u,uv,...v->...", moved, covariance, moved), 0.0))
    columns = [np.interp(time_s, moments_s[known], column) for column in sigma.reshape(len(sigma), -1).T]
    return np.stack(columns, axis=1).reshape(len(time_s), 2, 2)


def _mean_over_frames(values: Floats) -> Floats:
    """Return the mean along the first axis of what is finite; nan where nothing is."""
    count = np.isfinite(values).sum(axis=0)
    return np.asarray(np.where(count > 0, np.nansum(values, axis=0) / np.maximum(count, 1), np.nan))
