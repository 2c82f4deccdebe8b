"""How far a project has come: the state of its eight steps, told from the facts on the disk."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from app import orthoimages, outcome
from app.errors import ApiError
from app.reference import reference_fit
from app.store import ProjectFolder, problem_of, stored_inputs
from core.check import check_project
from core.errors import InputError
from core.project import Project, project_json

if TYPE_CHECKING:
    from app.context import Context

STEPS = ("inputs", "orthoimage", "correspondences", "regions", "track", "review", "drift", "export")
# A leave-one-out error this many times the median of all is a click to look at again (and at least this many pixels).
_BAD_CLICK_RATIO, _BAD_CLICK_PX = 3.0, 1.5
_GOOD_COVERAGE = 0.5

Step = dict[str, str]


@dataclass(frozen=True)
class Facts:
    """State and message of each step; the project's problems, or None where they have not been looked for yet."""

    steps: dict[str, Step]
    problems: list[str] | None


def steps_of(here: Context, folder: ProjectFolder, project: Project, *, look: bool = True) -> Facts:
    """Return how far a project has come.

    Args:
        look: whether to look for problems now, which opens every input; otherwise what was found before is told.
    """
    checks: dict[str, Callable[[Context, ProjectFolder, Project], Step]] = {
        "inputs": _inputs,
        "orthoimage": _orthoimage,
        "correspondences": _correspondences,
        "regions": _regions,
        "track": _track,
        "review": _review,
        "drift": _drift,
        "export": _export,
    }
    return Facts(
        {name: check(here, folder, project) for name, check in checks.items()}, _problems(folder, project, look)
    )


def steps_of_broken(message: str) -> dict[str, Step]:
    """Return the steps of a project whose file cannot be used."""
    return {name: _step("error" if name == "inputs" else "todo", message if name == "inputs" else "") for name in STEPS}


def _step(status: str, message: str) -> Step:
    return {"status": status, "message": message}


def _inputs(here: Context, folder: ProjectFolder, project: Project) -> Step:
    missing, given = [], []
    for kind, file in stored_inputs(project.inputs).items():
        if file is None:
            continue
        try:
            path = folder.input_path(kind, project)
        except ApiError as error:
            return _step("error", error.message)
        if path is None or not path.is_file():
            missing.append(kind)
        else:
            given.append(kind)
    if "video" in missing:
        return _step("todo", "Choose the video, or send it.")
    if missing:
        return _step("error", f"Not found: {', '.join(missing)}; choose it again.")
    if project.method == "geometric" and "lens" not in given:
        return _step("warn", "The geometric method needs the lens; calibrate it or choose its file.")
    return _step("done", ", ".join(given))


def _orthoimage(here: Context, folder: ProjectFolder, project: Project) -> Step:
    if here.jobs.running(folder.id, "orthoimage") and _running(here, folder, "orthoimage"):
        return _step("running", "The orthoimage is being made.")
    if project.inputs.cloud is None:
        return _step("done", "Without a cloud, ground coordinates are typed in.")
    state = orthoimages.state_of(folder, project)
    if not state.ready:
        return _step("todo", "Make the orthoimage from the cloud.")
    if state.stale:
        return _step("stale", "Cloud or settings have changed since; make it again.")
    return _step("done", "")


def _running(here: Context, folder: ProjectFolder, kind: str) -> bool:
    job = here.jobs.running(folder.id, kind)
    return job is not None and job.kind == kind


