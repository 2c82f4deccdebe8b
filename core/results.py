"""What a measurement leaves behind for people: displacement histories as CSV, and the summary.

A history is one row per frame, none missing. A frame that could not be measured keeps its status and has no
numbers: never a guess, never the last value.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.coordinates import Bools, Floats
from core.errors import InputError
from core.intervals import within
from core.project import Intervals
from core.storage import write_atomically


class Status(StrEnum):
    """How far a frame can be trusted."""

    OK = "ok"
    WEAK = "weak"  # measured, but from fewer ground or edge points than it should have
    LOST = "lost"  # could not be measured
    EXCLUDED = "excluded"  # rejected by a person


# From best to worst: what is made of two measurements is as good as the worse of them.
STATUS_ORDER = (Status.OK, Status.WEAK, Status.LOST, Status.EXCLUDED)
MEASURED = (Status.OK, Status.WEAK)

# Fields of a history in the order of the file's columns; a pair has one column for x and one for y.
_VECTORS = ("p1_m", "p2_m", "p1_sigma_m", "p2_sigma_m", "p1_raw_m", "p2_raw_m")
_ANGLES = ("rotation_rad", "rotation_sigma_rad", "rotation_raw_rad")
CSV_HEADER = (
    "frame,time_s,status,p1_dx_m,p1_dy_m,p2_dx_m,p2_dy_m,rotation_rad,"
    "p1_dx_sigma_m,p1_dy_sigma_m,p2_dx_sigma_m,p2_dy_sigma_m,rotation_sigma_rad,"
    "p1_dx_raw_m,p1_dy_raw_m,p2_dx_raw_m,p2_dy_raw_m,rotation_raw_rad"
)
# A tenth of a micrometre, a nanoradian, a microsecond: a thousandth of what a frame's own noise can tell apart.
_LENGTH_DECIMALS, _ANGLE_DECIMALS, _TIME_DECIMALS = 7, 9, 6


@dataclass(frozen=True)
class Displacement:
    """Of P1 and P2 (F, 2, 2), metres, and rotation (F,), radians; or one standard deviation of both."""

    places_m: Floats
    rotation_rad: Floats


@dataclass(frozen=True)
class TargetHistory:
    """Displacement of one target from rest, one row per frame in presentation order.

    World axes (x east, y north), metres at the target's height; rotation counter-clockwise seen from above.
    Numbers of lost and excluded frames are blanked on construction, whatever was passed.

    Attributes:
        name: of the target.
        frame: (F,) indices in presentation order.
        time_s: (F,) container timestamps, first frame 0.
        status: (F,) of `Status` words.
        p1_m, p2_m: (F, 2) displacement of P1 and P2 from rest.
        rotation_rad: (F,).
        p1_sigma_m, p2_sigma_m: (F, 2) one standard deviation of that frame's random error.
        rotation_sigma_rad: (F,).
        p1_raw_m, p2_raw_m: (F, 2) ground-stabilised, at the paper's scale, without any drift correction.
        rotation_raw_rad: (F,).
    """

    name: str
    frame: NDArray[np.int64]
    time_s: Floats
    status: NDArray[np.str_]
    p1_m: Floats
    p2_m: Floats
    rotation_rad: Floats
    p1_sigma_m: Floats
    p2_sigma_m: Floats
    rotation_sigma_rad: Floats
    p1_raw_m: Floats
    p2_raw_m: Floats
    rotation_raw_rad: Floats

    def __post_init__(self) -> None:
        """Copy, check the shapes, blank what was not measured and make the arrays read-only."""
        frame = np.array(self.frame, dtype=np.int64)
        status = np.array([str(word) for word in self.status], dtype="<U8")
        unknown = set(status.tolist()) - {str(word) for word in Status}
        if unknown:
            raise ValueError(f"unknown status {sorted(unknown)} in the history of {self.name!r}")
        count = len(frame)
        blank = ~np.isin(status, MEASURED)
        for name in ("time_s", *_VECTORS, *_ANGLES):
            array = np.array(getattr(self, name), dtype=np.float64)
            shape = (count, 2) if name in _VECTORS else (count,)
            if array.shape != shape:
                raise ValueError(f"{name} of {self.name!r} has shape {array.shape}, expected {shape}")
            if name != "time_s":
                array[blank] = np.nan
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if status.shape != (count,):
            raise ValueError(f"status of {self.name!r} has shape {status.shape}, expected ({count},)")
        empty = frame[~blank & ~np.isfinite(self.p1_m).all(axis=1)]
        if len(empty):
            raise ValueError(f"frame {empty[0]} of {self.name!r} counts as measured but has no P1")
        frame.flags.writeable = status.flags.writeable = False
        object.__setattr__(self, "frame", frame)
        object.__setattr__(self, "status", status)

    @classmethod
    def of(
        cls,
        name: str,
        *,
        frame: NDArray[np.int64],
        time_s: Floats,
        status: NDArray[np.str_],
        value: Displacement,
        sigma: Displacement,
        raw: Displacement,
    ) -> Self:
        """Return the history of a target from its displacement, that one's standard deviation, and the raw one."""
        return cls(
            name=name,
            frame=frame,
            time_s=time_s,
            status=status,
            p1_m=value.places_m[:, 0],
            p2_m=value.places_m[:, 1],
            rotation_rad=value.rotation_rad,
            p1_sigma_m=sigma.places_m[:, 0],
            p2_sigma_m=sigma.places_m[:, 1],
            rotation_sigma_rad=sigma.rotation_rad,
            p1_raw_m=raw.places_m[:, 0],
            p2_raw_m=raw.places_m[:, 1],
            rotation_raw_rad=raw.rotation_rad,
        )

    @property
    def measured(self) -> Bools:
        """(F,) which frames have numbers: `ok` and `weak`."""
        return np.asarray(np.isin(self.status, MEASURED), dtype=np.bool_)

    def counts(self) -> dict[str, int]:
        """Number of frames of each status, all four named."""
        return {str(word): int(np.count_nonzero(self.status == str(word))) for word in STATUS_ORDER}


