"""Small rendered clips that several tests measure, each made once."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from core.coordinates import Floats
from core.measure import measure
from core.measurements import MeasurementStore
from core.project import Project, read_project, write_project
from core.results import TargetHistory
from core.run import FRAMES_FILE, LoadedInputs, load_inputs
from core.solution import Solution
from core.solve import solve
from sample_data.catalogue import SCENES, Brief, compose
from sample_data.make import make
from sample_data.scene import Recording, Scene

INPUTS = ("video.mp4", "site.laz", "lens.yaml", "gps.csv", "truth.npz")
# Five seconds that hold everything a camera's file may hold: B-frames, open groups of pictures, uneven time.
HARD_FILE = Recording(
    bit_rate=8_000_000, uneven_time=0.2, options={"x264-params": "open-gop=1:bframes=3:keyint=40:min-keyint=20"}
)
BRIEF = replace(
    SCENES["small"],
    pre_event_s=2.4,
    event_s=1.8,
    post_event_s=1.4,
    ringing_s=0.6,
    residual_m=(0.06, -0.03),
    recording=HARD_FILE,
)


def rendered(
    factory: pytest.TempPathFactory,
    name: str,
    brief: Brief,
    *,
    seed: int = 3,
    change: Callable[[Scene], Scene] = lambda scene: scene,
) -> Path:
    """Return a scene's folder, rendered once for all processes of a test run."""
    root = factory.getbasetemp()
    shared = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root
    folder, lock = shared / f"clip-{name}", shared / f"clip-{name}.lock"
    try:
        os.close(os.open(lock, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        while not folder.exists():
            time.sleep(0.2)
        return folder
    unfinished = shared / f".clip-{name}"
    make(change(compose(name, brief, seed)), unfinished)
    unfinished.rename(folder)
    return folder


def project_copy(clip: Path, folder: Path, **changes: Any) -> Path:
    """Return a new project folder with the clip's inputs and a changed project.json."""
    folder.mkdir(parents=True)
    for name in INPUTS:
        os.symlink((clip / name).resolve(), folder / name)
    write_project(folder, changed(read_project(clip), **changes))
    return folder


def changed(project: Project, **changes: Any) -> Project:
    """Return a project with some values replaced, checked as if a person had written them."""
    return Project.model_validate({**project.model_dump(by_alias=True), **changes})


def filmed_anew(clip: Path, folder: Path, change: Callable[[list[Any]], list[Any]], **changes: Any) -> Path:
    """Return a new project of a clip whose pictures, YUV 4:2:0 planes one below another, are changed before coding."""
    project_copy(clip, folder, **changes)
    (folder / "video.mp4").unlink()
    with av.open(str(clip / "video.mp4")) as given:
        frames = list(given.decode(video=0))
        rate = given.streams.video[0].average_rate
    pictures = change([frame.to_ndarray(format="yuv420p") for frame in frames])
    with av.open(str(folder / "video.mp4"), "w") as made:
        stream = made.add_stream("libx264", rate=rate, options={"preset": "veryfast", "crf": "18"})
        stream.width, stream.height = frames[0].width, frames[0].height
        stream.codec_context.time_base = frames[0].time_base
        for frame, picture in zip(frames, pictures, strict=True):
            coded = av.VideoFrame.from_ndarray(picture, format="yuv420p")
            coded.pts, coded.time_base = frame.pts, frame.time_base
            made.mux(stream.encode(coded))
        made.mux(stream.encode())
    return folder


def with_measurements(measured: Path, folder: Path, **changes: Any) -> Path:
    """Return a copy of a measured project, its measurements in it."""
    project_copy(measured, folder, **changes)
    (folder / "results").mkdir()
    for file in (measured / "results").glob("*"):
        if file.name == FRAMES_FILE or file.suffix == ".npz":
            shutil.copy(file, folder / "results")
    return folder


def measured(inputs: LoadedInputs, **how: Any) -> Solution:
    """Return the solution of a project, measured as far as it is not yet, without figures and report."""
    with MeasurementStore(inputs.folder / "results" / FRAMES_FILE) as store:
        recording = store.load(measure(inputs.setup(), store, **how))
    return solve(recording, inputs.project, inputs.lens, inputs.relief, has_lens=inputs.has_lens)


def measured_history(folder: Path, **how: Any) -> TargetHistory:
    """Return the displacement history of a project's first target."""
    inputs = load_inputs(folder)
    return measured(inputs, **how).histories[inputs.project.targets[0].name]


def displacement(history: TargetHistory) -> Floats:
    """Return (F, 2, 2) displacement of P1 and P2."""
    return np.stack([history.p1_m, history.p2_m], axis=1)


def truth(clip: Path) -> dict[str, Any]:
    """Return what the renderer knows."""
    return dict(np.load(clip / "truth.npz"))


def true_displacement(clip: Path) -> Floats:
    """Return (F, 2, 2) displacement of the roof's P1 and P2, from the first frame, as the renderer knows it."""
    known = truth(clip)
    return np.stack([known["roof_p1_m"], known["roof_p2_m"]], axis=1)


def roof_pixel_m(brief: Brief) -> float:
    """Return what a pixel covers at roof level."""
    return (brief.altitude_m - brief.roof_m) / brief.focal_px
