"""`project.json`: the one definition of everything a person decides.

These models are also the wire types of the browser interface. They are frozen: an edit makes a new project.
Only the file's own consistency is checked here; whether the inputs fit together is checked by `core.check`.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from core.coordinates import LARGEST_M
from core.errors import InputError
from core.storage import write_atomically
from core.text_files import decoded

PROJECT_FILE = "project.json"
RESULTS_FOLDER = "results"
# No frame is larger; nor is what lies beside one of any use so far from it.
LARGEST_PX = 1e6
# Strict: neither "18.3" nor true is a number.
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
Whole = Annotated[int, Field(strict=True)]
Metres = Annotated[Finite, Field(ge=-LARGEST_M, le=LARGEST_M)]
Length = Annotated[Positive, Field(le=LARGEST_M)]
Pixels = Annotated[Finite, Field(ge=-LARGEST_PX, le=LARGEST_PX)]
Point = tuple[Metres, Metres]
PointPx = tuple[Pixels, Pixels]
Interval = tuple[Finite, Finite]
Method = Literal["geometric", "paper"]

LINE_NAMES = ("L1", "L2", "T1")

# Intervals that touch, or that a person drew this far into one another, are as they were meant.
_TOUCHING_S = 0.1
# An antenna farther from where its target appears than this, and than this many times the target's height, by which
# high places appear displaced, is in other coordinates.
_FAR_M = 50.0
_FAR_HEIGHTS = 3.0


def _named(file: str) -> str:
    if not file or "\0" in file:
        raise ValueError("names no file; give its path")
    return file


def _named_if_any(file: str | None) -> str | None:
    try:
        return None if file is None else _named(file)
    except ValueError as error:
        raise ValueError(f"{error}, or null where there is none") from None


FileName = Annotated[str, AfterValidator(_named)]
FileNameIfAny = Annotated[str | None, AfterValidator(_named_if_any)]


class Model(BaseModel):
    """Frozen, and refuses keys it does not know."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class GpsInput(Model):
    """A GPS record and the names of its columns."""

    file: FileName
    time: str = "time_s"
    x: str = "east_m"
    y: str = "north_m"
    at_m: Point | None = Field(default=None, description="antenna position on the roof, world metres at roof level")


class Inputs(Model):
    """Files measured from; paths are relative to the project folder."""

    video: FileName
    cloud: FileNameIfAny = None
    lens: FileNameIfAny = None
    gps: GpsInput | None = None


class Orthoimage(Model):
    """Raster of the orthoimage and the height of the ground in the cloud."""

    pixel_size_m: Length = 0.01
    extent_m: tuple[Metres, Metres, Metres, Metres] | None = Field(default=None, description="west, south, east, north")
    ground_z_m: Metres | None = None

    @field_validator("extent_m")
    @classmethod
    def _ordered(cls, extent: tuple[float, float, float, float] | None) -> tuple[float, float, float, float] | None:
        if extent is not None and not (extent[0] < extent[2] and extent[1] < extent[3]):
            raise ValueError("must be [west, south, east, north] with west < east and south < north")
        return extent


class Correspondence(Model):
    """One clicked pair: a place on the ground (world metres) and in the raw reference frame (pixels)."""

    id: Whole
    ground_m: Point
    frame_px: PointPx
    enabled: Annotated[bool, Field(strict=True)] = True


class Band(Model):
    """Search band of one roof line on the orthorectified reference frame, in plan metres."""

    from_m: Point
    to_m: Point
    width_m: Length = 0.5

    @model_validator(mode="after")
    def _has_length(self) -> Band:
        if (self.to_m[0] - self.from_m[0]) ** 2 + (self.to_m[1] - self.from_m[1]) ** 2 < 1e-6:
            raise ValueError("from_m and to_m are the same place; a band needs a length")
        return self


class Lines(Model):
    """The three lines of a target: L1 and L2 side by side, T1 across them."""

    L1: Band
    L2: Band
    T1: Band


