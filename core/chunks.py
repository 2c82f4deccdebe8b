"""A clip cut into chunks of frames that can be measured anywhere, in any order.

The cuts depend on the video, on how many workers there are and on the machine's cores, never on who is quick: the same
command measures the same frames from the same beginnings.
"""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.video import FrameIndex

# Frames measured before a chunk's first and thrown away: what a search finds and what predictions lead to then agree
# to a ten-thousandth of a pixel, but for single patches.
WARM_UP = 8
# A chunk is never shorter: finding the way in costs about as much as measuring ten frames.
LEAST_FRAMES = 30
# Frames that a process measures while those that help it are still loading.
HEAD_START = 18
# One process keeps two cores busy, decoding and measuring; a second on cores of its own repays its start by so many
# frames.
CORES_EACH = 2
REPAYING_FRAMES = 60
# Frames of so many pixels, full HD, are decoded more quickly than measured, which a process does on one core. Processes
# that share cores then take 0.83 of the time of one, and repay their start by more frames; at 4K they save nothing,
# rather the contrary, and take twice the memory.
LIGHT_PIXELS = 2_100_000
REPAYING_FRAMES_SHARING = 500
# So many processes are started unasked: each takes half a gigabyte at 4K.
USUAL_PROCESSES = 4


@dataclass(frozen=True)
class Chunk:
    """Frames `start` to `stop`, exclusive."""

    start: int
    stop: int


def processes_for(frames: int, workers: int | None, cores: int, *, pixels: int) -> int:
    """Return how many of `workers` processes measure so many frames in the shortest time.

    Args:
        workers: None where nobody said how many there may be.
        pixels: of a frame.
    """
    apart = min(cores // CORES_EACH, frames // REPAYING_FRAMES)
    sharing = min(cores, frames // REPAYING_FRAMES_SHARING) if pixels <= LIGHT_PIXELS else 1
    return min(workers or USUAL_PROCESSES, max(1, apart, sharing))


def missing_chunks(done: Sequence[int], index: FrameIndex, parts: int, head_start: int = 0) -> list[Chunk]:
    """Return what is left to measure of a video, cut into about `parts` equal parts.

    Args:
        head_start: by how many frames the first part is longer.
    """
    gaps = missing_frames(done, len(index))
    left = sum(gap.stop - gap.start for gap in gaps)
    share = max(LEAST_FRAMES, -(-left // parts))
    chunks: list[Chunk] = []
    for gap in gaps:
        chunks += _cut(gap, max(1, round((gap.stop - gap.start) / share)), index, 0 if chunks else head_start)
    return chunks


def missing_frames(done: Sequence[int], total: int) -> list[Chunk]:
    """Return the stretches of `total` frames that are not among those done."""
    measured = np.zeros(total, dtype=bool)
    measured[[frame for frame in done if frame < total]] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[True], measured, [True]]).astype(np.int8)))
    return [Chunk(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


def _cut(gap: Chunk, parts: int, index: FrameIndex, head_start: int) -> list[Chunk]:
    """Cut a stretch where decoding can begin with few frames for nothing, as near to equal parts as that allows."""
    keys = index.key_frames
    length = gap.stop - gap.start
    cuts = {gap.start, gap.stop}
    for number in range(1, parts):
        wanted = gap.start + head_start + number * (length - head_start) // parts
        after = bisect_right(keys, wanted - WARM_UP)
        convenient = [key + WARM_UP for key in keys[max(0, after - 1) : after + 1]]
        possible = [cut for cut in (wanted, *convenient) if gap.start < cut < gap.stop]
        cuts.add(min(possible, key=lambda cut: abs(cut - wanted) + _for_nothing(cut, keys)))
    edges = sorted(cuts)
    return [Chunk(start, stop) for start, stop in itertools.pairwise(edges)]


def _for_nothing(start: int, keys: Sequence[int]) -> int:
    """Return how many frames before the warm-up of a chunk are decoded only because decoding must begin there."""
    first = max(0, start - WARM_UP)
    return first - keys[bisect_right(keys, first) - 1] if keys and keys[0] <= first else first
