"""What a file has to be before it becomes an input: looked into quickly, so that nothing replaces what works."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from app.errors import Invalid
from core.cloud import CLOUD_SUFFIXES, TABLE_SUFFIXES
from core.errors import InputError
from core.gps_record import gps_columns
from core.lens import read_lens
from core.video import probe

# How each format of point clouds begins; the others are tables of numbers.
_BEGINNINGS = {".las": b"LASF", ".laz": b"LASF", ".ply": b"ply", ".pcd": b"VERSION", ".e57": b"ASTM-E57"}
_LOOKED_AT_BYTES = 4096
_COORDINATES = 3


def require_usable(kind: str, file: Path, name: str) -> None:
    """Look into a file that is to become an input of a kind; `name` is how a person knows it.

    A cloud is not read through, which may take a minute; that follows, in a job.

    Raises:
        Invalid: it is something else, or damaged.
    """
    looks: dict[str, Callable[[Path, str], object]] = {
        "video": lambda file, name: probe(file),
        "lens": lambda file, name: read_lens(file),
        "gps": _look_at_gps,
        "cloud": _look_at_cloud,
    }
    try:
        looks[kind](file, name)
    except InputError as error:
        raise Invalid(str(error).replace(str(file), name), path=f"inputs.{kind}") from None


def _look_at_gps(file: Path, name: str) -> None:
    columns = gps_columns(file)
    if len(columns) < _COORDINATES:
        raise InputError(f"{name}: is no GPS record, which has a time and two coordinates in a line; choose a CSV.")


def _look_at_cloud(file: Path, name: str) -> None:
    suffix = Path(name).suffix.lower()
    with file.open("rb") as stream:
        head = stream.read(_LOOKED_AT_BYTES)
    if suffix not in CLOUD_SUFFIXES:
        raise InputError(f"{name}: is no point cloud; these end in {', '.join(CLOUD_SUFFIXES)}.")
    if suffix in _BEGINNINGS and _BEGINNINGS[suffix] not in (head if suffix == ".pcd" else head[:8]):
        raise InputError(f"{name}: does not begin as a {suffix[1:].upper()} file does; export or copy it again.")
    lines = [_holds_a_point(line) for line in head.splitlines() if line.strip()]
    if suffix in TABLE_SUFFIXES and 2 * sum(lines) < len(lines):  # a header of a few lines is as it should be
        raise InputError(f"{name}: is no table of points, one with its coordinates in a line; export the cloud again.")


def _holds_a_point(line: bytes) -> bool:
    words = re.split(rb"[,;\s]+", line.strip())
    return sum(_is_number(word) for word in words) >= _COORDINATES


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
