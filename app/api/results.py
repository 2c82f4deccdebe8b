"""Tracking and its results: run, watched, cancelled; histories, single frames, files."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path
from typing import Any

from fastapi import APIRouter
from fastapi.responses import FileResponse, Response

from app import outcome
from app.answers import points
from app.api.projects import Body
from app.context import Context, Folder, Here
from app.errors import ApiError, Missing, NotYet
from app.growing import LEAST_FRAMES, rows_of
from app.jobs import Finish, Job
from app.places import Places
from app.store import CACHE_FOLDER, ProjectFolder
from core.errors import InputError
from core.project import Method, Project
from core.results import TargetHistory, plain
from core.review import FrameOverlay, frame_overlay

router = APIRouter(prefix="/api/projects/{project_id}")

# What the results folder holds for the engine and the server, not for people.
_INTERNAL = (".sqlite", ".npz", ".made-from", ".json-journal", ".sqlite-journal")
_INTERNAL_NAMES = ("job.json", "sha256.json", "lens_report.json")
# A report is one file with its styles inside; opened here it may show itself and do nothing else.
_REPORT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; font-src data:; sandbox"


class Start(Body):
    """How to track."""

    fresh: bool = False


@router.post("/track")
def track(folder: Folder, here: Here, wanted: Start | None = None) -> dict[str, Any]:
    """Measure what is missing and make all results, in a job; goes on where an earlier one stopped."""
    folder.load()
    job = here.jobs.start(folder, "track", {"fresh": bool(wanted and wanted.fresh)}, finish_track(here))
    here.growing.follow(here.hub, folder, job)
    return {"job": job.as_json()}


def finish_track(here: Context) -> Finish:
    """Return what is to be done in the server once results are there."""

    def finish(folder: ProjectFolder, result: Any) -> Any:
        here.hub.publish(folder.id, "orthoimage", {"ready": True})
        # Whoever looks at the results next looks at single frames, which need the solution at hand.
        threading.Thread(target=_solve_ahead, args=(here, folder), daemon=True).start()
        return result

    return finish


def _solve_ahead(here: Context, folder: ProjectFolder) -> None:
    with contextlib.suppress(InputError, ApiError):
        here.outcomes.solved(folder, folder.load().project)


@router.delete("/track")
def cancel(folder: Folder, here: Here) -> dict[str, Any]:
    """Ask the running measurement to stop; what it has measured is kept."""
    job = _running(here, folder)
    if job is not None:
        here.jobs.cancel(job)
    return {"job": job.as_json() if job else None}


def _running(here: Context, folder: ProjectFolder) -> Job | None:
    job = here.jobs.running(folder.id, "track")
    return job if job is not None and job.kind == "track" else None


@router.get("/track")
def track_state(folder: Folder, here: Here) -> dict[str, Any]:
    """Return how far the measurement is, and the displacement so far."""
    project = folder.load().project
    job = _running(here, folder) or here.jobs.latest(folder.id, "track")
    running = job is not None and job.is_running
    state = outcome.state_of(folder, project)
    resumable = not running and state.frames_done > 0 and not state.finished
    message = "" if job is None else job.message
    if resumable and not message:
        message = f"Stopped after {state.frames_done} of {state.frames_total} frames; it goes on from there."
    return {
        "job": None if job is None else job.as_json(),
        "resumable": resumable,
        "frames_done": state.frames_done,
        "frames_total": state.frames_total,
        "message": message,
        "first_values_after": LEAST_FRAMES,
        "preview": here.growing.rows(folder.id) if running else _rows(here, folder, project),
    }


def _rows(here: Context, folder: ProjectFolder, project: Project) -> dict[str, Any]:
    rows = {}
    for target in project.targets:
        with contextlib.suppress(InputError, ApiError):
            rows[target.name] = rows_of(here.outcomes.history(folder, project, target.name))
    return rows or _rows_of_part(here, folder, project)


def _rows_of_part(here: Context, folder: ProjectFolder, project: Project) -> dict[str, Any]:
    """Return the displacement of a measurement that was stopped on its way."""
    try:
        solution = here.outcomes.solved(folder, project).solution
    except (InputError, ApiError):
        return {}
    return {name: rows_of(history) for name, history in solution.histories.items()}


@router.get("/results")
def results(folder: Folder, here: Here) -> dict[str, Any]:
    """Return the summary of the results, whether they still fit the project, and their files.

    `measured` names the methods by which the whole video is measured as the project wants it now; `methods` also
    the one of the results that were written last.
    """
    project = folder.load().project
    state = outcome.state_of(folder, project)
    measured = here.outcomes.methods(folder, project)
    methods = list(measured)
    if state.summary is not None and state.summary["method"] not in methods:
        methods.append(state.summary["method"])
    return {
        "ready": state.ready,
        "stale": state.stale,
        "measured": measured,
        "summary": state.summary,
        "targets": list(state.summary["targets"]) if state.summary else [],
        "methods": methods,
        "files": [_file(folder, path) for path in _files(folder)],
    }


@router.get("/results/{target}")
def history(
    target: str, folder: Folder, here: Here, method: Method | None = None, unfiltered: bool = False
) -> dict[str, Any]:
    """Return a target's displacement, column by column as in its CSV; null where nothing was measured.

    `is_earlier` tells that the project cannot be solved as it stands: this is what the last run wrote. `unfiltered`
    asks for what the method measured, whatever filter the project applies to it.
    """
    project = folder.load().project
    if unfiltered:
        shown = here.outcomes.unfiltered(folder, project, target, method or project.method)
    else:
        shown = here.outcomes.shown(folder, project, target, method)
    return {**columns_of(shown.history), "is_earlier": shown.is_earlier}


def columns_of(found: TargetHistory) -> dict[str, Any]:
    """Return the columns of a history by the names of the CSV's header."""
    columns: dict[str, Any] = {
        "frame": found.frame.tolist(),
        "time_s": plain(found.time_s),
        "status": found.status.tolist(),
    }
    for suffix in ("", "_sigma", "_raw"):
        for point in ("p1", "p2"):
            vectors = getattr(found, f"{point}{suffix}_m")
            columns[f"{point}_dx{suffix}_m"] = plain(vectors[:, 0])
            columns[f"{point}_dy{suffix}_m"] = plain(vectors[:, 1])
        columns[f"rotation{suffix}_rad"] = plain(getattr(found, f"rotation{suffix}_rad"))
    return columns


