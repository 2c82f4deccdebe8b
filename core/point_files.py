"""Point clouds in files anyone can write: PLY, PCD and columns of text, read in float64 without other libraries.

Whatever a file calls its columns, they arrive here as one table of named columns; `core.cloud` makes a cloud of them.
"""

from __future__ import annotations

import itertools
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from core.coordinates import Floats
from core.errors import InputError
from core.progress import Progress
from core.text_files import UTF_16_MARKS

_TEXT_CHUNK_LINES = 500_000
_BYTE_ORDER_MARK = b"\xef\xbb\xbf".decode("latin-1")

# What surveyors, scanners and programs call the same column.
_COLUMN_NAMES = {
    "x": ("x", "east", "easting", "east_m", "x_m", "//x"),
    "y": ("y", "north", "northing", "north_m", "y_m"),
    "z": ("z", "height", "elevation", "elev", "up", "up_m", "z_m", "altitude"),
    "intensity": ("intensity", "scalar_intensity", "i", "reflectance", "scalar_reflectance"),
    "red": ("red", "r", "rf", "diffuse_red"),
    "green": ("green", "g", "gf", "diffuse_green"),
    "blue": ("blue", "b", "bf", "diffuse_blue"),
}
_COLUMN_OF_NAME = {name: column for column, names in _COLUMN_NAMES.items() for name in names}

_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_UNIT = re.compile(rb"[\[(][^\])]*[\])]")
_WHOLE = re.compile(r"[-+]?\d+")
_WITH_COMMAS = re.compile(rb"[-+]?\d+(?P<decimals>,\d+)?(?P<after>,?)")


@dataclass(frozen=True)
class PointTable:
    """Points as a file gives them.

    Attributes:
        xyz: (N, 3) float64, the file's own coordinates, metres.
        rgb: (N, 3), the file's own range, or None.
        intensity: (N,) float32 or None.
        stored_in_float32: whether the file kept coordinates in single precision.
    """

    xyz: Floats
    rgb: NDArray[Any] | None = None
    intensity: NDArray[np.float32] | None = None
    stored_in_float32: bool = False


def read_ply(path: Path, progress: Progress) -> PointTable:
    """Read the vertices of a PLY file, ascii or binary.

    Raises:
        InputError: the header is damaged, vertices lack x y z, or the file ends early.
    """
    with path.open("rb") as stream:
        encoding, elements = _ply_header(path, stream)
        names = [name for name, _, _ in elements]
        if "vertex" not in names:
            raise InputError(f"{path}: its header has no vertex element; export the points again.")
        before = elements[: names.index("vertex")]
        _, count, properties = elements[names.index("vertex")]
        if any("list" in kind for _, _, earlier in [*before, elements[names.index("vertex")]] for _, kind in earlier):
            raise InputError(f"{path}: has list properties before or in its vertices; export it as points only.")
        if encoding == "ascii":
            for _ in range(sum(lines for _, lines, _ in before)):
                stream.readline()
            values = _text_rows(path, _text_lines(stream, count), _header_lines(path), columns=len(properties))
            _require_count(path, len(values), count)
            table: Any = {name: values[:, column] for column, (name, _) in enumerate(properties)}
        else:
            order = "<" if encoding == "binary_little_endian" else ">"
            for _, lines, earlier in before:
                stream.seek(lines * sum(np.dtype(kind).itemsize for _, kind in earlier), 1)
            dtype = _record_type(path, [(name, order + kind) for name, kind in properties])
            table = _records(path, stream, dtype, count)
    progress("cloud", 1, 1)
    float32 = encoding != "ascii" and dict(properties).get("x") == "f4"
    return _table(path, [name for name, _ in properties], table, float32)


def _ply_header(path: Path, stream: IO[bytes]) -> tuple[str, list[tuple[str, int, list[tuple[str, str]]]]]:
    """Return the encoding and each element's name, count and (property, numpy type), up to `end_header`."""
    if stream.readline().strip() != b"ply":
        raise InputError(f"{path}: does not begin with `ply`; give a PLY file or name it by its true format.")
    encoding, elements = "", list[tuple[str, int, list[tuple[str, str]]]]()
    for _ in range(1000):
        words = stream.readline().decode("latin-1").split()
        try:
            match words:
                case ["end_header"]:
                    if encoding not in ("ascii", "binary_little_endian", "binary_big_endian"):
                        break
                    return encoding, elements
                case ["format", encoding, *_]:
                    pass
                case ["element", name, count]:
                    elements.append((name, _count(count), []))
                case ["property", "list", *_, name]:
                    elements[-1][2].append((name, "list"))
                case ["property", kind, name]:
                    elements[-1][2].append((name, _PLY_TYPES[kind]))
        except (ValueError, KeyError, IndexError):
            raise InputError(f"{path}: header line `{' '.join(words)}` is not PLY; export the file again.") from None
    raise InputError(f"{path}: its PLY header does not end or names no known format; export the file again.")


