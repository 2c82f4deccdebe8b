"""One project folder from inputs to results: what `rooftrack run` and the browser interface both call."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from core.check import obstacles
from core.cloud import Cloud, read_cloud
from core.coordinates import Floats
from core.errors import InputError
from core.export import Results, write_results
from core.georeference import ReferenceFit
from core.gps_record import GpsRecord, read_gps
from core.ground_plane import GroundPlane, fit_ground_plane
from core.ground_poses import fit_with_relief
from core.lens import Lens, read_lens, require_image_size
from core.locks import take_lock
from core.measure import measure
from core.measurements import MeasurementStore, Recording, discard_unreadable
from core.orthoimage import ORTHOIMAGE_FILE, make_orthoimage, origin_of, read_origin, write_geotiff, write_origin
from core.prediction import MeasureSetup
from core.progress import CancelToken, Progress, heeding, silent
from core.project import PROJECT_FILE, RESULTS_FOLDER, Project, naming_file, read_project
from core.relief import Relief, rasterise
from core.solve import solve
from core.storage import File, content_identity, file_at, opened, state_of, write_atomically
from core.version import program_version
from core.video import VideoInfo, frame_index, probe

FRAMES_FILE = "frames.sqlite"
RELIEF_FILE = "relief.npz"
# Counts up when a relief keeps something else, so that none of an earlier version is taken for it.
RELIEF_VERSION = 2
# How far around the clicks the relief of the ground is kept, metres.
RELIEF_MARGIN_M = 15.0


@dataclass(frozen=True)
class LoadedInputs:
    """A project with everything it names, opened and checked against each other.

    Attributes:
        lens: as calibrated, or an ideal one where none is given.
        has_lens: whether it is the calibrated one.
        relief: of the ground, where there is a cloud.
    """

    folder: Path
    project: Project
    video: File
    info: VideoInfo
    lens: Lens
    has_lens: bool
    relief: Relief | None
    gps: GpsRecord | None

    @cached_property
    def reference_fit(self) -> ReferenceFit:
        """The fit of the clicks, made once.

        Raises:
            InputError: the clicks do not do.
        """
        return fit_with_relief(self.project, self.lens, self.relief, has_lens=self.has_lens)

    def setup(self) -> MeasureSetup:
        """Return what the pass over the video needs."""
        return MeasureSetup.of(self.project, self.video, self.reference_fit)


@dataclass(frozen=True)
class RunSummary:
    """What a run did, for the terminal."""

    folder: Path
    frames: int
    frames_measured: int
    measuring_s: float
    solving_s: float
    summary: Mapping[str, Any]


def run_project(
    folder: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    fresh: bool = False,
    progress: Progress = silent,
    cancel: CancelToken | None = None,
) -> RunSummary:
    """Measure what is missing, solve, and write all results of a project folder.

    Args:
        workers: processes that measure side by side, as `core.measure.measure`.
        scheduler: address of a Dask scheduler whose workers measure instead.
        fresh: forget earlier measurements of this method.

    Raises:
        InputError: with the first thing that keeps the project from being measured; earlier results stay as they were.
        Cancelled: on request; what was measured stays and the next run goes on from there.
    """
    cancel = cancel or CancelToken()
    progress = heeding(cancel, progress)
    with ExitStack() as stack:
        stack.enter_context(naming_file(folder))
        inputs = load_inputs(folder, progress)
        _require_runnable(inputs)
        stack.enter_context(_only_writer(folder / RESULTS_FOLDER))
        started = time.perf_counter()
        recording, known = _recorded(
            inputs, fresh, workers=workers, scheduler=scheduler, progress=progress, cancel=cancel
        )
        measured_s = time.perf_counter() - started
        progress("solving", 0, 1)
        solving = time.perf_counter()
        solution = solve(recording, inputs.project, inputs.lens, inputs.relief, has_lens=inputs.has_lens)
        solved_s = time.perf_counter() - solving
        progress("solving", 1, 1)
        _write_orthoimage(inputs, progress)
        files = {file: file_at(folder, file) for file in input_files(inputs.project)}
        results = Results(
            project=inputs.project,
            folder=folder,
            recording=recording,
            solution=solution,
            gps=inputs.gps,
            video=inputs.video,
            info=inputs.info,
            sha256={name: sha256_of(file, folder / RESULTS_FOLDER) for name, file in files.items()},
            identity={name: content_identity(file) for name, file in files.items()},
            version=program_version(),
            frames_measured=len(recording.frame) - known,
            measuring_s=measured_s,
            solving_s=solved_s,
        )
        summary = write_results(folder / RESULTS_FOLDER, results, progress)
        return RunSummary(folder, len(recording.frame), results.frames_measured, measured_s, solved_s, summary)


def _recorded(inputs: LoadedInputs, fresh: bool, **how: Any) -> tuple[Recording, int]:
    """Return the finished recording of a project, and how many of its frames an earlier run had measured."""
    setup = inputs.setup()
    file = inputs.folder / RESULTS_FOLDER / FRAMES_FILE
    if fresh:
        discard_unreadable(file)
    with MeasurementStore(file) as store:
        found = None if fresh else store.find(setup.method, setup.fingerprint)
        known = 0 if found is None else len(store.measured_frames(found))
        return store.load(measure(setup, store, fresh=fresh, **how)), known


@contextmanager
def _only_writer(results: Path) -> Iterator[None]:
    """Keep other processes from measuring the same project and writing its results.

    Raises:
        InputError: one of them does so already.
    """
    results.mkdir(parents=True, exist_ok=True)
    lock = take_lock(results)
    if lock is None:
        raise InputError(f"{results.parent}: is being measured by another process; wait for its end, or stop it.")
    with lock:
        yield


def load_inputs(folder: Path, progress: Progress = silent, *, project: Project | None = None) -> LoadedInputs:
    """Open everything a project names.

    Args:
        project: in that folder, as `project.json` has it where None.

    Raises:
        InputError: something is missing, malformed or does not fit together.
    """
    project = project or read_project(folder)
    video = file_at(folder, project.inputs.video)
    info = probe(video)
    lens = _lens_of(folder, project, video, info)
    gps = project.inputs.gps
    return LoadedInputs(
        folder=folder,
        project=project,
        video=video,
        info=info,
        lens=lens or Lens.stand_in((info.width, info.height)),
        has_lens=lens is not None,
        relief=_relief_of(folder, project, progress),
        gps=None if gps is None else read_gps(folder / gps.file, gps),
    )


def _lens_of(folder: Path, project: Project, video: File, info: VideoInfo) -> Lens | None:
    if project.inputs.lens is None:
        return None
    file = folder / project.inputs.lens
    lens = read_lens(file)
    require_image_size(lens, width=info.width, height=info.height, lens_file=file, video_file=video)
    return lens


@dataclass(frozen=True)
class ReliefPlan:
    """Which relief of the ground a project needs.

    Attributes:
        extent_m: west, south, east, north.
        at_m: (2,) where heights count from the ground plane.
        file: that keeps it, named by all that decides it.
    """

    extent_m: tuple[float, float, float, float]
    at_m: Floats
    file: Path

    def make(self, cloud: Cloud, plane: GroundPlane) -> Relief:
        """Make the relief from the cloud and keep it in place of earlier ones."""
        relief = rasterise(cloud, plane, self.extent_m, self.at_m)
        relief.save(self.file)
        for old in set(self.file.parent.glob(f"*-{RELIEF_FILE}")) - {self.file}:
            # The server and a run beside it may both be at this.
            old.unlink(missing_ok=True)
        return relief


def relief_plan(folder: Path, project: Project) -> ReliefPlan | None:
    """Return which relief a project needs; None without a cloud or clicks.

    Raises:
        InputError: the cloud cannot be read.
    """
    if project.inputs.cloud is None or not project.correspondences:
        return None
    cloud_file = folder / project.inputs.cloud
    places = np.array([pair.ground_m for pair in project.correspondences])
    west, south = np.floor(places.min(axis=0) - RELIEF_MARGIN_M)
    east, north = np.ceil(places.max(axis=0) + RELIEF_MARGIN_M)
    below = _middle_of_targets(project, places)
    extent = (float(west), float(south), float(east), float(north))
    decided = json.dumps(
        [RELIEF_VERSION, _cloud_identity(cloud_file), extent, below.tolist(), project.orthoimage.ground_z_m]
    )
    name = hashlib.sha256(decided.encode()).hexdigest()[:16]
    return ReliefPlan(extent, below, folder / RESULTS_FOLDER / f"{name}-{RELIEF_FILE}")


def _cloud_identity(cloud_file: Path) -> str:
    try:
        return content_identity(cloud_file)
    except FileNotFoundError:
        raise InputError(f"{cloud_file}: not found; correct inputs.cloud or put the file there.") from None
    except OSError as error:
        raise InputError(f"{cloud_file}: cannot be read ({error.strerror}); correct inputs.cloud.") from None


def _relief_of(folder: Path, project: Project, progress: Progress) -> Relief | None:
    """Return the ground's relief, from an earlier run where the cloud and what decides the raster are the same."""
    plan = relief_plan(folder, project)
    if plan is None:
        return None
    known = Relief.load(plan.file)
    return known if known is not None else plan.make(*read_ground(folder, project, progress))


