"""GPS records: text with a header line and one position a line, as receivers and spreadsheets write them."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from core.clock_times import EXAMPLES, ClockTime, finite, read_time, seconds
from core.coordinates import LARGEST_M, Floats, read_only
from core.errors import InputError
from core.project import GpsInput
from core.text_files import decoded

# Samples a record may lack: about six days at 10 Hz. Laid out evenly they take a gigabyte when they are correlated.
_MOST_MISSING = 5_000_000
_DECIMAL_COMMA = re.compile(r"([-+]?\d*),(\d+)")


@dataclass(frozen=True)
class GpsRecord:
    """Positions of an antenna on the target.

    Attributes:
        name: of the file with its folder, for messages.
        time_s: (G,) increasing, the receiver's own clock.
        position_m: (G, 2) east and north, any origin.
    """

    name: str
    time_s: Floats
    position_m: Floats


@dataclass(frozen=True)
class _Lines:
    """The lines of a record that carry something.

    Attributes:
        names: of its columns.
        separator: between the columns; None for blanks.
        rows: number and text of each line below the names.
    """

    path: Path
    names: list[str]
    separator: str | None
    rows: list[tuple[int, str]]

    def place_of(self, key: str, name: str) -> int:
        """Return which column `inputs.gps.<key>` names.

        Raises:
            InputError: none, or several.
        """
        if self.names.count(name) == 1:
            return self.names.index(name)
        if name in self.names:
            raise InputError(f'{self.path}: has several columns "{name}"; give each a name of its own.')
        found = ", ".join(f'"{column}"' for column in self.names)
        raise InputError(
            f'{self.path}: has no column "{name}" (found {found}); name the right one in inputs.gps.{key} of '
            "project.json."
        )

    def fields(self, number: int, text: str) -> list[str]:
        """Return what a line holds, an empty text for each column that it lacks.

        Raises:
            InputError: it holds more than there are names.
        """
        fields = _split(self.path, number, text, self.separator)
        if any(fields[len(self.names) :]):
            raise InputError(
                f"{self.path}: line {number}: holds {len(fields)} values under {len(self.names)} names of columns; "
                "write numbers with decimal points, and a name over each column."
            )
        return fields + [""] * (len(self.names) - len(fields))


def read_gps(path: Path, settings: GpsInput) -> GpsRecord:
    """Read a GPS record: text with a header line and one position a line.

    Columns are separated by commas, semicolons, tabs or blanks; other columns, empty lines and lines that start with #
    are passed over. Times are seconds, or dates and times of day, which count from the first. Where commas separate no
    columns, numbers may have decimal commas.

    Raises:
        InputError: names the file, and the missing column or the line at fault.
    """
    lines = _content_lines(path)
    places = {key: lines.place_of(key, getattr(settings, key)) for key in ("time", "x", "y")}
    if len(set(places.values())) < len(places):
        raise InputError(
            f"{path}: inputs.gps of project.json takes two of time, x and y from one column; name three columns."
        )
    rows = [_row(lines, number, text, places=list(places.values())) for number, text in lines.rows]
    if len(rows) < 4:
        raise InputError(f"{path}: has {len(rows)} positions; at least four are needed for a comparison.")
    moments, positions = zip(*rows, strict=True)
    _require_one_notation(lines, settings.time, moments)
    time_s = seconds(moments)
    backwards = np.flatnonzero(np.diff(time_s) <= 0)
    if len(backwards):
        before = int(backwards[0])
        raise InputError(
            f'{path}: line {lines.rows[before + 1][0]}: "{settings.time}" is {time_s[before + 1]:.12g}, not after the '
            f"line before ({time_s[before]:.12g}); sort the record and remove what is double."
        )
    _require_one_stretch(lines, time_s)
    return GpsRecord(str(path), read_only(time_s), read_only(positions))


def _require_one_notation(lines: _Lines, name: str, moments: Sequence[ClockTime]) -> None:
    """Refuse times of which some are written in another way than the first."""
    first = moments[0].notation
    for moment, (number, _) in zip(moments, lines.rows, strict=True):
        if moment.notation is not first:
            raise InputError(
                f'{lines.path}: line {number}: "{name}" is {moment.notation}, but {first} in the lines before; '
                "write all alike."
            )


def _require_one_stretch(lines: _Lines, time_s: Floats) -> None:
    """Refuse times that jump so far that no even grid over them fits into memory, as from 0 to Unix seconds."""
    steps_s = np.diff(time_s)
    usual_s = float(np.median(steps_s))
    if (time_s[-1] - time_s[0]) / usual_s - len(steps_s) <= _MOST_MISSING:
        return
    widest = int(np.argmax(steps_s))
    raise InputError(
        f"{lines.path}: line {lines.rows[widest + 1][0]}: its time is {steps_s[widest]:g} s after that of the line "
        f"before, {time_s[widest]:g} s, while most are {usual_s:g} s apart; correct the times, or keep only the "
        "stretch of this video."
    )


def gps_columns(path: Path) -> list[str]:
    """Return the names of a GPS record's columns, to choose time and place from.

    Raises:
        InputError: the file cannot be read as text, or is empty.
    """
    return _content_lines(path).names


def _content_lines(path: Path) -> _Lines:
    try:
        text = decoded(path.read_bytes())
    except FileNotFoundError:
        raise InputError(
            f"{path}: not found; correct inputs.gps.file of project.json or set inputs.gps to null."
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); make it accessible, or choose another.") from None
    except ValueError as error:
        raise InputError(f"{path}: cannot be read as text ({error}); export the GPS record as CSV.") from None
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise InputError(f"{path}: is empty; export the GPS record again as CSV with a header line.")
    (first, header), *rows = lines
    separator = max(",;\t", key=header.count)
    divided_by = separator if separator in header else None
    return _Lines(path, _split(path, first, header, divided_by), divided_by, rows)


def _split(path: Path, number: int, text: str, separator: str | None) -> list[str]:
    if separator is None:
        return text.split()
    try:
        return [field.strip() for field in next(csv.reader([text], delimiter=separator))]
    except csv.Error as error:
        raise InputError(f"{path}: line {number}: is no line of a table ({error}); correct or remove it.") from None


def _row(lines: _Lines, number: int, text: str, *, places: list[int]) -> tuple[ClockTime, tuple[float, float]]:
    """Return the time and the position in a line."""
    fields = lines.fields(number, text)
    if lines.separator != ",":
        fields = [_with_decimal_point(field) for field in fields]

    def refusal(place: int, wanted: str) -> InputError:
        field = fields[place]
        what = f'"{field}", not {wanted}' if field else "empty"
        return InputError(f'{lines.path}: line {number}: "{lines.names[place]}" is {what}; correct or remove the line.')

    time_place, *position_places = places
    try:
        moment = read_time(fields[time_place])
    except ValueError:
        raise refusal(time_place, f"a number or a time such as {EXAMPLES}") from None
    position = []
    for place in position_places:
        try:
            position.append(finite(fields[place]))
        except ValueError:
            raise refusal(place, "a number") from None
        if abs(position[-1]) > LARGEST_M:
            raise refusal(place, "a coordinate in metres")
    return moment, (position[0], position[1])


def _with_decimal_point(field: str) -> str:
    """Return a number with a decimal comma with a point instead, and anything else as it is."""
    number = _DECIMAL_COMMA.fullmatch(field)
    return ".".join(number.groups()) if number else field
