"""The pass over the video: frames in, measurements in raw pixels out.

It needs the geometry only to know where to look. Frames are independent of each other but for predictions, so a clip
can be cut into chunks that are measured anywhere, in any order; a chunk finds camera and targets by itself and warms
up on a few frames before its first, so that its numbers are those of an uninterrupted pass.
"""

from __future__ import annotations

import multiprocessing
import queue
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from core.cluster import measure_on_cluster
from core.errors import InputError
from core.following import CONFIRM_EVERY, make_follower
from core.ground import FEATURES, GroundTracker, choose_features, ground_mask
from core.measurements import FrameMeasurement, MeasurementStore, Reference
from core.paper import PaperMeasurer
from core.prediction import MeasureSetup, nothing_measured, predict_apparent, predict_homography
from core.progress import CancelToken, Progress, silent
from core.video import Luma, frame_index, read_frame, read_frames

# Frames measured before a chunk's first and thrown away: predictions have forgotten their beginning by then.
WARM_UP = 6
# Frames per task of a cluster: long enough that finding the way in costs little, short enough to lose little.
CLUSTER_CHUNK = 240


class Measurer(Protocol):
    """Measures frames one after another, given those before."""

    reference: Reference

    def measure(self, luma: Luma, *, frame: int, time_s: float, before: Sequence[FrameMeasurement]) -> FrameMeasurement:
        """Return what a frame shows; `before` holds up to two frames that precede it, the nearest last."""


def make_measurer(setup: MeasureSetup, reference: Reference | None = None) -> Measurer:
    """Return the measurer of the setup's method, its eyes on the reference frame.

    Args:
        reference: of an earlier recording, to go on with exactly its features; chosen anew where None.
    """
    luma = read_frame(setup.video, setup.reference_frame).luma
    if setup.method == "paper":
        return PaperMeasurer(luma, setup)
    return GeometricMeasurer(luma, setup, reference)


class GeometricMeasurer:
    """Patches on the ground, strips or patches on the targets; see `core.ground` and `core.following`."""

    def __init__(self, luma: Luma, setup: MeasureSetup, reference: Reference | None = None) -> None:
        points = choose_features(luma, setup.moving_regions_px, FEATURES) if reference is None else reference.ground_raw
        allowed = ground_mask(luma.shape, setup.moving_regions_px)
        self._ground = GroundTracker(luma, points, setup.lens, allowed)
        self._followers = {
            target.name: make_follower(luma, target, setup.rays_from_plan, setup.lens) for target in setup.targets
        }
        targets_raw = {name: follower.reference_raw for name, follower in self._followers.items()}
        self.reference = Reference(points, targets_raw)

    def measure(self, luma: Luma, *, frame: int, time_s: float, before: Sequence[FrameMeasurement]) -> FrameMeasurement:
        """Return what a frame shows; see `Measurer.measure`."""
        ground = self._ground.find(luma, predict_homography(before))
        if ground is None:
            return nothing_measured(self.reference, frame, time_s)
        targets_raw, apparent = {}, {}
        for name, follower in self._followers.items():
            predicted = predict_apparent(before, name, time_s)
            match = follower.find(luma, ground.H_ray_ray0, predicted, confirm=frame % CONFIRM_EVERY == 0)
            targets_raw[name], apparent[name] = match.raw, match.apparent
        return FrameMeasurement(frame, time_s, ground.H_ray_ray0, ground.matches.raw, targets_raw, apparent)


@dataclass(frozen=True)
class Chunk:
    """Frames `start` to `stop`, exclusive."""

    start: int
    stop: int


def measure_chunk(
    setup: MeasureSetup,
    chunk: Chunk,
    *,
    reference: Reference | None = None,
    before: Sequence[FrameMeasurement] = (),
    measurer: Measurer | None = None,
    threads: int = 0,
) -> Iterator[FrameMeasurement]:
    """Yield the measurements of a chunk's frames in order.

    Args:
        reference: features to look for; those of the measurer where None.
        before: the last two frames before the chunk, where known; otherwise the chunk finds its own way in.
        measurer: one that has been made already.
        threads: decoder threads, 0 for one per core.
    """
    measurer = measurer or make_measurer(setup, reference)
    history = list(before)[-2:]
    first = chunk.start if history else max(0, chunk.start - WARM_UP)
    for frame in read_frames(setup.video, first, chunk.stop, threads=threads):
        measured = measurer.measure(frame.luma, frame=frame.index, time_s=frame.time_s, before=history)
        history = [*history[-1:], measured]
        if frame.index >= chunk.start:
            yield measured


