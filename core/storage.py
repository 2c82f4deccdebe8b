"""Files where they lie: on this machine, or far away under an address such as `s3://campaign/eq7.mp4`.

What lies far away is read through fsspec, piece by piece as it is needed, and fsspec is loaded by the first such
address only. Who may read is settled where fsspec looks for it (environment, its own configuration), never in a
project.
"""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import urlsplit

from core.errors import InputError

# Read at once from far away: about half a second of 4K video, so that waiting for an answer weighs little.
BLOCK_BYTES = 4 << 20
# Bytes read at each of a file's places to tell it from another.
SAMPLE_BYTES = 1 << 20


@dataclass(frozen=True)
class FarFile:
    """A file that lies far away; can be sent to another process or machine.

    Args:
        address: as fsspec knows it, with its protocol; chains such as `filecache::s3://...` too.

    Raises:
        InputError: it holds a password.
    """

    address: str

    def __post_init__(self) -> None:
        if urlsplit(self.address.rpartition("::")[2]).password is not None:
            raise InputError(
                "project.json: an address holds a password; take it out and give it to the storage's own settings "
                "(its environment variables, or fsspec's configuration)."
            )

    def __str__(self) -> str:
        return self.address

    @property
    def name(self) -> str:
        """What comes last in the address."""
        return self.address.rstrip("/").rpartition("/")[2]

    @property
    def is_near(self) -> bool:
        """Whether the address leads to this machine's own files after all."""
        return urlsplit(self.address.rpartition("::")[2]).scheme in ("file", "local")


File = Path | FarFile


@dataclass(frozen=True)
class FileState:
    """What tells without reading whether a file is still the same: its size and something that changes with it."""

    size: int
    version: str


def file_at(folder: Path, named: str) -> File:
    """Return the file that a project in `folder` names: by an address, or by a path as seen from the folder."""
    return FarFile(named) if "://" in named else folder / named


def state_of(file: File) -> FileState:
    """Return a file's state.

    Raises:
        OSError: a file on this machine is not there.
        InputError: one that lies far away cannot be reached.
    """
    if isinstance(file, Path):
        state = file.stat()
        return FileState(state.st_size, str(state.st_mtime_ns))
    storage, path = _storage_of(file)
    with _said_plainly(file):
        return FileState(int(storage.info(path)["size"]), str(storage.ukey(path)))


@contextmanager
def opened(file: File) -> Iterator[BinaryIO]:
    """Open a file for reading from any place in it.

    Raises:
        OSError: a file on this machine cannot be read.
        InputError: one that lies far away cannot be reached.
    """
    if isinstance(file, Path):
        with file.open("rb") as stream:
            yield stream
        return
    storage, path = _storage_of(file)
    with _said_plainly(file):
        far = storage.open(path, "rb", block_size=BLOCK_BYTES)
    with far:
        yield far


def content_identity(file: File) -> str:
    """Return a name for a file's content from its size and samples of its bytes; quick for any size.

    Raises:
        OSError: a file on this machine is not there or cannot be read.
        InputError: one that lies far away cannot be reached.
    """
    size = state_of(file).size
    digest = hashlib.sha256(str(size).encode())
    with opened(file) as stream:
        for place in sorted({0, max(0, size // 2), max(0, size - SAMPLE_BYTES)}):
            stream.seek(place)
            digest.update(stream.read(SAMPLE_BYTES))
    return digest.hexdigest()


def _storage_of(file: FarFile) -> tuple[Any, str]:
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise InputError(
            f"{file}: reading it needs fsspec; install it with `pip install rooftrack[cluster]`."
        ) from None
    try:
        storage, path = url_to_fs(file.address)
    except ImportError as error:
        raise InputError(f"{file}: this kind of storage needs a package of its own ({error}); install it.") from None
    except ValueError as error:
        raise InputError(f"{file}: is no address that fsspec knows ({error}); correct inputs.video.") from None
    return storage, str(path)


@contextmanager
def _said_plainly(file: FarFile) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise InputError(f"{file}: not found; correct inputs.video or put the file there.") from None
    except Exception as error:  # every kind of storage has errors of its own
        raise InputError(
            f"{file}: cannot be read ({type(error).__name__}: {error}); see that this machine may read it."
        ) from None


def write_atomically(file: Path, content: bytes) -> None:
    """Replace a file's content in one step, durable before it takes the old one's place."""
    file.parent.mkdir(parents=True, exist_ok=True)
    # Two threads may write the same file.
    part = file.with_name(f".{file.name}.{secrets.token_hex(4)}.part")
    try:
        with part.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(file)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename, error.filename2 = str(file), None
        raise
