"""Large bodies on their way to the disk: in pieces, into a part file, and in place only when complete."""

from __future__ import annotations

import asyncio
import os
import shutil
from collections.abc import AsyncIterator
from pathlib import Path

from fastapi import Request
from starlette.requests import ClientDisconnect

from app.errors import Invalid

# Pieces are gathered to this size before each trip to the thread that writes.
_PIECE_BYTES = 4 << 20
# What the disk keeps free for the results and for everybody else.
SPARE_BYTES = 200 << 20


async def receive_file(request: Request, part: Path) -> int:
    """Write a request's body to a new file, durably; return its size. A body that breaks off leaves nothing.

    Raises:
        Invalid: nothing came, it broke off, or the disk has no room for it.
    """
    announced = _announced(request)
    _require_room(part, announced or 0)
    size = 0
    try:
        with part.open("xb") as stream:
            async for piece in _pieces(request):
                if announced is None:
                    _require_room(part, len(piece))
                await asyncio.to_thread(stream.write, piece)
                size += len(piece)
            await asyncio.to_thread(_make_durable, stream.fileno())
        if size == 0 or (announced is not None and size != announced):
            raise Invalid("The file arrived empty or incomplete and was not kept; send it again.")
    except ClientDisconnect:
        part.unlink(missing_ok=True)
        raise Invalid("The transfer broke off and nothing was kept; send the file again.") from None
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return size


def _make_durable(descriptor: int) -> None:
    os.fsync(descriptor)


def _announced(request: Request) -> int | None:
    length = request.headers.get("content-length")
    return int(length) if length is not None and length.isdigit() else None


def _require_room(part: Path, size: int) -> None:
    free = shutil.disk_usage(part.parent).free
    if size + SPARE_BYTES > free:
        raise Invalid(
            f"The disk of the workspace has {free / 1e9:.1f} GB free and the file needs {size / 1e9:.1f} GB; "
            "make room, or choose the file by its path instead of sending it."
        )


async def _pieces(request: Request) -> AsyncIterator[bytes]:
    gathered = bytearray()
    async for chunk in request.stream():
        gathered += chunk
        if len(gathered) >= _PIECE_BYTES:
            yield bytes(gathered)
            gathered.clear()
    if gathered:
        yield bytes(gathered)