def relative_history(
    history: TargetHistory, base: TargetHistory, *, rest_m: ArrayLike, base_rest_m: ArrayLike
) -> TargetHistory:
    """Return the displacement of a target relative to another one: roof minus table, a storey minus the one below.

    Each point of the target loses the motion the base would give *to that same place* as a rigid body: the mean
    displacement of the base's P1 and P2, and its rotation about their middle. Without the rotation a base turning
    by 1 mrad would leave 10 mm at a roof point 10 m from it. Axes stay those of the world.

    The variances are added as if the errors of target and base were independent. Both share the frame's camera
    pose, so this errs on the large side.

    Args:
        history: of the target.
        base: of what it is measured against, on the same frames.
        rest_m: (2, 2) P1 and P2 of the target at rest, world metres.
        base_rest_m: (2, 2) P1 and P2 of the base at rest, world metres.

    Returns:
        A history under the target's name; a frame is as good as the worse of the two.

    Raises:
        ValueError: the histories are not of the same frames.
    """
    if not np.array_equal(history.frame, base.frame):
        raise ValueError(f"{history.name!r} and {base.name!r} are not histories of the same frames")
    arms_m = np.asarray(rest_m, dtype=np.float64) - np.asarray(base_rest_m, dtype=np.float64).mean(axis=0)
    rank = {str(word): place for place, word in enumerate(STATUS_ORDER)}
    worse = [
        max(pair, key=rank.__getitem__) for pair in zip(history.status.tolist(), base.status.tolist(), strict=True)
    ]
    moved = [_carried(base.p1_m, base.p2_m, base.rotation_rad, arm) for arm in arms_m]
    moved_raw = [_carried(base.p1_raw_m, base.p2_raw_m, base.rotation_raw_rad, arm) for arm in arms_m]
    middle_variance = (base.p1_sigma_m**2 + base.p2_sigma_m**2) / 4
    turned = [np.abs(arm[::-1]) * base.rotation_sigma_rad[:, None] for arm in arms_m]
    return TargetHistory(
        name=history.name,
        frame=history.frame,
        time_s=history.time_s,
        status=np.array(worse),
        p1_m=history.p1_m - moved[0],
        p2_m=history.p2_m - moved[1],
        rotation_rad=history.rotation_rad - base.rotation_rad,
        p1_sigma_m=np.sqrt(history.p1_sigma_m**2 + middle_variance + turned[0] ** 2),
        p2_sigma_m=np.sqrt(history.p2_sigma_m**2 + middle_variance + turned[1] ** 2),
        rotation_sigma_rad=np.hypot(history.rotation_sigma_rad, base.rotation_sigma_rad),
        p1_raw_m=history.p1_raw_m - moved_raw[0],
        p2_raw_m=history.p2_raw_m - moved_raw[1],
        rotation_raw_rad=history.rotation_raw_rad - base.rotation_raw_rad,
    )


