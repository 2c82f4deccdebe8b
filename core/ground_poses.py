"""The camera's pose in every frame, from ground features that the reference frame ties to the surveyed ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.camera import Pose, PoseFit, fit_poses, intersect_height, plan_homographies, project
from core.coordinates import Bools, Floats, evenly_spread
from core.georeference import ReferenceFit, fit_reference
from core.lens import Lens
from core.measurements import Recording
from core.patches import HALF_PX
from core.project import Project
from core.relief import Relief
from core.robust import finite_median, robust_sigma
from core.solution import Ground

# Ground points a frame needs; below half of the usual number it is weak.
LEAST_GROUND = 20
# No ground feature is believed to be steadier than this part of the usual one.
LEAST_SCATTER = 0.3
# A feature that lies further from the ground stands on it, if that is told by so many standard deviations.
STANDING_M = 0.5
STANDING_SIGMA = 4.0
STANDING_FRAMES = 150
STANDING_ROUNDS = 4
# Frames, evenly spread, that say how steady a feature is.
TRUST_FRAMES = 1000
# In fewer frames than these, a feature agrees with the others, or stands out of them, by chance.
LEAST_TRUST_FRAMES = 10
# Least scatter of ground points at which outliers are told, pixels.
LEAST_SIGMA_PX = 0.01
# An encoder short of bits repeats the ground of a key frame in the frames that follow, while strips go on moving. It is
# looked for where features usually scatter by more than COARSE_PX, pixels. A frame repeats another if its features
# scatter less than this part of what is usual, and have moved against each other since the frame before by less than
# this part of what is usual.
COARSE_PX = 0.15
REPEATED = 0.45


def click_elevation(project: Project, relief: Relief | None) -> Floats | None:
    """Return how far the ground lies above the datum at each click (N,), or None where it is not known."""
    if relief is None or not project.correspondences:
        return None
    return relief.at(np.array([pair.ground_m for pair in project.correspondences]))


def fit_with_relief(project: Project, lens: Lens, relief: Relief | None, *, has_lens: bool = True) -> ReferenceFit:
    """Return the reference fit of the project's clicks, with the ground's own elevation below them where known."""
    elevation = click_elevation(project, relief)
    return fit_reference(project.correspondences, lens, has_lens=has_lens, elevation_m=elevation)


def ground_points(raw: Floats, lens: Lens, pose0: Pose, *, origin_m: Floats, relief: Relief | None) -> Floats:
    """Return the world coordinates (N, 3) of ground features seen at raw reference pixels (N, 2)."""
    rays = lens.rays_from_raw(raw)
    xy = intersect_height(pose0.R, pose0.centre_m, rays, 0.0)
    z = np.zeros(len(xy))
    for _ in range(2 if relief is not None else 0):
        assert relief is not None
        z = relief.at(xy + origin_m)
        xy = intersect_height(pose0.R, pose0.centre_m, rays, z)
    return np.column_stack([xy, z])


def _on_ground(raw: Floats, lens: Lens, pose0: Pose, *, origin_m: Floats, relief: Relief | None) -> Bools:
    """Return which features (N,) seen at raw reference pixels (N, 2) show the ground and nothing that stands on it."""
    if relief is None:
        return np.ones(len(raw), dtype=bool)
    reach = HALF_PX * float(pose0.centre_m[2]) / float(lens.focal_px.mean())
    shown = relief.shows_ground(lens.rays_from_raw(raw), pose0, origin_m, reach)
    # A cloud that shows next to no ground where the camera looks is another day's, or another site's.
    return shown if shown.sum() >= 2 * LEAST_GROUND else np.ones(len(raw), dtype=bool)


def solve_ground(
    recording: Recording,
    lens: Lens,
    pose0: Pose,
    *,
    origin_m: Floats,
    relief: Relief | None,
    reference_frame: int | None = None,
) -> Ground:
    """Return the pose of every frame from the ground features.

    Args:
        reference_frame: the only one in which the features may all lie where the reference frame shows them.
    """
    points = ground_points(recording.reference.ground_raw, lens, pose0, origin_m=origin_m, relief=relief)
    rays = lens.rays_from_raw(recording.ground_raw)
    on_ground = _on_ground(recording.reference.ground_raw, lens, pose0, origin_m=origin_m, relief=relief)
    weight = on_ground * np.ones(len(rays))[:, None]
    focal = float(lens.focal_px.mean())
    least = LEAST_SIGMA_PX / focal
    poses = fit_poses(rays, weight, points, pose0, sigma_floor=least)
    trusted = weight
    if len(rays) >= LEAST_TRUST_FRAMES:
        trusted = weight * _trust(poses)
        trusted *= ~_standing(rays, trusted, points, poses, pose0=pose0, least_sigma=least)
        poses = fit_poses(rays, trusted, points, poses, iterations=4, sigma_floor=least)
    agreeing = np.where(trusted > 0, poses.weight / np.maximum(trusted, 1e-300), 0.0)
    inlier = agreeing > 0.1
    squared = np.where(inlier, (np.nan_to_num(poses.residual) ** 2).sum(axis=-1), 0.0)
    count = inlier.sum(axis=1)
    rms = np.sqrt(squared.sum(axis=1) / np.maximum(2 * count, 1)) * focal
    usable = (count >= LEAST_GROUND) & np.isfinite(poses.centre_m).all(axis=1) & (poses.centre_m[:, 2] > 0)
    usable &= ~_repeated(recording.ground_raw, rms, usable) | (recording.frame == reference_frame)
    return Ground(points, agreeing, plan_homographies(poses.R, poses.centre_m), poses, rms, count, usable)


def _repeated(ground_raw: Floats, rms_px: Floats, usable: Bools) -> Bools:
    """Return which frames (F,) show the ground of the reference frame again instead of their own."""
    repeated = np.zeros(len(rms_px), dtype=bool)
    usual = float(np.median(rms_px[usable])) if usable.any() else 0.0
    near = np.flatnonzero((rms_px < REPEATED * usual) & (np.arange(len(rms_px)) > 0))
    if usual > COARSE_PX and len(near):
        some = 1 + evenly_spread(len(rms_px) - 1, TRUST_FRAMES)
        usual_change = float(np.median(_change_px(ground_raw, some)))
        repeated[near] = _change_px(ground_raw, near) < REPEATED * usual_change
    return repeated


def _change_px(ground_raw: Floats, frames: NDArray[np.int64]) -> Floats:
    """Return how unevenly features (F, N, 2) have moved since the frame before, in some frames (M,)."""
    moved = np.moveaxis(ground_raw[frames] - ground_raw[frames - 1], -1, 1)
    return robust_sigma((moved - finite_median(moved)[..., None]).reshape(len(frames), -1))


def _standing(
    rays: Floats, weight: Floats, points_m: Floats, poses: PoseFit, *, pose0: Pose, least_sigma: float
) -> Bools:
    """Return which ground features (N,) move, wherever the camera does, like something high above the ground.

    A car that came after the scan is in no point cloud; its features lie at another height along their line of sight.
    They pull the poses along, so what stands out at first is taken away before the next are looked for.

    Args:
        least_sigma: of any feature in a frame, rays.
    """
    some = evenly_spread(len(rays), STANDING_FRAMES)
    rays, weight = rays[some], weight[some]
    poses = poses.selected(some)
    standing = np.zeros(len(points_m), dtype=bool)
    for _ in range(STANDING_ROUNDS):
        height, sigma = _heights(points_m, poses, pose0, least_sigma)
        usual = np.where(standing, np.nan, height)
        spread = robust_sigma(usual - finite_median(usual))
        found = standing | (np.abs(height) > np.maximum(STANDING_M, STANDING_SIGMA * np.maximum(sigma, spread)))
        if (found == standing).all():
            break
        standing = found
        poses = fit_poses(rays, weight * ~standing, points_m, poses, iterations=4)
    return standing


def _heights(points_m: Floats, poses: PoseFit, pose0: Pose, least_sigma: float) -> tuple[Floats, Floats]:
    """Return how high above their places (N,) features seem to lie, and its standard deviation, metres."""
    a_metre_higher = points_m + (pose0.centre_m - points_m) / (pose0.centre_m[2] - points_m[:, 2:])
    J = project(poses.R, poses.centre_m, a_metre_higher) - project(poses.R, poses.centre_m, points_m)
    seen = np.isfinite(poses.residual) & np.isfinite(J)
    J, residual = np.where(seen, J, 0.0), np.where(seen, poses.residual, 0.0)
    power = (J * J).sum(axis=(0, 2))
    height = (J * residual).sum(axis=(0, 2)) / np.maximum(power, 1e-300)
    left_over = ((residual - J * height[:, None]) ** 2).sum(axis=(0, 2)) / np.maximum(seen.sum(axis=(0, 2)) - 1, 1)
    return height, np.sqrt(np.maximum(left_over, least_sigma**2) / np.maximum(power, 1e-300))


def _trust(poses: PoseFit) -> Floats:
    """Return the relative weight (N,) of ground features from how steadily each agrees with all others.

    One corner keeps its place to a thirtieth of a pixel in all frames, another, on grass, to half a pixel.
    """
    residual = poses.residual[:: max(1, len(poses.residual) // TRUST_FRAMES)]
    own = residual - finite_median(np.moveaxis(residual, 0, -1))
    sigma = robust_sigma(np.moveaxis(own, 1, 0).reshape(own.shape[1], -1))
    known = sigma > 0
    if not known.any():
        return np.ones(len(sigma))
    usual = float(np.median(sigma[known]))
    return np.where(known, (usual / np.maximum(sigma, LEAST_SCATTER * usual)) ** 2, 0.0)