def _count(word: str) -> int:
    """Return how many there are of something.

    Raises:
        ValueError: it is no number, or a negative one.
    """
    count = int(word)
    if count < 0:
        raise ValueError(f"{count} of something")
    return count


def _header_lines(path: Path) -> int:
    with path.open("rb") as stream:
        return next(number for number, line in enumerate(stream, start=1) if line.strip() == b"end_header")


def read_pcd(path: Path, progress: Progress) -> PointTable | None:
    """Read a PCD file, ascii or binary; None for binary_compressed, which is left to open3d.

    Raises:
        InputError: the header is damaged, x y z are missing, or the file ends early.
    """
    with path.open("rb") as stream:
        header, lines = _pcd_header(path, stream)
        try:
            counts = [_count(word) for word in header["COUNT"]]
            kinds = zip(header["TYPE"], header["SIZE"], strict=True)
            types = [np.dtype(f"<{kind.lower()}{size}").str for kind, size in kinds]
            fields = list(zip(header["FIELDS"], types, counts, strict=True))
            count, encoding = _count(header["POINTS"][0]), header["DATA"][0]
        except (KeyError, ValueError, IndexError, TypeError):
            raise InputError(f"{path}: its PCD header is incomplete or inconsistent; export the file again.") from None
        names = [name if width == 1 else f"{name}*{width}" for name, _, width in fields]
        if encoding == "ascii":
            firsts = np.cumsum([0, *counts[:-1]])
            values = _text_rows(path, _text_lines(stream, count), lines, columns=sum(counts))
            _require_count(path, len(values), count)
            table: Any = {name: values[:, first] for name, first in zip(names, firsts, strict=True)}
        elif encoding in ("binary", "binary_compressed"):
            unique = [f"_{i}" if name == "_" else name for i, name in enumerate(names)]
            dtype = _record_type(path, [(n, kind, (w,)) if w > 1 else (n, kind)
                                        for n, (_, kind, w) in zip(unique, fields, strict=True)])  # fmt: skip
            if encoding == "binary_compressed":
                _require_whole_compressed(path, stream, count * dtype.itemsize)
                return None
            table = _records(path, stream, dtype, count)
        else:
            raise InputError(f'{path}: its PCD header says "DATA {encoding}", which is no PCD; export the file again.')
    progress("cloud", 1, 1)
    float32 = encoding == "binary" and dict(zip(names, types, strict=True)).get("x") == "<f4"
    packed = {name: table[name] for name in ("rgb", "rgba") if name in names}
    result = _table(path, names, table, float32)
    for value, kind in ((value, types[names.index(name)]) for name, value in packed.items()):
        result = PointTable(result.xyz, _unpacked_rgb(value, kind), result.intensity, result.stored_in_float32)
    return result


def _pcd_header(path: Path, stream: IO[bytes]) -> tuple[dict[str, list[str]], int]:
    header: dict[str, list[str]] = {}
    for number in range(1, 101):
        words = stream.readline().decode("latin-1").split()
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
            if words[0].upper() == "DATA":
                header.setdefault("COUNT", ["1"] * len(header.get("FIELDS", [])))
                return header, number
    raise InputError(f"{path}: has no PCD header that ends in DATA; give a PCD file or name it by its true format.")