@router.get("/review/{number}")
def review(number: int, folder: Folder, here: Here, method: Method | None = None) -> dict[str, Any]:
    """Return what was measured in one frame, in raw pixels."""
    project = folder.load().project
    solved = here.outcomes.solved(folder, project, method)
    record = outcome.frame_record(folder, solved, number)
    seen = frame_overlay(solved.recording, solved.solution, solved.inputs.project, number=number, measured=record)
    if seen is None:
        raise Missing(f"Frame {number} has not been measured.", path="frame")
    return _overlay(seen)


def _overlay(seen: FrameOverlay) -> dict[str, Any]:
    targets = {}
    for name, target in seen.targets.items():
        targets[name] = {
            "bands_raw": {line: points(outline) for line, outline in target.bands_raw.items()},
            "edges_raw": {line: points(edges) for line, edges in target.edges_raw.items()},
            "lines_raw": {line: points(places) for line, places in target.lines_raw.items()},
            "points_raw": {
                "used": points(target.points_raw),
                "rejected": points(target.points_rejected_raw),
            },
            "p1_raw": plain(target.p1_raw),
            "p2_raw": plain(target.p2_raw),
        }
    pose = seen.pose
    return {
        "frame": seen.frame,
        "time_s": seen.time_s,
        "status": dict(seen.status),
        "ground": {"used": points(seen.ground_used), "rejected": points(seen.ground_rejected)},
        "targets": targets,
        "camera": None if pose is None else {"centre_m": plain(pose.centre_m), "R": plain(pose.R)},
    }


@router.post("/report")
def report(folder: Folder, here: Here) -> dict[str, Any]:
    """Make results, figures and report anew from what has been measured, in a job."""
    project = folder.load().project
    if not outcome.state_of(folder, project).finished:
        raise NotYet("The video has not been measured as the project stands now; track first.", path="track")
    return {"job": here.jobs.start(folder, "report", {}, finish_track(here)).as_json()}


@router.get("/files/{name:path}")
def file(name: str, folder: Folder) -> Response:
    """Return a file of the results."""
    known = {_name(folder, path): path for path in _files(folder)}
    if name not in known:
        raise Missing(f"{name}: there is no such file among the results.", path=name)
    path = Places([folder.folder]).file(known[name])
    if path.suffix == ".html":
        return FileResponse(path, headers={"Content-Security-Policy": _REPORT_POLICY, "Cache-Control": "no-cache"})
    if path.suffix == ".png":
        return FileResponse(path, headers={"Cache-Control": "no-cache"})
    return FileResponse(path, filename=f"{folder.id}-{path.name}", headers={"Cache-Control": "no-cache"})


def _files(folder: ProjectFolder) -> list[Path]:
    found = []
    for path in sorted(folder.results.rglob("*")) if folder.results.is_dir() else []:
        inside = path.relative_to(folder.results)
        internal = path.name in _INTERNAL_NAMES or path.name.endswith(_INTERNAL)
        hidden = any(part.startswith(".") or part == CACHE_FOLDER for part in inside.parts)
        if path.is_file() and not path.is_symlink() and not internal and not hidden:
            found.append(path)
    return found


def _name(folder: ProjectFolder, path: Path) -> str:
    return path.relative_to(folder.results).as_posix()


def _file(folder: ProjectFolder, path: Path) -> dict[str, Any]:
    state = path.stat()
    return {"name": _name(folder, path), "size": state.st_size, "modified_s": state.st_mtime}
