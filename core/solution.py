"""What a solve finds out: the types that carry it to tables, figures and the browser."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from core.camera import PoseFit
from core.coordinates import Bools, Floats
from core.flight import SmoothFlight
from core.georeference import ReferenceFit
from core.lens import Lens
from core.measurements import Recording
from core.project import Project
from core.results import Status, TargetHistory
from core.row_times import Readout
from core.self_calibration import SelfCalibration


@dataclass(frozen=True)
class Ground:
    """The ground in all frames, relative to the local origin.

    Attributes:
        points_m: (N, 3) of the features.
        weight: (F, N) robust weights; 0 for features that were rejected or not seen.
        H_plan_ray: (F, 3, 3) from rays of each frame to local plan metres.
        poses: of all frames; None for `paper`, which knows none.
        rms_px: (F,) of the inliers.
        inliers: (F,).
        usable: (F,) whether the frame's geometry can be believed.
    """

    points_m: Floats
    weight: Floats
    H_plan_ray: Floats
    poses: PoseFit | None
    rms_px: Floats
    inliers: NDArray[np.int64]
    usable: Bools

    @property
    def known_poses(self) -> PoseFit:
        """The poses of a geometric solution.

        Raises:
            ValueError: the method knows none.
        """
        if self.poses is None:
            raise ValueError("this method stabilises frames by homographies and knows no poses")
        return self.poses


@dataclass(frozen=True)
class TargetSolution:
    """One target in all frames, before relative motion is taken.

    Attributes:
        history: displacement from rest.
        rest_m: (2, 2) P1 and P2 at rest, absolute world metres.
        growth: (F,) by what part of itself the target appears larger than at rest, nan where not measured; None for
            `paper`, whose scale follows what it sees.
        texture_used: (M,) which patches about its lines move with them and took part.
    """

    history: TargetHistory
    rest_m: Floats
    growth: Floats | None = None
    texture_used: Bools = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))


@dataclass(frozen=True)
class Solution:
    """Everything a solve found out.

    Attributes:
        reference: the fit of the clicks, with the lens as calibrated.
        lens: as used, self-calibration included.
        heights_m: of each target, as used; None where `paper` was given none.
        ground: every frame's geometry and its quality.
        targets: by name.
        histories: what is exported: relative motion taken, drift filtered.
        self_calibration, flight, readout: reports; None where they do not apply.
        warnings: sentences for people.
    """

    reference: ReferenceFit
    lens: Lens
    heights_m: Mapping[str, float | None]
    ground: Ground
    targets: Mapping[str, TargetSolution]
    histories: Mapping[str, TargetHistory]
    self_calibration: SelfCalibration | None
    flight: SmoothFlight | None
    readout: Readout | None
    warnings: tuple[str, ...]


def excluded_by(project: Project, recording: Recording) -> Bools:
    """Return which frames (F,) of a recording a person has rejected."""
    return np.array([project.is_excluded(int(frame)) for frame in recording.frame], dtype=np.bool_)


def frame_status(
    recording: Recording, project: Project, ground: Ground, *, points_used: NDArray[np.int64], determined: Bools
) -> NDArray[np.str_]:
    """Return the status (F,) of a target's frames from how much of ground and target was seen.

    Args:
        points_used: (F,) stations or patches of the target that agree with its motion.
        determined: (F,) whether they fix both translations and the rotation.
    """
    measured = ground.usable & determined
    usual_ground = np.median(ground.inliers[measured]) if measured.any() else 0
    usual_points = np.median(points_used[measured]) if measured.any() else 0
    few = (ground.inliers < 0.5 * usual_ground) | (points_used < 0.7 * usual_points)
    excluded = excluded_by(project, recording)
    status = np.where(few, Status.WEAK.value, Status.OK.value)
    status = np.where(measured & (points_used >= 0.15 * usual_points), status, Status.LOST.value)
    return np.asarray(np.where(excluded, Status.EXCLUDED.value, status), dtype=np.str_)
