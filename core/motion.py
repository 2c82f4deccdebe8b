"""From measured points to rigid motion in a plane: two translations and a rotation.

All functions work on many frames at once, and in any plane frame: rays while following, metres in the result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.coordinates import Bools, Floats, finite_rows
from core.normal_equations import solve_damped
from core.robust import biweight, finite_median, robust_sigma

ITERATIONS = 8
# Plain Gauss-Newton doubles the right digits each time; rotations are fractions of a degree.
PLAIN_ITERATIONS = 4


@dataclass(frozen=True)
class LineSet:
    """Straight lines in a plane: points x with normal . (x - centre) = offset.

    Attributes:
        normal: (L, 2) unit normals.
        offset: (L,).
        centre: (2,) origin of the offsets and pivot of rotations.
    """

    normal: Floats
    offset: Floats
    centre: Floats

    def intersection(self, first: int, second: int) -> Floats:
        """Return the point (2,) where two lines meet."""
        rows = [first, second]
        return np.asarray(self.centre + np.linalg.solve(self.normal[rows], self.offset[rows]))


@dataclass(frozen=True)
class RigidFit:
    """Rigid motion of F frames relative to the reference: x -> centre + R(rotation) (x - centre) + shift.

    Attributes:
        shift: (F, 2).
        rotation_rad: (F,) counter-clockwise in a right-handed frame.
        residual: (F, ...) what each point left over, nan where it was not observed.
        weight: (F, ...) final robust weights.
        normal: (F, 3, 3) normal matrix of (shift, rotation): the inverse of their covariance if points err
            independently.
        sigma: (F, L) robust standard deviation of the residuals of each line, nan where it is not seen; (F, 1) of
            points.
    """

    shift: Floats
    rotation_rad: Floats
    residual: Floats
    weight: Floats
    normal: Floats
    sigma: Floats

    def at(self, point: Floats, centre: Floats) -> Floats:
        """Return the displacement (F, 2) of a point (2,) of the body."""
        return np.asarray(self.carried(point[None], centre)[:, 0] - point)

    def carried(self, points: Floats, centre: Floats) -> Floats:
        """Return where points (N, 2) of the body are, (F, N, 2)."""
        arm = points - centre
        c, s = np.cos(self.rotation_rad)[:, None], np.sin(self.rotation_rad)[:, None]
        turned = np.stack([c * arm[:, 0] - s * arm[:, 1], s * arm[:, 0] + c * arm[:, 1]], axis=-1)
        return np.asarray(centre + self.shift[:, None] + turned)


def fit_line(points: Floats, weight: Floats, centre: Floats) -> tuple[Floats, float]:
    """Return the unit normal (2,) and the offset of the robust total-least-squares line through points (K, 2).

    Args:
        weight: (K,) prior weights; points that are not finite are passed over.
        centre: (2,) origin of the offset.
    """
    seen = finite_rows(points) & (weight > 0)
    x, prior = points[seen] - centre, weight[seen]
    used = prior
    normal, offset = np.array([0.0, 1.0]), 0.0
    for iteration in range(ITERATIONS):
        mean = (used[:, None] * x).sum(axis=0) / used.sum()
        _, _, axes = np.linalg.svd((x - mean) * np.sqrt(used)[:, None], full_matrices=False)
        normal = axes[1] if axes[1][np.argmax(np.abs(axes[1]))] > 0 else -axes[1]
        offset = float(normal @ mean)
        residual = x @ normal - offset
        sigma = max(float(robust_sigma(residual)), 1e-12)
        used = prior * biweight(residual, (3.0 if iteration < 2 else 1.0) * sigma)
    return normal, offset


@dataclass(frozen=True)
class Regression:
    """Straight lines through the points of F frames: y = intercept + slope x, each line in axes of its own.

    Attributes:
        centre: (L, 2) origin and `along` (L, 2) unit vector of each line's axes; y is to the left of x.
        coefficients: (F, L, 2) intercept and slope; nan where a line had too few points.
        covariance: (F, L, 2, 2) of the same, if points err independently.
        used: (F, L) number of points that agree.
    """

    centre: Floats
    along: Floats
    coefficients: Floats
    covariance: Floats
    used: NDArray[np.int64]

    def intersection(self, first: int, second: int) -> Floats:
        """Return where two lines meet (F, 2)."""
        normals, offsets = self._normals([first, second])
        return self._met(normals, offsets)

    def intersection_sigma(self, first: int, second: int) -> Floats:
        """Return one standard deviation (F, 2) of where two lines meet, along the axes."""
        rows = [first, second]
        normals, offsets = self._normals(rows)
        place = self._met(normals, offsets)
        x = ((place[:, None] - self.centre[rows]) * self.along[rows]).sum(axis=-1)
        lever = np.stack([np.ones_like(x), x], axis=-1)
        variance = np.einsum("flu,fluv,flv->fl", lever, self.covariance[:, rows], lever)
        usable: Bools = np.asarray(np.isfinite(normals).all(axis=(1, 2)))
        inverse = np.linalg.inv(np.where(usable[:, None, None], normals, np.eye(2)))
        sigma = np.sqrt(np.einsum("fxl,fl->fx", inverse**2, variance))
        return np.asarray(np.where(usable[:, None], sigma, np.nan))

    def _normals(self, rows: list[int]) -> tuple[Floats, Floats]:
        left = np.stack([-self.along[rows, 1], self.along[rows, 0]], axis=-1)
        normals = left - self.coefficients[:, rows, 1:] * self.along[rows]
        offsets = self.coefficients[:, rows, 0] + (normals * self.centre[rows]).sum(axis=-1)
        return normals, offsets

    def _met(self, normals: Floats, offsets: Floats) -> Floats:
        usable: Bools = np.asarray(np.isfinite(normals).all(axis=(1, 2)) & finite_rows(offsets))
        safe = np.where(usable[:, None, None], normals, np.eye(2))
        met = np.linalg.solve(safe, np.nan_to_num(offsets)[..., None])[..., 0]
        return np.asarray(np.where(usable[:, None], met, np.nan))


def regress_lines(points: Floats, least: int = 10) -> Regression:
    """Return the robust regression line of each of L lines in F frames; the first frame sets the axes.

    Args:
        points: (F, L, K, 2), nan where not measured.
        least: points a line needs.
    """
    first = points[0]
    centre = np.stack([np.nanmean(line, axis=0) for line in first])
    along = np.stack([_direction(line[finite_rows(line)]) for line in first])
    moved = points - centre[:, None, :]
    x = (moved * along[:, None, :]).sum(axis=-1)
    y = moved[..., 1] * along[:, None, 0] - moved[..., 0] * along[:, None, 1]
    seen = np.isfinite(x) & np.isfinite(y)
    x, y = np.where(seen, x, 0.0), np.where(seen, y, 0.0)
    coefficients = np.stack([_median(np.where(seen, y, np.nan), axis=-1), np.zeros(x.shape[:2])], axis=-1)
    used, sigma, normal = seen.astype(np.float64), np.ones(x.shape[:2]), np.zeros((*x.shape[:2], 2, 2))
    for iteration in range(ITERATIONS):
        residual = np.where(seen, y - coefficients[..., :1] - coefficients[..., 1:] * x, np.nan)
        sigma = np.maximum(robust_sigma(residual), 1e-9)
        used = np.where(seen, biweight(residual, (3.0 if iteration < 3 else 1.0) * sigma[..., None]), 0.0)
        design = np.stack([np.ones_like(x), x], axis=-1)
        normal = np.einsum("flk,flku,flkv->fluv", used, design, design)
        normal += 1e-9 * np.eye(2)
        moment = np.einsum("flk,flku,flk->flu", used, design, y)
        coefficients = np.linalg.solve(normal, moment[..., None])[..., 0]
    enough = (used > 0.1).sum(axis=-1) >= least
    coefficients[~enough] = np.nan
    covariance = np.linalg.inv(normal) * (sigma**2)[..., None, None]
    return Regression(centre, along, coefficients, covariance, (used > 0.1).sum(axis=-1))


def _direction(points: Floats) -> Floats:
    _, _, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    return np.asarray(axes[0])


def rigid_from_lines(
    points: Floats, weight: Floats, lines: LineSet, *, pattern: Floats | None = None, sigma_floor: float = 1e-12
) -> RigidFit:
    """Return the rigid motion that carries reference lines onto measured points.

    Only motion across a line counts, so L1 and L2 alone say nothing along themselves: their frames come back with a
    singular normal matrix, which the caller must refuse.

    Args:
        points: (F, L, K, 2) mid-line points, nan where not measured.
        weight: (F, L, K) prior weights.
        lines: the L reference lines.
        pattern: (L, K) lasting departure of each place from its straight line, taken off.
    """
    frames, count, stations, _ = points.shape
    seen = finite_rows(points) & (weight > 0)
    x = np.where(seen[..., None], points - lines.centre, 0.0)
    target = np.broadcast_to(lines.offset[:, None], (count, stations))
    if pattern is not None:
        target = target + pattern
    shift, angle = np.zeros((frames, 2)), np.zeros(frames)
    prior = np.where(seen, weight, 0.0)
    used, normal = prior, np.zeros((frames, 3, 3))
    sigma = np.full((frames, count), sigma_floor)
    for iteration in range(ITERATIONS):
        residual, J = _line_residual(x, shift, angle, lines.normal, target)
        masked = np.where(seen, residual, np.nan)
        if iteration < 2:
            # Two lines that stand still must not outvote the third, which alone sees the motion along them.
            residual = np.broadcast_to(_median(masked, axis=-1)[..., None], residual.shape)
            normal, step = _gauss_newton(J[..., :2], residual, prior)
            shift = shift + step
            continue
        sigma = np.maximum(robust_sigma(masked), sigma_floor)
        sigma[~seen.any(axis=-1)] = np.nan
        usual = np.maximum(_median(sigma, axis=0), sigma_floor)
        funnel = 3.0 if iteration < 4 else 1.0
        used = prior * biweight(masked, funnel * sigma[..., None])
        normal, step = _gauss_newton(J, residual, used / (usual**2)[:, None])
        shift, angle = shift + step[:, :2], angle + step[:, 2]
    residual, _ = _line_residual(x, shift, angle, lines.normal, target)
    return RigidFit(shift, angle, np.where(seen, residual, np.nan), used, normal, sigma)


def _line_residual(x: Floats, shift: Floats, angle: Floats, normal: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Return how far (F, L, K) each point lies beyond its moved line and the derivatives (F, L, K, 3) of the model."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    turned_u = c * normal[:, 0] - s * normal[:, 1]  # (F, L): normals after the rotation
    turned_v = s * normal[:, 0] + c * normal[:, 1]
    moved = x - shift[:, None, None, :]
    distance = turned_u[..., None] * moved[..., 0] + turned_v[..., None] * moved[..., 1]
    J = np.empty((*distance.shape, 3))
    J[..., 0] = turned_u[..., None]
    J[..., 1] = turned_v[..., None]
    J[..., 2] = turned_v[..., None] * moved[..., 0] - turned_u[..., None] * moved[..., 1]
    return distance - target, J


def rigid_with_weights(
    points: Floats, weight: Floats, at_rest: LineSet | Floats, centre: Floats, *, iterations: int = PLAIN_ITERATIONS
) -> RigidFit:
    """Return the rigid motion by plain least squares with weights that are given, such as those of an earlier fit.

    Unlike the robust fits it depends smoothly on the points, as derivatives need.

    Args:
        points: (F, L, K, 2) of lines or (F, N, 2), nan where not measured.
        weight: (F, L, K) or (F, N), inverse variances.
        at_rest: the L lines, or the N points (N, 2).
    """
    seen = finite_rows(points) & (weight > 0)
    x = np.where(seen[..., None], points - centre, 0.0)
    used = np.where(seen, weight, 0.0)
    shift, angle, normal = np.zeros((len(points), 2)), np.zeros(len(points)), np.zeros((len(points), 3, 3))
    residual, spread = np.zeros(used.shape), used
    for _ in range(iterations):
        if isinstance(at_rest, LineSet):
            target = np.broadcast_to(at_rest.offset[:, None], used.shape[1:])
            residual, J = _line_residual(x, shift, angle, at_rest.normal, target)
        else:
            residual, J = _point_residual(x, shift, angle, at_rest - centre)
            spread = np.repeat(used[..., None], 2, axis=-1)
        normal, step = _gauss_newton(J, residual, spread)
        shift, angle = shift + step[:, :2], angle + step[:, 2]
    return RigidFit(shift, angle, residual, used, normal, np.ones((len(points), 1)))


def rigid_from_points(
    points: Floats, weight: Floats, reference: Floats, centre: Floats, *, sigma_floor: float = 1e-12
) -> RigidFit:
    """Return the rigid motion that carries reference points (N, 2) onto measured ones (F, N, 2)."""
    seen = finite_rows(points) & (weight > 0)
    x = np.where(seen[..., None], points - centre, 0.0)
    r = reference - centre
    shift, angle = _median(np.where(seen[..., None], x - r, np.nan), axis=1), np.zeros(len(points))
    shift = np.nan_to_num(shift)
    prior = np.where(seen, weight, 0.0)
    used, normal = prior, np.zeros((len(points), 3, 3))
    sigma = np.full((len(points), 1), sigma_floor)
    for iteration in range(ITERATIONS):
        residual, J = _point_residual(x, shift, angle, r)
        distance = np.where(seen, np.linalg.norm(residual, axis=-1) / np.sqrt(2.0), np.nan)
        # The median of a Rayleigh variable is 1.18 sigma.
        sigma = np.maximum(1.2011 * _median(distance, axis=-1)[:, None], sigma_floor)
        used = prior * biweight(distance, (3.0 if iteration < 3 else 1.0) * sigma)
        both = np.repeat(used[..., None], 2, axis=-1) / (sigma**2)[..., None]
        normal, step = _gauss_newton(J, residual, both)
        shift, angle = shift + step[:, :2], angle + step[:, 2]
    residual, _ = _point_residual(x, shift, angle, r)
    return RigidFit(shift, angle, np.where(seen[..., None], residual, np.nan), used, normal, sigma)


def _point_residual(x: Floats, shift: Floats, angle: Floats, r: Floats) -> tuple[Floats, Floats]:
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    turned = np.stack([c * r[:, 0] - s * r[:, 1], s * r[:, 0] + c * r[:, 1]], axis=-1)
    J = np.zeros((*turned.shape, 3))
    J[..., 0, 0] = J[..., 1, 1] = 1.0
    J[..., 0, 2], J[..., 1, 2] = -turned[..., 1], turned[..., 0]
    return x - turned - shift[:, None, :], J


def combined_fit(fit: RigidFit, other: RigidFit, weight: Floats) -> RigidFit:
    """Return the motion that two fits about the same centre tell together; residuals and weights of the first.

    Args:
        weight: (F,) of the other's information; 0 where it is not to count.
    """
    information = weight[:, None, None] * other.normal
    beyond = np.column_stack([other.shift - fit.shift, other.rotation_rad - fit.rotation_rad])
    normal = fit.normal + information
    step = solve_damped(normal, (information @ beyond[..., None])[..., 0])
    return replace(fit, shift=fit.shift + step[:, :2], rotation_rad=fit.rotation_rad + step[:, 2], normal=normal)


def _median(values: Floats, axis: int) -> Floats:
    """Return the median of what is finite along an axis; 0 where nothing is."""
    return finite_median(np.moveaxis(values, axis, -1))


def _gauss_newton(J: Floats, residual: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return normal matrices (F, U, U) and steps (F, U); singular frames take the smallest step that fits."""
    frames, unknowns = len(J), J.shape[-1]
    flat, w = J.reshape(frames, -1, unknowns), weight.reshape(frames, -1)
    r = np.where(w > 0, residual.reshape(frames, -1), 0.0)
    weighted = np.swapaxes(flat * w[..., None], -1, -2)
    A = weighted @ flat
    return A, solve_damped(A, (weighted @ r[..., None])[..., 0])


