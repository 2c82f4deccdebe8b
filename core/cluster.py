"""Chunks of a video as tasks of an existing Dask cluster; the results come back to one writer.

A task is a pure function of its arguments, so Dask may run it again when a worker dies; a chunk is taken over whole,
once, when its task has finished, and nothing is counted twice.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence

from core.chunks import Chunk
from core.errors import InputError
from core.measurements import FrameMeasurement

# Frames per task: long enough that finding the way in costs little, short enough to lose little.
TASK_FRAMES = 240
# Times a task is run again when its worker has died.
RETRIES = 3
# Measures a chunk on whatever machine it runs; workers import it by name.
ChunkWork = Callable[[bytes, Chunk], list[FrameMeasurement]]


def measure_on_cluster(
    work: ChunkWork, eyes: bytes, divide: Callable[[int], Sequence[Chunk]], frames: int, scheduler: str
) -> Generator[FrameMeasurement, None, None]:
    """Yield the measurements of chunks as their tasks finish, frames of a chunk in order.

    Args:
        work: what a task does.
        eyes: what it does that with.
        divide: cuts what is to be measured into about so many chunks.
        frames: of the video.
        scheduler: address, such as `tcp://127.0.0.1:8786`.

    Raises:
        InputError: Dask is not installed, or no scheduler answers.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise InputError("--scheduler needs Dask; install it with `pip install rooftrack[cluster]`.") from None
    try:
        client = Client(scheduler, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error}); start one.") from None
    with client:
        chunks = divide(tasks_for(frames, sum(client.nthreads().values())))
        futures = [client.submit(work, eyes, chunk, pure=False, retries=RETRIES) for chunk in chunks]
        try:
            # Its loop must be named: this client is nobody's default.
            for future in as_completed(futures, loop=client.loop):
                yield from future.result()
        finally:
            client.cancel(futures)


def tasks_for(frames: int, workers: int) -> int:
    """Return the number of tasks for a video: of some `TASK_FRAMES` each, and none that is left over at the end."""
    tasks = max(1, -(-frames // TASK_FRAMES))
    return tasks if workers < 2 or tasks % workers == 0 or tasks < workers else -(-tasks // workers) * workers
