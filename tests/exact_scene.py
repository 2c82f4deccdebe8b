"""A measurement computed from geometry alone, without pictures: what an errorless engine would record.

A camera drifts 42 m above a ground of known points while a roof 12 m high stands, shakes and comes to rest elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from core.camera import Pose, exponential, plan_homography, project
from core.coordinates import Floats, invert_homography, rotation_2d
from core.lens import Lens
from core.measurements import Recording, Reference
from core.project import Correspondence, Project

SIZE = (960, 540)
HEIGHT_M = 12.0
RATE_HZ = 15.0
STATIONS = 40
FRAMES = 120
RESIDUAL_M = 0.08
LENS = Lens(
    SIZE, np.array([[610.0, 0.0, 474.0], [0.0, 612.0, 275.0], [0.0, 0.0, 1.0]]), np.array([-0.08, 0.03, 1e-3, -5e-4, 0])
)
# Both edges of each strip at rest, relative to the roof's middle: L1, L2 along x, T1 along y; 0.2 m wide.
LINES_M = {"L1": ((-3.0, 0.6), (3.0, 0.6)), "L2": ((-3.0, -0.6), (3.0, -0.6)), "T1": ((0.4, -2.0), (0.4, 2.0))}
ROOF_M = np.array([1.5, -0.8])
# The site's coordinates count from somewhere else, so that nothing may depend on small numbers.
SITE_M = np.array([4200.0, 7300.0])


@dataclass(frozen=True)
class Truth:
    """Displacement of P1 and P2 (F, 2) and rotation (F,) from the first frame, and the camera (F, 3)."""

    p1_m: Floats
    p2_m: Floats
    rotation_rad: Floats
    centre_m: Floats


def pose(frame: float) -> Pose:
    """Return the camera of a frame, relative to `SITE_M`."""
    t = frame / RATE_HZ
    drift = np.array([0.25 * np.sin(0.5 * t), 0.2 * np.sin(0.4 * t + 1), 0.1 * np.sin(0.3 * t)])
    down = np.diag([1.0, -1.0, -1.0])
    shaking = 0.004 * np.array([np.sin(1.9 * t), np.cos(1.3 * t), np.sin(0.7 * t)])
    return Pose(exponential(shaking + [0.06, -0.03, 0.05]) @ down, np.array([0.7, -1.2, 42.0]) + drift)


def motion(frame: float) -> tuple[Floats, float]:
    """Return the roof's shift (2,) and rotation: still for 3 s, shaken for 3 s, then at rest 8 cm further east."""
    t = frame / RATE_HZ
    shaking = float(np.clip(min(t - 3.0, 6.0 - t), 0.0, 1.0))
    residual = RESIDUAL_M * float(np.clip((t - 4.0) / 1.5, 0.0, 1.0))
    return np.array([0.3 * shaking * np.sin(9 * t) + residual, 0.05 * shaking * np.cos(7 * t)]), 2e-3 * shaking


def _edges() -> Floats:
    """Return (3, STATIONS, 2, 2) roof points relative to the roof's middle."""
    along = np.linspace(0.0, 1.0, STATIONS)[:, None]
    lines = []
    for start, end in LINES_M.values():
        a, b = np.array(start), np.array(end)
        across = 0.1 * np.array([a[1] - b[1], b[0] - a[0]]) / np.linalg.norm(b - a)
        middle = a + along * (b - a)
        lines.append(np.stack([middle - across, middle + across], axis=1))
    return np.array(lines)


def ground_places() -> Floats:
    """Return (N, 2) places on the ground that no frame hides behind the roof."""
    places = np.random.default_rng(3).uniform((-24.0, -13.0), (24.0, 13.0), (260, 2))
    return places[(np.abs(places - ROOF_M) > (7.0, 5.5)).any(axis=1)]


