"""What lifts the ground's metres to a target: its height above the ground, or the known distance P1–P2.

An obstacle is said from the target's key in `project.json` on: what is wrong with it and what to do. A doubt keeps
nothing from being measured; it is a sentence for whoever uses the result.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from core.camera import Pose
from core.coordinates import Floats
from core.errors import InputError
from core.project import PROJECT_FILE, Target

# How far scales at the roof may lie from each other: wrong by more are height, lens or bands, not the measurement.
SCALE_TOLERANCE = 0.02
# How many times as long, or as short, as the bands allow a known distance is before it must be another unit.
_OTHER_UNIT = 2.0
# Nothing rises nearer to the camera than to this part of its height.
_LEAST_SCALE = 0.1


def height_obstacle(target: Target, camera: Pose | None) -> str | None:
    """Return what keeps `geometric` from knowing a target's plane, or None.

    Args:
        camera: of the reference frame; None where the clicks do not tell it.
    """
    if target.height_m is None:
        return f'height_m: missing, but method "geometric" needs the height of "{target.name}"; add it'
    return _too_high(target.height_m, camera)


def kind_obstacle(target: Target) -> str | None:
    """Return what keeps `paper` from following a target, or None."""
    if target.kind == "points":
        return 'kind: "points", which method "paper" does not know; choose "geometric", or mark lines'
    return None


def scale_obstacle(target: Target, camera: Pose | None, *, has_lens: bool) -> str | None:
    """Return what keeps `paper` from knowing a target's scale, or None.

    Args:
        camera: as in `height_obstacle`.
        has_lens: whether there is a lens, without which the clicks tell no camera.
    """
    if (obstacle := kind_obstacle(target)) is not None:
        return obstacle
    if target.p1_p2_m is None and (target.height_m is None or not has_lens):
        return (
            'p1_p2_m: missing; "paper" takes its scale from the known distance P1-P2, or from height_m and a lens; '
            "add one of them"
        )
    return None if target.height_m is None else _too_high(target.height_m, camera)


def _too_high(height_m: float, camera: Pose | None) -> str | None:
    if camera is None or height_m < camera.centre_m[2]:
        return None
    return (
        f"height_m: {height_m:g}, but by the clicks the camera hovers {camera.centre_m[2]:.1f} m above the ground; "
        "correct the height, the clicks or the lens"
    )


def distance_doubt(target: Target, places_m: Floats, *, height_m: float | None) -> str | None:
    """Return what makes a target's known distance P1–P2 doubtful, or None.

    Args:
        places_m: (2, 2) P1 and P2 at that height, world metres.
        height_m: of the target, as calibrated; None where it is not known.
    """
    if target.p1_p2_m is None or height_m is None or target.kind != "lines":
        return None
    distance_m = float(np.linalg.norm(places_m[0] - places_m[1]))
    if abs(distance_m / target.p1_p2_m - 1.0) <= SCALE_TOLERANCE:
        return None
    return (
        f"P1 and P2 of {target.name} lie {distance_m:.3f} m apart where it is {height_m:.2f} m high, but p1_p2_m is "
        f"{target.p1_p2_m:.3f} m; check height_m, the lens and the bands."
    )


def distance_obstacle(target: Target, apart_m: tuple[float, float], camera: Pose | None) -> str | None:
    """Return what makes a target's known distance P1–P2 impossible, most likely another unit, or None.

    Args:
        apart_m: the least and the most that its bands let P1 and P2 lie apart where they appear, plan metres.
        camera: as in `height_obstacle`, which has nothing against the target.
    """
    if target.p1_p2_m is None:
        return None
    if camera is not None and target.height_m is not None:
        lowest = highest = 1.0 - target.height_m / camera.centre_m[2]
    else:
        lowest, highest = _LEAST_SCALE, 1.0
    least_m, most_m = lowest * apart_m[0], highest * apart_m[1]
    if least_m / _OTHER_UNIT <= target.p1_p2_m <= most_m * _OTHER_UNIT:
        return None
    return (
        f"p1_p2_m: {target.p1_p2_m:g}, but its bands put P1 and P2 {least_m:.2f} to {most_m:.2f} m apart; write it in "
        "metres, or correct the bands"
    )


def height_doubt(target: Target, shown_m: float | None, camera: Pose | None) -> str | None:
    """Return what makes a target's height doubtful, or None.

    Args:
        shown_m: height above the ground of what the point cloud shows where the target is; None where it shows nothing.
        camera: of the reference frame.
    """
    if shown_m is None or target.height_m is None or camera is None:
        return None
    if abs(shown_m - target.height_m) <= SCALE_TOLERANCE * (camera.centre_m[2] - target.height_m):
        return None
    return (
        f"height_m of {target.name} is {target.height_m:.2f} m, but the point cloud shows it {shown_m:.2f} m above the "
        "ground; check height_m and orthoimage.ground_z_m."
    )


def doubts(
    target: Target, places_m: Floats, *, height_m: float | None, shown_m: float | None, camera: Pose | None
) -> Iterator[str]:
    """Yield everything about a target's height and known distance that is doubtful; see the two above."""
    both = distance_doubt(target, places_m, height_m=height_m), height_doubt(target, shown_m, camera)
    yield from (doubt for doubt in both if doubt is not None)


def refuse_if(obstacle: str | None, target: Target) -> None:
    """Refuse a target with an obstacle.

    Raises:
        InputError: naming the obstacle.
    """
    if obstacle is not None:
        raise InputError(f"{PROJECT_FILE}: targets.{target.name}.{obstacle}.")


def scale_at_roof(target: Target, places_m: Floats, *, height_m: float | None, camera: Pose | None) -> float:
    """Return metres at roof level per plan metre: from the known distance P1–P2, or else from the heights.

    Args:
        target: that `scale_obstacle` or `height_obstacle` has nothing against.
        places_m: (2, 2) P1 and P2 where they appear on the ground plane, plan metres.
        height_m: of the target, as calibrated.
        camera: of the reference frame.

    Source: the paper, Fig. 6(a).
    """
    if target.p1_p2_m is not None and target.kind == "lines":
        return target.p1_p2_m / float(np.linalg.norm(places_m[0] - places_m[1]))
    assert height_m is not None
    assert camera is not None
    return float(1.0 - height_m / camera.centre_m[2])
