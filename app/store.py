"""Projects as folders of a workspace: found, made, edited without losing anything, thrown away and fetched back."""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
import threading
import time
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from app.errors import ApiError, Conflict, Invalid, Missing, Refused
from app.history import HISTORY_FILE, Entry, Head, History
from app.intake import require_usable
from app.places import Places
from core.errors import InputError
from core.project import (
    PROJECT_FILE,
    RESULTS_FOLDER,
    GpsInput,
    Inputs,
    Project,
    parse_project,
    project_json,
    project_problems,
    read_project,
    write_project,
)
from core.storage import FarFile, File, file_at

_AnyFile = TypeVar("_AnyFile", bound=File)

CACHE_FOLDER = "cache"
TRASH_FOLDER = ".trash"
CHECKERBOARD_FOLDER = "checkerboard"
# Named in a project made without a video: not there yet, so the inputs step asks for it.
VIDEO_TO_COME = "video.mp4"
INPUT_KINDS = ("video", "cloud", "lens", "gps")
_RESERVED = {PROJECT_FILE, HISTORY_FILE, RESULTS_FOLDER, CHECKERBOARD_FOLDER}
# A folder a person named may be called anything that is hidden nowhere and leads nowhere.
_ID = re.compile(r'(?!\.)[^\x00-\x1f\x7f/\\:*?"<>|]{1,255}')
# Windows gives these names to devices, whatever ending follows.
_DEVICE = re.compile(r"(?:con|prn|aux|nul|(?:com|lpt)[0-9])(?:\..*)?", re.IGNORECASE)
_NAME_LENGTH = 60
_PART_PREFIX = ".incoming-"
_TRASH_KEPT_S = 31 * 86_400.0


@dataclass(frozen=True)
class Deleted:
    """A project in the trash.

    Attributes:
        undo_token: what fetches it back.
        deleted_s, kept_until_s: seconds since the epoch.
    """

    undo_token: str
    id: str
    name: str
    deleted_s: float
    kept_until_s: float


@dataclass(frozen=True)
class Saved:
    """A project as it lies on the disk, and where it stands in its history."""

    project: Project
    head: Head


