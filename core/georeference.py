"""Clicked pairs -> the reference frame on the ground: homography, camera pose, and how far each click can be trusted.

Ground coordinates of a site may be UTM's: all fitting is done relative to a stated local origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from core.camera import Pose, fit_poses, intersect_height, jacobians, plan_homography, pose_from_homography, project
from core.coordinates import Floats, apply_homography, invert_homography
from core.errors import InputError
from core.lens import Lens
from core.project import Correspondence

# Share of the frame's cells (4 x 4) that clicks should touch.
COVERAGE_CELLS = 4
# Standard deviations across the best line below which clicks count as collinear, as a part of their extent.
COLLINEAR = 0.02
# A click contradicts the others where it lies off their fit by more than this many metres, which no hand does, and by
# this many times what their own scatter allows; a few clicks scatter little by chance, but no hand is steadier than
# CLICK_PX.
CONTRADICTION_M = 0.3
CONTRADICTION = 5.0
CLICK_PX = 1.0
# Beyond this the others are no use either, and search bands lie nowhere near their lines.
HOPELESS_M = 5.0


@dataclass(frozen=True)
class PairResidual:
    """One clicked pair against the fit.

    Attributes:
        residual_px: clicked minus predicted place in the frame, undistorted pixels.
        residual_m: clicked minus predicted place on the ground, metres.
        left_out_px, left_out_m: size of the same when the pair takes no part in the fit; None where that cannot be fit.
        left_out_sigma_px: what left_out_px may be by the scatter of the others, one standard deviation; likewise.
        predicted_raw: where the ground click should appear in the raw frame.
        predicted_m: where the frame click lies on the ground.
    """

    id: int
    enabled: bool
    residual_px: tuple[float, float]
    residual_m: tuple[float, float]
    left_out_px: float | None
    left_out_m: float | None
    left_out_sigma_px: float | None
    predicted_raw: tuple[float, float]
    predicted_m: tuple[float, float]


@dataclass(frozen=True)
class ReferenceFit:
    """The reference frame tied to the ground.

    Attributes:
        origin_m: (2,) local origin; plan and world coordinates inside the engine are relative to it.
        H_plan_ray: (3, 3) from rays to local plan metres.
        pose: of the reference frame, relative to the local origin; None where no lens is known.
        pairs: every pair, enabled or not.
        rms_px, rms_m: of the enabled pairs; left_out_rms_px of their leave-one-out errors.
        coverage: share of the frame's cells with an enabled click.
    """

    origin_m: Floats
    lens: Lens
    H_plan_ray: Floats
    pose: Pose | None
    pairs: tuple[PairResidual, ...]
    rms_px: float
    rms_m: float
    left_out_rms_px: float | None
    coverage: float

    @property
    def contradiction(self) -> str | None:
        """What is wrong with the pair that contradicts the others most, or with all; a sentence without its end."""
        worst = self._contradicting
        if worst is not None:
            return (
                f"correspondences: id {worst.id} lies {worst.left_out_m:.2f} m from where the others put it; click it "
                "again or disable it"
            )
        if self.rms_m > CONTRADICTION_M:
            return (
                f"correspondences: miss each other by {self.rms_m:.2f} m (RMS), and none stands out; look for several "
                "mistaken ones, or a lens.yaml of another camera"
            )
        return None

    @property
    def is_hopeless(self) -> bool:
        """Whether a pair contradicts the others so far that nothing can be measured by them."""
        worst = self._contradicting
        return worst is not None and (worst.left_out_m or 0.0) > HOPELESS_M

    @property
    def _contradicting(self) -> PairResidual | None:
        off = {
            pair: pair.left_out_px / pair.left_out_sigma_px
            for pair in self.pairs
            if pair.enabled and pair.left_out_px and pair.left_out_sigma_px and (pair.left_out_m or 0) > CONTRADICTION_M
        }
        worst = max(off, key=off.__getitem__, default=None)
        return None if worst is None or off[worst] < CONTRADICTION else worst

    def plan_from_raw(self, raw: Floats) -> Floats:
        """Return absolute plan metres (N, 2) of raw reference pixels (N, 2)."""
        return apply_homography(self.H_plan_ray, self.lens.rays_from_raw(raw)) + self.origin_m

    def rays_from_plan(self, plan_m: Floats) -> Floats:
        """Return rays (N, 2) of the reference frame at absolute plan metres (N, 2)."""
        return apply_homography(invert_homography(self.H_plan_ray), np.asarray(plan_m) - self.origin_m)

    def raw_from_plan(self, plan_m: Floats) -> Floats:
        """Return raw reference pixels (N, 2) at absolute plan metres (N, 2)."""
        return self.lens.raw_from_rays(self.rays_from_plan(plan_m))

    def world_from_plan(self, plan_m: Floats, height_m: float) -> Floats:
        """Return where plan places (N, 2) lie at a height above the ground: absolute x, y.

        Raises:
            InputError: no camera pose is known.
        """
        pose = self._require_pose()
        part = height_m / pose.centre_m[2]
        centre = pose.centre_m[:2] + self.origin_m
        return np.asarray(plan_m + part * (centre - plan_m))

    def plan_from_world(self, world_m: Floats, height_m: float) -> Floats:
        """Return where places (N, 2) at a height appear on the ground plane: absolute plan metres.

        Raises:
            InputError: no camera pose is known.
        """
        pose = self._require_pose()
        enlargement = height_m / (pose.centre_m[2] - height_m)
        return np.asarray(world_m + enlargement * (world_m - pose.centre_m[:2] - self.origin_m))

    def _require_pose(self) -> Pose:
        if self.pose is None:
            raise InputError(
                "inputs.lens is missing: heights above the ground need the lens calibration; add lens.yaml."
            )
        return self.pose


def fit_reference(
    pairs: Sequence[Correspondence], lens: Lens, *, has_lens: bool = True, elevation_m: Floats | None = None
) -> ReferenceFit:
    """Tie the reference frame to the ground by clicked pairs.

    Args:
        lens: interior orientation; an ideal lens serves where none is known.
        has_lens: whether the lens is known; without it there is a homography but no pose.
        elevation_m: (len(pairs),) of the ground clicks above the ground plane; zero where None.

    Raises:
        InputError: fewer than four enabled pairs, collinear pairs, or clicks where the lens model ends.

    Source: paper, "UAV Drift and Perspective Correction", first sub-step; planar pose after Zhang (2000).
    """
    enabled = np.array([pair.enabled for pair in pairs], dtype=bool)
    ground, raw = np.array([pair.ground_m for pair in pairs]), np.array([pair.frame_px for pair in pairs])
    check_pairs(pairs)
    origin = np.rint(ground[enabled].mean(axis=0))
    local = ground - origin
    rays = lens.rays_from_raw(raw)
    if not np.isfinite(rays[enabled]).all():
        worst = next(pair.id for pair, ray in zip(pairs, rays, strict=True) if not np.isfinite(ray).all())
        raise InputError(f"project.json: correspondence {worst} lies where the lens model ends; move or disable it.")
    height = np.zeros(len(pairs)) if elevation_m is None else np.nan_to_num(elevation_m)
    points = np.column_stack([local, height])
    model = _fit(rays[enabled], points[enabled], has_lens)
    left_out = _left_out(rays, points, enabled=enabled, lens=lens, model=model)
    residuals = tuple(
        _pair_residual(pair, ray, point, model=model, lens=lens, origin=origin, left_out=out)
        for pair, ray, point, out in zip(pairs, rays, points, left_out, strict=True)
    )
    used = [pair for pair in residuals if pair.enabled]
    outs = [pair.left_out_px for pair in used if pair.left_out_px is not None]
    return ReferenceFit(
        origin_m=origin,
        lens=lens,
        H_plan_ray=model.H_plan_ray,
        pose=model.pose,
        pairs=residuals,
        rms_px=float(np.sqrt(np.mean([np.sum(np.square(pair.residual_px)) for pair in used]))),
        rms_m=float(np.sqrt(np.mean([np.sum(np.square(pair.residual_m)) for pair in used]))),
        left_out_rms_px=float(np.sqrt(np.mean(np.square(outs)))) if outs else None,
        coverage=_coverage(raw[enabled], lens.image_size_px),
    )


def reference_pose(
    pairs: Sequence[Correspondence],
    lens: Lens,
    *,
    origin_m: Floats,
    elevation_m: Floats | None,
    shift_m: Floats | None = None,
) -> Pose:
    """Return the reference frame's pose alone, for lenses that differ a little from one that has been fitted.

    Args:
        origin_m: (2,) local origin the pose is relative to.
        elevation_m: as in `fit_reference`.
        shift_m: (3,) by which the camera's centre is taken to lie beside the fit; the rotation then follows the clicks.
    """
    rays, points = _enabled_clicks(pairs, lens, origin_m, elevation_m)
    start = pose_from_homography(invert_homography(_linear_homography(rays, points[:, :2])))
    pose = _pose(rays, points, start)
    if shift_m is None or not np.any(shift_m):
        return pose
    centre = (pose.centre_m + shift_m)[None]
    turned = fit_poses(rays[None], np.ones((1, len(rays))), points, pose, robust=False, fixed_centre_m=centre)
    return Pose(turned.R[0], turned.centre_m[0])


def reference_centre_sigma(fit: ReferenceFit, pairs: Sequence[Correspondence], elevation_m: Floats | None) -> Floats:
    """Return how well the clicks fix the camera's centre, (3,) metres, one standard deviation.

    A camera a little to the side that looks a little slanted sees nearly the same ground: the clicks tell the two
    apart by perspective alone.
    """
    assert fit.pose is not None
    rays, points = _enabled_clicks(pairs, fit.lens, fit.origin_m, elevation_m)
    at_clicks = fit_poses(rays[None], np.ones((1, len(rays))), points, fit.pose, iterations=1, robust=False)
    freedom = max(2 * len(rays) - 6, 1)
    variance = float((at_clicks.residual**2).sum()) / freedom
    covariance = variance * np.linalg.pinv(at_clicks.normal[0], hermitian=True)
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance)[3:], 0.0)))


def _enabled_clicks(
    pairs: Sequence[Correspondence], lens: Lens, origin_m: Floats, elevation_m: Floats | None
) -> tuple[Floats, Floats]:
    """Return rays (N, 2) and local world points (N, 3) of the enabled pairs."""
    enabled = np.array([pair.enabled for pair in pairs], dtype=bool)
    ground = np.array([pair.ground_m for pair in pairs])[enabled] - origin_m
    height = np.zeros(len(ground)) if elevation_m is None else np.nan_to_num(elevation_m)[enabled]
    rays = lens.rays_from_raw(np.array([pair.frame_px for pair in pairs])[enabled])
    return rays, np.column_stack([ground, height])


def check_pairs(pairs: Sequence[Correspondence]) -> None:
    """Refuse pairs from which no homography follows.

    Raises:
        InputError: naming what is wrong with them.
    """
    enabled = [pair for pair in pairs if pair.enabled]
    if len(enabled) < 4:
        raise InputError(
            f"project.json: {_number(len(enabled))} enabled, at least four are needed, about 20 well spread advised."
        )
    for what, points in (
        ("ground_m", np.array([pair.ground_m for pair in enabled])),
        ("frame_px", np.array([pair.frame_px for pair in enabled])),
    ):
        if _collinear(points):
            if (stray := _stray(points)) is not None:
                raise InputError(
                    f"project.json: correspondence {enabled[stray].id} lies so far from all others in {what} that they "
                    "seem to lie in one place; correct it."
                )
            raise InputError(
                f"project.json: the correspondences are collinear in {what}, so the ground's tilt is unknown; "
                "add pairs well away from their line."
            )
    if _all_but_one_collinear(np.array([pair.ground_m for pair in enabled])):
        raise InputError(
            "project.json: all correspondences but one are collinear in ground_m; add pairs well away from their line."
        )


def _number(count: int) -> str:
    return (
        "one correspondence is" if count == 1 else f"{count} correspondences are" if count else "no correspondence is"
    )


def _collinear(points: Floats) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= COLLINEAR * spread[0])


def _stray(points: Floats) -> int | None:
    """Return which of collinear points is alone to blame, since the others spread as they should; None if none is."""
    farthest = int(np.argmax(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
    others = np.delete(points, farthest, axis=0)
    return farthest if len(others) >= 4 and not _collinear(others) else None


def _all_but_one_collinear(points: Floats) -> bool:
    """Whether leaving some one point out makes the rest collinear: a homography then has a free parameter."""
    return any(_collinear(np.delete(points, number, axis=0)) for number in range(len(points)))


@dataclass(frozen=True)
class _Model:
    H_plan_ray: Floats
    pose: Pose | None

    def rays(self, points: Floats) -> Floats:
        if self.pose is not None:
            return project(self.pose.R, self.pose.centre_m, points)
        return apply_homography(invert_homography(self.H_plan_ray), points[:, :2])

    def plan(self, ray: Floats, height_m: float) -> Floats:
        if self.pose is not None:
            return intersect_height(self.pose.R, self.pose.centre_m, ray[None], height_m)[0]
        return apply_homography(self.H_plan_ray, ray[None])[0]

    @property
    def unknowns(self) -> int:
        """Of a pose, or of a homography."""
        return 6 if self.pose is not None else 8

    def derivatives(self, points: Floats) -> Floats:
        """Return how rays of points (N, 3) change with the pose, (N, 2, 6), or with H_ray_plan's entries, (N, 2, 9)."""
        if self.pose is not None:
            return jacobians(self.pose.R[None], self.pose.centre_m[None], points)[1][0]
        H = invert_homography(self.H_plan_ray)
        plan = np.column_stack([points[:, :2], np.ones(len(points))])
        ray, zero = self.rays(points), np.zeros_like(plan)
        across = np.stack([np.hstack([plan, zero, -ray[:, :1] * plan]), np.hstack([zero, plan, -ray[:, 1:] * plan])], 1)
        return np.asarray(across / (plan @ H[2])[:, None, None])


