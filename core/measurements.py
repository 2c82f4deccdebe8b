"""`results/frames.sqlite`: what one pass over the video measured, in raw pixels, committed as it comes.

A *recording* belongs to one method and one fingerprint of everything that decides what is measured (video, reference
frame, moving regions, bands). Geometry, clicks, lens and intervals are not among it: they are applied when solving.
"""

from __future__ import annotations

import json
import sqlite3
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.apparent import Apparent
from core.coordinates import Floats
from core.errors import InputError

# At most this much work is lost when the machine stops.
COMMIT_EVERY_S = 0.8
_SCHEMA = """
CREATE TABLE IF NOT EXISTS recordings (
    id INTEGER PRIMARY KEY, method TEXT NOT NULL, fingerprint TEXT NOT NULL, finished INTEGER NOT NULL DEFAULT 0,
    targets TEXT NOT NULL, reference BLOB NOT NULL, UNIQUE (method, fingerprint));
CREATE TABLE IF NOT EXISTS frames (
    recording INTEGER NOT NULL REFERENCES recordings(id) ON DELETE CASCADE, frame INTEGER NOT NULL,
    time_s REAL NOT NULL, measured BLOB NOT NULL, PRIMARY KEY (recording, frame)) WITHOUT ROWID;
"""


# How SQLite's complaints begin where a file's tables are not these.
_OTHER_TABLES = "no such"


@dataclass(frozen=True)
class Reference:
    """What is looked for, as found in the reference frame, raw pixels.

    Attributes:
        ground_raw: (N, 2) ground features.
        targets_raw: per target, (L, S, 2, 2) edges of lines or (M, 2) patches of points.
        texture_raw: per target, (M, 2) patches about its lines; none of a target that is not named.
    """

    ground_raw: Floats
    targets_raw: Mapping[str, Floats]
    texture_raw: Mapping[str, Floats] = field(default_factory=dict)


@dataclass(frozen=True)
class FrameMeasurement:
    """What one frame showed.

    Attributes:
        H_ray_ray0: (3, 3) homography of the ground from the reference frame; nan where the ground was not recognised.
        ground_raw: (N, 2), nan where a feature was not found.
        targets_raw, texture_raw: as in `Reference`, nan where not found.
        apparent: each target's apparent motion, None where undetermined; a prediction, never a result.
    """

    frame: int
    time_s: float
    H_ray_ray0: Floats
    ground_raw: Floats
    targets_raw: Mapping[str, Floats]
    apparent: Mapping[str, Apparent | None]
    texture_raw: Mapping[str, Floats] = field(default_factory=dict)


@dataclass(frozen=True)
class Recording:
    """All frames measured so far, in presentation order, as arrays (F, ...)."""

    method: str
    finished: bool
    reference: Reference
    frame: NDArray[np.int64]
    time_s: Floats
    H_ray_ray0: Floats
    ground_raw: Floats
    targets_raw: Mapping[str, Floats]
    texture_raw: Mapping[str, Floats] = field(default_factory=dict)

    def texture_of(self, name: str) -> Floats:
        """Return the patches about the lines of a target, (F, M, 2); none where none were looked for."""
        return self.texture_raw.get(name, np.empty((len(self.frame), 0, 2)))

    def selected(self, chosen: NDArray[np.int64]) -> Recording:
        """Return some of the frames, by their place (M,) in these arrays."""
        return replace(
            self,
            frame=self.frame[chosen],
            time_s=self.time_s[chosen],
            H_ray_ray0=self.H_ray_ray0[chosen],
            ground_raw=self.ground_raw[chosen],
            targets_raw={name: raw[chosen] for name, raw in self.targets_raw.items()},
            texture_raw={name: raw[chosen] for name, raw in self.texture_raw.items()},
        )