def seen(frame: float, points: Floats) -> Floats:
    """Return the raw pixels (..., 2) of places (..., 3) relative to `SITE_M`."""
    camera = pose(frame)
    return LENS.raw_from_rays(project(camera.R, camera.centre_m, points.reshape(-1, 3))).reshape(*points.shape[:-1], 2)


def on_roof(frame: float) -> Floats:
    shift, angle = motion(frame)
    places = _edges() @ rotation_2d(angle).T + ROOF_M + shift
    return np.concatenate([places, np.full((*places.shape[:-1], 1), HEIGHT_M)], axis=-1)


# Where ground clicks are made, metres from the site's middle.
CLICKS = [(-22, -11), (-8, -12), (9, -11.5), (22, -12), (21, 0), (22, 11), (7, 12), (-9, 11), (-23, 12), (-21, 1)]


def project_document(**changes: Any) -> Project:
    """Return the project a careful person would have made."""
    places = np.array(CLICKS, dtype=float)
    pixels = seen(0, np.column_stack([places, np.zeros(len(places))]))
    bands = {
        name: {"from_m": (np.array(a) + ROOF_M + SITE_M).tolist(), "to_m": (np.array(b) + ROOF_M + SITE_M).tolist()}
        for name, (a, b) in LINES_M.items()
    }
    made: dict[str, Any] = {
        "name": "exact",
        "inputs": {"video": "video.mp4", "lens": "lens.yaml"},
        "correspondences": [
            Correspondence(id=number + 1, ground_m=tuple(place + SITE_M), frame_px=tuple(pixel))
            for number, (place, pixel) in enumerate(zip(places, pixels, strict=True))
        ],
        "moving_regions_px": [[(380, 200), (620, 200), (620, 380), (380, 380)]],
        "targets": [{"name": "roof", "height_m": HEIGHT_M, "p1_p2_m": 1.2, "lines": bands}],
        "intervals_s": {"pre_event": (0.0, 2.9), "event": (3.0, 6.0), "residual": (6.5, 7.9)},
    }
    return Project.model_validate({**made, **changes})


@lru_cache
def recording(noise_px: float = 0.0, frames: int = FRAMES, names: tuple[str, ...] = ("roof",)) -> Recording:
    """Return what is seen of ground and roof, with normal noise on every coordinate of every frame but the first."""
    ground = np.column_stack([ground_places(), np.zeros(len(ground_places()))])
    noise = np.random.default_rng(5)
    seen_ground = np.array([seen(frame, ground) for frame in range(frames)])
    seen_roof = np.array([seen(frame, on_roof(frame)) for frame in range(frames)])
    reference = Reference(seen_ground[0], {name: seen_roof[0] for name in names})
    if noise_px:
        seen_ground = seen_ground + noise.normal(scale=noise_px, size=seen_ground.shape)
        seen_roof = seen_roof + noise.normal(scale=noise_px, size=seen_roof.shape)
    plan = [plan_homography(pose(frame)) for frame in range(frames)]
    return Recording(
        method="geometric",
        finished=True,
        reference=reference,
        frame=np.arange(frames),
        time_s=np.arange(frames) / RATE_HZ,
        H_ray_ray0=np.array([invert_homography(H) @ plan[0] for H in plan]),
        ground_raw=seen_ground,
        targets_raw={name: seen_roof for name in names},
    )


def truth(frames: int = FRAMES) -> Truth:
    """Return what should come out."""
    p1, p2 = np.array([0.4, 0.6]), np.array([0.4, -0.6])
    moved = [motion(frame) for frame in range(frames)]
    return Truth(
        p1_m=np.array([shift + rotation_2d(angle) @ p1 - p1 for shift, angle in moved]),
        p2_m=np.array([shift + rotation_2d(angle) @ p2 - p2 for shift, angle in moved]),
        rotation_rad=np.array([angle for _, angle in moved]),
        centre_m=np.array([pose(frame).centre_m for frame in range(frames)]) + np.append(SITE_M, 0.0),
    )
