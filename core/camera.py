"""The pinhole camera in space: poses, projection, and robust poses of many frames at once.

A pose leads from `world` (metres, z up) to the camera (x right, y down, z forward): x_camera = R (X - C). *Rays* are
normalised undistorted image coordinates (x/z, y/z), the frame in which all geometry is done; `core.lens` leads from
raw pixels to rays and back.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.coordinates import Floats, batches, finite_rows
from core.normal_equations import solve_damped
from core.parallel import on_all_cores
from core.robust import TUKEY, robust_sigma

# Frames solved together: bounds the memory of the normal equations to some tens of MB at 500 points a frame.
BATCH = 96


@dataclass(frozen=True)
class Pose:
    """One camera pose: `R` (3, 3) camera from world, `centre_m` (3,) world."""

    R: Floats
    centre_m: Floats


@dataclass(frozen=True)
class PoseFit:
    """Poses of F frames from N ground points, with what they left over.

    Attributes:
        R: (F, 3, 3) camera from world.
        centre_m: (F, 3) world.
        residual: (F, N, 2) observed minus projected rays.
        weight: (F, N) final robust weights; 0 for points left out.
        normal: (F, 6, 6) normal matrix of (rotation, centre) for unit ray variance.
        sigma: (F,) robust standard deviation of one ray coordinate.
    """

    R: Floats
    centre_m: Floats
    residual: Floats
    weight: Floats
    normal: Floats
    sigma: Floats

    def selected(self, chosen: NDArray[np.int64]) -> PoseFit:
        """Return some of the frames, by their place (M,) in these arrays."""
        return PoseFit(*(getattr(self, each.name)[chosen] for each in fields(self)))


def exponential(omega: ArrayLike) -> Floats:
    """Return rotation matrices (..., 3, 3) of rotation vectors (..., 3), radians (Rodrigues)."""
    omega = np.asarray(omega, dtype=np.float64)
    angle = np.linalg.norm(omega, axis=-1)[..., None, None]
    K = cross_matrix(omega)
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle**2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24, (1.0 - np.cos(safe)) / safe**2)
    return np.eye(3) + a * K + b * (K @ K)


def cross_matrix(vector: ArrayLike) -> Floats:
    """Return (..., 3, 3) matrices that multiply as the cross product with (..., 3) vectors."""
    v = np.asarray(vector, dtype=np.float64)
    zero = np.zeros_like(v[..., 0])
    rows = [zero, -v[..., 2], v[..., 1], v[..., 2], zero, -v[..., 0], -v[..., 1], v[..., 0], zero]
    return np.stack(rows, axis=-1).reshape(*v.shape[:-1], 3, 3)


def project(R: ArrayLike, centre_m: ArrayLike, points_m: ArrayLike) -> Floats:
    """Return rays (..., N, 2) of world points (N, 3) or (..., N, 3) seen from poses (..., 3, 3), (..., 3)."""
    R, centre_m = np.asarray(R), np.asarray(centre_m)
    camera = (np.asarray(points_m) - centre_m[..., None, :]) @ np.swapaxes(R, -1, -2)
    return camera[..., :2] / camera[..., 2:]


def intersect_height(R: ArrayLike, centre_m: ArrayLike, rays: ArrayLike, z_m: ArrayLike) -> Floats:
    """Return the world x, y (..., N, 2) where rays (..., N, 2) meet the horizontal plane(s) z = `z_m`.

    Args:
        z_m: a height, or one per ray (..., N).
    """
    rays = np.asarray(rays, dtype=np.float64)
    R, centre_m = np.asarray(R), np.asarray(centre_m)
    directions = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1) @ R
    reach = (np.asarray(z_m) - centre_m[..., None, 2]) / directions[..., 2]
    return centre_m[..., None, :2] + reach[..., None] * directions[..., :2]


def plan_homography(pose: Pose) -> Floats:
    """Return H_plan_ray (3, 3): from rays of one pose to metres on the ground plane z = 0."""
    return np.asarray(plan_homographies(pose.R[None], pose.centre_m[None])[0])


def plan_homographies(R: Floats, centre_m: Floats) -> Floats:
    """Return H_plan_ray (F, 3, 3) of poses (F, 3, 3), (F, 3); nan where a pose is not finite."""
    H_ray_plan = R @ np.stack(
        [np.broadcast_to([1.0, 0.0, 0.0], centre_m.shape), np.broadcast_to([0.0, 1.0, 0.0], centre_m.shape), -centre_m],
        axis=-1,
    )
    usable = np.isfinite(H_ray_plan).all(axis=(1, 2)) & (np.abs(centre_m[:, 2]) > 1e-9)
    inverse = np.full_like(H_ray_plan, np.nan)
    inverse[usable] = np.linalg.inv(H_ray_plan[usable])
    return inverse


def pose_from_homography(H_ray_plan: ArrayLike) -> Pose:
    """Return the pose whose image of the ground plane z = 0 is nearest to a homography (Zhang 2000, eq. 8).

    Args:
        H_ray_plan: (3, 3) from plan metres to rays.
    """
    H = np.asarray(H_ray_plan, dtype=np.float64)
    H = H / np.sqrt(np.linalg.norm(H[:, 0]) * np.linalg.norm(H[:, 1]))
    candidates = []
    for sign in (1.0, -1.0):
        r1, r2, t = sign * H[:, 0], sign * H[:, 1], sign * H[:, 2]
        U, _, Vt = np.linalg.svd(np.column_stack([r1, r2, np.cross(r1, r2)]))
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        candidates.append(Pose(R=R, centre_m=-R.T @ t))
    return max(candidates, key=lambda pose: float(pose.centre_m[2]))  # the one above the ground


def jacobians(R: Floats, centre_m: Floats, points_m: Floats) -> tuple[Floats, Floats]:
    """Return rays (F, N, 2) and their derivatives (F, N, 2, 6) by (rotation, centre).

    The rotation is perturbed on the left, R <- exp(omega) R; the centre additively, in world metres.
    """
    rays, J = _derivatives(R, centre_m, points_m)
    return rays.transpose(0, 2, 1), J.transpose(0, 3, 2, 1)


def _derivatives(R: Floats, centre_m: Floats, points_m: Floats) -> tuple[Floats, Floats]:
    """Return rays (F, 2, N) and derivatives (F, 6, 2, N) as `jacobians`: points last, as they lie in memory best."""
    camera = R @ (points_m.T - centre_m[:, :, None])
    inverse_z = 1.0 / camera[:, 2:]
    rays = camera[:, :2] * inverse_z
    a, b = rays[:, 0], rays[:, 1]
    J = np.empty((len(R), 6, *rays.shape[1:]))
    J[:, 1, 1] = a * b
    J[:, 0, 0], J[:, 1, 0], J[:, 2, 0] = -J[:, 1, 1], 1.0 + a * a, -b
    J[:, 0, 1], J[:, 2, 1] = -(1.0 + b * b), a
    for row in range(2):
        J[:, 3:, row] = (rays[:, row, None] * R[:, 2, :, None] - R[:, row, :, None]) * inverse_z
    return rays, J


def fit_poses(
    rays: Floats,
    weight: Floats,
    points_m: Floats,
    start: Pose | PoseFit,
    *,
    iterations: int = 8,
    robust: bool = True,
    sigma_floor: float = 1e-6,
    fixed_centre_m: Floats | None = None,
) -> PoseFit:
    """Return the robust least-squares pose of each frame from its ground points, all frames at once.

    Args:
        rays: (F, N, 2) observed, nan where not observed.
        weight: (F, N) prior weights: inverse variances in any unit, 0 where not to be used.
        points_m: (N, 3) world, nan where not known.
        start: one pose for all frames, or an earlier fit of the same frames.
        robust: whether to weigh down outliers (Tukey's biweight on a median scale).
        sigma_floor: smallest scale of the robust weights, rays.
        fixed_centre_m: (F, 3) camera centres to hold; only rotations are fitted then.
    """
    frames = len(rays)
    if isinstance(start, Pose):
        R0, C0 = np.repeat(start.R[None], frames, 0), np.repeat(start.centre_m[None], frames, 0)
    else:
        R0, C0 = start.R, start.centre_m
    if fixed_centre_m is not None:
        C0 = fixed_centre_m
    unknowns = 3 if fixed_centre_m is not None else 6
    weight = np.where(finite_rows(points_m), weight, 0.0)
    points_m = np.nan_to_num(points_m)

    def fit(s: slice) -> tuple[Floats, ...]:
        return _fit_batch(
            rays[s], weight[s], points_m, R0[s], C0[s],
            iterations=iterations, robust=robust, sigma_floor=sigma_floor, unknowns=unknowns,
        )  # fmt: skip

    parts = on_all_cores(fit, batches(frames, BATCH))
    return PoseFit(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _fit_batch(
    rays: Floats,
    weight: Floats,
    points_m: Floats,
    R: Floats,
    C: Floats,
    *,
    iterations: int,
    robust: bool,
    sigma_floor: float,
    unknowns: int,
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    seen = finite_rows(rays) & (weight > 0)
    observed = np.where(seen[:, None], rays.transpose(0, 2, 1), 0.0)
    base = np.where(seen, weight, 0.0)
    used, sigma = base, np.full(len(rays), sigma_floor)
    root = np.sqrt(base)[:, None]
    for iteration in range(iterations):
        predicted, J = _derivatives(R, C, points_m)
        residual = observed - predicted
        if robust:
            # Of a point that is known to be good, little is already too much.
            sigma = np.maximum(_sigma_seen(root * residual, seen), sigma_floor)
            # A wide funnel first, so that a poor start does not throw good points out.
            funnel = 4.0 if iteration < 2 else 1.0
            used = base * _tukey(root * residual, funnel * sigma)
        A, g = _normal(J[:, :unknowns], residual, used)
        step = solve_damped(A, g)
        R = exponential(step[:, :3]) @ R
        if unknowns == 6:
            C = C + step[:, 3:]
        if np.abs(step).max(initial=0.0) < 1e-12:
            break
    predicted, J = _derivatives(R, C, points_m)
    residual = np.where(seen[:, None], observed - predicted, np.nan)
    normal, _ = _normal(J, np.zeros_like(observed), used)
    sigma = np.maximum(_sigma_seen(residual, used > 0), sigma_floor)
    return R, C, residual.transpose(0, 2, 1), used, normal, sigma


def _normal(J: Floats, residual: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return normal matrices (F, U, U) and right sides (F, U) of derivatives (F, U, 2, N), residuals (F, 2, N)."""
    frames, unknowns = J.shape[:2]
    weighted = (J * weight[:, None, None]).reshape(frames, unknowns, -1)
    A = weighted @ J.reshape(frames, unknowns, -1).swapaxes(1, 2)
    return A, (weighted @ residual.reshape(frames, -1, 1))[..., 0]


def _sigma_seen(residual: Floats, seen: NDArray[np.bool_]) -> Floats:
    """Return each frame's robust standard deviation (F,) of one coordinate of the residuals (F, 2, N) that are seen."""
    return robust_sigma(np.where(seen[:, None], residual, np.nan).reshape(len(residual), -1))


def _tukey(residual: Floats, sigma: Floats) -> Floats:
    """Return the weights (F, N) of residuals (F, 2, N)."""
    # Two coordinates together: the median of a Rayleigh variable is 1.18 sigma, so the cut keeps its meaning per axis.
    ratio = (residual**2).sum(axis=1) / (2.0 * (TUKEY * sigma[:, None]) ** 2)
    return np.where(ratio < 1.0, (1.0 - np.minimum(ratio, 1.0)) ** 2, 0.0)