class MeasurementStore:
    """The open file; one writer at a time.

    Raises:
        InputError: the file exists and is something else, or is damaged where it is read; when writing, there is no
            room for more.
    """

    def __init__(self, file: Path) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        self._file = file
        with ExitStack() as opening:
            try:
                self._db = opening.enter_context(closing(sqlite3.connect(file, timeout=20.0)))
                self._db.execute("PRAGMA foreign_keys = ON")
                self._db.executescript(_SCHEMA)
            except sqlite3.OperationalError as error:
                raise InputError(
                    f"{file}: cannot be opened ({error}); make room for it, or move away what is in its place."
                ) from None
            except sqlite3.DatabaseError as error:
                raise self._damaged(error) from None
            opening.pop_all()
        self._last_commit = time.monotonic()

    def __enter__(self) -> MeasurementStore:
        return self

    def __exit__(self, *_: object) -> None:
        with closing(self._db):
            self.commit()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:
            if _OTHER_TABLES in str(error):
                raise self._damaged(error) from None
            raise InputError(
                f"{self._file}: cannot be written ({error}); see that its folder is still there, make room on its disk "
                "and run again, which goes on from what is there."
            ) from None
        except sqlite3.DatabaseError as error:
            raise self._damaged(error) from None

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.DatabaseError, zlib.error, ValueError) as error:
            if isinstance(error, sqlite3.OperationalError) and _OTHER_TABLES not in str(error):
                raise InputError(
                    f"{self._file}: cannot be read ({error}); see that it is still there, then do it again."
                ) from None
            raise self._damaged(error) from None

    def _damaged(self, error: Exception) -> InputError:
        return InputError(f"{self._file}: is not readable ({error}); delete it, it can be measured again.")

    def require_readable(self) -> None:
        """See whether the file is whole and its tables are these.

        Raises:
            InputError: it is not.
        """
        with self._reading():
            (said,) = self._db.execute("PRAGMA quick_check(1)").fetchone()
            if said != "ok":
                raise sqlite3.DatabaseError(said)
            self._db.execute("SELECT id, method, fingerprint, finished, targets, reference FROM recordings LIMIT 0")
            self._db.execute("SELECT recording, frame, time_s, measured FROM frames LIMIT 0")

    def find(self, method: str, fingerprint: str) -> int | None:
        """Return the number of a recording, or None."""
        query = "SELECT id FROM recordings WHERE method = ? AND fingerprint = ?"
        with self._reading():
            row = self._db.execute(query, (method, fingerprint)).fetchone()
        return None if row is None else int(row[0])

    def begin(self, method: str, fingerprint: str, reference: Reference) -> int:
        """Start a recording, taking the place of earlier ones of the same method; return its number."""
        names = list(reference.targets_raw)
        arrays = [reference.ground_raw, *_by_target(names, reference)]
        with self._writing(), self._db:
            self._db.execute("DELETE FROM recordings WHERE method = ?", (method,))
            cursor = self._db.execute(
                "INSERT INTO recordings (method, fingerprint, targets, reference) VALUES (?, ?, ?, ?)",
                (method, fingerprint, json.dumps(names), _packed(arrays)),
            )
        return int(cursor.lastrowid or 0)

    def append(self, recording: int, measured: FrameMeasurement) -> None:
        """Add a frame; it is safe on disk within a second."""
        names = list(measured.targets_raw)
        states = [_state(measured.apparent[name]) for name in names]
        arrays = [measured.ground_raw, *_by_target(names, measured)]
        blob = np.concatenate([measured.H_ray_ray0.ravel(), *states]).astype("<f8").tobytes() + _packed(arrays)
        with self._writing():
            self._db.execute(
                "INSERT OR REPLACE INTO frames (recording, frame, time_s, measured) VALUES (?, ?, ?, ?)",
                (recording, measured.frame, measured.time_s, blob),
            )
        if time.monotonic() - self._last_commit > COMMIT_EVERY_S:
            self.commit()

    def commit(self) -> None:
        """Make everything appended so far safe."""
        with self._writing():
            self._db.commit()
        self._last_commit = time.monotonic()

    def finish(self, recording: int) -> None:
        """Mark a recording as complete."""
        with self._writing(), self._db:
            self._db.execute("UPDATE recordings SET finished = 1 WHERE id = ?", (recording,))

    def is_finished(self, recording: int) -> bool:
        """Whether the whole video has been measured."""
        with self._reading():
            row = self._db.execute("SELECT finished FROM recordings WHERE id = ?", (recording,)).fetchone()
        return bool(row and row[0])

    def measured_frames(self, recording: int) -> list[int]:
        """Return the numbers of the frames measured so far, ascending."""
        with self._reading():
            rows = self._db.execute("SELECT frame FROM frames WHERE recording = ? ORDER BY frame", (recording,))
            return [int(row[0]) for row in rows]

    def reference(self, recording: int) -> Reference:
        """Return what the recording looks for."""
        query = "SELECT targets, reference FROM recordings WHERE id = ?"
        with self._reading():
            names, blob = self._db.execute(query, (recording,)).fetchone()
            ground, *by_target = _unpacked(blob)
            return Reference(ground, *_named(json.loads(names), by_target))

    def frame(self, recording: int, frame: int) -> FrameMeasurement | None:
        """Return one frame, or None."""
        query = "SELECT frame, time_s, measured FROM frames WHERE recording = ? AND frame = ?"
        names = list(self.reference(recording).targets_raw)
        with self._reading():
            row = self._db.execute(query, (recording, frame)).fetchone()
            return None if row is None else _measurement(row, names)

    def load(self, recording: int, only: Sequence[int] | None = None) -> Recording:
        """Return everything measured so far, or what is measured of some frames only."""
        reference = self.reference(recording)
        names = list(reference.targets_raw)
        query = "SELECT frame, time_s, measured FROM frames WHERE recording = ?"
        if only is not None:
            query += " AND frame IN (SELECT value FROM json_each(?))"
        chosen = () if only is None else (json.dumps(list(only)),)
        with self._reading():
            rows = self._db.execute(f"{query} ORDER BY frame", (recording, *chosen))
            frames = [_measurement(row, names) for row in rows]
            method = self._db.execute("SELECT method FROM recordings WHERE id = ?", (recording,)).fetchone()[0]

        def stacked(rows: list[Floats], like: Floats) -> Floats:
            return np.array(rows).reshape(len(frames), *like.shape)

        return Recording(
            method=method,
            finished=self.is_finished(recording),
            reference=reference,
            frame=np.array([frame.frame for frame in frames], dtype=np.int64),
            time_s=np.array([frame.time_s for frame in frames]),
            H_ray_ray0=stacked([frame.H_ray_ray0 for frame in frames], np.eye(3)),
            ground_raw=stacked([frame.ground_raw for frame in frames], reference.ground_raw),
            targets_raw={
                name: stacked([frame.targets_raw[name] for frame in frames], like)
                for name, like in reference.targets_raw.items()
            },
            texture_raw={
                name: stacked([frame.texture_raw[name] for frame in frames], like)
                for name, like in reference.texture_raw.items()
            },
        )


