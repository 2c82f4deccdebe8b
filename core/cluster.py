"""Chunks of a video as tasks of an existing Dask cluster; the results come back to one writer.

A task is a pure function of its arguments, so Dask may run it again when a worker dies; a chunk is taken over whole,
once, when its task has finished, and nothing is counted twice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Any

from core.chunks import Chunk
from core.errors import InputError
from core.measurements import FrameMeasurement

# Frames per task: long enough that finding the way in costs little, short enough that many workers share a clip. Few
# workers have so many tasks each instead, none so long that much is lost with a worker.
TASK_FRAMES = 240
TASKS_EACH = 2
MOST_TASK_FRAMES = 960
# Times a task is run again when its worker has died.
RETRIES = 3
# Measures a chunk on whatever machine it runs; workers import it by name.
ChunkWork = Callable[[bytes, Chunk], list[FrameMeasurement]]


class Cluster:
    """Dask's workers, which load what they will need from now on; a context, at whose end the connection is closed.

    Args:
        work: what a task does.
        scheduler: address, such as `tcp://127.0.0.1:8786`.
    """

    def __init__(self, work: ChunkWork, scheduler: str) -> None:
        self._work = work
        self._scheduler = scheduler
        # Dask itself takes a while to load, during which this process has other things to do.
        self._connecting = ThreadPoolExecutor(1)
        self._connection = self._connecting.submit(self._connect)

    def __enter__(self) -> Cluster:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._connecting.shutdown()
        if self._connection.exception() is None:
            self._connection.result().close()

    def _connect(self) -> Any:
        try:
            from distributed import Client
        except ImportError:
            raise InputError("--scheduler needs Dask; install it with `pip install rooftrack[cluster]`.") from None
        try:
            client: Any = Client(self._scheduler, timeout=10, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                f"--scheduler {self._scheduler}: no Dask scheduler answers there ({error}); start one."
            ) from None
        # Nobody waits for these: a worker that is not there any more, or not yet, loads with its first task.
        self._loading = [client.submit(_load, self._work, workers=[worker], pure=False) for worker in client.nthreads()]
        return client

    def require(self) -> None:
        """Wait for the connection.

        Raises:
            InputError: Dask is not installed, or no scheduler answers.
        """
        self._connection.result()

    def measure(
        self, prepared: bytes, divide: Callable[[int], Sequence[Chunk]], frames: int
    ) -> Generator[FrameMeasurement, None, None]:
        """Yield the measurements of chunks as their tasks finish, frames of a chunk in order.

        Args:
            prepared: as in `core.workers.Order`.
            divide: cuts what is to be measured into about so many chunks.
            frames: of the video.
        """
        from distributed import KilledWorker, as_completed

        client = self._connection.result()
        chunks = longest_first(divide(tasks_for(frames, sum(client.nthreads().values()))))
        futures = {client.submit(self._work, prepared, chunk, pure=False, retries=RETRIES): chunk for chunk in chunks}
        try:
            # Its loop must be named: this client is nobody's default.
            for future in as_completed(futures, loop=client.loop):
                try:
                    measured = future.result()
                except KilledWorker:
                    chunk = futures[future]
                    raise InputError(
                        f"one worker after another died measuring frames {chunk.start} to {chunk.stop - 1}; give them "
                        "more memory, or fewer threads each, and run again."
                    ) from None
                yield from measured
        finally:
            client.cancel(list(futures))


def _load(work: ChunkWork) -> None:
    """Do nothing: to receive its argument a worker imports what the work needs."""


def longest_first(chunks: Sequence[Chunk]) -> list[Chunk]:
    """Return the order in which chunks are given out: with short ones last, all workers are done at about one time."""
    return sorted(chunks, key=lambda chunk: chunk.start - chunk.stop)


def tasks_for(frames: int, workers: int) -> int:
    """Return the number of tasks for a video, none of which is left over at the end."""
    share = frames / (TASKS_EACH * max(workers, 1))
    tasks = max(1, math.ceil(frames / min(max(share, TASK_FRAMES), MOST_TASK_FRAMES)))
    return tasks if workers < 2 or tasks % workers == 0 or tasks < workers else -(-tasks // workers) * workers
