"""What has been measured of a project: the state of it, and the engine's solution, kept while nothing changes.

Solving is a pure function of what was recorded and what the project says now, so the pages always show the project
as it stands; the files in `results/` are as old as the last run.
"""

from __future__ import annotations

import sqlite3
import threading
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from app.errors import ApiError, NotYet
from app.frames import Fingerprint, file_of, fingerprint, identity
from app.jobs import JOB_FILE
from app.store import ProjectFolder, read_json, stored_inputs
from app.videos import video_info
from core.errors import InputError
from core.export import SUMMARY_FILE, GpsCheck, Results, compared_with_gps
from core.lens import Lens
from core.measurements import FrameMeasurement, MeasurementStore, Recording
from core.prediction import MeasureSetup
from core.project import Drift, Method, Project, Target, project_json
from core.results import TargetHistory, read_history_csv
from core.run import FRAMES_FILE, LoadedInputs, load_inputs, relief_plan
from core.solution import Solution
from core.solve import solve, unfiltered_history, with_histories
from core.storage import File
from core.version import program_version
from core.video import frame_index

METHODS: tuple[Method, ...] = ("geometric", "paper")
_KEPT = 4


@dataclass(frozen=True)
class Recorded:
    """How much of a video has been measured as the project wants it now."""

    frames: int = 0
    finished: bool = False


@dataclass(frozen=True)
class Outcome:
    """State of the results.

    Attributes:
        ready: whether a run has left results.
        stale: whether the project or an input has changed since.
        frames_done, frames_total, finished: of the measurement the project wants now.
        failure: why the last measurement failed; empty where it did not.
        counts: frames of each status, worst target first where there are several.
    """

    ready: bool = False
    stale: bool = False
    frames_done: int = 0
    frames_total: int = 0
    finished: bool = False
    failure: str = ""
    counts: dict[str, int] = field(default_factory=dict)
    summary: dict[str, Any] | None = None


@dataclass(frozen=True, eq=False)
class Solved:
    """What was measured, and what the engine makes of it."""

    inputs: LoadedInputs
    fingerprint: str
    recording: Recording
    solution: Solution


@dataclass(frozen=True, eq=False)
class Shown:
    """A target's displacement to look at, and whether it is only that of an earlier state of the project."""

    history: TargetHistory
    is_earlier: bool = False


def state_of(folder: ProjectFolder, project: Project) -> Outcome:
    """Return the state of a project's results, from the facts on the disk."""
    summary = read_json(folder.results / SUMMARY_FILE)
    ready = isinstance(summary, dict) and isinstance(summary.get("targets"), dict)
    recorded = recorded_of(folder, project, project.method)
    counts: dict[str, int] = {}
    for target in summary["targets"].values() if ready else ():
        for status, count in target["counts"].items():
            counts[status] = max(count, counts.get(status, 0))
    return Outcome(
        ready=ready,
        stale=ready and _is_stale(folder, project, summary),
        frames_done=recorded.frames,
        frames_total=_frames_total(folder, project, recorded.frames > 0),
        finished=recorded.finished,
        failure=_failure(folder),
        counts=counts,
        summary=summary if ready else None,
    )


def _failure(folder: ProjectFolder) -> str:
    """Return why the last measurement failed; empty where it did not."""
    note = read_json(folder.results / JOB_FILE)
    failed = isinstance(note, dict) and note.get("kind") == "track" and note.get("state") == "failed"
    return str(note["message"]) if failed else ""


def _is_stale(folder: ProjectFolder, project: Project, summary: dict[str, Any]) -> bool:
    now = project.model_dump(mode="json")
    then = summary.get("settings")
    if not isinstance(then, dict) or _deciding(then) != _deciding(now):
        return True
    return summary.get("identity") != _identities(folder, project)


def _identities(folder: ProjectFolder, project: Project) -> dict[str, str] | None:
    """Return a name for the content of each input, by its path as the project names it; None where one is not there."""
    try:
        files = {stored: folder.input_file(kind, project) for kind, stored in stored_inputs(project.inputs).items()}
        return {stored: identity(file) for stored, file in files.items() if stored is not None and file is not None}
    except (InputError, ApiError):
        return None


def _deciding(settings: dict[str, Any]) -> dict[str, Any]:
    """Return what results follow from: not the name, and nothing of a filter that is not applied."""
    drift = settings.get("drift")
    unfiltered = isinstance(drift, dict) and drift.get("filter") == "none"
    return {**settings, "name": "", "drift": "none" if unfiltered else drift}


def _frames_total(folder: ProjectFolder, project: Project, exactly: bool) -> int:
    """Return how many frames the video has; what the container says suffices before any is measured."""
    try:
        video = folder.require_video(project)
        return len(frame_index(video)) if exactly else video_info(video).frames or 0
    except (InputError, ApiError):
        return 0