def _fit(rays: Floats, points: Floats, has_lens: bool) -> _Model:
    H_plan_ray = _homography(rays, points[:, :2])
    if not has_lens:
        return _Model(H_plan_ray, None)
    pose = _pose(rays, points, pose_from_homography(invert_homography(H_plan_ray)))
    # A mirrored ground is fitted just as well, by a camera that has it behind itself.
    in_front = ((points - pose.centre_m) @ pose.R[2] > 0).all()
    if not np.isfinite(pose.centre_m).all() or pose.centre_m[2] <= 0 or not in_front:
        raise InputError(
            "project.json: no camera above the ground sees the correspondences like this; look for swapped or mirrored "
            "pairs, east and north exchanged, or a lens.yaml of another camera."
        )
    return _Model(plan_homography(pose), pose)


def _pose(rays: Floats, points: Floats, start: Pose) -> Pose:
    fit = fit_poses(rays[None], np.ones((1, len(rays))), points, start, iterations=30, robust=False)
    return Pose(fit.R[0], fit.centre_m[0])


def _homography(rays: Floats, plan: Floats) -> Floats:
    """Return H_plan_ray by linear solution and least squares of the transfer error in the frame."""
    start = invert_homography(_linear_homography(rays, plan))

    def transfer(h: Floats) -> Floats:
        return np.asarray((apply_homography(np.append(h, 1.0).reshape(3, 3), plan) - rays).ravel())

    best = least_squares(transfer, start.ravel()[:8], method="lm", x_scale="jac").x
    return invert_homography(np.append(best, 1.0).reshape(3, 3))


