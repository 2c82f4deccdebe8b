"""Times as receivers write them: numbers of seconds, dates with times of day, or times of day alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, time, timedelta
from enum import StrEnum

import numpy as np

from core.coordinates import Floats

MICROSECOND = timedelta(microseconds=1)
DAY_US = timedelta(days=1) // MICROSECOND
EXAMPLES = "2026-03-01T12:00:00.250Z or 12:00:00.250"


class Notation(StrEnum):
    """How a time is written, in words."""

    SECONDS = "a number"
    DATE = "a date and time"
    ZONED_DATE = "a date and time with its time zone"
    TIME_OF_DAY = "a time of day"


@dataclass(frozen=True)
class ClockTime:
    """One time: seconds as they stand, or microseconds since midnight or since a date that all share."""

    notation: Notation
    value: float


def read_time(text: str) -> ClockTime:
    """Return what a text says.

    Raises:
        ValueError: it is no finite number, no ISO 8601 date and time and no time of day.
    """
    try:
        return ClockTime(Notation.SECONDS, finite(text))
    except ValueError:
        pass
    try:
        of_day = time.fromisoformat(text)
    except ValueError:
        moment = datetime.fromisoformat(text)
        notation = Notation.DATE if moment.tzinfo is None else Notation.ZONED_DATE
        since = moment.replace(tzinfo=moment.tzinfo or UTC) - datetime(1970, 1, 1, tzinfo=UTC)
        return ClockTime(notation, since // MICROSECOND)
    since = timedelta(hours=of_day.hour, minutes=of_day.minute, seconds=of_day.second, microseconds=of_day.microsecond)
    return ClockTime(Notation.TIME_OF_DAY, since // MICROSECOND)


def finite(text: str) -> float:
    """Return the number that a text says.

    Raises:
        ValueError: it says none, or an infinite one.
    """
    value = float(text)
    if not np.isfinite(value):
        raise ValueError(f"{text} is not finite")
    return value


def seconds(times: Sequence[ClockTime]) -> Floats:
    """Return times of one notation in seconds (N,): as they stand, or since the first, over midnight too."""
    values = [each.value for each in times]
    if times[0].notation is Notation.SECONDS:
        return np.array(values, dtype=np.float64)
    since_first = np.array(values, dtype=np.int64) - int(values[0])
    if times[0].notation is Notation.TIME_OF_DAY:
        # A step back by more than half a day is a step over midnight.
        midnights = np.cumsum(np.diff(since_first, prepend=0) < -DAY_US // 2)
        since_first = since_first + DAY_US * midnights
    return np.asarray(since_first / 1e6, dtype=np.float64)
