"""Every saved state of a project, so that undo survives a reload, a crash and a restart.

`history.sqlite` lies beside `project.json`, which stays the truth: where the two differ, somebody edited the
file by hand, and that becomes a state of its own.
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from core.errors import InputError

HISTORY_FILE = "history.sqlite"
# What a history that SQLite cannot read is moved to.
DAMAGED_FILE = "history.sqlite.damaged"
# At 20 kB a state this is some 20 MB at most; an afternoon of clicking is a few hundred states.
STATES_KEPT = 1000
OUTSIDE_LABEL = "changed outside"

_SCHEMA = """
CREATE TABLE IF NOT EXISTS states (position INTEGER PRIMARY KEY, label TEXT, saved_s REAL, document TEXT);
CREATE TABLE IF NOT EXISTS head (only INTEGER PRIMARY KEY CHECK (only = 1), position INTEGER, revision INTEGER);
"""


@dataclass(frozen=True)
class Head:
    """Where the project stands in its history.

    Attributes:
        revision: grows with every change of `project.json`, undo and redo among them.
        undo_label, redo_label: what would be undone or redone; None where there is nothing.
    """

    revision: int
    undo_label: str | None
    redo_label: str | None


@dataclass(frozen=True)
class Entry:
    """One saved state."""

    position: int
    label: str
    saved_s: float


class History:
    """The states of one project. Not safe for threads: its owner holds a lock."""

    def __init__(self, file: Path) -> None:
        self._file = file

    def follow(self, document: str) -> Head:
        """Return the head for what `project.json` holds now, first taking note of an edit made outside."""
        with self._open() as database:
            position, _ = _head(database)
            if _document(database, position) != document:
                _append(database, OUTSIDE_LABEL if position else "created", document)
            return _describe(database)

    def record(self, label: str, document: str, *, merge: bool = False) -> Head:
        """Append a state, dropping those that were undone; `merge` replaces the newest where its label is the same."""
        with self._open() as database:
            position, _ = _head(database)
            newest = database.execute("SELECT label FROM states WHERE position = ?", (position,)).fetchone()
            ahead = database.execute("SELECT 1 FROM states WHERE position > ?", (position,)).fetchone()
            if merge and newest == (label,) and position > 1 and not ahead:
                database.execute(
                    "UPDATE states SET document = ?, saved_s = ? WHERE position = ?", (document, time.time(), position)
                )
                database.execute("UPDATE head SET revision = revision + 1")
            else:
                _append(database, label, document)
            return _describe(database)

    def neighbour(self, step: int) -> str | None:
        """Return the document one undo (-1) or one redo (+1) away, or None."""
        with self._open() as database:
            position, _ = _head(database)
            return _document(database, position + step)

    def move(self, step: int) -> Head:
        """Go one state back (-1) or forward (+1), once `project.json` holds it."""
        with self._open() as database:
            database.execute("UPDATE head SET position = position + ?, revision = revision + 1", (step,))
            return _describe(database)

    def entries(self) -> tuple[list[Entry], int]:
        """Return all states, oldest first, and the position of the one that holds now."""
        with self._open() as database:
            rows = database.execute("SELECT position, label, saved_s FROM states ORDER BY position").fetchall()
            return [Entry(*row) for row in rows], _head(database)[0]

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        try:
            with closing(self._connected()) as database, database:
                yield database
        except sqlite3.Error as error:
            if self._set_aside(error):
                raise InputError(f"{self._file}: was damaged and has begun anew; load the page again.") from None
            raise InputError(
                f"{self._file}: cannot be used ({error}); see that it may be written and the disk has room."
            ) from None

    def _connected(self) -> sqlite3.Connection:
        """Return the database, begun anew where the file is none: a project is more than its history."""
        try:
            return _connected(self._file)
        except sqlite3.Error as error:
            if not self._set_aside(error):
                raise
            return _connected(self._file)

    def _set_aside(self, error: sqlite3.Error) -> bool:
        """Move the file out of the way if the error says that it is damaged; return whether it does."""
        # The lowest byte is the kind of error, what lies above only its details.
        damaged = getattr(error, "sqlite_errorcode", 0) & 0xFF in (sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT)
        if damaged:
            os.replace(self._file, self._file.with_name(DAMAGED_FILE))
        return damaged


def _connected(file: Path) -> sqlite3.Connection:
    database = sqlite3.connect(file, timeout=10.0)
    try:
        database.executescript(_SCHEMA)
    except sqlite3.Error:
        database.close()
        raise
    return database


def _head(database: sqlite3.Connection) -> tuple[int, int]:
    row = database.execute("SELECT position, revision FROM head").fetchone()
    return (int(row[0]), int(row[1])) if row else (0, 0)


def _document(database: sqlite3.Connection, position: int) -> str | None:
    row = database.execute("SELECT document FROM states WHERE position = ?", (position,)).fetchone()
    return str(row[0]) if row else None


def _append(database: sqlite3.Connection, label: str, document: str) -> None:
    position, revision = _head(database)
    database.execute("DELETE FROM states WHERE position > ?", (position,))
    database.execute("INSERT INTO states VALUES (?, ?, ?, ?)", (position + 1, label, time.time(), document))
    database.execute("INSERT OR REPLACE INTO head VALUES (1, ?, ?)", (position + 1, revision + 1))
    database.execute("DELETE FROM states WHERE position <= ?", (position + 1 - STATES_KEPT,))


def _describe(database: sqlite3.Connection) -> Head:
    position, revision = _head(database)
    labels = dict(database.execute("SELECT position, label FROM states WHERE position >= ?", (position - 1,)))
    undo = labels[position] if position - 1 in labels else None
    return Head(revision=revision, undo_label=undo, redo_label=labels.get(position + 1))
