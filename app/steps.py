"""How far a project has come: the state of its eight steps, told from the facts on the disk."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app import orthoimages, outcome
from app.errors import ApiError
from app.frames import Fingerprint, fingerprint
from app.reference import lens_of, outside_frame, reference_fit
from app.store import ProjectFolder, problem_of, stored_inputs
from app.videos import is_read_through, video_info
from core.check import check_project, results_obstacle
from core.errors import InputError
from core.gps_record import GpsRecord, read_gps
from core.project import GpsInput, Project, project_json
from core.video import frame_index

if TYPE_CHECKING:
    from app.context import Context

# The states of a step that leave nothing to do in it.
SETTLED = ("done", "unneeded")
STEPS = ("inputs", "orthoimage", "correspondences", "regions", "track", "review", "drift", "export")
# A leave-one-out error this many times the median of all is a click to look at again (and at least this many pixels).
_BAD_CLICK_RATIO, _BAD_CLICK_PX = 3.0, 1.5
_GOOD_COVERAGE = 0.5

_NO_VIDEO = "inputs.video: none is given yet; choose the video in the inputs."

Step = dict[str, str]

_PROBLEMS_KEPT = 32
_known_problems: dict[Any, list[str]] = {}


@dataclass(frozen=True)
class Facts:
    """State and message of each step; the project's problems, or None where they have not been looked for yet."""

    steps: dict[str, Step]
    problems: list[str] | None


@dataclass(frozen=True)
class _Look:
    """A project that is being looked at; what costs something is found out once."""

    here: Context
    folder: ProjectFolder
    project: Project

    @cached_property
    def outcome(self) -> outcome.Outcome:
        return outcome.state_of(self.folder, self.project)

    def is_running(self, kind: str) -> bool:
        job = self.here.jobs.running(self.folder.id, kind)
        return job is not None and job.kind == kind


def steps_of(here: Context, folder: ProjectFolder, project: Project, *, look: bool = True) -> Facts:
    """Return how far a project has come.

    Args:
        look: whether to look for problems now, which opens every input; otherwise what was found before is told.
    """
    seen = _Look(here, folder, project)
    checks: dict[str, Callable[[_Look], Step]] = {
        "inputs": _inputs,
        "orthoimage": _orthoimage,
        "correspondences": _correspondences,
        "regions": _regions,
        "track": _track,
        "review": _review,
        "drift": _drift,
        "export": _export,
    }
    problems = _problems(folder, project, look and _is_read_through(seen))
    return Facts({name: check(seen) for name, check in checks.items()}, problems)


def _is_read_through(seen: _Look) -> bool:
    """Whether looking for problems takes no longer than a page may; a large video is read through meanwhile."""
    try:
        video = seen.folder.require_video(seen.project)
        return is_read_through(seen.here.hub, seen.folder, video)
    except (InputError, ApiError):
        return True


def steps_of_broken(message: str) -> dict[str, Step]:
    """Return the steps of a project whose file cannot be used."""
    return {name: _step("error" if name == "inputs" else "todo", message if name == "inputs" else "") for name in STEPS}


def _step(status: str, message: str) -> Step:
    return {"status": status, "message": message}


def _inputs(seen: _Look) -> Step:
    missing: list[str] = []
    given: list[str] = []
    for kind, file in stored_inputs(seen.project.inputs).items():
        if file is None:
            continue
        try:
            (given if seen.folder.is_there(kind, seen.project) else missing).append(kind)
        except ApiError as error:
            return _step("error", error.message)
    if seen.folder.named_input("video", seen.project) is None:
        return _step("todo", "Choose the video, or send it.")
    if missing:
        return _step("error", f"Not found: {', '.join(missing)}; choose it again.")
    if wrong := _unusable(seen):
        return _step("error", wrong)
    if seen.project.method == "geometric" and "lens" not in given:
        return _step("warn", "The geometric method needs the lens; calibrate it or choose its file.")
    return _step("done", ", ".join(given))


def _unusable(seen: _Look) -> str:
    """Return what is wrong with the first input that is there and cannot be used; empty where nothing is known to be.

    A cloud takes long to read: of it, only what reading it showed before is told.
    """
    folder, project = seen.folder, seen.project
    try:
        video = folder.require_video(project)
        if isinstance(video, Path):  # one far away is looked at by whoever needs its frames
            video_info(video)
            lens_of(folder, project)
        seen.here.sites.require_usable(folder, project)
        if project.inputs.gps is not None:
            _read_gps(fingerprint(folder.require_input("gps", project)), project.inputs.gps)
    except (InputError, ApiError) as error:
        return problem_of(error).replace(f"{folder.folder}{os.sep}", "")
    return ""


@lru_cache(maxsize=32)
def _read_gps(file: Fingerprint, columns: GpsInput) -> GpsRecord:
    return read_gps(Path(file[0]), columns)


