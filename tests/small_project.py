"""A project small enough to make in a moment, complete enough to be checked; nothing in it can be measured well."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from core.lens import Lens, write_lens

SIZE = (160, 120)
FRAMES = 40
RATE_HZ = 20


def picture(size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """Return rough ground, and in its middle a plain roof with three painted strips, (height, width, 3)."""
    width, height = size
    blots = np.random.default_rng(1).integers(0, 255, (height // 3, width // 3, 3), dtype=np.uint8)
    shown = np.asarray(cv2.resize(blots, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
    roof = shown[height // 2 - 26 : height // 2 + 26, width // 2 - 26 : width // 2 + 26]
    roof[:] = 60
    for strip in (roof[18:21], roof[30:33], roof[:, 24:27]):
        strip[:] = 220
    return shown


def write_video(
    file: Path, size: tuple[int, int] = SIZE, frames: int = FRAMES, options: dict[str, str] | None = None
) -> None:
    shown = picture(size)
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=RATE_HZ, options=options)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        for _ in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(shown, format="rgb24")))
        container.mux(stream.encode())


def write_interlaced_video(file: Path) -> None:
    write_video(file, options={"x264-params": "tff=1"})


def write_inputs(folder: Path) -> None:
    """Write video.mp4, lens.yaml, site.csv and gps.csv."""
    folder.mkdir(parents=True, exist_ok=True)
    write_video(folder / "video.mp4")
    write_lens(folder / "lens.yaml", Lens.ideal(SIZE, 150.0))
    east, north = np.meshgrid(np.arange(-10, 10, 0.25), np.arange(-10, 10, 0.25))
    height = np.random.default_rng(2).normal(0, 0.01, east.size)
    cloud = np.column_stack((east.ravel(), north.ravel(), height))
    np.savetxt(folder / "site.csv", cloud, delimiter=",", header="x,y,z", comments="", fmt="%.3f")
    time_s = np.arange(0, 2, 0.1)
    gps = np.column_stack((time_s, 0.1 * np.sin(time_s), 0.0 * time_s))
    np.savetxt(folder / "gps.csv", gps, delimiter=",", header="time_s,east_m,north_m", comments="", fmt="%.4f")


def document() -> dict[str, Any]:
    """Return a project.json without a mistake, to be changed at will."""
    pairs = [
        {"id": number, "ground_m": [x, y], "frame_px": [79.5 + 10 * x, 59.5 - 10 * y]}
        for number, (x, y) in enumerate([(-7, -5), (7, -5), (7, 5), (-7, 5), (0, 4)], start=1)
    ]
    return {
        "rooftrack": 1,
        "name": "small",
        "inputs": {"video": "video.mp4", "cloud": "site.csv", "lens": "lens.yaml", "gps": {"file": "gps.csv"}},
        "correspondences": pairs,
        "moving_regions_px": [[[52, 32], [108, 32], [108, 88], [52, 88]]],
        "targets": [
            {
                "name": "roof",
                "height_m": 3.0,
                "p1_p2_m": 1.2,
                "lines": {
                    "L1": {"from_m": [-2, 0.6], "to_m": [2, 0.6]},
                    "L2": {"from_m": [-2, -0.6], "to_m": [2, -0.6]},
                    "T1": {"from_m": [0, -2], "to_m": [0, 2]},
                },
            }
        ],
        "intervals_s": {"pre_event": [0.0, 0.5], "event": [0.6, 1.4], "residual": [1.5, 1.95]},
    }


def write_document(folder: Path, project: dict[str, Any]) -> None:
    (folder / "project.json").write_text(json.dumps(project), encoding="utf-8")
