"""The two ways a measurement stops early: input that cannot be used, and a person who changed their mind."""

from __future__ import annotations

import errno
import os
from pathlib import Path

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
OBSTRUCTED = (errno.EISDIR, errno.ENOTDIR, errno.EEXIST, errno.ENOTEMPTY)


class InputError(Exception):
    """Input that cannot be used, said in one sentence that names the file, the place in it and the remedy.

    The message is shown to people as it stands, on the terminal and in the browser.
    """


class Cancelled(Exception):
    """The person asked to stop; everything measured so far is kept."""


def disk_problem(error: OSError) -> str:
    """Return what kept a file from being written or read, in one sentence with its remedy."""
    file = error.filename2 or error.filename
    if error.errno == errno.ENOTDIR and isinstance(file, str | os.PathLike):
        # A file far up may stand in the way of a whole path.
        file = next((parent for parent in Path(file).parents if parent.is_file()), file)
    where = f"{os.fsdecode(file)}: " if isinstance(file, str | bytes | os.PathLike) else ""
    if error.errno == errno.EEXIST and isinstance(file, str | os.PathLike) and _leads_nowhere(Path(file)):
        return f"{where}is a link to {os.readlink(Path(file))}, which is not there; bring that back or remove the link."
    if error.errno in DISK_FULL:
        remedy = "make room on the disk"
    elif error.errno in OBSTRUCTED:
        remedy = "move away what lies in its place"
    else:
        remedy = "make it accessible"
    return f"{where}{error.strerror or error}; {remedy}, then do it again."


def _leads_nowhere(file: Path) -> bool:
    return file.is_symlink() and not file.exists()
