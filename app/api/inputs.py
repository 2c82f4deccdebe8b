"""Inputs: chosen on this computer or sent by the browser, what was understood of each, lens calibration."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import cv2
from fastapi import APIRouter, Request, Response
from fastapi.responses import FileResponse
from starlette.concurrency import run_in_threadpool

from app.api.projects import Body
from app.calibrations import REPORT_FILE, board_of
from app.context import Context, Folder, Here, tell_saved
from app.errors import ApiError, Invalid, Missing
from app.frames import fingerprint
from app.intake import require_usable
from app.jobs import Finish
from app.places import SUFFIXES_OF_CLOUD_TABLES, kind_of
from app.store import (
    CHECKERBOARD_FOLDER,
    INPUT_KINDS,
    ProjectFolder,
    plain_name,
    problem_of,
    read_json,
    stored_inputs,
)
from app.uploads import receive_file
from app.videos import is_read_through, video_info
from core.errors import InputError
from core.gps_record import gps_columns, read_gps
from core.lens import read_lens, require_image_size
from core.project import Project
from core.storage import File
from core.video import frame_index, video_warnings

router = APIRouter(prefix="/api")

_SHOWN_AS_THEY_ARE = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
UploadKind = Literal["video", "cloud", "lens", "gps", "checkerboard"]


@router.get("/browse")
def browse(here: Here, dir: str | None = None, kind: str | None = None) -> dict[str, Any]:
    """Return the folders and files of one folder; hidden ones are left out."""
    folder = here.places.allowed(dir) if dir else here.workspace.folder.resolve()
    if not folder.is_dir():
        raise Missing(f"{folder}: there is no such folder; choose another.", path="dir")
    try:
        entries = [entry for entry in os.scandir(folder) if not entry.name.startswith(".")]
    except OSError as error:
        raise Invalid(f"{folder}: cannot be opened ({error.strerror}); choose another.", path="dir") from None
    listed = [described for entry in entries if (described := _entry(entry)) and _wanted(described, kind)]
    listed.sort(key=lambda entry: (not entry["is_dir"], str(entry["name"]).lower()))
    parent = folder.parent if any(root in folder.parents for root in here.places.roots) else None
    return {
        "dir": str(folder),
        "parent": str(parent) if parent else None,
        "roots": [str(root) for root in here.places.roots],
        "home": str(Path.home()),
        "workspace": str(here.workspace.folder),
        "entries": listed,
    }


@router.get("/browse/which")
def which(path: str, here: Here) -> dict[str, Any]:
    """Return the file at a path that was typed, or null where it is a folder."""
    place = here.places.allowed(path)
    return {"file": None if place.is_dir() else str(here.places.file(path))}


def _entry(entry: os.DirEntry[str]) -> dict[str, Any] | None:
    try:
        is_dir = entry.is_dir()
        if not is_dir and not entry.is_file():
            return None
        size = None if is_dir else entry.stat().st_size
    except OSError:
        return None
    kind = "dir" if is_dir else kind_of(Path(entry.name))
    return {"name": entry.name, "path": entry.path, "is_dir": is_dir, "size": size, "kind": kind}


def _wanted(entry: dict[str, Any], kind: str | None) -> bool:
    table = kind == "cloud" and str(entry["name"]).lower().endswith(SUFFIXES_OF_CLOUD_TABLES)
    return kind is None or entry["kind"] in ("dir", kind) or table


@router.put("/projects/{project_id}/upload/{kind}")
async def upload(kind: UploadKind, filename: str, request: Request, folder: Folder, here: Here) -> dict[str, Any]:
    """Take in a file as the raw body; a checkerboard picture is kept beside the inputs, all others become the input.

    What cannot be used as that input is refused, and the file given before stays.
    """
    name = plain_name(filename)
    if kind == "checkerboard" and kind_of(Path(name)) != "image":
        raise Invalid(f"{name}: is no picture; send JPEG, PNG or TIFF files of the checkerboard.", path="filename")
    part = folder.part_file()
    await receive_file(request, part)
    return await run_in_threadpool(_take_in, here, folder, kind, part, name)


def _take_in(here: Context, folder: ProjectFolder, kind: UploadKind, part: Path, name: str) -> dict[str, Any]:
    try:
        if kind == "checkerboard":
            (folder.folder / CHECKERBOARD_FOLDER).mkdir(exist_ok=True)
            os.replace(part, folder.folder / CHECKERBOARD_FOLDER / name)
            return {"file": f"{CHECKERBOARD_FOLDER}/{name}", "revision": folder.load().head.revision}
        require_usable(kind, part, name)
        saved = folder.take_in(kind, part, name)
    finally:
        part.unlink(missing_ok=True)
    file = stored_inputs(saved.project.inputs)[kind]
    tell_saved(here, folder, saved, f"take in {kind} {file}")
    here.hub.publish(folder.id, "inputs", {"kind": kind})
    return {"file": file, "revision": saved.head.revision}


@router.get("/projects/{project_id}/inputs")
def inputs(folder: Folder, here: Here, again: bool = False) -> dict[str, Any]:
    """Return what was understood of each input: null, an error, or its facts.

    Args:
        again: whether a cloud is read anew where reading it broke off.
    """
    if again:
        here.sites.forget_failure(folder)
    project = folder.load().project
    return {kind: _understood(here, folder, project, kind) for kind in INPUT_KINDS}


def _understood(here: Context, folder: ProjectFolder, project: Project, kind: str) -> dict[str, Any] | None:
    named = folder.named_input(kind, project)
    if named is None:
        return None
    found: dict[str, Any] = {}
    readers: dict[str, Callable[..., dict[str, Any]]] = {"video": _video, "cloud": _cloud, "lens": _lens, "gps": _gps}
    try:
        file = folder.require_video(project) if kind == "video" else folder.require_input(kind, project)
        if kind == "gps":
            found["columns_found"] = gps_columns(Path(str(file)))
        facts = {"file": named, "path": str(file), "size": fingerprint(file)[1], **found}
        return facts | readers[kind](here, folder, project, file)
    except (InputError, ApiError) as error:
        return {"file": named, "error": {"message": problem_of(error)}, **found}


def _video(here: Context, folder: ProjectFolder, project: Project, video: File) -> dict[str, Any]:
    info = video_info(video)
    facts = {"width": info.width, "height": info.height, "codec": info.codec, "rotation_deg": info.rotation_deg}
    if not is_read_through(here.hub, folder, video):
        told = {"rate_hz": info.rate_hz, "frames": info.frames, "duration_s": info.duration_s}
        return facts | told | {"variable_rate": None, "warnings": video_warnings(video.name, info, None)}
    index = frame_index(video)
    steps_s = index.time_s[1:] - index.time_s[:-1]
    varies = len(steps_s) > 0 and bool(abs(steps_s - steps_s.mean()).max() > 0.1 * steps_s.mean())
    return facts | {
        "rate_hz": 1.0 / float(steps_s.mean()) if len(steps_s) else info.rate_hz,
        "frames": len(index),
        "duration_s": float(index.time_s[-1]),
        "variable_rate": varies,
        "warnings": video_warnings(video.name, info, float(index.time_s[-1])),
    }


def _cloud(here: Context, folder: ProjectFolder, project: Project, path: Path) -> dict[str, Any]:
    return here.sites.facts(folder, project, path) or {"reading": True}


def _lens(here: Context, folder: ProjectFolder, project: Project, path: Path) -> dict[str, Any]:
    lens = read_lens(path)
    if folder.is_there("video", project):
        video = folder.require_video(project)
        info = video_info(video)
        require_image_size(lens, width=info.width, height=info.height, lens_file=path.name, video_file=video.name)
    return {
        "image_size_px": list(lens.image_size_px),
        "focal_px": lens.focal_px.tolist(),
        "centre_px": lens.centre_px.tolist(),
        "distortion": lens.distortion.tolist(),
        "rms_px": lens.rms_px,
        "readout_s": lens.readout_s,
        "sigma": vars(lens.sigma),
    }


def _gps(here: Context, folder: ProjectFolder, project: Project, path: Path) -> dict[str, Any]:
    assert project.inputs.gps is not None
    record = read_gps(path, project.inputs.gps)
    duration_s = float(record.time_s[-1] - record.time_s[0])
    return {
        "rows": len(record.time_s),
        "rate_hz": (len(record.time_s) - 1) / duration_s,
        "duration_s": duration_s,
        "columns": project.inputs.gps.model_dump(include={"time", "x", "y"}),
    }


@router.get("/projects/{project_id}/lens/images")
def lens_images(folder: Folder) -> dict[str, Any]:
    """Return the checkerboard pictures that were sent."""
    return {"images": [{"name": path.name, "size": path.stat().st_size} for path in checkerboard_images(folder)]}


@router.delete("/projects/{project_id}/lens/images/{name}")
def remove_lens_image(name: str, folder: Folder) -> dict[str, Any]:
    """Remove a checkerboard picture."""
    _lens_image(folder, name).unlink()
    return lens_images(folder)


@router.get("/projects/{project_id}/lens/images/{name}")
def lens_image(name: str, folder: Folder, here: Here) -> Response:
    """Return a checkerboard picture: one that was sent, or one the last calibration took from this computer."""
    try:
        path = _lens_image(folder, name)
    except Missing:
        path = _calibrated_image(here, folder, name)
    if path.suffix.lower() in _SHOWN_AS_THEY_ARE:
        return FileResponse(path)
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise Invalid(f"{name}: cannot be read as a picture; take it out and send it again.", path=name)
    return Response(cv2.imencode(".png", picture)[1].tobytes(), media_type="image/png")


def _calibrated_image(here: Context, folder: ProjectFolder, name: str) -> Path:
    report = read_json(folder.results / REPORT_FILE)
    for file in report.get("files", []) if isinstance(report, dict) else []:
        if Path(file).name == name and kind_of(Path(file)) == "image":
            return here.places.file(file)
    raise Missing(f"{name}: there is no such checkerboard picture.", path=name)


def checkerboard_images(folder: ProjectFolder) -> list[Path]:
    """Return the checkerboard pictures of a project."""
    place = folder.folder / CHECKERBOARD_FOLDER
    found = place.iterdir() if place.is_dir() else iter(())
    return sorted(path for path in found if kind_of(path) == "image" and not path.name.startswith("."))


def _lens_image(folder: ProjectFolder, name: str) -> Path:
    for path in checkerboard_images(folder):
        if path.name == name:
            return path
    raise Missing(f"{name}: there is no such checkerboard picture.", path=name)


class Calibration(Body):
    """What to calibrate a lens from; `board` counts inner corners."""

    files: list[str] | Literal["uploaded"] = "uploaded"
    board: str = "9x6"
    square_m: float


@router.post("/projects/{project_id}/lens/calibrate")
def calibrate(wanted: Calibration, folder: Folder, here: Here) -> dict[str, Any]:
    """Calibrate the lens in a job; its file becomes the project's lens."""
    if wanted.files == "uploaded":
        files = checkerboard_images(folder)
    else:
        files = [here.places.file(file) for file in wanted.files]
    if not files:
        raise Invalid("There are no checkerboard pictures yet; send some, or choose files.", path="files")
    board_of(wanted.board)
    parameters = {"files": [str(file) for file in files], "board": wanted.board, "square_m": wanted.square_m}
    job = here.jobs.start(folder, "calibrate", parameters, finish_calibration(here))
    return {"job": job.as_json()}


def finish_calibration(here: Context) -> Finish:
    """Return what makes the calibrated lens the project's own."""

    def finish(folder: ProjectFolder, result: Any) -> Any:
        label = "take the calibrated lens"
        saved = folder.change_input("lens", folder.folder / result["file"], label=label)
        tell_saved(here, folder, saved, label)
        here.hub.publish(folder.id, "inputs", {"kind": "lens"})
        return result

    return finish


@router.get("/projects/{project_id}/lens/report")
def lens_report(folder: Folder) -> dict[str, Any] | None:
    """Return the report of the last calibration, or null where no lens has been calibrated in this project."""
    report = read_json(folder.results / REPORT_FILE)
    return report if isinstance(report, dict) else None