class ProjectFolder:
    """One project: its file, its history, its inputs. Edits of one project happen one after the other."""

    def __init__(self, folder: Path, places: Places) -> None:
        self.id = folder.name
        self.folder = folder
        self._places = places
        self._history = History(folder / HISTORY_FILE)
        self._lock = threading.RLock()

    @property
    def results(self) -> Path:
        """Folder of everything that can be computed again."""
        return self.folder / RESULTS_FOLDER

    def load(self) -> Saved:
        """Return the project and its revision.

        Raises:
            InputError: `project.json` cannot be used.
        """
        with self._lock:
            project = self._read()
            return Saved(project, self._history.follow(project_json(project)))

    def save(self, document: Any, *, revision: int, label: str, merge: bool = False) -> Saved:
        """Replace the project, if `revision` is still the newest.

        Raises:
            Conflict: with the newer state, when it is not.
            Invalid: with every problem of the document.
        """
        with self._lock:
            self._require_newest(revision)
            return self._store(self._checked(document), label=label, merge=merge)

    def change_input(self, kind: str, file: Path | None, *, label: str) -> Saved:
        """Point one input at a file, on top of whatever the newest state is."""
        with self._lock:
            saved = self.load()
            inputs = saved.project.inputs.model_dump()
            stored = None if file is None else self._named(self._places.allowed(os.path.abspath(file)))
            if kind == "gps" and stored is not None:
                inputs["gps"] = {**(inputs["gps"] or {}), "file": stored}
            else:
                inputs[kind] = stored
            document = saved.project.model_dump(mode="json")
            document["inputs"] = inputs
            return self._store(self._checked(document), label=label)

    def step_history(self, step: int, *, revision: int) -> Saved:
        """Undo (-1) or redo (+1), if `revision` is still the newest.

        Raises:
            Conflict: it is not, or there is nothing to undo or redo.
        """
        with self._lock:
            self._require_newest(revision)
            document = self._history.neighbour(step)
            if document is None:
                raise Conflict("There is nothing to undo." if step < 0 else "There is nothing to redo.")
            project = parse_project(document, self.folder / PROJECT_FILE)
            write_project(self.folder, project)
            return Saved(project, self._history.move(step))

    def entries(self) -> tuple[list[Entry], int]:
        """Return the states of the history, oldest first, and the position of the present one."""
        with self._lock:
            self.load()
            return self._history.entries()

    def stamp(self) -> tuple[int, int]:
        """Return what changes whenever `project.json` or the results are written, whoever does it."""
        return _modified_ns(self.folder / PROJECT_FILE), _modified_ns(self.results / "summary.json")

    def input_file(self, kind: str, project: Project | None = None) -> File | None:
        """Return where an input lies, on this computer or, of a video, perhaps far away; None where none is given.

        Raises:
            Refused: outside the allowed folders.
        """
        stored = self.named_input(kind, project or self.load().project)
        return None if stored is None else self._file_of(kind, stored)

    def named_input(self, kind: str, project: Project) -> str | None:
        """Return what a project names as an input, where a person named it; None where none is given.

        A project needs the name of a video from the beginning, so one made without carries a name nobody chose. Where
        somebody has clicked in its frames, there was a video of that name.
        """
        stored = stored_inputs(project.inputs)[kind]
        clicked = project.correspondences or project.moving_regions_px
        to_come = kind == "video" and stored == VIDEO_TO_COME and not clicked and not (self.folder / stored).exists()
        return None if to_come else stored

    def input_path(self, kind: str, project: Project | None = None) -> Path | None:
        """Return where an input lies on this computer, or None where none is given there.

        Raises:
            Refused: outside the allowed folders.
        """
        file = self.input_file(kind, project)
        return file if isinstance(file, Path) else None

    def require_video(self, project: Project | None = None) -> File:
        """Return where the video lies.

        Raises:
            Missing: none is given, or it is not there.
        """
        return _there("video", self.input_file("video", project))

    def require_input(self, kind: str, project: Project | None = None) -> Path:
        """Return where an input lies on this computer.

        Raises:
            Missing: none is given, or it is not there.
        """
        return _there(kind, self.input_path(kind, project))

    def is_there(self, kind: str, project: Project | None = None) -> bool:
        """Whether an input is given and, as far as can be told without a network, can be read.

        Raises:
            Refused: outside the allowed folders.
        """
        file = self.input_file(kind, project)
        return file.is_file() if isinstance(file, Path) else file is not None

    def take_in(self, kind: str, part: Path, wanted: str) -> Saved:
        """Make what was received an input, under the name it came with or the next free one.

        What this very input was may be replaced; a file of another input, or one that is no input, never is.
        """
        with self._lock:
            name = self._free_name(wanted, kind)
            os.replace(part, self.folder / name)
            return self.change_input(kind, self.folder / name, label=f"take in {kind} {name}")

    def _free_name(self, wanted: str, kind: str) -> str:
        name = plain_name(wanted)
        number, candidate = 1, Path(name)
        while self._is_taken(candidate.name, kind):
            number += 1
            candidate = candidate.with_name(f"{Path(name).stem}-{number}{candidate.suffix}")
        return candidate.name

    def _is_taken(self, name: str, kind: str) -> bool:
        """Whether a file of the project folder is anything but this kind of input."""
        named = stored_inputs(self._read().inputs)
        kinds = {other for other, file in named.items() if file and os.path.normpath(file) == name}
        return bool(kinds - {kind}) or (not kinds and os.path.lexists(self.folder / name))

    def part_file(self) -> Path:
        """Return a place for something that is still coming in."""
        return self.folder / f"{_PART_PREFIX}{secrets.token_hex(8)}"

    def remove_parts(self) -> None:
        """Remove what a server that was killed had not received completely."""
        for part in self.folder.glob(f"{_PART_PREFIX}*"):
            part.unlink(missing_ok=True)

    def _read(self) -> Project:
        if not (self.folder / PROJECT_FILE).exists():
            raise Missing(f"{self.id}: there is no such project.", path=self.id)
        return read_project(self.folder)

    def _require_newest(self, revision: int) -> None:
        saved = self.load()
        if saved.head.revision != revision:
            raise Conflict(
                "Another tab or program has changed this project since; its newer state is shown, edit again.",
                project=saved.project.model_dump(mode="json"),
                revision=saved.head.revision,
            )

    def _checked(self, document: Any) -> Project:
        problems = project_problems(document)
        if problems:
            raise Invalid("; ".join(problems) + ".", path=problems[0].partition(":")[0], problems=problems)
        project = Project.model_validate(document)
        before = stored_inputs(self._read().inputs)
        changed = {kind: file for kind, file in stored_inputs(project.inputs).items() if file != before[kind]}
        files = {kind: self._file_of(kind, file) for kind, file in changed.items() if file is not None}
        for kind, file in files.items():
            if isinstance(file, Path) and file.is_file():
                require_usable(kind, file, file.name)
        named = {kind: self._named(file) for kind, file in files.items()}
        return project.model_copy(update={"inputs": with_inputs(project.inputs, named)})

    def _file_of(self, kind: str, stored: str) -> File:
        """Return where an input that is written into the project so lies.

        Raises:
            Refused: outside the allowed folders.
        """
        file = file_at(self.folder, stored) if kind == "video" else self.folder / stored
        if isinstance(file, Path):
            return self._places.allowed(os.path.abspath(file))
        if file.is_near:
            raise Refused(f"{file}: is a file of this computer; name it by its path.", path=f"inputs.{kind}")
        return file

    def _named(self, file: File) -> str:
        """How an input is written into the project: by its address, or from the folder, so that both may be moved."""
        if isinstance(file, FarFile):
            return file.address
        try:
            return Path(os.path.relpath(file, self.folder)).as_posix()
        except ValueError:  # another drive on Windows
            return file.as_posix()

    def _store(self, project: Project, *, label: str, merge: bool = False) -> Saved:
        write_project(self.folder, project)
        return Saved(project, self._history.record(label, project_json(project), merge=merge))