def displacement_at(history: TargetHistory, *, rest_m: ArrayLike, at_m: ArrayLike) -> Floats:
    """Return the displacement of any place on a target, such as a GPS antenna, by its rigid motion.

    Args:
        history: of the target.
        rest_m: (2, 2) P1 and P2 at rest, world metres.
        at_m: (2,) the place at rest, world metres.

    Returns:
        (F, 2) metres, NaN where not measured.
    """
    arm_m = np.asarray(at_m, dtype=np.float64) - np.asarray(rest_m, dtype=np.float64).mean(axis=0)
    return _carried(history.p1_m, history.p2_m, history.rotation_rad, arm_m)


def _carried(p1_m: Floats, p2_m: Floats, rotation_rad: Floats, arm_m: Floats) -> Floats:
    """Return (F, 2) how far a rigid body carries the place at `arm_m` (2,) from the middle of its P1 and P2."""
    less_cosine, sine = 1 - np.cos(rotation_rad), np.sin(rotation_rad)
    turned = np.stack(
        [-less_cosine * arm_m[0] - sine * arm_m[1], sine * arm_m[0] - less_cosine * arm_m[1]],
        axis=1,
    )
    return np.asarray((p1_m + p2_m) / 2 + turned, dtype=np.float64)


def write_history_csv(path: Path, history: TargetHistory) -> None:
    """Write `results/<target>.csv` atomically; the same history gives the same bytes."""
    columns: list[list[str]] = [
        [str(number) for number in history.frame.tolist()],
        _texts(history.time_s, _TIME_DECIMALS),
        history.status.tolist(),
    ]
    for suffix in ("", "_sigma", "_raw"):
        for point in ("p1", "p2"):
            vectors = getattr(history, f"{point}{suffix}_m")
            columns += [_texts(vectors[:, axis], _LENGTH_DECIMALS) for axis in (0, 1)]
        columns.append(_texts(getattr(history, f"rotation{suffix}_rad"), _ANGLE_DECIMALS))
    rows = [",".join(row) for row in zip(*columns, strict=True)]
    write_atomically(path, ("\n".join([CSV_HEADER, *rows]) + "\n").encode())


def _texts(values: Floats, decimals: int) -> list[str]:
    # Adding zero turns the -0.0 that rounding leaves into 0.0.
    rounded = (np.round(values, decimals) + 0.0).tolist()
    return [f"{value:.{decimals}f}" if math.isfinite(value) else "" for value in rounded]


