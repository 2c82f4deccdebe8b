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
        InputError: there is a project already, an input is missing, its name is no text, or the lens is another
            camera's.
    """
    file = folder / PROJECT_FILE
    if file.exists():
        raise InputError(f"{file}: exists already and is left as it is; choose another folder.")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; choose a folder.")
    for path in (video, cloud, lens, gps):
        if isinstance(path, Path) and not path.is_file():
            raise InputError(f"{path}: there is no such file; correct the path.")
    project = Project(
        name=_as_text(name or folder.resolve().name),
        inputs=Inputs(
            video=_seen_from(folder, video),
            cloud=_seen_from(folder, cloud) if cloud else None,
            lens=_seen_from(folder, lens) if lens else None,
            gps=GpsInput(file=_seen_from(folder, gps)) if gps else None,
        ),
    )
    _require_lens_of_video(lens, video)
    write_project(folder, project)
    return project


def _require_lens_of_video(lens: Path | None, video: File) -> None:
    info = probe(video)
    if lens is not None:
        require_image_size(read_lens(lens), width=info.width, height=info.height, lens_file=lens, video_file=video)


def _seen_from(folder: Path, path: File) -> str:
    """Return the path relative to the folder with forward slashes; absolute where they share no drive.

    Raises:
        InputError: a name in it is no text.
    """
    if isinstance(path, FarFile):
        return path.address
    try:
        seen = Path(os.path.relpath(path.resolve(), folder.resolve()))
    except ValueError:
        seen = path.resolve()
    return _as_text(seen.as_posix())


def _as_text(name: str) -> str:
    """Return a name that can be written into a file of text.

    Raises:
        InputError: the system knows it by bytes that are no UTF-8, as old archives unpack.
    """
    try:
        name.encode()
    except UnicodeEncodeError:
        shown = os.fsencode(name).decode(errors="replace")
        raise InputError(f"{shown}: has letters in its name that are not UTF-8; rename it.") from None
    return name
