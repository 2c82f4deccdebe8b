"""A whole project as one file: written as a stream, read back without trusting it."""

from __future__ import annotations

import io
import lzma
import os
import posixpath
import shutil
import stat
import time
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath

from app.errors import FORBIDDEN, Invalid
from app.history import DAMAGED_FILE, HISTORY_FILE
from app.jobs import JOB_FILE
from app.store import CACHE_FOLDER, ProjectFolder, Workspace, stored_inputs, with_inputs
from app.uploads import SPARE_BYTES
from core.errors import DISK_FULL, InputError
from core.project import PROJECT_FILE, RESULTS_FOLDER, Project, parse_project, project_json, write_project

INPUTS_FOLDER = "inputs"

_PIECE_BYTES = 1 << 20
# Already as small as they get: packing them again costs minutes and saves nothing.
_PACKED_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".laz", ".jpg", ".jpeg", ".png", ".e57", ".zip")
# An honest project has some hundred files, and text that packs to a tenth; a bomb has more of either.
_MAX_FILES = 20_000
_MAX_RATIO = 100
_FREE_BYTES = 64 << 20
# What systems put beside the files of a folder that a person packs.
_OF_SYSTEMS = ("__MACOSX", ".DS_Store", "Thumbs.db", "desktop.ini")
# What reading a damaged zip raises, wherever the damage is: its directory, a header, or what was packed.
_DAMAGE = (
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
    lzma.LZMAError,
    NotImplementedError,
    EOFError,
    OSError,
    UnicodeError,
)


def archive_stream(project: ProjectFolder, *, inputs: bool) -> Iterator[bytes]:
    """Yield a zip of the project folder in pieces, holding no more than one piece of it in memory.

    Inputs that lie elsewhere are packed under `inputs/`, and the packed `project.json` names them there, so that the
    archive can be opened on another computer.
    """
    stored = project.load().project
    outside = _outside_inputs(project, stored) if inputs else {}
    renamed = {kind: f"{INPUTS_FOLDER}/{kind}/{path.name}" for kind, path in outside.items()}
    document = project_json(stored.model_copy(update={"inputs": with_inputs(stored.inputs, renamed)}))
    sink = _Sink()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED, allowZip64=True) as archive:
        archive.writestr(PROJECT_FILE, document)
        left_out = set() if inputs else _inside_inputs(project, stored)
        for path in _files(project, left_out):
            yield from _packed(archive, sink, path, path.relative_to(project.folder).as_posix())
        for kind, path in outside.items():
            yield from _packed(archive, sink, path, renamed[kind])
    yield sink.take()


def _outside_inputs(project: ProjectFolder, stored: Project) -> dict[str, Path]:
    found = {}
    for kind, file in stored_inputs(stored.inputs).items():
        path = project.input_path(kind, stored) if file is not None else None
        if path is not None and path.is_file() and project.folder.resolve() not in path.parents:
            found[kind] = path
    return found


def _inside_inputs(project: ProjectFolder, stored: Project) -> set[Path]:
    files = (file for file in stored_inputs(stored.inputs).values() if file is not None)
    return {Path(os.path.abspath(project.folder / file)) for file in files}


def _files(project: ProjectFolder, left_out: set[Path]) -> Iterator[Path]:
    own = {PROJECT_FILE, HISTORY_FILE, DAMAGED_FILE, f"{RESULTS_FOLDER}/{JOB_FILE}"}
    for folder, folders, names in os.walk(project.folder):
        folders[:] = sorted(name for name in folders if not name.startswith(".") and name != CACHE_FOLDER)
        for name in sorted(names):
            path = Path(folder) / name
            relative = path.relative_to(project.folder).as_posix()
            plain = path.is_file() and not path.is_symlink() and not name.startswith(".")
            if plain and relative not in own and path not in left_out:
                yield path


def _packed(archive: zipfile.ZipFile, sink: _Sink, path: Path, name: str) -> Iterator[bytes]:
    entry = zipfile.ZipInfo.from_file(path, name, strict_timestamps=False)
    packed = path.suffix.lower() in _PACKED_SUFFIXES
    entry.compress_type = zipfile.ZIP_STORED if packed else zipfile.ZIP_DEFLATED
    with path.open("rb") as source, archive.open(entry, "w", force_zip64=True) as target:
        while piece := source.read(_PIECE_BYTES):
            target.write(piece)
            yield sink.take()
    yield sink.take()