def is_determined(normal: Floats, least_ratio: float = 1e-4) -> NDArray[np.bool_]:
    """Return for each normal matrix (F, 3, 3) whether its points fix both translations and the rotation."""
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-300))
    values = np.linalg.eigvalsh(normal / (scale[:, :, None] * scale[:, None, :]))
    ratio = values[:, 0] / np.maximum(values[:, -1], 1e-300)
    return np.asarray((ratio > least_ratio) & (np.diagonal(normal, axis1=1, axis2=2) > 0).all(axis=1))


def is_determined_as_whole(normal: Floats, whole: Floats, least_share: float = 0.1) -> NDArray[np.bool_]:
    """Return for each normal matrix (F, 3, 3) whether it fixes the motion, and in every direction not too weakly.

    A line of which hardly anything is seen still makes the equations soluble, and so do two that are not quite
    parallel; what they then say along the other lines is worth nothing.

    Args:
        whole: (3, 3) of a frame in which the whole target is seen, with the usual noise.
        least_share: of its information on the weakest direction.
    """
    determined = is_determined(normal)
    weakest = np.zeros(len(normal))
    weakest[determined] = _weakest_information(normal[determined])
    return np.asarray(determined & (weakest >= least_share * _weakest_information(whole)))


def _weakest_information(normal: Floats) -> Floats:
    """Return what normal matrices (..., 3, 3) tell of the shift in the direction that they know least."""
    return np.asarray(1.0 / np.linalg.eigvalsh(np.linalg.inv(normal)[..., :2, :2])[..., -1])