def read_history_csv(path: Path) -> TargetHistory:
    """Read a displacement history back; the target is named by the file.

    Raises:
        InputError: the file is missing or is no such history, with the line at fault.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: not found; measure the project with `rooftrack run` first.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); measure the project again.") from None
    rows = list(csv.reader(io.StringIO(text)))
    if not rows or ",".join(rows[0]) != CSV_HEADER:
        raise InputError(f"{path}: line 1 is not the header of a displacement history; measure the project again.")
    numbers, statuses = _parsed_rows(path, rows[1:])
    vector = {name: numbers[:, [place, place + 1]] for name, place in zip(_VECTORS, (2, 4, 7, 9, 12, 14), strict=True)}
    angle = {name: numbers[:, place] for name, place in zip(_ANGLES, (6, 11, 16), strict=True)}
    try:
        return TargetHistory(
            name=path.stem,
            frame=numbers[:, 0].astype(np.int64),
            time_s=numbers[:, 1],
            status=np.array(statuses, dtype=np.str_),
            **vector,
            **angle,
        )
    except ValueError as error:
        raise InputError(f"{path}: {error}; measure the project again.") from None


def _parsed_rows(path: Path, rows: list[list[str]]) -> tuple[Floats, list[str]]:
    """Return (F, 17) of all columns but `status`, and the statuses."""
    width = CSV_HEADER.count(",") + 1
    numbers = np.full((len(rows), width - 1), np.nan)
    for number, row in enumerate(rows):
        place = f"{path}: line {number + 2}"
        if len(row) != width:
            raise InputError(f"{place} has {len(row)} fields instead of {width}; measure the project again.")
        try:
            numbers[number] = [float(field) if field else math.nan for field in (*row[:2], *row[3:])]
        except ValueError as error:
            raise InputError(f"{place}: {error}; measure the project again.") from None
        if not np.isfinite(numbers[number, :2]).all():
            raise InputError(f"{place} has no frame number or no time; measure the project again.")
    return numbers, [row[2] for row in rows]


def summarise(history: TargetHistory, intervals: Intervals) -> dict[str, Any]:
    """Return a target's rows of `summary.json`; P1 at the top, P2 likewise under `p2`.

    Peaks are the extremes within the event, or within the whole video where no event is given. What cannot be
    told (no such interval, nothing measured in it) is None.
    """
    return {
        **_point_rows(history, history.p1_m, intervals),
        "p2": _point_rows(history, history.p2_m, intervals),
        "rotation_peak_rad": _largest(np.abs(history.rotation_rad[within(history.time_s, intervals.event)])),
        "sigma_median_m": _per_axis(np.nanmedian, history.p1_sigma_m),
        "counts": history.counts(),
    }


def _point_rows(history: TargetHistory, values_m: Floats, intervals: Intervals) -> dict[str, Any]:
    event = within(history.time_s, intervals.event)
    rows: dict[str, Any] = {
        "peak_positive_m": _peak(history.time_s[event], values_m[event], sign=1),
        "peak_negative_m": _peak(history.time_s[event], values_m[event], sign=-1),
        "residual_m": None,
        "pre_event_rms_m": None,
    }
    if intervals.residual is not None:
        rows["residual_m"] = _per_axis(np.nanmean, values_m[within(history.time_s, intervals.residual)])
    if intervals.pre_event is not None:
        rows["pre_event_rms_m"] = _per_axis(_rms, values_m[within(history.time_s, intervals.pre_event)])
    return rows


def _peak(time_s: Floats, values_m: Floats, *, sign: int) -> dict[str, dict[str, float] | None]:
    peaks: dict[str, dict[str, float] | None] = {}
    for axis, name in enumerate("xy"):
        values = values_m[:, axis]
        if not np.isfinite(values).any():
            peaks[name] = None
            continue
        place = int(np.nanargmax(sign * values))
        peaks[name] = {"value": float(values[place]), "time_s": float(time_s[place])}
    return peaks


def _per_axis(measure: Any, values: Floats) -> dict[str, float] | None:
    if not np.isfinite(values).any(axis=0).all():
        return None
    return {name: float(measure(values[:, axis])) for axis, name in enumerate("xy")}


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _largest(values: Floats) -> float | None:
    return float(np.nanmax(values)) if np.isfinite(values).any() else None


def write_summary(path: Path, summary: Mapping[str, Any]) -> None:
    """Write `summary.json` atomically; arrays become lists, and numbers that do not exist become null."""
    text = json.dumps(plain(summary), indent=2, ensure_ascii=False, allow_nan=False)
    write_atomically(path, (text + "\n").encode())


def plain(value: Any) -> Any:
    """Return a value as JSON knows it: dataclasses by field, arrays as lists, nan and infinity as null."""
    if isinstance(value, np.ndarray):
        return _listed(value)
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Path):
        return value.as_posix()
    return value


def _listed(array: NDArray[Any]) -> Any:
    """Return an array as lists; number by number only where one of them does not exist."""
    if array.dtype.kind != "f" or np.isfinite(array).all():
        return array.tolist()
    boxed = array.astype(object)
    boxed[~np.isfinite(array)] = None
    return boxed.tolist()