def recorded_of(folder: ProjectFolder, project: Project, method: Method) -> Recorded:
    """Return how much has been measured by a method of what the project wants now."""
    file = folder.results / FRAMES_FILE
    try:
        video = folder.require_video(project)
        wanted = _wanted(fingerprint(video), project.model_copy(update={"method": method}))
        if not file.is_file():
            return Recorded()
        with MeasurementStore(file) as store:
            recording = store.find(method, wanted)
            if recording is None:
                return Recorded()
            return Recorded(len(store.measured_frames(recording)), store.is_finished(recording))
    except (InputError, ApiError, sqlite3.Error):
        return Recorded()


def wanted_fingerprint(video: File, project: Project) -> str:
    """Return the engine's name for what a project wants measured of its video.

    Raises:
        InputError: the video is not there.
    """
    return _wanted(fingerprint(video.resolve() if isinstance(video, Path) else video), project)


def _wanted(video: Fingerprint, project: Project) -> str:
    return _wanted_fingerprint(
        video,
        reference_frame=project.reference_frame,
        moving_regions_px=project.moving_regions_px,
        targets=project.targets,
        method=project.method,
    )


@lru_cache(maxsize=64)
def _wanted_fingerprint(
    video: Fingerprint,
    *,
    reference_frame: int,
    moving_regions_px: tuple[tuple[tuple[float, float], ...], ...],
    targets: tuple[Target, ...],
    method: Method,
) -> str:
    """Return the engine's name for what is to be measured; the geometry, left out here, takes no part in it."""
    setup = MeasureSetup(
        video=file_of(video),
        reference_frame=reference_frame,
        moving_regions_px=moving_regions_px,
        targets=targets,
        method=method,
        lens=Lens.ideal((2, 2), 1.0),
        H_ray_plan=np.eye(3),
        origin_m=np.zeros(2),
    )
    return setup.fingerprint


class Outcomes:
    """Solutions of the projects a person is looking at."""

    def __init__(self) -> None:
        self._solved: OrderedDict[Any, Solved] = OrderedDict()
        self._checks: OrderedDict[Any, GpsCheck | None] = OrderedDict()
        self._locks: dict[str, threading.Lock] = {}
        self._lock = threading.Lock()

    def methods(self, folder: ProjectFolder, project: Project) -> list[Method]:
        """Return the methods by which the whole video has been measured as the project wants it now."""
        return [method for method in METHODS if recorded_of(folder, project, method).finished]

    def solved(self, folder: ProjectFolder, project: Project, method: Method | None = None) -> Solved:
        """Return what has been measured, solved with the project as it stands now.

        Raises:
            NotYet: nothing has been measured as the project wants it now.
            InputError: the project cannot be solved.
        """
        chosen = method or project.method
        recorded = recorded_of(folder, project, chosen)
        if recorded.frames < 2:
            raise NotYet("Nothing has been measured yet with these bands and regions; track first.", path="track")
        wanted = by_method(project, chosen)
        alike = (folder.id, chosen, recorded, _but_filter(wanted), input_stamps(folder, project))
        with self._one_at_a_time(folder.id):
            with self._lock:
                kept = {key: found for key, found in self._solved.items() if key[0] == alike}
            found = kept.get((alike, wanted.drift))
            if found is None:
                # Filtering a known motion anew is a moment's work; solving ten minutes of video is not.
                found = _filtered(next(iter(kept.values())), wanted) if kept else _solve(folder, wanted)
                self._keep(self._solved, (alike, wanted.drift), found)
        return found

    def history(
        self, folder: ProjectFolder, project: Project, target: str, method: Method | None = None
    ) -> TargetHistory:
        """Return a target's displacement, of the project as it stands or, failing that, as the last run wrote it.

        Raises:
            NotYet: there is neither.
        """
        return self.shown(folder, project, target, method).history

    def shown(self, folder: ProjectFolder, project: Project, target: str, method: Method | None = None) -> Shown:
        """Return a target's displacement: as the last run wrote it where that still holds, else solved now.

        Where the project cannot be solved as it stands, what the last run wrote is better than nothing.

        Raises:
            NotYet: there is neither.
        """
        chosen = method or project.method
        state = state_of(folder, project)
        file = folder.results / f"{target}.csv"
        summary = state.summary or {}
        written = target in summary.get("targets", {}) and summary.get("method") == chosen and file.is_file()
        if written and not state.stale:
            return Shown(_written(fingerprint(file)))
        if recorded_of(folder, project, chosen).finished:
            try:
                solution = self.solved(folder, project, chosen).solution
            except InputError:
                solution = None
            if solution is not None and target in solution.histories:
                return Shown(solution.histories[target])
        if written:
            return Shown(_written(fingerprint(file)), is_earlier=True)
        raise NotYet(f"{target}: not measured by the {chosen} method yet; track first.", path="track")

    def unfiltered(self, folder: ProjectFolder, project: Project, target: str, method: Method) -> Shown:
        """Return a target's displacement by a method as it was before any filter.

        Raises:
            NotYet: it was not measured by that method.
            InputError: the project cannot be solved as it stands.
        """
        if by_method(project, method).drift.filter == "none":
            return self.shown(folder, project, target, method)
        (wanted,) = (one for one in project.targets if one.name == target)
        solution = self.solved(folder, project, method).solution
        return Shown(unfiltered_history(solution, wanted, project.intervals_s))

    def gps(self, folder: ProjectFolder, project: Project, drift: Drift) -> GpsCheck | None:
        """Return how a project compares with its GPS, with a filter chosen for the look of it.

        Raises:
            NotYet: nothing has been measured.
            InputError: the two cannot be compared.
        """
        found = self.solved(folder, project)
        key = (found, drift)
        with self._lock:
            if key in self._checks:
                return self._checks[key]
        check = compared_with_gps(_results_of(folder, project.model_copy(update={"drift": drift}), found))
        self._keep(self._checks, key, check)
        return check

    def _keep(self, kept: OrderedDict[Any, Any], key: Any, value: Any) -> None:
        with self._lock:
            kept[key] = value
            while len(kept) > _KEPT:
                kept.popitem(last=False)

    def _one_at_a_time(self, project_id: str) -> threading.Lock:
        with self._lock:
            return self._locks.setdefault(project_id, threading.Lock())


