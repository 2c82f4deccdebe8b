"""One server at a time takes care of a workspace: tidies what broke off, and goes on with what was interrupted."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import IO

LOCK_FILE = ".rooftrack.lock"


def take_charge(workspace: Path) -> IO[bytes] | None:
    """Return an open file that is the charge of a workspace until it is closed; None where another server has it.

    The operating system lets go of it however the server ends.
    """
    file = (workspace / LOCK_FILE).open("ab")
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return None
    return file
