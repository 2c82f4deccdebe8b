"""How long work looks on a terminal: one line that fills, or now and then a plain line where nobody watches."""

from __future__ import annotations

import shutil
import time
from collections import deque
from collections.abc import Callable
from typing import TextIO

# Redrawn no more often than eyes can follow, and logged no more often than a log should grow.
REDRAW_S = 0.1
LOG_S = 10.0
# The rate is that of the last seconds: a run that resumes or slows down is soon told rightly.
RATE_WINDOW_S = 8.0
# The stages whose units mean something to people.
UNITS = {"measuring": "frames", "calibration": "pictures"}


class TerminalProgress:
    """A `core.progress.Progress` that writes stage, share done, rate and time left to a stream.

    Args:
        out: where to write; drawn in place when it is a terminal, else a line at most every `LOG_S`.
        clock: seconds, ever increasing.
    """

    def __init__(self, out: TextIO, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._out = out
        self._clock = clock
        self._drawn_in_place = out.isatty()
        self._smooth = "utf" in (out.encoding or "").lower()
        self._stage: str | None = None
        self._history: deque[tuple[float, int]] = deque()
        self._begun_at = self._written_at = 0.0
        self._begun_with = 0
        self._last = (0, 0)
        self._line_open = False

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Take note that `done` of `total` units of `stage` are finished."""
        now = self._clock()
        if stage != self._stage:
            self.close()
            self._stage = stage
            self._history.clear()
            self._begun_at, self._begun_with = now, done
            self._written_at = now - REDRAW_S if self._drawn_in_place else now
        self._last = (done, total)
        self._history.append((now, done))
        while len(self._history) > 2 and now - self._history[0][0] > RATE_WINDOW_S:
            self._history.popleft()
        interval = REDRAW_S if self._drawn_in_place else LOG_S
        if done >= total:
            self.close()
        elif now - self._written_at >= interval:
            self._written_at = now
            self._write()

    def close(self) -> None:
        """Finish the line of the current stage, so that other text starts on a line of its own."""
        if self._stage is None:
            return
        done, total = self._last
        if self._line_open or done >= total:
            self._write()
            if self._drawn_in_place:
                self._out.write("\n")
                self._out.flush()
        self._line_open = False
        self._stage = None

    def _write(self) -> None:
        if self._drawn_in_place:
            width = shutil.get_terminal_size().columns - 1
            self._out.write("\r" + self._line(width)[:width].ljust(width))
            self._line_open = True
        else:
            self._out.write(self._line(0) + "\n")
        self._out.flush()

    def _line(self, width: int) -> str:
        done, total = self._last
        share = min(1.0, done / total) if total else 1.0
        label = f"{self._stage:<16}"
        if width == 0:
            return f"{label} {share:4.0%}  {self._facts()}".rstrip()
        return f"{label} {self._bar(share, max(8, min(40, width - len(label) - 52)))} {share:4.0%}  {self._facts()}"

    def _facts(self) -> str:
        """How much, how fast, and how much longer; of a finished stage, how long it took."""
        done, total = self._last
        rate, unit = self._rate(), UNITS.get(self._stage or "")
        facts = [f"{done}/{total} {unit}"] if unit else []
        if unit and rate is not None:
            facts.append(f"{rate:.1f} {unit}/s")
        if done >= total:
            facts.append(clock_text(self._history[-1][0] - self._begun_at))
        elif rate is not None:
            facts.append(f"{clock_text((total - done) / rate)} left")
        return "  ".join(facts)

    def _bar(self, share: float, cells: int) -> str:
        full, empty = ("━", "─") if self._smooth else ("#", "-")
        filled = round(share * cells)
        return full * filled + empty * (cells - filled)

    def _rate(self) -> float | None:
        """Units a second: of a finished stage over all of it, else of the last seconds."""
        (since, before), (now, done) = self._history[0], self._history[-1]
        if done >= self._last[1]:
            since, before = self._begun_at, self._begun_with
        return (done - before) / (now - since) if now > since and done > before else None


def clock_text(seconds: float) -> str:
    """Return a duration as m:ss, or h:mm:ss from an hour on."""
    whole = max(0, round(seconds))
    hours, minutes, rest = whole // 3600, whole // 60 % 60, whole % 60
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