def read_ground(folder: Path, project: Project, progress: Progress = silent) -> tuple[Cloud, GroundPlane]:
    """Return the project's cloud and its ground plane.

    Raises:
        InputError: there is no cloud, or no ground in it.
    """
    if project.inputs.cloud is None:
        raise InputError(f"{folder / 'project.json'}: inputs.cloud is missing; add the LiDAR point cloud.")
    file = folder / project.inputs.cloud
    cloud = read_cloud(file, progress)
    try:
        return cloud, fit_ground_plane(cloud, project.orthoimage.ground_z_m)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _middle_of_targets(project: Project, otherwise: Floats) -> Floats:
    """Return the middle (2,) of what is measured, where heights count from the ground.

    To a metre, so that moving a band a little does not make the relief anew.
    """
    corners: list[tuple[float, float]] = []
    for target in project.targets:
        if target.lines is not None:
            bands = (target.lines.L1, target.lines.L2, target.lines.T1)
            corners += [end for band in bands for end in (band.from_m, band.to_m)]
        corners += list(target.region_m or ())
    return np.asarray(np.rint((np.array(corners) if corners else otherwise).mean(axis=0)))


def _require_runnable(inputs: LoadedInputs) -> None:
    for obstacle in obstacles(inputs.project, inputs.info, frame_index(inputs.video), inputs.reference_fit):
        raise InputError(f"{inputs.folder / PROJECT_FILE}: {obstacle}.")