class Target(Model):
    """Something that moves and is measured: a roof, a shake table, a storey."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")
    kind: Literal["lines", "points"] = "lines"
    height_m: Metres | None = None
    p1_p2_m: Length | None = None
    lines: Lines | None = None
    region_m: tuple[Point, ...] | None = None
    relative_to: str | None = None

    @model_validator(mode="after")
    def _has_its_kind(self) -> Target:
        if self.kind == "lines" and self.lines is None:
            raise ValueError('a target of kind "lines" needs "lines" with the bands L1, L2 and T1')
        if self.kind == "points" and (self.region_m is None or len(self.region_m) < 3):
            raise ValueError('a target of kind "points" needs "region_m" with three or more corners')
        return self

    @property
    def corners(self) -> Iterator[tuple[str, Point]]:
        """The key and the place, plan metres, of each end of its bands or each corner of its region."""
        if self.kind == "points":
            for number, corner in enumerate(self.region_m or ()):
                yield f"region_m[{number}]", corner
        elif self.lines is not None:
            for name in LINE_NAMES:
                band: Band = getattr(self.lines, name)
                yield f"lines.{name}.from_m", band.from_m
                yield f"lines.{name}.to_m", band.to_m


class Intervals(Model):
    """Named parts of the video, seconds from its first frame."""

    pre_event: Interval | None = None
    event: Interval | None = None
    residual: Interval | None = None

    @field_validator("pre_event", "event", "residual")
    @classmethod
    def _ordered(cls, interval: Interval | None) -> Interval | None:
        if interval is not None and not interval[0] < interval[1]:
            raise ValueError("must be [start, end] with start < end")
        return interval


class Drift(Model):
    """High-pass filter of the paper; none where geometry has removed the drift."""

    filter: Literal["none", "high-pass"] = "none"
    order: Annotated[Whole, Field(ge=1, le=20)] = 10
    corner_hz: Positive = 0.25


class Project(Model):
    """Everything a person decided about one measurement."""

    rooftrack: Literal[1] = 1
    name: Annotated[str, Field(min_length=1)]
    inputs: Inputs
    orthoimage: Orthoimage = Orthoimage()
    reference_frame: Annotated[Whole, Field(ge=0)] = 0
    correspondences: tuple[Correspondence, ...] = ()
    moving_regions_px: tuple[tuple[PointPx, ...], ...] = ()
    targets: tuple[Target, ...] = ()
    excluded_frames: tuple[tuple[Whole, Whole], ...] = ()
    intervals_s: Intervals = Intervals()
    method: Method = "geometric"
    drift: Drift = Drift()

    @field_validator("rooftrack", mode="before")
    @classmethod
    def _is_number(cls, version: object) -> object:
        if isinstance(version, bool | float):
            raise ValueError("must be the whole number 1")
        return version

    @field_validator("correspondences")
    @classmethod
    def _ids_differ(cls, pairs: tuple[Correspondence, ...]) -> tuple[Correspondence, ...]:
        _refuse_twice("id", (pair.id for pair in pairs))
        return pairs

    @field_validator("moving_regions_px")
    @classmethod
    def _are_polygons(cls, regions: tuple[tuple[PointPx, ...], ...]) -> tuple[tuple[PointPx, ...], ...]:
        for number, region in enumerate(regions):
            if len(region) < 3:
                raise ValueError(f"region {number} has {len(region)} corners; a polygon needs three or more")
        return regions

    @field_validator("excluded_frames")
    @classmethod
    def _ranges_ordered(cls, ranges: tuple[tuple[Whole, Whole], ...]) -> tuple[tuple[Whole, Whole], ...]:
        for first, last in ranges:
            if not 0 <= first <= last:
                raise ValueError(f"[{first}, {last}] must be [first, last] with 0 <= first <= last")
        return ranges

    @field_validator("targets")
    @classmethod
    def _targets_refer(cls, targets: tuple[Target, ...]) -> tuple[Target, ...]:
        _refuse_alike_names(targets)
        by_name = {target.name: target for target in targets}
        for target in targets:
            if target.relative_to is None:
                continue
            base = by_name.get(target.relative_to)
            if base is None or base is target:
                raise ValueError(f'"{target.name}" is relative to "{target.relative_to}", which is no other target')
            if base.relative_to is not None:
                raise ValueError(f'"{target.name}" is relative to "{base.name}", which is itself relative')
        return targets

    def is_excluded(self, frame: int) -> bool:
        """Whether a person rejected this frame."""
        return any(first <= frame <= last for first, last in self.excluded_frames)


def _refuse_alike_names(targets: Iterable[Target]) -> None:
    """Refuse names that differ by case only: their results would be one file on many disks."""
    seen: dict[str, str] = {}
    for target in targets:
        name, other = target.name, seen.setdefault(target.name.casefold(), target.name)
        if other != name:
            raise ValueError(f'"{other}" and "{name}" differ by case only, as their files may not; rename one of them')
    _refuse_twice("name", (target.name for target in targets))


def _refuse_twice(what: str, values: Iterable[object]) -> None:
    seen: set[object] = set()
    for value in values:
        if value in seen:
            raise ValueError(f"{what} {value!r} is used twice")
        seen.add(value)


def read_project(folder: Path) -> Project:
    """Read and check `project.json` of a project folder.

    Raises:
        InputError: the file is missing, is not JSON, or breaks its definition; every problem is named with its path.
    """
    file = folder / PROJECT_FILE
    try:
        text = decoded(file.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{file}: not found; make a project with `rooftrack new {folder} --video FILE`.") from None
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); restore it from a copy.") from None
    except ValueError as error:
        raise InputError(f"{file}: cannot be read as text ({error}); restore it from a copy.") from None
    return parse_project(text, file)


def parse_project(text: str, file: Path | str = PROJECT_FILE) -> Project:
    """Return the project a JSON text describes; `file` is named in messages.

    Raises:
        InputError: with every problem and its path in the file.
    """
    try:
        # Windows' Notepad may put a byte order mark before the text.
        content = text.removeprefix("\ufeff")
        document = json.loads(content, object_pairs_hook=lambda pairs: _without_repetition(pairs, file))
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        raise InputError(f"{file}: {place} is not valid JSON ({error.msg}); correct it there.") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: no project looks like this ({error}); restore it from a copy.") from None
    problems = file_problems(document)
    if problems:
        raise InputError(f"{file}: " + "; ".join(problems) + ".")
    return Project.model_validate(document)


def project_doubts(project: Project) -> Iterator[str]:
    """Yield what keeps nothing from being measured but cannot be meant, in sentences that begin with its place."""
    times = project.intervals_s
    for first, then in (("pre_event", "event"), ("event", "residual"), ("pre_event", "residual")):
        before, after = getattr(times, first), getattr(times, then)
        if before is None or after is None:
            continue
        shared_s = min(before[1], after[1]) - max(before[0], after[0])
        if shared_s >= _TOUCHING_S:
            yield f"intervals_s: {first} and {then} share {shared_s:.1f} s; let one end before the other begins."
        elif before[0] > after[0]:
            yield f"intervals_s: {first} lies after {then}; correct them."
    gps = project.inputs.gps
    places = [corner for target in project.targets for _, corner in target.corners]
    if gps is not None and gps.at_m is not None and places:
        nearest_m = min(math.dist(gps.at_m, place) for place in places)
        if nearest_m > _FAR_M + _FAR_HEIGHTS * max(abs(target.height_m or 0.0) for target in project.targets):
            yield (
                f"inputs.gps.at_m: [{gps.at_m[0]:g}, {gps.at_m[1]:g}] lies {nearest_m:.0f} m from the nearest target; "
                "give the antenna's place in the coordinates of the cloud."
            )


@contextmanager
def naming_file(folder: Path) -> Iterator[None]:
    """Have mistakes found in `project.json`, wherever they are found, name the file with its folder."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(f"{PROJECT_FILE}: "):
            raise InputError(f"{folder}{os.sep}{error}") from None
        raise