def _linear_homography(rays: Floats, plan: Floats) -> Floats:
    """Return H_plan_ray by the direct linear transformation (Hartley & Zisserman 2003, algorithm 4.2)."""
    T_ray, T_plan = _normalising(rays), _normalising(plan)
    x, X = apply_homography(T_ray, rays), apply_homography(T_plan, plan)
    one, zero = np.ones((len(x), 1)), np.zeros((len(x), 3))
    Xh = np.hstack([X, one])
    A = np.vstack([np.hstack([Xh, zero, -x[:, :1] * Xh]), np.hstack([zero, Xh, -x[:, 1:] * Xh])])
    H = np.linalg.svd(A)[2][-1].reshape(3, 3)
    return invert_homography(np.linalg.inv(T_ray) @ H @ T_plan)


def _normalising(points: Floats) -> Floats:
    """Return the similarity (3, 3) that centres points and scales them to unit size (Hartley 1997)."""
    mean = points.mean(axis=0)
    scale = np.sqrt(2.0) / max(float(np.linalg.norm(points - mean, axis=1).mean()), 1e-12)
    return np.array([[scale, 0.0, -scale * mean[0]], [0.0, scale, -scale * mean[1]], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class _LeftOut:
    """How far a pair lies from the fit of the others, and how far it may by their scatter (`PairResidual`)."""

    px: float
    m: float
    sigma_px: float | None


def _left_out(rays: Floats, points: Floats, *, enabled: np.ndarray, lens: Lens, model: _Model) -> list[_LeftOut | None]:
    """Return each pair against the fit of the others; None where there is none.

    Source: the externally studentised residual (Cook & Weisberg 1982, section 2.2.1): a pair that takes part in the fit
    draws it to itself, and all others off it.
    """
    others = enabled & ~np.eye(len(rays), dtype=bool)
    if model.pose is None:
        models = _models_without_poses(rays, points, others)
    else:
        models = _models_near(rays, points, others, model.pose)
    focal = float(lens.focal_px.mean())
    errors: list[_LeftOut | None] = []
    for ray, point, chosen, without in zip(rays, points, others, models, strict=True):
        if without is None or not _determined(points[chosen, :2]):
            errors.append(None)
            continue
        pixels = (ray - without.rays(point[None])[0]) * lens.focal_px
        metres = point[:2] - without.plan(ray, point[2])
        sigma = _expected_error(without, rays[chosen], points[chosen], point, click=CLICK_PX / focal)
        errors.append(
            _LeftOut(
                float(np.linalg.norm(pixels)), float(np.linalg.norm(metres)), None if sigma is None else sigma * focal
            )
        )
    return errors


def _expected_error(model: _Model, rays: Floats, points: Floats, point: Floats, *, click: float) -> float | None:
    """Return how far a further pair at `point` (3,) may lie off, in rays; None where all pairs are needed for the fit.

    Args:
        model: fitted to rays (N, 2) and points (N, 3).
        click: standard deviation of one coordinate of a click by the steadiest hand, rays.
    """
    residual = rays - model.rays(points)
    J, J_there = model.derivatives(points), model.derivatives(point[None])[0]
    freedom = residual.size - model.unknowns
    if freedom <= 0:
        return None
    variance = max(float((residual**2).sum()) / freedom, click**2)
    covariance = np.linalg.pinv(np.einsum("nxu,nxv->uv", J, J), hermitian=True)
    return float(np.sqrt(variance * np.trace(np.eye(2) + J_there @ covariance @ J_there.T)))


def _determined(ground: Floats) -> bool:
    return len(ground) >= 4 and not _collinear(ground) and not _all_but_one_collinear(ground)


def _models_near(rays: Floats, points: Floats, others: np.ndarray, near: Pose) -> list[_Model | None]:
    """Return the fit of each row of `others` (N, N), all at once from the pose of the whole fit."""
    fits = fit_poses(
        np.repeat(rays[None], len(rays), axis=0), others.astype(np.float64), points, near, iterations=30, robust=False
    )
    poses = (Pose(R, centre_m) for R, centre_m in zip(fits.R, fits.centre_m, strict=True))
    return [
        _Model(plan_homography(pose), pose) if np.isfinite(pose.centre_m).all() and pose.centre_m[2] > 0 else None
        for pose in poses
    ]


def _models_without_poses(rays: Floats, points: Floats, others: np.ndarray) -> list[_Model | None]:
    models: list[_Model | None] = []
    for chosen in others:
        try:
            determined = _determined(points[chosen, :2])
            models.append(_fit(rays[chosen], points[chosen], False) if determined else None)
        except InputError:
            models.append(None)
    return models


def _pair_residual(
    pair: Correspondence,
    ray: Floats,
    point: Floats,
    *,
    model: _Model,
    lens: Lens,
    origin: Floats,
    left_out: _LeftOut | None,
) -> PairResidual:
    predicted_ray, predicted = model.rays(point[None])[0], model.plan(ray, point[2])
    du, dv = (ray - predicted_ray) * lens.focal_px
    dx, dy = point[:2] - predicted
    u, v = lens.raw_from_rays(predicted_ray)
    x, y = predicted + origin
    return PairResidual(
        id=pair.id,
        enabled=pair.enabled,
        residual_px=(float(du), float(dv)),
        residual_m=(float(dx), float(dy)),
        left_out_px=None if left_out is None else left_out.px,
        left_out_m=None if left_out is None else left_out.m,
        left_out_sigma_px=None if left_out is None else left_out.sigma_px,
        predicted_raw=(float(u), float(v)),
        predicted_m=(float(x), float(y)),
    )


def _coverage(raw: Floats, image_size_px: tuple[int, int]) -> float:
    cells = np.floor(raw / np.array(image_size_px) * COVERAGE_CELLS).clip(0, COVERAGE_CELLS - 1).astype(int)
    return len({(int(u), int(v)) for u, v in cells}) / COVERAGE_CELLS**2