def _write_orthoimage(inputs: LoadedInputs, progress: Progress) -> None:
    """Write the orthoimage unless the one there was made from the same cloud and settings."""
    if inputs.project.inputs.cloud is None:
        return
    file = inputs.folder / RESULTS_FOLDER / ORTHOIMAGE_FILE
    settings = inputs.project.orthoimage
    origin = origin_of(_cloud_identity(inputs.folder / inputs.project.inputs.cloud), settings)
    if read_origin(file) == origin:
        return
    cloud, plane = read_ground(inputs.folder, inputs.project, progress)
    write_geotiff(file, make_orthoimage(cloud, plane, settings, progress))
    write_origin(file, origin)


def input_files(project: Project) -> list[str]:
    """Return the input files of a project as it names them."""
    inputs = project.inputs
    files = [inputs.video, inputs.cloud, inputs.lens, inputs.gps.file if inputs.gps else None]
    return [file for file in files if file is not None]


def sha256_of(file: File, results: Path) -> str:
    """Return a file's SHA-256; that of a large file is kept in `results` while its size and time stay."""
    state = state_of(file)
    known_file = results / "sha256.json"
    try:
        known = json.loads(known_file.read_text())
    except (OSError, ValueError):
        known = {}
    key = f"{file.name} {state.size} {state.version}"
    if key not in known:
        with opened(file) as stream:
            known[key] = _digest(stream)
        write_atomically(known_file, json.dumps(known, indent=1).encode())
    return str(known[key])


def _digest(stream: BinaryIO) -> str:
    digest = hashlib.sha256()
    while block := stream.read(1 << 20):
        digest.update(block)
    return digest.hexdigest()