def _without_repetition(pairs: list[tuple[str, Any]], file: Path | str) -> dict[str, Any]:
    """Return an object of the file; JSON would take the last of two values of one key without a word."""
    document = dict(pairs)
    if len(document) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise InputError(f'{file}: the key "{twice}" stands twice in one place; remove one of them.')
    return document


def file_problems(document: Any) -> list[str]:
    """Return each problem of a whole file: those of the project it describes, and that it does not say what it is."""
    unnamed = isinstance(document, dict) and "rooftrack" not in document
    return [*(['rooftrack: missing, add it: "rooftrack": 1'] if unnamed else []), *project_problems(document)]


def project_problems(document: Any) -> list[str]:
    """Return each problem of a parsed `project.json`, `path: what is wrong and what to do`; none means valid."""
    try:
        Project.model_validate(document)
    except ValidationError as error:
        return [_sentence(entry["loc"], entry["type"], entry["msg"], entry.get("input")) for entry in error.errors()]
    return []


def _sentence(location: tuple[int | str, ...], kind: str, message: str, value: object) -> str:
    if not location and kind == "model_type":
        return "holds no project, which is an object with name, inputs and more; restore it from a copy"
    path = re.sub(r"\.\[", "[", ".".join(f"[{part}]" if isinstance(part, int) else part for part in location)) or "top"
    if kind == "extra_forbidden":
        return f'{path}: unknown key "{location[-1]}", remove it or correct its spelling'
    if kind == "missing":
        return f"{path}: missing, add it"
    if kind == "string_pattern_mismatch":
        return (
            f"{path}: {_shortened(value)} cannot be the name of a file; take up to 64 letters from A to Z, digits, "
            "- and _, a letter or digit first"
        )
    message = message.removeprefix("Value error, ")
    if kind == "value_error":
        return f"{path}: {message}"
    return f"{path}: {message[0].lower()}{message[1:]}, not {_shortened(value)}"


def _shortened(value: object) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def write_project(folder: Path, project: Project) -> None:
    """Write `project.json` atomically: a crash leaves the old file or the new one, never half of one."""
    write_atomically(folder / PROJECT_FILE, project_json(project).encode())


def project_json(project: Project) -> str:
    """Return the file's text: short lists on one line, so that a person can read and edit it."""
    text = json.dumps(project.model_dump(mode="json"), indent=2, ensure_ascii=False)
    # Only the layout breaks lines; within strings a break is written as an escape.
    flat_list = re.compile(r'\[\n\s*((?:[^\[\]{}"]|"(?:[^"\\]|\\.)*")*?)\n\s*\]')
    return flat_list.sub(lambda found: "[" + re.sub(r"\n\s*", " ", found.group(1)) + "]", text) + "\n"