def _correspondences(here: Context, folder: ProjectFolder, project: Project) -> Step:
    enabled = sum(pair.enabled for pair in project.correspondences)
    if enabled < 4:
        return _step("todo", f"{enabled} pairs of at least 4, better 20.")
    try:
        fit = reference_fit(here, folder, project)
    except (InputError, ApiError) as error:
        return _step("error", problem_of(error))
    message = f"{enabled} pairs, {fit.rms_px:.2f} px, {100 * fit.rms_m:.1f} cm"
    errors = sorted(pair.left_out_px for pair in fit.pairs if pair.enabled and pair.left_out_px is not None)
    if errors and errors[-1] > max(_BAD_CLICK_PX, _BAD_CLICK_RATIO * errors[len(errors) // 2]):
        return _step("warn", f"{message}; one pair is off by {errors[-1]:.1f} px when left out")
    if fit.coverage < _GOOD_COVERAGE:
        return _step("warn", f"{message}; they cover {100 * fit.coverage:.0f} % of the frame, spread them wider")
    return _step("done", message)


def _regions(here: Context, folder: ProjectFolder, project: Project) -> Step:
    todo = []
    if not project.moving_regions_px:
        todo.append("outline what moves")
    if not project.targets:
        todo.append("add a target with its bands")
    if project.method == "geometric" and any(target.height_m is None for target in project.targets):
        todo.append("give each target its height")
    if todo:
        return _step("todo", (", ".join(todo) + ".").capitalize())
    return _step("done", ", ".join(target.name for target in project.targets))


def _track(here: Context, folder: ProjectFolder, project: Project) -> Step:
    if _running(here, folder, "track"):
        return _step("running", "Tracking.")
    state = outcome.state_of(folder, project)
    if state.ready and not state.stale:
        return _step("done", f"{state.frames_done} frames")
    if state.failure:
        return _step("error", state.failure)
    if 0 < state.frames_done < state.frames_total:
        return _step("warn", f"Stopped after {state.frames_done} of {state.frames_total} frames; go on.")
    if state.ready:
        return _step("stale", "The project has changed since; track again.")
    return _step("todo", "Not tracked yet.")


def _review(here: Context, folder: ProjectFolder, project: Project) -> Step:
    state = outcome.state_of(folder, project)
    if not state.ready:
        return _step("todo", "After tracking.")
    lost, weak = state.counts.get("lost", 0), state.counts.get("weak", 0)
    if lost or weak:
        return _step("warn", f"{lost} lost and {weak} weak frames to look at")
    return _step("stale" if state.stale else "done", "No weak or lost frame")


def _drift(here: Context, folder: ProjectFolder, project: Project) -> Step:
    if not outcome.state_of(folder, project).ready:
        return _step("todo", "After tracking.")
    if project.intervals_s.pre_event is None:
        return _step("todo", "Drag the pre-event interval on the plot.")
    if project.method == "paper" and project.drift.filter == "none":
        return _step("warn", "The paper's method leaves the camera's drift in; choose a high-pass filter.")
    chosen = project.drift
    return _step("done", "No filter" if chosen.filter == "none" else f"High-pass at {chosen.corner_hz:g} Hz")


def _export(here: Context, folder: ProjectFolder, project: Project) -> Step:
    state = outcome.state_of(folder, project)
    if not state.ready:
        return _step("todo", "After tracking.")
    return _step("stale", "Results are older than the project.") if state.stale else _step("done", "")


def _problems(folder: ProjectFolder, project: Project, look: bool) -> list[str] | None:
    key = (str(folder.folder), project_json(project), _stamps(folder, project))
    if not look:
        return _found_problems.get(key)
    found = _look(key)
    _found_problems.clear()
    _found_problems[key] = found
    return found


_found_problems: dict[Any, list[str]] = {}


@lru_cache(maxsize=64)
def _look(key: tuple[str, str, tuple[Any, ...]]) -> list[str]:
    from pathlib import Path

    place = f"{key[0]}{os.sep}"
    return [problem.replace(place, "") for problem in check_project(Path(key[0]), with_cloud=False)]


def _stamps(folder: ProjectFolder, project: Project) -> tuple[Any, ...]:
    """Return what changes with any input."""
    stamps = []
    for file in stored_inputs(project.inputs).values():
        try:
            state = (folder.folder / file).stat() if file else None
        except OSError:
            state = None
        stamps.append((state.st_size, state.st_mtime_ns) if state else None)
    return tuple(stamps)
