"""Chunks of a video as tasks of an existing Dask cluster; the results come back to one writer.

A task is a pure function of its arguments, so Dask may run it again when a worker dies; a chunk is taken over whole,
once, when its task has finished, and nothing is counted twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from core.errors import InputError
from core.measurements import FrameMeasurement, Reference
from core.prediction import MeasureSetup

# Measures frames start to stop (exclusive) on whatever machine it runs.
ChunkWork = Callable[[MeasureSetup, int, int, Reference], list[FrameMeasurement]]


def measure_on_cluster(
    work: ChunkWork, setup: MeasureSetup, chunks: Sequence[tuple[int, int]], *, reference: Reference, scheduler: str
) -> Iterator[FrameMeasurement]:
    """Yield the measurements of chunks as their tasks finish, frames of a chunk in order.

    Args:
        work: what a task does; workers import it by name.
        chunks: (start, stop) frames.
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
        futures = [client.submit(work, setup, start, stop, reference, pure=False, retries=3) for start, stop in chunks]
        try:
            # Its loop must be named: this client is nobody's default.
            for future in as_completed(futures, loop=client.loop):
                yield from future.result()
        finally:
            client.cancel(futures)
