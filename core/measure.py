"""The pass over the video: frames in, measurements in raw pixels out.

It needs the geometry only to know where to look. Frames are independent of each other but for predictions, so a clip
can be cut into chunks that are measured anywhere, in any order; a chunk finds camera and targets by itself and warms
up on a few frames before its first, so that its numbers are those of an uninterrupted pass.
"""

from __future__ import annotations

import itertools
import math
import pickle
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Protocol

import cv2

from core.chunks import HEAD_START, WARM_UP, Chunk, missing_chunks, processes_for
from core.cluster import Cluster
from core.errors import InputError
from core.following import CONFIRM_EVERY, make_follower
from core.ground import FEATURES, GroundTracker, View, choose_features, ground_mask
from core.measurements import FrameMeasurement, MeasurementStore, Reference
from core.parallel import available_cores
from core.patches import Singles
from core.prediction import MeasureSetup, nothing_measured, predict_apparent, predict_homography
from core.progress import CancelToken, Progress, silent
from core.video import Frame, FrameIndex, FramesAhead, Luma, frame_index, read_frames
from core.workers import Helpers, Order

# So many frames after the reference frame an encoder no longer repeats it; where they correlate with it by less than
# this, it is too noisy to go by itself.
JUDGED_BY = 12
CLEAN_SCORE = 0.96
# Frames after the reference frame over which a noisy reference is averaged, and the fewest that do.
VIEWS = 64
LEAST_VIEWS = 12


class Measurer(Protocol):
    """Measures frames one after another, given those before."""

    reference: Reference

    def measure(self, luma: Luma, *, frame: int, time_s: float, before: Sequence[FrameMeasurement]) -> FrameMeasurement:
        """Return what a frame shows; `before` holds up to two frames that precede it, the nearest last."""


def make_measurer(
    setup: MeasureSetup,
    reference: Reference | None = None,
    index: FrameIndex | None = None,
    decoding: FramesAhead | None = None,
) -> Measurer:
    """Return the measurer of the setup's method, which has looked at the reference frame.

    Args:
        reference: of an earlier recording, to go on with exactly its features; chosen anew where None.
        index: of the video, where it is known already.
        decoding: frames being decoded of which none is taken yet; if with the reference frame, it need not be decoded
            twice.

    Raises:
        InputError: the video or its reference frame cannot be read, or that shows nothing to hold on to.
    """
    first = setup.reference_frame
    with ExitStack() as stack:
        if decoding is None or decoding.start != first:
            cores = available_cores()
            stop = first + 1 + JUDGED_BY
            decoding = stack.enter_context(FramesAhead(setup.video, first, stop, threads=cores, index=index))
        frames = decoding.peek()
        frame = next(frames, None)
        if frame is None or frame.index != first:
            raise InputError(f"{setup.video}: frame {first} cannot be decoded; choose another reference_frame.")
        luma = frame.luma
        if setup.method == "paper":
            # Brings a library along that takes a while to load.
            from core.paper import PaperMeasurer

            return PaperMeasurer(luma, setup)
        measurer = GeometricMeasurer(luma, setup, reference)
        if measurer.finds_noise(frame.luma for frame in itertools.islice(frames, JUDGED_BY)):
            measurer.denoise(
                frame.luma for frame in read_frames(setup.video, first + 1, first + 1 + VIEWS, index=index)
            )
        return measurer


