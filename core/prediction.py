"""What the pass over the video is told, and how it guesses where to look in the next frame."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from core.apparent import Apparent
from core.coordinates import Floats, apply_homography, invert_homography
from core.errors import InputError
from core.lens import Lens
from core.measurements import FrameMeasurement, Reference
from core.project import Method, Project, Target
from core.storage import File, content_identity

if TYPE_CHECKING:
    # Brings a library along that takes a while to load, which workers that only measure are spared.
    from core.georeference import ReferenceFit

# Raised whenever the same video would be measured differently: older recordings are then not continued.
MEASURE_VERSION = 11
# Over a longer gap nothing goes on as it was, and the last place is as good a guess as any.
MOST_STEPS = 2.0


@dataclass(frozen=True)
class MeasureSetup:
    """Everything the pass over a video needs; can be sent to another process or machine.

    Attributes:
        H_ray_plan: (3, 3) from local plan metres to rays of the reference frame: where to look.
        origin_m: (2,) of the local plan.
    """

    video: File
    reference_frame: int
    moving_regions_px: tuple[tuple[tuple[float, float], ...], ...]
    targets: tuple[Target, ...]
    method: Method
    lens: Lens
    H_ray_plan: Floats
    origin_m: Floats

    @classmethod
    def of(cls, project: Project, video: File, fit: ReferenceFit) -> MeasureSetup:
        """Return what a project asks of its video, looked for where the fit of the clicks says."""
        return cls(
            video=video,
            reference_frame=project.reference_frame,
            moving_regions_px=project.moving_regions_px,
            targets=project.targets,
            method=project.method,
            lens=fit.lens,
            H_ray_plan=invert_homography(fit.H_plan_ray),
            origin_m=fit.origin_m,
        )

    def rays_from_plan(self, plan_m: Floats) -> Floats:
        """Return rays (N, 2) of the reference frame at absolute plan metres (N, 2)."""
        return apply_homography(self.H_ray_plan, np.asarray(plan_m) - self.origin_m)

    @cached_property
    def fingerprint(self) -> str:
        """Names what is measured: equal fingerprints, equal measurements, whatever the geometry."""
        looked_for = [
            target.model_dump(mode="json", include={"name", "kind", "lines", "region_m"}) for target in self.targets
        ]
        decided = [MEASURE_VERSION, self.method, self.reference_frame, self.moving_regions_px, looked_for]
        digest = hashlib.sha256(json.dumps(decided, sort_keys=True).encode())
        digest.update(_video_identity(self.video).encode())
        return digest.hexdigest()


def _video_identity(video: File) -> str:
    try:
        return content_identity(video)
    except OSError:
        raise InputError(f"{video}: not found; correct inputs.video or put the file there.") from None


def nothing_measured(reference: Reference, frame: int, time_s: float) -> FrameMeasurement:
    """Return the record of a frame in which the ground was not recognised."""
    return FrameMeasurement(
        frame,
        time_s,
        np.full((3, 3), np.nan),
        np.full_like(reference.ground_raw, np.nan),
        {name: np.full_like(raw, np.nan) for name, raw in reference.targets_raw.items()},
        dict.fromkeys(reference.targets_raw),
        {name: np.full_like(raw, np.nan) for name, raw in reference.texture_raw.items()},
    )


def predict_homography(before: Sequence[FrameMeasurement], time_s: float) -> Floats | None:
    """Return the camera's homography at a time if it goes on turning and drifting as in the last two frames."""
    if not before or not np.isfinite(before[-1].H_ray_ray0).all():
        return None
    last = before[-1].H_ray_ray0
    if len(before) < 2 or not np.isfinite(before[-2].H_ray_ray0).all():
        return last
    turn = np.linalg.inv(before[-2].H_ray_ray0) @ last
    return np.asarray(last @ (np.eye(3) + _steps_ahead(before, time_s) * (turn / turn[2, 2] - np.eye(3))))


def predict_apparent(before: Sequence[FrameMeasurement], name: str, time_s: float) -> Apparent | None:
    """Return a target's apparent motion at a time if it goes on as in the last two frames."""
    if not before or (last := before[-1].apparent[name]) is None:
        return None
    if len(before) < 2 or (earlier := before[-2].apparent[name]) is None:
        return last
    return last.towards(earlier, _steps_ahead(before, time_s))


def _steps_ahead(before: Sequence[FrameMeasurement], time_s: float) -> float:
    """Return how far a time lies behind the last frame, in steps from the frame before that one."""
    step_s = before[-1].time_s - before[-2].time_s
    return min((time_s - before[-1].time_s) / step_s, MOST_STEPS) if step_s > 0 else 1.0