def _by_target(names: Sequence[str], measured: Reference | FrameMeasurement) -> Iterator[Floats]:
    """Yield what is measured of every target, and then what about its lines."""
    yield from (measured.targets_raw[name] for name in names)
    yield from (measured.texture_raw.get(name, np.empty((0, 2))) for name in names)


def _named(names: Sequence[str], by_target: Sequence[Floats]) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Return what `_by_target` yielded, under the names of the targets."""
    targets, textures = by_target[: len(names)], by_target[len(names) :]
    return dict(zip(names, targets, strict=True)), dict(zip(names, textures, strict=True))


def _state(apparent: Apparent | None) -> Floats:
    if apparent is None:
        return np.full(3, np.nan)
    return np.array([*apparent.shift, apparent.rotation_rad])


def _measurement(row: tuple[int, float, bytes], names: list[str]) -> FrameMeasurement:
    frame, time_s, blob = row
    count = 9 + 3 * len(names)
    head = np.frombuffer(blob, dtype="<f8", count=count)
    ground, *by_target = _unpacked(blob[8 * count :])
    targets_raw, texture_raw = _named(names, by_target)
    states = head[9:].reshape(-1, 3)
    apparent = {
        name: Apparent(state[:2].copy(), float(state[2])) if np.isfinite(state).all() else None
        for name, state in zip(names, states, strict=True)
    }
    return FrameMeasurement(frame, time_s, head[:9].reshape(3, 3).copy(), ground, targets_raw, apparent, texture_raw)


def _packed(arrays: list[Floats]) -> bytes:
    """Pack arrays of raw pixels: 1/8192 px is far below what any of them is known to, and small when compressed."""
    shapes = json.dumps([array.shape for array in arrays]).encode()
    values = np.concatenate([array.ravel() for array in arrays]) if arrays else np.empty(0)
    ticks = np.where(np.isfinite(values), np.rint(np.nan_to_num(values) * 8192.0), np.iinfo(np.int32).min)
    return len(shapes).to_bytes(4, "little") + shapes + zlib.compress(ticks.astype("<i4").tobytes(), 1)


def _unpacked(blob: bytes) -> list[Floats]:
    size = int.from_bytes(blob[:4], "little")
    shapes = json.loads(blob[4 : 4 + size])
    ticks = np.frombuffer(zlib.decompress(blob[4 + size :]), dtype="<i4")
    values = np.where(ticks == np.iinfo(np.int32).min, np.nan, ticks / 8192.0)
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    return [part.reshape(shape) for part, shape in zip(np.split(values, ends[:-1]), shapes, strict=True)]


def discard_unreadable(file: Path) -> None:
    """Delete a file of measurements that can no longer be read, so that it can be made anew."""
    if not file.is_file():
        return
    try:
        with MeasurementStore(file) as store:
            store.require_readable()
    except InputError:
        file.unlink()