class GeometricMeasurer:
    """Patches on the ground, strips or patches on the targets; see `core.ground` and `core.following`.

    Args:
        luma: the reference frame, (height, width).
        reference: of an earlier recording, whose ground features are taken; chosen anew where None.

    Attributes:
        reference: where the features are in the reference frame, raw pixels.

    Raises:
        InputError: the frame shows too little ground, or no line or texture where a target should be.
    """

    def __init__(self, luma: Luma, setup: MeasureSetup, reference: Reference | None = None) -> None:
        if reference is None:
            points = choose_features(luma, setup.moving_regions_px, FEATURES, setup.lens)
        else:
            points = reference.ground_raw
        allowed = ground_mask(luma.shape, setup.moving_regions_px)
        self._ground = GroundTracker(luma, points, setup.lens, allowed)
        self._followers = {
            target.name: make_follower(luma, target, setup.rays_from_plan, setup.lens, setup.moving_regions_px)
            for target in setup.targets
        }
        self.reference = Reference(
            points,
            {name: follower.reference_raw for name, follower in self._followers.items()},
            {name: follower.reference_texture_raw for name, follower in self._followers.items()},
        )
        self._first = setup.reference_frame
        self._views = range(0)

    def finds_noise(self, following: Iterable[Luma]) -> bool:
        """Whether the reference frame is too noisy to go by itself, as a few frames after it tell."""
        scores = [view.score for view in self._ground.look_ahead(following)]
        return bool(scores) and scores[-1] < CLEAN_SCORE

    def denoise(self, following: Iterable[Luma]) -> None:
        """Average patches over the frames after the reference frame."""
        followers = [follower for follower in self._followers.values() if len(follower.texture)]
        looking: list[Callable[[View], Singles]] = [self._ground.views, *(follower.views for follower in followers)]
        seen = [[views(view) for views in looking] for view in self._ground.look_ahead(following)]
        if len(seen) < LEAST_VIEWS:
            return
        patches = [self._ground.patches, *(follower.texture.patches for follower in followers)]
        for each, views in zip(patches, zip(*seen, strict=True), strict=True):
            each.denoise(views)
        self._views = range(self._first, self._first + 1 + len(seen) // 2)

    def measure(self, luma: Luma, *, frame: int, time_s: float, before: Sequence[FrameMeasurement]) -> FrameMeasurement:
        """Return what a frame shows; see `Measurer.measure`."""
        is_view = frame in self._views
        ground = self._ground.find(luma, predict_homography(before, time_s), is_view=is_view)
        if ground is None:
            return nothing_measured(self.reference, frame, time_s)
        targets_raw, texture_raw, apparent = {}, {}, {}
        for name, follower in self._followers.items():
            predicted = predict_apparent(before, name, time_s)
            confirm = frame % CONFIRM_EVERY == 0
            match = follower.find(luma, ground.H_ray_ray0, predicted, confirm=confirm, is_view=is_view)
            targets_raw[name], texture_raw[name], apparent[name] = match.raw, match.texture_raw, match.apparent
        return FrameMeasurement(
            frame, time_s, ground.H_ray_ray0, ground.matches.raw, targets_raw, apparent, texture_raw
        )


def measure_chunk(
    setup: MeasureSetup,
    chunk: Chunk,
    *,
    measurer: Measurer,
    before: Sequence[FrameMeasurement] = (),
    threads: int = 0,
    index: FrameIndex | None = None,
    decoding: FramesAhead | None = None,
) -> Iterator[FrameMeasurement]:
    """Yield the measurements of a chunk's frames in order; in one that cannot be decoded nothing is measured.

    Args:
        before: the last two frames before the chunk, where known; otherwise the chunk finds its own way in.
        threads: decoder threads, as `FramesAhead`.
        index: of the video, where it is known already.
        decoding: frames being decoded already, from the chunk's first on.
    """
    index = index or frame_index(setup.video)
    first = chunk.start if before else max(0, chunk.start - WARM_UP)
    history = list(before)[-2:]
    with decoding or FramesAhead(setup.video, first, chunk.stop, threads=threads, index=index) as frames:
        for number, frame in _numbered(frames, first, chunk.stop):
            time_s = index.time_s_of(number)
            if frame is None:
                measured = nothing_measured(measurer.reference, number, time_s)
            else:
                measured = measurer.measure(frame.luma, frame=number, time_s=time_s, before=history)
            history = [*history[-1:], measured]
            if number >= chunk.start:
                yield measured


def _numbered(frames: Iterable[Frame], start: int, stop: int) -> Iterator[tuple[int, Frame | None]]:
    """Yield all numbers from `start` to `stop` with their frames, None for those that did not come."""
    expected = start
    for frame in frames:
        if frame.index >= stop:
            break
        yield from ((number, None) for number in range(expected, frame.index))
        yield frame.index, frame
        expected = frame.index + 1
    yield from ((number, None) for number in range(expected, stop))


def measure(
    setup: MeasureSetup,
    store: MeasurementStore,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    fresh: bool = False,
    progress: Progress = silent,
    cancel: CancelToken | None = None,
) -> int:
    """Measure what is still missing of a video, resuming where an earlier run stopped; return the recording's number.

    Args:
        workers: processes on this machine at most, this one among them: as many as its cores and the clip's length
            repay; None for four at most.
        scheduler: address of a Dask scheduler whose workers measure instead.
        fresh: forget what was measured before.

    Raises:
        InputError: the video cannot be read, or shows no ground or no line where the project says.
        Cancelled: on request; what was measured stays.
    """
    cancel = cancel or CancelToken()
    recording = None if fresh else store.find(setup.method, setup.fingerprint)
    if recording is not None and store.is_finished(recording):
        return recording
    remainder = _Remainder(setup, store, frame_index(setup.video), recording)
    with ExitStack() as stack:
        source = remainder.here(stack, workers) if scheduler is None else remainder.remotely(stack, scheduler)
        recording = remainder.begun
        done, total = len(remainder.done), len(remainder.index)
        _take_over(source, store, recording, done=done, total=total, progress=progress, cancel=cancel)
    store.finish(recording)
    return recording


class _Remainder:
    """What of a video is still to be measured.

    While the reference frame is looked at, helpers or the cluster load and the first chunk is being decoded.

    Args:
        recording: of what is measured already, None where nothing is.

    Attributes:
        done: frames that are measured already.
    """

    def __init__(self, setup: MeasureSetup, store: MeasurementStore, index: FrameIndex, recording: int | None) -> None:
        self._setup = setup
        self._store = store
        self._recording = recording
        self.index = index
        self.done = [] if recording is None else store.measured_frames(recording)

    @property
    def begun(self) -> int:
        """The recording that measurements go into, known once its reference frame has been looked at."""
        assert self._recording is not None
        return self._recording

    def here(self, stack: ExitStack, workers: int | None) -> Generator[FrameMeasurement, None, None]:
        """Return what this process and its helpers will measure; they are gone when the stack closes."""
        setup, cores = self._setup, available_cores()
        left, pixels = len(self.index) - len(self.done), math.prod(setup.lens.image_size_px)
        processes = processes_for(left, workers, cores, pixels=pixels)
        chunks = missing_chunks(self.done, self.index, processes, HEAD_START)
        helping = max(0, min(processes, len(chunks)) - 1)
        helpers = stack.enter_context(Helpers(measure_order, helping))
        threads = max(1, cores // (1 + helping)) if helping else 0
        decoding = None
        if self._recording is None:
            decoding = stack.enter_context(FramesAhead(setup.video, threads=threads, index=self.index))
        before = [_before(self._store, self._recording, chunk.start) for chunk in chunks]
        measurer = self._measurer(decoding)

        def own(order: Order) -> Iterator[FrameMeasurement]:
            return measure_chunk(
                setup,
                order.chunk,
                measurer=measurer,
                before=order.before,
                threads=order.threads,
                index=self.index,
                decoding=decoding if order.chunk == chunks[0] else None,
            )

        prepared = self._begin(measurer)
        orders = [Order(prepared, chunk, known, threads) for chunk, known in zip(chunks, before, strict=True)]
        return helpers.measure(orders, own)

    def remotely(self, stack: ExitStack, scheduler: str) -> Generator[FrameMeasurement, None, None]:
        """Return what the workers of a Dask scheduler will measure; they are left when the stack closes."""
        cluster = stack.enter_context(Cluster(measure_remotely, scheduler))
        measurer = self._measurer()
        cluster.require()
        prepared = self._begin(measurer)
        return cluster.measure(
            prepared, lambda parts: missing_chunks(self.done, self.index, parts), frames=len(self.index)
        )

    def _measurer(self, decoding: FramesAhead | None = None) -> Measurer:
        reference = None if self._recording is None else self._store.reference(self._recording)
        return make_measurer(self._setup, reference, self.index, decoding)

    def _begin(self, measurer: Measurer) -> bytes:
        """Begin a recording where there is none, and pack what helpers and workers need."""
        if self._recording is None:
            self._recording = self._store.begin(self._setup.method, self._setup.fingerprint, measurer.reference)
        return pickle.dumps(PreparedVideo(self._setup, self.index, measurer))


def _take_over(
    source: Generator[FrameMeasurement, None, None],
    store: MeasurementStore,
    recording: int,
    *,
    done: int,
    total: int,
    progress: Progress,
    cancel: CancelToken,
) -> None:
    """Store what comes, as it comes; `done` of `total` frames are there already."""
    progress("measuring", done, total)
    try:
        with closing(source):
            for number, measured in enumerate(source, done + 1):
                store.append(recording, measured)
                progress("measuring", number, total)
                cancel.raise_if_cancelled()
    finally:
        store.commit()


def _before(store: MeasurementStore, recording: int | None, start: int) -> list[FrameMeasurement]:
    """Return the last two frames before one, or none where the last is not known."""
    if recording is None:
        return []
    found = [store.frame(recording, frame) for frame in (start - 2, start - 1) if frame >= 0]
    known = [frame for frame in found if frame is not None]
    return known if known and known[-1].frame == start - 1 else []


@dataclass(frozen=True)
class PreparedVideo:
    """What all chunks of a video have in common, sent to whoever measures them; they need no reference frame then."""

    setup: MeasureSetup
    index: FrameIndex
    measurer: Measurer


class _Kept(threading.local):
    """What a worker unpacked last: the next chunk is mostly of the same video."""

    packed = b""
    prepared: PreparedVideo


_kept = _Kept()


def measure_order(order: Order) -> Iterator[FrameMeasurement]:
    """Yield the measurements of one chunk; runs in a helping process or on a worker, beside others."""
    # Libraries that start threads of their own would only get in each other's way.
    cv2.setNumThreads(1)
    if _kept.packed != order.prepared:
        _kept.prepared = pickle.loads(order.prepared)
        _kept.packed = order.prepared
    yield from measure_chunk(
        _kept.prepared.setup,
        order.chunk,
        measurer=_kept.prepared.measurer,
        before=order.before,
        threads=order.threads,
        index=_kept.prepared.index,
    )


def measure_remotely(prepared: bytes, chunk: Chunk) -> list[FrameMeasurement]:
    """Return the measurements of one chunk; runs on a worker."""
    return list(measure_order(Order(prepared, chunk)))
