"""One process at a time: a lock that the operating system lets go of, however its owner ends."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import IO

LOCK_FILE = ".rooftrack.lock"


def take_lock(folder: Path) -> IO[bytes] | None:
    """Return an open file that is the lock of a folder until it is closed; None where another process holds it."""
    stream = (folder / LOCK_FILE).open("ab")
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        stream.close()
        return None
    return stream