class _Sink(io.RawIOBase):
    """A file that can only be written, and hands on what was written so far."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []
        self._position = 0

    def writable(self) -> bool:
        return True

    def write(self, data: object) -> int:
        piece = bytes(data)  # type: ignore[call-overload]
        self._pieces.append(piece)
        self._position += len(piece)
        return len(piece)

    def tell(self) -> int:
        return self._position

    def take(self) -> bytes:
        """Return what came since the last time."""
        taken = b"".join(self._pieces)
        self._pieces.clear()
        return taken


def restore(workspace: Workspace, archive_file: Path, name: str | None) -> ProjectFolder:
    """Unpack an archive as a new project of the workspace; an archive that is refused leaves nothing behind.

    Raises:
        Invalid: no zip, no project in it or one that cannot be used, a name that leads outside, a link, or far more
            content than its size.
        OSError: the disk is full, or does not allow writing.
    """
    folder = archive_file.with_name(f"{archive_file.name}.folder")
    try:
        with zipfile.ZipFile(archive_file) as archive:
            entries = _trusted_entries(archive, archive_file)
            folder.mkdir()
            for entry, target in entries.items():
                _unpack(archive, entry, folder / target)
        project = _project_in(folder)
        if name:
            project = project.model_copy(update={"name": name})
        write_project(folder, project)
        return workspace.adopt(folder, project.name)
    except _DAMAGE as error:
        if isinstance(error, OSError) and error.errno in (*DISK_FULL, *FORBIDDEN):
            raise  # it is the disk's doing, and another archive would fare no better
        raise Invalid(f"The archive is damaged or no zip file ({error}); choose one made by Rooftrack.") from None
    except RuntimeError:
        raise Invalid("The archive is encrypted; unpack it and pack it again without a password.") from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _project_in(folder: Path) -> Project:
    try:
        return parse_project((folder / PROJECT_FILE).read_text(encoding="utf-8"), PROJECT_FILE)
    except InputError as error:
        reason = str(error).removeprefix(f"{PROJECT_FILE}: ")
        raise Invalid(f"The {PROJECT_FILE} in the archive cannot be used: {reason}") from None


def _trusted_entries(archive: zipfile.ZipFile, archive_file: Path) -> dict[zipfile.ZipInfo, PurePosixPath]:
    """Return the files of an archive and where each goes, relative to the project folder."""
    files = [entry for entry in archive.infolist() if not entry.is_dir() and not _is_of_a_system(entry)]
    if len(files) > _MAX_FILES:
        raise Invalid(f"The archive holds {len(files)} files, which no project has; choose one made by Rooftrack.")
    packed_bytes = archive_file.stat().st_size
    total_bytes = sum(entry.file_size for entry in files)
    if total_bytes > _MAX_RATIO * packed_bytes + _FREE_BYTES:
        raise Invalid("The archive would grow beyond all measure when unpacked; choose one made by Rooftrack.")
    if total_bytes + SPARE_BYTES > shutil.disk_usage(archive_file.parent).free:
        raise Invalid(f"The archive needs {total_bytes / 1e9:.1f} GB, more than the disk has free; make room.")
    places = {entry: _safe_place(entry) for entry in files}
    top = _top_folder(places.values())
    inner = {entry: place.relative_to(top) for entry, place in places.items()}
    if PurePosixPath(PROJECT_FILE) not in inner.values():
        raise Invalid(f"The archive holds no {PROJECT_FILE}; choose one made by Rooftrack.")
    return {entry: place for entry, place in inner.items() if not _is_servers_own(place)}


def _is_servers_own(place: PurePosixPath) -> bool:
    """Whether a file is what a server notes down for itself; one from elsewhere would be believed."""
    own = (PurePosixPath(HISTORY_FILE), PurePosixPath(RESULTS_FOLDER, JOB_FILE))
    cached = PurePosixPath(RESULTS_FOLDER, CACHE_FOLDER) in place.parents
    return place in own or cached or any(part.startswith(".") for part in place.parts)


def _safe_place(entry: zipfile.ZipInfo) -> PurePosixPath:
    name = entry.filename.replace("\\", "/")
    place = PurePosixPath(name)
    leads_out = place.is_absolute() or ".." in place.parts or ":" in name or "\0" in name or not place.parts
    if leads_out or stat.S_ISLNK(entry.external_attr >> 16):
        raise Invalid(f"The archive holds {entry.filename!r}, which leads outside the project; it was not unpacked.")
    return place


def _is_of_a_system(entry: zipfile.ZipInfo) -> bool:
    parts = entry.filename.replace("\\", "/").split("/")
    return parts[0] in _OF_SYSTEMS or parts[-1] in _OF_SYSTEMS


def _top_folder(places: Iterable[PurePosixPath]) -> PurePosixPath:
    """Return the folder everything lies in, as when a person packed the project's folder itself, or one around it."""
    folders = [place.parent.as_posix() for place in places]
    return PurePosixPath(posixpath.commonpath(folders) if folders else ".")


def _unpack(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path) -> None:
    """Write one file, no longer than the archive said it is."""
    target.parent.mkdir(parents=True, exist_ok=True)
    left = entry.file_size
    try:
        with archive.open(entry) as source, target.open("xb") as stream:
            while piece := source.read(_PIECE_BYTES):
                left -= len(piece)
                if left < 0:
                    raise Invalid(f"The archive lies about the size of {entry.filename!r}; it was not unpacked.")
                stream.write(piece)
        # A person tells by their times which of two files is the older one.
        packed_s = time.mktime((*entry.date_time, 0, 0, -1))
        os.utime(target, (packed_s, packed_s))
    except FileExistsError:
        raise Invalid(f"The archive holds {entry.filename!r} twice; choose one made by Rooftrack.") from None
