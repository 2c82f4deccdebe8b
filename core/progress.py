"""How long work tells what it has done, and how it is asked to stop."""

from __future__ import annotations

import threading
from typing import Protocol

from core.errors import Cancelled


class Progress(Protocol):
    """Receives the state of long work; called often, so it must be quick."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Take note that `done` of `total` units of `stage` are finished."""


def silent(stage: str, done: int, total: int) -> None:
    """Ignore progress: the default where nobody watches."""


def heeding(cancel: CancelToken, progress: Progress) -> Progress:
    """Return a progress that stops the work it is told of, by `Cancelled`, once somebody asked to."""

    def told(stage: str, done: int, total: int) -> None:
        progress(stage, done, total)
        cancel.raise_if_cancelled()

    return told


class CancelToken:
    """A flag one thread raises and the working thread reads between two units of work."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def cancel(self) -> None:
        """Ask the work to stop after the unit it is in."""
        self._event.set()

    @property
    def cancelled(self) -> bool:
        """Whether somebody asked to stop."""
        return self._event.is_set()

    def raise_if_cancelled(self) -> None:
        """Stop here if somebody asked to.

        Raises:
            Cancelled: after `cancel()`.
        """
        if self._event.is_set():
            raise Cancelled
