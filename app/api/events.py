"""Server-sent events of a project, and its jobs."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from typing import Any

from fastapi import APIRouter
from fastapi.responses import StreamingResponse

from app.context import Context, Folder, Here
from app.errors import ApiError
from app.events import message
from app.store import ProjectFolder
from core.errors import InputError

router = APIRouter(prefix="/api")

_HEARTBEAT_S = 10.0
# How soon a tab hears of an edit by another program, such as the command line.
_LOOK_S = 1.0


@router.get("/jobs/{job_id}")
def job(job_id: str, here: Here) -> dict[str, Any]:
    """Return a job."""
    return {"job": here.jobs.get(job_id).as_json()}


@router.delete("/jobs/{job_id}")
def cancel(job_id: str, here: Here) -> dict[str, Any]:
    """Ask a job to stop."""
    found = here.jobs.get(job_id)
    here.jobs.cancel(found)
    return {"job": found.as_json()}


@router.get("/projects/{project_id}/events")
async def events(folder: Folder, here: Here) -> StreamingResponse:
    """Return the stream of events of a project, beginning with where it stands."""
    return StreamingResponse(
        _stream(here, folder),
        media_type="text/event-stream",
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


async def _stream(here: Context, folder: ProjectFolder) -> AsyncIterator[str]:
    with here.hub.listen(folder.id) as listener:
        stamp = await asyncio.to_thread(folder.stamp)
        yield message("hello", await asyncio.to_thread(_hello, here, folder))
        spoken_s = time.monotonic()
        async for text in listener.messages(pause_s=_LOOK_S):
            if text:
                yield text
                continue
            seen = await asyncio.to_thread(folder.stamp)
            if seen[0] != stamp[0]:
                yield message("project", await asyncio.to_thread(_hello, here, folder))
            if seen[1] != stamp[1]:
                yield message("results", {})
            stamp = seen
            if time.monotonic() - spoken_s >= _HEARTBEAT_S:
                spoken_s = time.monotonic()
                yield ": here\n\n"


def _hello(here: Context, folder: ProjectFolder) -> dict[str, Any]:
    running = here.jobs.running(folder.id, "track")
    try:
        head = folder.load().head
    except (InputError, ApiError):
        return {"revision": None, "job": None}
    return {"revision": head.revision, "label": head.undo_label, "job": running.as_json() if running else None}