def _orthoimage(seen: _Look) -> Step:
    if seen.is_running("orthoimage"):
        return _step("running", "The orthoimage is being made.")
    if seen.project.inputs.cloud is None and seen.project.correspondences:
        return _step("unneeded", "Without a cloud, ground coordinates are typed in.")
    if seen.project.inputs.cloud is None:
        return _step("todo", "Choose the point cloud in the inputs; without one, ground coordinates are typed in.")
    state = orthoimages.state_of(seen.folder, seen.project)
    if not state.ready:
        return _step("todo", "Make the orthoimage from the cloud.")
    if state.stale:
        return _step("stale", "Cloud or settings have changed since; make it again.")
    return _step("done", "")


def _frames(seen: _Look) -> int | None:
    """Return how many frames the video has, as far as that can be told at once."""
    try:
        video = seen.folder.require_video(seen.project)
        return len(frame_index(video)) if _is_read_through(seen) else video_info(video).frames
    except (InputError, ApiError):
        return None


def _correspondences(seen: _Look) -> Step:
    frames, reference = _frames(seen), seen.project.reference_frame
    if frames is not None and reference >= frames:
        return _step("error", f"Reference frame {reference}: the video ends with frame {frames - 1}; choose another.")
    enabled = sum(pair.enabled for pair in seen.project.correspondences)
    if enabled < 4:
        return _step("todo", f"{enabled} pairs of at least 4, better 20.")
    try:
        if beside := outside_frame(seen.folder, seen.project, seen.project.correspondences):
            return _step("error", beside)
        fit = reference_fit(seen.here, seen.folder, seen.project)
    except (InputError, ApiError) as error:
        return _step("error", problem_of(error))
    message = f"{enabled} pairs, {fit.rms_px:.2f} px, {100 * fit.rms_m:.1f} cm"
    errors = sorted(pair.left_out_px for pair in fit.pairs if pair.enabled and pair.left_out_px is not None)
    if errors and errors[-1] > max(_BAD_CLICK_PX, _BAD_CLICK_RATIO * errors[len(errors) // 2]):
        return _step("warn", f"{message}; one pair is off by {errors[-1]:.1f} px when left out")
    if fit.coverage < _GOOD_COVERAGE:
        return _step("warn", f"{message}; they cover {100 * fit.coverage:.0f} % of the frame, spread them wider")
    return _step("done", message)


def _regions(seen: _Look) -> Step:
    todo = []
    if not seen.project.moving_regions_px:
        todo.append("outline what moves")
    if not seen.project.targets:
        todo.append("add a target with its bands")
    if seen.project.method == "geometric" and any(target.height_m is None for target in seen.project.targets):
        todo.append("give each target its height")
    if todo:
        return _step("todo", (", ".join(todo) + ".").capitalize())
    return _step("done", ", ".join(target.name for target in seen.project.targets))


def _track(seen: _Look) -> Step:
    if seen.is_running("track"):
        return _step("running", "Tracking.")
    state = seen.outcome
    if state.ready and not state.stale:
        return _step("done", f"{state.frames_done} frames")
    if state.failure:
        return _step("error", state.failure)
    if state.frames_done > 0 and not state.finished:
        return _step("warn", f"Stopped after {state.frames_done} of {state.frames_total} frames; go on.")
    if state.ready:
        return _step("stale", "The project has changed since; track again.")
    return _step("todo", "Not tracked yet.")


def _review(seen: _Look) -> Step:
    state = seen.outcome
    if not state.ready:
        return _step("todo", "After tracking.")
    lost, weak = state.counts.get("lost", 0), state.counts.get("weak", 0)
    if lost or weak:
        return _step("warn", f"{lost} lost and {weak} weak frames to look at")
    return _step("stale" if state.stale else "done", "No weak or lost frame")


def _drift(seen: _Look) -> Step:
    if not seen.outcome.ready:
        return _step("todo", "After tracking.")
    if seen.project.intervals_s.pre_event is None:
        return _step("todo", "Drag the pre-event interval on the plot.")
    if seen.project.method == "paper" and seen.project.drift.filter == "none":
        return _step("warn", "The paper's method leaves the camera's drift in; choose a high-pass filter.")
    chosen = seen.project.drift
    return _step("done", "No filter" if chosen.filter == "none" else f"High-pass at {chosen.corner_hz:g} Hz")


def _export(seen: _Look) -> Step:
    state = seen.outcome
    if not state.ready:
        return _step("todo", "After tracking.")
    return _step("stale", "Results are older than the project.") if state.stale else _step("done", "")


def _problems(folder: ProjectFolder, project: Project, look: bool) -> list[str] | None:
    no_place = results_obstacle(folder.folder)
    key = (str(folder.folder), project_json(project), outcome.input_stamps(folder, project), no_place)
    if look and key not in _known_problems:
        place = f"{folder.folder}{os.sep}"
        found = [problem.replace(place, "") for problem in check_project(folder.folder, thorough=False)]
        if folder.named_input("video", project) is None:
            found = [_NO_VIDEO if problem.startswith(f"{project.inputs.video}:") else problem for problem in found]
        while len(_known_problems) >= _PROBLEMS_KEPT:
            _known_problems.pop(next(iter(_known_problems)), None)
        _known_problems[key] = found
    return _known_problems.get(key)