def _solve(folder: ProjectFolder, project: Project) -> Solved:
    inputs = loaded(folder, project)
    wanted = _wanted(fingerprint(folder.require_video(project)), project)
    with MeasurementStore(folder.results / FRAMES_FILE) as store:
        number = store.find(project.method, wanted)
        if number is None:
            raise NotYet("Nothing has been measured yet with these bands and regions; track first.", path="track")
        recording = store.load(number)
    solution = solve(recording, inputs.project, inputs.lens, inputs.relief, has_lens=inputs.has_lens)
    return Solved(inputs, wanted, recording, solution)


def _filtered(found: Solved, project: Project) -> Solved:
    """Return what was solved with the filter of a project that differs in nothing else."""
    inputs = replace(found.inputs, project=project)
    return replace(found, inputs=inputs, solution=with_histories(found.solution, project))


def by_method(project: Project, method: Method) -> Project:
    """Return a project as it would be by another method, with the filter that usually goes with that one."""
    if method == project.method:
        return project
    usual = project.drift.model_copy(update={"filter": "none" if method == "geometric" else "high-pass"})
    return project.model_copy(update={"method": method, "drift": usual})


def loaded(folder: ProjectFolder, project: Project) -> LoadedInputs:
    """Return the inputs of a project, opened.

    Raises:
        NotYet: the cloud has not been read for what the project needs of it.
        InputError: they do not fit together.
    """
    plan = relief_plan(folder.folder, project)
    if plan is not None and not plan.file.is_file():
        raise NotYet("The ground is being taken from the cloud; it takes a moment.", path="inputs.cloud")
    return load_inputs(folder.folder, project=project)


@lru_cache(maxsize=8)
def _written(file: Fingerprint) -> TargetHistory:
    return read_history_csv(Path(file[0]))


def frame_record(folder: ProjectFolder, solved: Solved, frame: int) -> FrameMeasurement | None:
    """Return what was recorded of one frame."""
    method = solved.inputs.project.method
    with MeasurementStore(folder.results / FRAMES_FILE) as store:
        number = store.find(method, solved.fingerprint)
        return None if number is None else store.frame(number, frame)


def _results_of(folder: ProjectFolder, project: Project, found: Solved) -> Results:
    return Results(
        project=project,
        folder=folder.folder,
        recording=found.recording,
        solution=found.solution,
        gps=found.inputs.gps,
        video=found.inputs.video,
        info=found.inputs.info,
        sha256={},
        identity={},
        version=program_version(),
        frames_measured=0,
        measuring_s=0.0,
        solving_s=0.0,
    )


def _but_filter(project: Project) -> str:
    """Return what a project says, but for its name and the filter of the drift."""
    return project_json(project.model_copy(update={"name": "-", "drift": Drift()}))


def input_stamps(folder: ProjectFolder, project: Project) -> tuple[Fingerprint | None, ...]:
    """Return what changes with any input of a project."""
    return tuple(_stamp(folder, project, kind) for kind in stored_inputs(project.inputs))


def _stamp(folder: ProjectFolder, project: Project, kind: str) -> Fingerprint | None:
    try:
        file = folder.input_file(kind, project)
        return None if file is None else fingerprint(file)
    except (InputError, ApiError):
        return None