def measure(
    setup: MeasureSetup,
    store: MeasurementStore,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    fresh: bool = False,
    progress: Progress = silent,
    cancel: CancelToken | None = None,
) -> int:
    """Measure what is still missing of a video, resuming where an earlier run stopped; return the recording's number.

    Args:
        workers: processes on this machine.
        scheduler: address of a Dask scheduler whose workers measure instead.
        fresh: forget what was measured before.

    Raises:
        InputError: the video cannot be read, or shows no ground or no line where the project says.
        Cancelled: on request; what was measured stays.
    """
    cancel = cancel or CancelToken()
    if fresh:
        store.delete(setup.method)
    recording = store.find(setup.method, setup.fingerprint)
    if recording is not None and store.is_finished(recording):
        return recording
    known = None if recording is None else store.reference(recording)
    measurer = make_measurer(setup, known)
    if recording is None:
        recording = store.begin(setup.method, setup.fingerprint, measurer.reference)
    total = len(frame_index(setup.video))
    done = store.measured_frames(recording)
    if scheduler is not None:
        chunks = missing_chunks(done, total, -(-total // CLUSTER_CHUNK))
        source = _on_cluster(setup, chunks, measurer.reference, scheduler)
    elif workers > 1 and len(chunks := missing_chunks(done, total, workers)) > 1:
        source = _side_by_side(setup, chunks, store, recording, measurer.reference)
    else:
        source = _one_after_another(setup, missing_chunks(done, total, 1), store, recording, measurer)
    finished = len(done)
    progress("measuring", finished, total)
    try:
        for measured in source:
            store.append(recording, measured)
            finished += 1
            progress("measuring", finished, total)
            cancel.raise_if_cancelled()
    finally:
        source.close()
        store.commit()
    store.finish(recording)
    return recording


def missing_chunks(done: Sequence[int], total: int, workers: int) -> list[Chunk]:
    """Return what is left to measure, cut so that `workers` have about equal shares."""
    measured = np.zeros(total, dtype=bool)
    measured[[frame for frame in done if frame < total]] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[True], measured, [True]]).astype(np.int8)))
    gaps = [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]
    left = sum(stop - start for start, stop in gaps)
    share = max(30, -(-left // workers)) if workers > 1 else max(1, left)
    return [Chunk(first, min(first + share, stop)) for start, stop in gaps for first in range(start, stop, share)]


def _before(store: MeasurementStore, recording: int, start: int) -> list[FrameMeasurement]:
    found = [store.frame(recording, frame) for frame in (start - 2, start - 1) if frame >= 0]
    known = [frame for frame in found if frame is not None]
    return known if known and known[-1].frame == start - 1 else []


def _one_after_another(
    setup: MeasureSetup, chunks: Sequence[Chunk], store: MeasurementStore, recording: int, measurer: Measurer
) -> Generator[FrameMeasurement, None, None]:
    for chunk in chunks:
        before = _before(store, recording, chunk.start)
        yield from measure_chunk(setup, chunk, before=before, measurer=measurer)


def _side_by_side(
    setup: MeasureSetup, chunks: Sequence[Chunk], store: MeasurementStore, recording: int, reference: Reference
) -> Generator[FrameMeasurement, None, None]:
    """Measure chunks in one process each; only this process writes."""
    context = multiprocessing.get_context("spawn")
    results: multiprocessing.Queue[FrameMeasurement | Exception | None] = context.Queue(maxsize=64)
    processes = [
        context.Process(
            target=_work,
            args=(setup, chunk, reference, _before(store, recording, chunk.start), results),
            name=f"frames from {chunk.start}",
            daemon=True,
        )
        for chunk in chunks
    ]
    for process in processes:
        process.start()
    try:
        running = len(processes)
        while running:
            try:
                item = results.get(timeout=1.0)
            except queue.Empty:
                _require_alive(processes)
                continue
            if isinstance(item, Exception):
                raise item
            if item is None:
                running -= 1
                continue
            yield item
    finally:
        for process in processes:
            process.terminate()
            process.join()


def _on_cluster(
    setup: MeasureSetup, chunks: Sequence[Chunk], reference: Reference, scheduler: str
) -> Generator[FrameMeasurement, None, None]:
    spans = [(chunk.start, chunk.stop) for chunk in chunks]
    yield from measure_on_cluster(measure_remotely, setup, spans, reference=reference, scheduler=scheduler)


def measure_remotely(setup: MeasureSetup, start: int, stop: int, reference: Reference) -> list[FrameMeasurement]:
    """Return the measurements of one chunk; runs on a worker, on one core."""
    cv2.setNumThreads(1)
    return list(measure_chunk(setup, Chunk(start, stop), reference=reference, threads=1))


def _require_alive(processes: Sequence[multiprocessing.process.BaseProcess]) -> None:
    for process in processes:
        if process.exitcode not in (None, 0):
            raise InputError(
                f"the worker measuring {process.name} ended unexpectedly (exit {process.exitcode}); run again."
            )


def _work(
    setup: MeasureSetup,
    chunk: Chunk,
    reference: Reference,
    before: Sequence[FrameMeasurement],
    results: multiprocessing.Queue[FrameMeasurement | Exception | None],
) -> None:
    # One worker per core: libraries that start threads of their own would only get in each other's way.
    cv2.setNumThreads(1)
    try:
        for measured in measure_chunk(setup, chunk, reference=reference, before=before, threads=1):
            results.put(measured)
        results.put(None)
    except KeyboardInterrupt:
        return
    except Exception as error:  # raised again by the process that collects
        results.put(error)
