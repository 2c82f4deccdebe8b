"""What a job's process tells the server, in JSON lines (see `app.jobs`)."""

from __future__ import annotations

import json
import threading
import time
from typing import Any, TextIO

# Progress lines a second that are worth the pipe.
_LINES_PER_S = 20.0


class Reporter:
    """Writes reports to the server; progress of the same stage is thinned out."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._lock = threading.Lock()
        self._last = ("", 0.0)

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report progress: `core.progress.Progress`."""
        now = time.monotonic()
        same, last_s = self._last
        if stage == same and done < total and now - last_s < 1.0 / _LINES_PER_S:
            return
        self._last = (stage, now)
        self.send({"stage": stage, "done": done, "total": total})

    def event(self, name: str, data: Any) -> None:
        """Have the server tell all tabs of the project."""
        self.send({"event": name, "data": data})

    def send(self, report: dict[str, Any]) -> None:
        """Write one line; a server that is gone is noticed by the end of the standard input."""
        with self._lock:
            try:
                self._stream.write(json.dumps(report) + "\n")
                self._stream.flush()
            except OSError:
                return
