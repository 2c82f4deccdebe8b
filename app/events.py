"""Server-sent events: what every open tab of a project hears at once."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from typing import Any

# A tab that reads nothing for this many events is behind for good; it is told to load anew instead of growing a queue.
_QUEUE_LENGTH = 1000


class Hub:
    """Takes events from any thread and hands them to the tabs that listen to the project."""

    def __init__(self) -> None:
        self._listeners: dict[str, set[_Listener]] = {}
        self._lock = threading.Lock()
        self._closed = False

    def publish(self, project_id: str, event: str, data: Any) -> None:
        """Tell every tab of a project."""
        with self._lock:
            listeners = list(self._listeners.get(project_id, ()))
        for listener in listeners:
            listener.put(message(event, data))

    @contextmanager
    def listen(self, project_id: str) -> Iterator[_Listener]:
        """Listen to a project from the running event loop."""
        listener = _Listener(asyncio.get_running_loop())
        with self._lock:
            self._listeners.setdefault(project_id, set()).add(listener)
            if self._closed:
                listener.end()
        try:
            yield listener
        finally:
            with self._lock:
                self._listeners[project_id].discard(listener)

    def close(self) -> None:
        """End every stream, so that the server can stop without waiting for its tabs."""
        with self._lock:
            self._closed = True
            listeners = [listener for group in self._listeners.values() for listener in group]
        for listener in listeners:
            listener.end()


class _Listener:
    """One tab's queue."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._queue: asyncio.Queue[str | None] = asyncio.Queue(_QUEUE_LENGTH)

    def put(self, message: str | None) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._put, message)

    def end(self) -> None:
        self.put(None)

    def _put(self, message: str | None) -> None:
        if message is None or self._queue.full():
            while not self._queue.empty():
                self._queue.get_nowait()
            message = None
        self._queue.put_nowait(message)

    async def messages(self, *, pause_s: float) -> AsyncIterator[str]:
        """Yield messages as they come, and an empty string after each pause without one; end with the server."""
        while True:
            try:
                message = await asyncio.wait_for(self._queue.get(), pause_s)
            except TimeoutError:
                message = ""
            if message is None:
                return
            yield message


def message(event: str, data: Any) -> str:
    """Return an event as it goes over the wire."""
    return f"event: {event}\ndata: {json.dumps(data, allow_nan=False)}\n\n"