def folder_name(name: str) -> str:
    """Return a folder's name for a project, the same on every system: letters and digits of any script are kept.

    Raises:
        Invalid: there is none in the name.
    """
    composed = unicodedata.normalize("NFC", name)
    kept = "".join(sign if sign in " ._-" or unicodedata.category(sign)[0] in "LMN" else "\n" for sign in composed)
    plain = re.sub(r"\n+", "-", kept).strip(" ._-")[:_NAME_LENGTH].rstrip(" ._-")
    if not plain:
        raise Invalid("A project needs a name with a letter or a digit in it; give one.", path="name")
    return f"project {plain}" if _DEVICE.fullmatch(plain) else plain


def plain_name(wanted: str) -> str:
    """Return a file name for the project folder, as wanted but free of what could do harm.

    Raises:
        Invalid: nothing usable is left of it, or the project itself uses the name.
    """
    name = re.sub(r"[^\w .()+-]", "_", Path(wanted.replace("\\", "/")).name).strip(" .")[-120:]
    if not name or name.lower() in _RESERVED or name.startswith("."):
        raise Invalid(f"{wanted!r} cannot be the name of an input; rename the file.", path="filename")
    return name


def stored_inputs(inputs: Inputs) -> dict[str, str | None]:
    """Return the file of each kind of input as `project.json` has it."""
    gps = inputs.gps.file if inputs.gps else None
    return {"video": inputs.video, "cloud": inputs.cloud, "lens": inputs.lens, "gps": gps}


def _there(kind: str, file: _AnyFile | None) -> _AnyFile:
    """Return an input's file if one is given and, on this computer, can be found.

    Raises:
        Missing: none is given, or it is not there.
    """
    if file is None:
        raise Missing(f"No {kind} is given; choose one in the inputs.", path=f"inputs.{kind}")
    if isinstance(file, Path) and not file.is_file():
        raise Missing(f"{file.name}: not found; choose the {kind} again in the inputs.", path=f"inputs.{kind}")
    return file


def with_inputs(inputs: Inputs, files: dict[str, str]) -> Inputs:
    """Return inputs with some of the files replaced."""
    changes: dict[str, Any] = {kind: file for kind, file in files.items() if kind != "gps"}
    if "gps" in files:
        file = files["gps"]
        changes["gps"] = inputs.gps.model_copy(update={"file": file}) if inputs.gps else GpsInput(file=file)
    return inputs.model_copy(update=changes)


