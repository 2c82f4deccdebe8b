"""A new project folder: `project.json` with its inputs, which stay where they are."""

from __future__ import annotations

import os
from pathlib import Path

from core.errors import InputError
from core.lens import read_lens, require_image_size
from core.project import PROJECT_FILE, GpsInput, Inputs, Project, write_project
from core.storage import FarFile, File
from core.video import probe


def create_project(
    folder: Path,
    *,
    video: File,
    cloud: Path | None = None,
    lens: Path | None = None,
    gps: Path | None = None,
    name: str | None = None,
) -> Project:
    """Make a project folder around inputs, which are named relative to it and not copied.

    Args:
        video: on this machine, or far away; what lies far away is named by its address.
        name: what people call it; the folder's name where None.

    Raises:
        InputError: there is a project already, an input is missing, or the lens is another camera's.
    """
    file = folder / PROJECT_FILE
    if file.exists():
        raise InputError(f"{file}: exists already and is left as it is; choose another folder.")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; choose a folder.")
    for path in (video, cloud, lens, gps):
        if isinstance(path, Path) and not path.is_file():
            raise InputError(f"{path}: there is no such file; correct the path.")
    _require_lens_of_video(lens, video)
    project = Project(
        name=name or folder.resolve().name,
        inputs=Inputs(
            video=_seen_from(folder, video),
            cloud=_seen_from(folder, cloud) if cloud else None,
            lens=_seen_from(folder, lens) if lens else None,
            gps=GpsInput(file=_seen_from(folder, gps)) if gps else None,
        ),
    )
    write_project(folder, project)
    return project


def _require_lens_of_video(lens: Path | None, video: File) -> None:
    info = probe(video)
    if lens is not None:
        require_image_size(read_lens(lens), width=info.width, height=info.height, lens_file=lens, video_file=video)


def _seen_from(folder: Path, path: File) -> str:
    """Return the path relative to the folder with forward slashes; absolute where they share no drive."""
    if isinstance(path, FarFile):
        return path.address
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:
        return path.resolve().as_posix()
