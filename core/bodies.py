"""A target as a rigid body in its own plane: where its lines or points lie at rest, and how measured ones move it."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from core.camera import Pose, PoseFit, intersect_height
from core.coordinates import Bools, Floats, batches
from core.lens import Lens
from core.measurements import Recording
from core.motion import (
    LineSet,
    RigidFit,
    fit_line,
    is_determined,
    is_determined_as_whole,
    rigid_from_lines,
    rigid_from_points,
    rigid_with_weights,
)
from core.parallel import on_all_cores
from core.robust import finite_median

# Frames fitted at a time; what scatter is usual is told from them.
BATCH = 1024


def world_points(raw: Floats, lens: Lens, poses: PoseFit | Pose, z_m: float) -> Floats:
    """Return local x, y (F, ..., 2) of raw pixels (F, ..., 2) on the plane z, seen from each frame's pose."""
    rays = lens.rays_from_raw(raw)
    flat = rays.reshape(len(rays), -1, 2)
    return intersect_height(poses.R, poses.centre_m, flat, z_m).reshape(rays.shape)


@dataclass(frozen=True)
class RestBody:
    """A target as it lies in the reference frame, in one plane.

    Attributes:
        lines: of a lines target, else None.
        points: (N, 2) of a points target, else None.
        stations: (L, S, 2) of a lines target, nan where not seen; else None.
        centre: (2,) pivot.
        places: (2, 2) P1 and P2.
    """

    lines: LineSet | None
    points: Floats | None
    stations: Floats | None
    centre: Floats
    places: Floats

    def fit(self, points: Floats, still: Bools) -> RigidFit:
        """Return the motion of F frames from points (F, L, S, 2) or (F, N, 2).

        Args:
            still: (F,) frames from which lasting departures of a strip from a straight line are learnt.
        """
        if self.points is not None or still.sum() < 10:
            return self._fit(points, None)
        residual = self._fit(points, None).residual[still]
        seen = np.isfinite(residual).sum(axis=0) >= 5
        pattern = np.where(seen, np.nanmedian(np.where(seen, residual, 0.0), axis=0), 0.0)
        return self._fit(points, np.nan_to_num(pattern))

    def _fit(self, points: Floats, pattern: Floats | None) -> RigidFit:
        """Fit some frames at a time, since a fit takes many times the memory of its points."""

        def fit(batch: slice) -> RigidFit:
            some = points[batch]
            weight = np.ones(some.shape[:-1])
            if self.lines is not None:
                return rigid_from_lines(some, weight, self.lines, pattern=pattern)
            assert self.points is not None
            return rigid_from_points(some, weight, self.points, self.centre)

        fits = on_all_cores(fit, batches(len(points), BATCH))
        columns = zip(*([getattr(fit, each.name) for each in fields(fit)] for fit in fits), strict=True)
        return RigidFit(*(np.concatenate(column) for column in columns))

    def fit_with(self, points: Floats, weight: Floats) -> RigidFit:
        """Return the motion of F frames from points weighted as given; smooth in the points."""
        at_rest = self.points if self.lines is None else self.lines
        assert at_rest is not None
        return rigid_with_weights(points, weight, at_rest, self.centre)

    def growth(self, fit: RigidFit) -> Floats:
        """Return by what part of itself the body appears larger than at rest, (F,); nan where not seen."""
        if self.lines is not None:
            seen = np.isfinite(fit.residual).any(axis=-1).all(axis=-1)
            beyond = finite_median(fit.residual)
            # A line beyond its place has shifted with the others, or lies further out by a part of its distance.
            by_shift_or_growth = np.column_stack([self.lines.normal, self.lines.offset])
            return np.asarray(np.where(seen, beyond @ np.linalg.pinv(by_shift_or_growth)[2], np.nan))
        assert self.points is not None
        arm = self.points - self.centre
        outwards = (fit.weight[..., None] * np.nan_to_num(fit.residual) * arm).sum(axis=(1, 2))
        whole = (fit.weight * (arm**2).sum(axis=-1)).sum(axis=1)
        return np.asarray(np.where(whole > 0, outwards / np.maximum(whole, 1e-300), np.nan))

    def is_determined(self, fit: RigidFit) -> Bools:
        """Return (F,) whether frames fix the motion.

        That the points of a textured roof scatter more than usual is no weakness: their standard deviation says it.
        """
        if self.stations is None:
            return is_determined(fit.normal)
        sigma = finite_median(fit.sigma.T)
        if not sigma.any():
            return np.zeros(len(fit.normal), dtype=np.bool_)
        # A line that is never seen would be as noisy as the others.
        noise = np.where(sigma > 0, sigma, sigma.max())
        weight = np.broadcast_to((1.0 / noise**2)[:, None], self.stations.shape[:2])
        return is_determined_as_whole(fit.normal, self.fit_with(self.stations[None], weight[None]).normal[0])


def midpoints(raw: Floats) -> Floats:
    """Return what carries the motion: mid-lines (F, L, S, 2) of edges (F, L, S, 2, 2), or patches as they are."""
    return raw.mean(axis=-2) if raw.ndim == 5 else raw


def rest_body(recording: Recording, name: str, *, lens: Lens, pose0: Pose, z_m: float) -> RestBody:
    """Return a target as it lies in the reference frame, on the plane z.

    P1 and P2 are L1 and L2 met by T1; of a points target, the ends of its region's longer axis.
    """
    raw = midpoints(recording.reference.targets_raw[name][None])
    places = world_points(raw, lens, Pose(pose0.R[None], pose0.centre_m[None]), z_m)[0]
    if places.ndim == 2:
        centre = np.nanmean(places, axis=0)
        _, _, axes = np.linalg.svd(places - centre, full_matrices=False)
        arm = axes[0] * np.ptp((places - centre) @ axes[0]) / 4
        return RestBody(None, places, None, centre, np.stack([centre + arm, centre - arm]))
    centre = np.nanmean(places.reshape(-1, 2), axis=0)
    fits = [fit_line(line, np.ones(len(line)), centre) for line in places]
    lines = LineSet(np.array([n for n, _ in fits]), np.array([o for _, o in fits]), centre)
    return RestBody(lines, None, places, centre, np.stack([lines.intersection(0, 2), lines.intersection(1, 2)]))