class Workspace:
    """A folder of projects."""

    def __init__(self, folder: Path, places: Places) -> None:
        self.folder = folder
        self.places = places
        self._open: dict[str, ProjectFolder] = {}
        self._lock = threading.Lock()

    def ids(self) -> list[str]:
        """Return the ids of all projects, the last edited first; `open` may refuse one that is a link to elsewhere."""
        found = [path.name for path in self.folder.iterdir() if _ID.fullmatch(path.name) and _is_project(path)]
        return sorted(found, key=lambda name: -self.updated_s(name))

    def updated_s(self, project_id: str) -> float:
        """Return when a project was last edited, seconds since the epoch."""
        return 1e-9 * _modified_ns(self.folder / project_id / PROJECT_FILE)

    def open(self, project_id: str) -> ProjectFolder:
        """Return a project by its id, the name of its folder.

        Raises:
            Missing: there is no such project.
        """
        folder = self.folder / project_id
        if not _ID.fullmatch(project_id) or not _is_project(folder):
            raise Missing(f"{project_id}: there is no such project.", path=project_id)
        self.places.allowed(folder)
        with self._lock:
            return self._open.setdefault(project_id, ProjectFolder(folder, self.places))

    def create(self, name: str, files: dict[str, str | None]) -> ProjectFolder:
        """Make a project folder; `files` are absolute paths of its inputs.

        Raises:
            ApiError: a file is outside the allowed folders, missing or not what it should be; nothing is left behind.
        """
        given = {kind: self.places.file(file) for kind, file in files.items() if file}
        for kind, file in given.items():
            require_usable(kind, file, file.name)
        with self._new_folder(name) as folder:
            relative = {kind: Path(os.path.relpath(file, folder)).as_posix() for kind, file in given.items()}
            inputs = with_inputs(Inputs(video=VIDEO_TO_COME), relative)
            write_project(folder, Project(name=name.strip(), inputs=inputs))
        return self.open(folder.name)

    def duplicate(self, source: ProjectFolder, name: str) -> ProjectFolder:
        """Copy a project, its results too; large inputs are linked where the file system can, so it costs no space."""
        project = source.load().project
        with self._new_folder(name) as folder:
            elsewhere: dict[str, str] = {}
            for kind, stored in stored_inputs(project.inputs).items():
                if stored is None:
                    continue
                original = Path(os.path.abspath(source.folder / stored))
                if source.folder not in original.parents:
                    elsewhere[kind] = Path(os.path.relpath(original, folder)).as_posix()
                elif original.is_file():
                    copy = folder / original.relative_to(source.folder)
                    copy.parent.mkdir(parents=True, exist_ok=True)
                    _link_or_copy(original, copy)
            if source.results.is_dir():
                shutil.copytree(source.results, folder / RESULTS_FOLDER, ignore=shutil.ignore_patterns("job.*"))
            write_project(
                folder,
                project.model_copy(update={"name": name.strip(), "inputs": with_inputs(project.inputs, elsewhere)}),
            )
        return self.open(folder.name)

    def throw_away(self, project: ProjectFolder) -> str:
        """Move a project to the trash of the workspace; return the token that fetches it back."""
        token = secrets.token_urlsafe(12)
        place = self.folder / TRASH_FOLDER / token
        place.mkdir(parents=True)
        os.rename(project.folder, place / project.id)
        with self._lock:
            self._open.pop(project.id, None)
        return token

    def fetch_back(self, token: str) -> ProjectFolder:
        """Move a project out of the trash again, under its old id where that is still free.

        Raises:
            Missing: the trash holds no such project.
        """
        place = self.folder / TRASH_FOLDER / token
        found = list(place.iterdir()) if re.fullmatch(r"[\w-]{8,40}", token) and place.is_dir() else []
        if not found:
            raise Missing("The trash no longer holds this project.", path="undo_token")
        target = self.folder / self._free_id(found[0].name)
        os.rename(found[0], target)
        place.rmdir()
        return self.open(target.name)

    def deleted(self) -> list[Deleted]:
        """Return the projects in the trash, the last thrown away first."""
        found = [self._deleted(folder) for folder in (self.folder / TRASH_FOLDER).glob("*/*") if _is_project(folder)]
        return sorted(found, key=lambda project: -project.deleted_s)

    def _deleted(self, folder: Path) -> Deleted:
        try:
            name = read_project(self.places.allowed(folder)).name
        except (InputError, ApiError):
            name = folder.name
        deleted_s = folder.parent.stat().st_mtime
        return Deleted(folder.parent.name, folder.name, name, deleted_s, deleted_s + _TRASH_KEPT_S)

    def empty_trash(self) -> None:
        """Remove what was thrown away more than a month ago."""
        trash = self.folder / TRASH_FOLDER
        for place in trash.iterdir() if trash.is_dir() else ():
            if time.time() - place.stat().st_mtime > _TRASH_KEPT_S:
                shutil.rmtree(place, ignore_errors=True)

    def adopt(self, folder: Path, name: str) -> ProjectFolder:
        """Take a finished project folder, lying elsewhere in the workspace, in under a free id."""
        with self._lock:
            target = self.folder / self._free_id(name)
            os.rename(folder, target)
        return self.open(target.name)

    @contextmanager
    def _new_folder(self, name: str) -> Iterator[Path]:
        """Make the folder of a new project; remove it again if the body fails."""
        with self._lock:
            folder = self.folder / self._free_id(name)
            folder.mkdir()
        try:
            yield folder
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def _free_id(self, name: str) -> str:
        plain = folder_name(name)
        number, candidate = 1, plain
        while (self.folder / candidate).exists():
            number += 1
            candidate = f"{plain}-{number}"
        return candidate


def problem_of(error: InputError | ApiError) -> str:
    """Return the sentence of an error, whichever kind it is."""
    return error.message if isinstance(error, ApiError) else str(error)


def read_json(file: Path) -> Any:
    """Return what a JSON file of the results holds, or None where it is missing or half a file."""
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _is_project(folder: Path) -> bool:
    return (folder / PROJECT_FILE).is_file()


def _link_or_copy(original: Path, copy: Path) -> None:
    try:
        os.link(original, copy)
    except OSError:
        shutil.copy2(original, copy)


def _modified_ns(file: Path) -> int:
    try:
        return file.stat().st_mtime_ns
    except OSError:
        return 0
