"""A clip that can really be measured, drawn in a moment: a camera that hovers still, a roof that moves to and fro."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from core.lens import Lens, write_lens
from tests.small_project import write_document

SIZE = (480, 360)
RATE_HZ = 20
FOCAL_PX = 500.0
CAMERA_M = 20.0
ROOF_M = 4.0
AMPLITUDE_M = 0.10
PERIOD_S = 0.8
REST_S = 0.5

_PIXELS_PER_PLAN_M = FOCAL_PX / CAMERA_M
_MIDDLE = np.array([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2])


def raw_of_plan(x: float, y: float) -> list[float]:
    return [_MIDDLE[0] + x * _PIXELS_PER_PLAN_M, _MIDDLE[1] - y * _PIXELS_PER_PLAN_M]


def displacement_m(time_s: float) -> float:
    """East displacement of the roof at its own height."""
    return AMPLITUDE_M * np.sin(2 * np.pi * (time_s - REST_S) / PERIOD_S) if time_s > REST_S else 0.0


def write_measurable(folder: Path, frames: int) -> None:
    folder.mkdir(parents=True)
    _write_video(folder / "video.mp4", frames)
    write_lens(folder / "lens.yaml", Lens.ideal(SIZE, FOCAL_PX))
    time_s = np.arange(0, frames / RATE_HZ, 0.1)
    east = [displacement_m(float(t)) for t in time_s]
    table = np.column_stack((time_s + 100.0, east, 0.0 * time_s))
    np.savetxt(folder / "gps.csv", table, delimiter=",", header="time_s,east_m,north_m", comments="", fmt="%.5f")
    write_document(folder, document(frames))


def document(frames: int) -> dict[str, Any]:
    corners = [(x, y) for x in (-8.0, 8.0, -3.0, 3.0) for y in (-6.0, 6.0, -5.0)]
    end_s = (frames - 1) / RATE_HZ
    return {
        "rooftrack": 1,
        "name": "measurable",
        "inputs": {"video": "video.mp4", "lens": "lens.yaml", "gps": {"file": "gps.csv"}},
        "correspondences": [
            {"id": number, "ground_m": [x, y], "frame_px": raw_of_plan(x, y)}
            for number, (x, y) in enumerate(corners, start=1)
        ],
        "moving_regions_px": [[raw_of_plan(*corner) for corner in ((-4.2, -3), (4.2, -3), (4.2, 3), (-4.2, 3))]],
        "targets": [
            {
                "name": "roof",
                "height_m": ROOF_M,
                "lines": {
                    "L1": {"from_m": [-2.5, 1.0], "to_m": [2.5, 1.0], "width_m": 0.6},
                    "L2": {"from_m": [-2.5, -1.0], "to_m": [2.5, -1.0], "width_m": 0.6},
                    "T1": {"from_m": [0.0, -2.0], "to_m": [0.0, 2.0], "width_m": 0.6},
                },
            }
        ],
        "intervals_s": {"pre_event": [0.0, REST_S], "event": [REST_S, end_s]},
    }


def _write_video(file: Path, frames: int) -> None:
    random = np.random.default_rng(3)
    ground = cv2.GaussianBlur(random.normal(0, 1, (SIZE[1], SIZE[0])), (0, 0), 1.5)
    ground = (110 + 30 * ground / ground.std()).astype(np.float32)
    roof, mask = _roof(random)
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=RATE_HZ, options={"crf": "14", "preset": "veryfast", "g": "25"})
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        for number in range(frames):
            # At the roof's height a metre is larger in the frame than on the ground.
            shift = displacement_m(number / RATE_HZ) * FOCAL_PX / (CAMERA_M - ROOF_M)
            moved = np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0]])
            top = cv2.warpAffine(roof, moved, SIZE, flags=cv2.INTER_CUBIC)
            share = cv2.warpAffine(mask, moved, SIZE, flags=cv2.INTER_LINEAR)
            picture = ground * (1 - share) + top * share + random.normal(0, 1, ground.shape)
            grey = np.clip(picture, 0, 255).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.repeat(grey[..., None], 3, 2), format="rgb24")))
        container.mux(stream.encode())


def _roof(random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A dark roof with three bright strips and some stains that make its picture its own; blurred as by optics."""
    roof, mask = np.full((SIZE[1], SIZE[0]), 70.0, np.float32), np.zeros((SIZE[1], SIZE[0]), np.float32)

    def fill(picture: np.ndarray, x: tuple[float, float], y: tuple[float, float], value: float) -> None:
        (u0, v1), (u1, v0) = raw_of_plan(x[0], y[0]), raw_of_plan(x[1], y[1])
        picture[round(v0) : round(v1) + 1, round(u0) : round(u1) + 1] = value

    fill(mask, (-3.4, 3.4), (-2.3, 2.3), 1.0)
    for _ in range(40):
        x, y = random.uniform(-3.2, 2.8), random.uniform(-2.2, 1.9)
        fill(roof, (x, x + 0.35), (y, y + 0.3), random.uniform(50, 95))
    for y in (1.0, -1.0):
        fill(roof, (-3.0, 3.0), (y - 0.1, y + 0.1), 200.0)
    fill(roof, (-0.1, 0.1), (-2.2, 2.2), 200.0)
    return cv2.GaussianBlur(roof, (0, 0), 0.8), cv2.GaussianBlur(mask, (0, 0), 0.8)