def _unpacked_rgb(packed: NDArray[Any], kind: str) -> NDArray[np.uint8]:
    """Split PCL's colour, four bytes that are declared a float or an integer, into (N, 3)."""
    whole = packed.astype(np.float32).view(np.uint32) if kind.startswith("<f") else packed.astype(np.uint32)
    return np.stack([(whole >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)


def read_text(path: Path, progress: Progress) -> PointTable:
    """Read columns of numbers: XYZ, PTS, TXT or CSV, with or without a line of names, or a title without numbers.

    Without names the columns are x y z, then intensity (4 columns), red green blue (6), or intensity red green
    blue (7, as PTS has them). Numbers may have decimal commas where commas separate no columns.

    Raises:
        InputError: a line is not what the first one promises; the line is named.
    """
    layout = _text_layout(path)
    size, parts = max(path.stat().st_size, 1), []
    with path.open("rb") as stream:
        for _ in range(layout.skip):
            stream.readline()
        lines_before = layout.skip
        while lines := _text_lines(stream, _TEXT_CHUNK_LINES, layout.comma):
            parts.append(_text_rows(path, lines, lines_before, columns=len(layout.names)))
            lines_before += len(lines)
            progress("cloud", int(1000 * stream.tell() / size), 1000)
    if not any(map(len, parts)):
        raise InputError(f"{path}: holds no points; export it again.")
    values = np.concatenate(parts) if len(parts) > 1 else parts[0]
    if layout.count is not None and len(values) != layout.count:
        _require_count(path, len(values), layout.count)
        values = values[: layout.count]
    return _table(path, layout.names, {name: values[:, i] for i, name in enumerate(layout.names)}, False)


@dataclass(frozen=True)
class _TextLayout:
    """What to skip, the columns' names, how many points a PTS file promises, and what a comma stands for."""

    skip: int
    names: list[str]
    count: int | None
    comma: str


def _text_layout(path: Path) -> _TextLayout:
    """Look at the first lines."""
    title, names, count = list[str](), list[str](), None
    with path.open("rb") as stream:
        for number, line in enumerate(stream):
            if number == 0 and line.startswith(UTF_16_MARKS):
                raise InputError(f"{path}: is text in UTF-16; save it as UTF-8.")
            comma = _meaning_of_comma(path, number + 1, line)
            words = _words(line, comma)
            if number > 100:
                break
            named = _names_in(line)
            if not words or (line.lstrip().startswith((b"#", b"//")) and not named):
                continue
            if named:
                names = named
            elif number == 0 and not any(_all_numbers([word]) for word in words):
                title = words
            elif len(words) == 1 and words[0].isdigit():
                count = int(words[0])
            elif len(words) >= 3 and _all_numbers(words):
                if not names and len(title) == len(words):
                    # Taken for x y z, columns of north, east and height would make a mirrored site.
                    raise InputError(
                        f"{path}: line 1 has a word for each column but does not name x, y and z; name them so, or "
                        "put # before a line that is only a title."
                    )
                return _TextLayout(number, names or _names_by_number(path, stream, line, comma), count, comma)
            else:
                raise InputError(
                    f"{path}: line {number + 1} is neither names of columns with x, y and z nor three or more numbers; "
                    "export the points as text again."
                )
    raise InputError(f"{path}: holds no points; export it again.")


def _words(line: bytes, comma: str = " ") -> list[str]:
    return [word.strip('"') for word in _spaced(line, comma).split()]


def _meaning_of_comma(path: Path, number: int, line: bytes) -> str:
    """Return what takes the place of commas: a point where they are decimal, as in `12,34;5;0,01`, else a blank.

    Raises:
        InputError: they are both, as in `12,34, 5, 0,01`.
    """
    words = [_WITH_COMMAS.fullmatch(word) for word in re.split(rb"[\s;]+", line.strip().rstrip(b";"))]
    if len(words) < 3 or not any(word and word["decimals"] for word in words) or not all(words):
        return " "
    if any(word and word["after"] for word in words):
        raise InputError(
            f"{path}: line {number} has decimal commas, which cannot be told from commas between columns; "
            "export the points with decimal points."
        )
    return "."


def _names_in(line: bytes) -> list[str]:
    """Return what a line calls the columns, units in brackets aside; empty where it does not name x, y and z."""
    bare = [word.lower().lstrip("#/") for word in _words(_UNIT.sub(b" ", line))]
    names = [_COLUMN_OF_NAME.get(name, name) for name in bare if name]
    return names if {"x", "y", "z"} <= set(names) else []


def _all_numbers(words: list[str]) -> bool:
    try:
        [float(word) for word in words]
    except ValueError:
        return False
    return True


def _names_by_number(path: Path, stream: IO[bytes], first_line: bytes, comma: str) -> list[str]:
    """Return what columns without names are, by their number and by what the first lines hold."""
    first = _words(first_line, comma)
    by_count = {
        3: [],
        4: ["intensity"],
        6: ["red", "green", "blue"],
        7: ["intensity", "red", "green", "blue"],
    }
    if len(first) not in by_count:
        raise InputError(f"{path}: has {len(first)} columns without names; add a first line that names x, y and z.")
    names = ["x", "y", "z", *by_count[len(first)]]
    lines = [first_line, *(line for line, _ in zip(stream, range(200), strict=False))]
    rows = [row for row in (_words(line, comma) for line in lines) if len(row) == len(first) and _all_numbers(row)]
    if len(first) >= 6 and b"," in first_line and all(_WHOLE.fullmatch(word) for row in rows for word in row):
        raise InputError(
            f"{path}: its {len(first)} columns of whole numbers may be half as many with decimal commas; export the "
            "points with decimal points, or add a first line that names x, y and z."
        )
    if "red" in names and not _are_colours(np.array([row[-3:] for row in rows], dtype=np.float64)):
        names[-3:] = ["normal_x", "normal_y", "normal_z"]
    return names


def _are_colours(values: Floats) -> bool:
    """Whether three more columns (N, 3) are colours, whole numbers or parts of one, and not normals of length one."""
    are_normals = np.allclose(np.linalg.norm(values, axis=1), 1.0, atol=0.01)
    are_whole, are_parts = np.all(values == np.rint(values)), np.all(values <= 1)
    return bool(not are_normals and np.all(values >= 0) and (are_whole or are_parts))


def _text_lines(stream: IO[bytes], most: int, comma: str = " ") -> list[str]:
    """Return the next lines, up to so many, with blanks between their columns; none at the end of the file."""
    return [_spaced(line, comma) for line in itertools.islice(stream, most)]


def _text_rows(path: Path, lines: list[str], lines_before: int, *, columns: int) -> Floats:
    """Return (N, columns) what lines hold besides comments and blanks.

    Raises:
        InputError: a line holds something else; it is named.
    """
    if not any(line.strip() and not line.startswith(("#", "//")) for line in lines):
        return np.empty((0, columns))
    try:
        values: Floats = np.loadtxt(lines, dtype=np.float64, ndmin=2, comments=("#", "//"))
    except ValueError:
        values = np.empty((0, 0))
    if values.shape[1] == columns:
        return values
    wrong = next(number for number, line in enumerate(lines, start=lines_before + 1) if not _holds(line, columns))
    raise InputError(f"{path}: line {wrong} does not hold {columns} numbers as it should; correct or remove it.")


def _holds(line: str, columns: int) -> bool:
    words = line.split()
    return not words or line.startswith(("#", "//")) or (len(words) == columns and _all_numbers(words))


def _spaced(line: bytes, comma: str) -> str:
    """Return a line with blanks between its columns, and something else in place of commas."""
    return line.decode("latin-1").removeprefix(_BYTE_ORDER_MARK).replace(",", comma).replace(";", " ").lstrip()


def _record_type(path: Path, columns: list[Any]) -> np.dtype[Any]:
    """Return the type of a binary file's records from the name, type and perhaps width of each column."""
    try:
        return np.dtype(columns)
    except ValueError as error:
        raise InputError(f"{path}: its header is inconsistent ({error}); export the file again.") from None


def _records(path: Path, stream: IO[bytes], dtype: np.dtype[Any], count: int) -> NDArray[Any]:
    _require_count(path, _bytes_left(stream) // max(dtype.itemsize, 1), count)
    return np.frombuffer(stream.read(count * dtype.itemsize), dtype=dtype, count=count)


def _require_whole_compressed(path: Path, stream: IO[bytes], size: int) -> None:
    """Refuse compressed points that are cut off, or are not `size` bytes of them as the header says."""
    sizes = stream.read(8)
    compressed, expanded = np.frombuffer(sizes.ljust(8, b"\0"), dtype="<u4").tolist()
    if len(sizes) < 8 or compressed > _bytes_left(stream):
        raise InputError(f"{path}: ends before its compressed points do; copy it again, it is cut off.")
    if expanded != size:
        raise InputError(
            f"{path}: holds {expanded} bytes of points and not {size} as its header says; export it again."
        )


def _bytes_left(stream: IO[bytes]) -> int:
    return os.fstat(stream.fileno()).st_size - stream.tell()


def _require_count(path: Path, found: int, promised: int) -> None:
    if found < promised:
        raise InputError(f"{path}: ends after {found} of {promised} points; copy it again, it is cut off.")


def _table(path: Path, names: list[str], columns: Any, float32: bool) -> PointTable:
    by_meaning = {_COLUMN_OF_NAME.get(name.lower(), name.lower()): name for name in reversed(names)}
    missing = [axis for axis in "xyz" if axis not in by_meaning]
    if missing:
        raise InputError(f"{path}: has no column {' and '.join(missing)}; its columns are {', '.join(names)}.")

    def column(meaning: str) -> NDArray[Any]:
        return np.asarray(columns[by_meaning[meaning]])

    xyz = np.stack([column(axis).astype(np.float64) for axis in "xyz"], axis=1)
    rgb = None
    if {"red", "green", "blue"} <= by_meaning.keys():
        rgb = np.stack([column(channel) for channel in ("red", "green", "blue")], axis=1)
    intensity = column("intensity").astype(np.float32) if "intensity" in by_meaning else None
    return PointTable(xyz, rgb, intensity, float32)
