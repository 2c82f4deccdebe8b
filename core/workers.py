"""Chunks of a video side by side on one machine: this process measures, and others help it.

Helpers are started early, so that they load while the reference frame is being read. Each has a pipe of its own: one
that dies is noticed at once and blocks nobody. Helpers write nothing; what they measured comes back to this process.
"""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import TracebackType

from core.chunks import Chunk
from core.errors import InputError
from core.measurements import FrameMeasurement


@dataclass(frozen=True)
class Order:
    """A chunk to be measured.

    Attributes:
        prepared: a `PreparedVideo` of `core.measure`, packed; the same for all chunks of a video.
        before: the last two frames before the chunk, where known.
        threads: of the decoder.
    """

    prepared: bytes
    chunk: Chunk
    before: Sequence[FrameMeasurement] = ()
    threads: int = 1


# Measures the frames of an order one after another; helpers import it by name.
Work = Callable[[Order], Iterator[FrameMeasurement]]


@dataclass
class _Helper:
    """A process, our end of its pipe, and what it is measuring."""

    process: BaseProcess
    pipe: Connection
    chunk: Chunk | None = None


class Helpers:
    """Processes that measure beside this one; a context, at whose end they are gone.

    Args:
        work: what they do with an order.
        count: how many of them.
    """

    def __init__(self, work: Work, count: int) -> None:
        self._helpers = [_start(work) for _ in range(count)]

    def __enter__(self) -> Helpers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for helper in self._helpers:
            helper.process.terminate()
            helper.process.join()
            helper.pipe.close()

    def measure(self, orders: Sequence[Order], own: Work) -> Generator[FrameMeasurement, None, None]:
        """Yield the measurements of all orders as they come, frames of a chunk in order.

        Args:
            own: what this process does with an order; without helpers it does them all.

        Raises:
            InputError: a helper died.
        """
        waiting = deque(orders)
        while waiting:
            mine = own(waiting.popleft())
            for helper in self._helpers:
                _give(helper, waiting)
            for measured in mine:
                yield measured
                yield from self._arrived(waiting, timeout=0.0)
        while any(helper.chunk for helper in self._helpers):
            yield from self._arrived(waiting, timeout=None)

    def _arrived(self, waiting: deque[Order], timeout: float | None) -> Iterator[FrameMeasurement]:
        """Yield what helpers have sent, waiting for the first of it; give new orders to those who are done."""
        while ready := wait([helper.pipe for helper in self._helpers if helper.chunk], timeout):
            for helper in self._helpers:
                if helper.pipe in ready:
                    yield from _received(helper, waiting)
            timeout = 0.0


def _start(work: Work) -> _Helper:
    # Not forked: threads of this process may hold locks that a copy would wait for in vain.
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_help, args=(work, theirs), name="rooftrack helper", daemon=True)
    process.start()
    theirs.close()
    return _Helper(process, ours)


def _give(helper: _Helper, waiting: deque[Order]) -> None:
    """Give a helper that has nothing to do the next order."""
    if helper.chunk or not waiting:
        return
    order = waiting.popleft()
    helper.chunk = order.chunk
    try:
        helper.pipe.send(order)
    except OSError:
        raise _died(helper) from None


def _received(helper: _Helper, waiting: deque[Order]) -> Iterator[FrameMeasurement]:
    try:
        item: FrameMeasurement | Exception | None = helper.pipe.recv()
    except (EOFError, OSError):
        raise _died(helper) from None
    if isinstance(item, Exception):
        raise item
    if item is None:
        helper.chunk = None
        _give(helper, waiting)
    else:
        yield item


def _died(helper: _Helper) -> InputError:
    helper.process.join(timeout=5.0)
    chunk = helper.chunk or Chunk(0, 0)
    return InputError(
        f"the worker measuring frames {chunk.start} to {chunk.stop - 1} ended unexpectedly "
        f"(exit {helper.process.exitcode}); run again, with fewer --workers where memory is short."
    )


def _help(work: Work, pipe: Connection) -> None:
    """Measure what is ordered until nobody orders any more; runs in a process of its own."""
    try:
        while True:
            for measured in work(pipe.recv()):
                pipe.send(measured)
            pipe.send(None)
    except (EOFError, BrokenPipeError, KeyboardInterrupt):
        return
    except Exception as error:  # raised again by the process that ordered
        pipe.send(error)
