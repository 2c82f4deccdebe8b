"""Pictures shown again: a recorder that hung for a moment, a film brought to a higher frame rate.

Such a frame holds nothing of its own time. Compression leaves it a little different from the one before, so it is told
by motion: ground and targets all stand still at once, and what they missed they catch up in one step. Where nothing
moves no such step comes, and nothing is lost by a repeat either.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.bodies import midpoints
from core.coordinates import Bools, Floats
from core.measurements import Recording
from core.robust import finite_median, robust_sigma

# Fewer frames say nothing about what is usual.
LEAST_FRAMES = 10
# Frames farther apart than so many usual ones are not compared.
WIDEST = 2.0
# Steps stand out if they are larger than this, pixels, and than so many times their noise.
LEAST_STEP_PX = 0.3
LEAST_STEP = 8.0
# Steps that stand out have one smaller than this part of them in between if that is a repeat. (Of 20,700 such triples
# in 180 recordings without repeats the smallest has 0.45; a repeat has 0.1 to 0.3.)
STILL = 0.35
# Steps have the same direction if this is less than the cosine between them.
ALONG = 0.5
# A coder that refines its picture may move what stands still this much, pixels, in so many frames.
REFINED_PX = 0.15
REFINED_FRAMES = 3
# Where several frames repeat one, the step that catches up tells it, however slow the motion was before: steps in the
# repeat are small beside the usual one, and that step is larger than this part of what steps like those beside it would
# have come to, of which MOST_MISSED count at most, as motion turns round.
CAUGHT_UP = 0.6
MOST_MISSED = 5
# A film brought to a higher frame rate repeats one of so many frames: every second from 30 to 60 Hz, every fifth from
# 24 to 30, every sixth from 25 to 30. Looked at are steps larger than this, pixels and times their noise, and those
# between such. So many it takes, of which this share is smaller than this part of its neighbours. (Without repeats,
# even the median is never below 0.8.)
PERIODS = (2, 3, 4, 5, 6)
REGULAR_PX = 0.15
REGULAR_NOISE = 4.0
LEAST_REGULAR = 10
REGULAR_SHARE = 0.75
REGULAR = 0.5
# Stretches of repeated frames that a sentence names.
MOST_NAMED = 3


def repeated_pictures(recording: Recording) -> Bools:
    """Return which frames (F,) show the picture before them once more."""
    repeated = np.zeros(len(recording.frame), dtype=np.bool_)
    if len(repeated) < LEAST_FRAMES:
        return repeated
    tracks = _tracks(recording)
    for track in tracks:
        for catching_up in np.flatnonzero(track.standing_out(LEAST_STEP_PX, LEAST_STEP)):
            first = _first_still(track, tracks, int(catching_up))
            repeated[first + 1 : catching_up + 1] = True
    for period in PERIODS:
        for phase in range(period):
            one_of_so_many = recording.frame[1:] % period == phase
            if _are_repeats(tracks, one_of_so_many):
                repeated[1:] |= one_of_so_many
    return repeated


def without_pictures(recording: Recording, gone: Bools) -> Recording:
    """Return a recording in which some frames (F,) show nothing."""

    def blanked(values: Floats) -> Floats:
        return np.where(gone.reshape(-1, *[1] * (values.ndim - 1)), np.nan, values)

    return replace(
        recording,
        H_ray_ray0=blanked(recording.H_ray_ray0),
        ground_raw=blanked(recording.ground_raw),
        targets_raw={name: blanked(raw) for name, raw in recording.targets_raw.items()},
        texture_raw={name: blanked(raw) for name, raw in recording.texture_raw.items()},
    )


def repeats_sentence(recording: Recording, repeated: Bools) -> str:
    """Say which frames (F,) repeat another, for people."""
    frames = recording.frame[repeated]
    stretches = [f"{each[0]}" if len(each) == 1 else f"{each[0]} to {each[-1]}" for each in _consecutive(frames)]
    named = ", ".join(stretches[:MOST_NAMED]) + (", ..." if len(stretches) > MOST_NAMED else "")
    return (
        f"{len(frames)} of {len(repeated)} frames show the picture before them once more and are lost ({named}): "
        "export the video as it was recorded, at its own frame rate, or film without interruptions."
    )


def _consecutive(numbers: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    return np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)


@dataclass(frozen=True)
class _Track:
    """How the ground or a target moves as a whole from each frame to the next.

    Attributes:
        step_px: (F-1, C) in the usual time between frames; nan where not known.
        size_px: (F-1,).
        usual_px: the median size.
        noise_px: standard deviation of the size.
    """

    step_px: Floats
    size_px: Floats
    usual_px: float
    noise_px: float

    @classmethod
    def of(cls, moved_px: Floats, duration: Floats) -> _Track:
        """Return a track from what moved (F-1, C) and in how many usual times between frames (F-1,)."""
        comparable = (duration < WIDEST)[:, None]
        step = np.where(comparable, moved_px / np.maximum(duration, 1 / WIDEST)[:, None], np.nan)
        # A step and the next but one are alike whether or not the one between is a repeat.
        noise = robust_sigma((step[2:] - step[:-2]).T) / 2
        size = np.linalg.norm(step, axis=1)
        return cls(step, size, float(finite_median(size)), float(noise.max() * np.sqrt(step.shape[1])))

    def standing_out(self, least_px: float, least: float) -> Bools:
        """Return which steps (F-1,) are no noise."""
        return np.asarray(self.size_px > max(least_px, least * self.noise_px))

    def between(self, chosen: Bools) -> Bools:
        """Return which steps (F-1,) lie between two chosen ones of the same direction."""
        found = np.zeros(len(chosen), dtype=np.bool_)
        along = (self.step_px[:-2] * self.step_px[2:]).sum(axis=1)
        found[1:-1] = chosen[:-2] & chosen[2:] & (along > ALONG * self.size_px[:-2] * self.size_px[2:])
        return found

    def pausing(self, still: float) -> Bools:
        """Return which steps (F-1,) are smaller than this part of the smaller of those beside them."""
        found = np.zeros(len(self.size_px), dtype=np.bool_)
        found[1:-1] = self.size_px[1:-1] < still * np.minimum(self.size_px[:-2], self.size_px[2:])
        return found


def _tracks(recording: Recording) -> list[_Track]:
    duration = np.diff(recording.time_s) / float(np.median(np.diff(recording.time_s)))
    duration = np.where(np.diff(recording.frame) == 1, duration, np.inf)
    moved = [_median(np.moveaxis(np.diff(recording.ground_raw, axis=0), -1, 1))]
    for name, raw in recording.targets_raw.items():
        step, reference = np.diff(midpoints(raw), axis=0), recording.reference.targets_raw[name]
        if reference.ndim == 4:
            across = reference[..., 1, :] - reference[..., 0, :]
            across = across / np.linalg.norm(across, axis=-1, keepdims=True)
            moved.append(_median((step * across).sum(axis=-1)))
        else:
            moved.append(_median(np.moveaxis(step, -1, 1)))
    return [_Track.of(each, duration) for each in moved]


def _median(values: Floats) -> Floats:
    """Return the median of what is finite along the last axis; nan where nothing is."""
    return np.where(np.isfinite(values).any(axis=-1), finite_median(values), np.nan)


def _first_still(track: _Track, tracks: list[_Track], catching_up: int) -> int:
    """Return the first of the steps that stand still before one that catches up; that step itself if none does."""
    earliest, largest = catching_up, STILL * track.size_px[catching_up]
    while earliest > 0 and track.size_px[earliest - 1] < largest:
        earliest -= 1
        largest = min(largest, STILL * track.usual_px)
    for first in range(earliest, catching_up):
        if _is_caught_up(track, first, catching_up) and _all_rest(tracks, first, catching_up):
            refined = range(max(1, first - REFINED_FRAMES), first)
            halts = (step for step in refined if _halt(tracks, step) and _all_rest(tracks, step, catching_up))
            return next(halts, first)
    return catching_up


def _is_caught_up(track: _Track, first: int, catching_up: int) -> bool:
    """Whether a step makes up for those before it, from `first` on, in which the track stands still."""
    size, missed = track.size_px, catching_up - first
    if missed == 1:
        between = track.between(track.standing_out(LEAST_STEP_PX, LEAST_STEP))
        return bool(between[first] and track.pausing(STILL)[first])
    beside = [float(size[step]) for step in (first - 1, catching_up + 1) if 0 <= step < len(size)]
    expected = min(missed + 1, MOST_MISSED) * np.nanmax([*beside, 0.0])
    return bool(size[first:catching_up].max() < STILL * track.usual_px and size[catching_up] > CAUGHT_UP * expected)


def _all_rest(tracks: list[_Track], first: int, catching_up: int) -> bool:
    """Whether all tracks stand still from a step on until another, as far as they are known."""
    sizes = np.nan_to_num([track.size_px[max(first - 1, 0) : catching_up + 1] for track in tracks])
    within = sizes[:, 1:-1] if first > 0 else sizes[:, :-1]
    beside = np.maximum(sizes[:, 0], sizes[:, -1])
    return bool((within.max(axis=1) < np.maximum(REFINED_PX, STILL * beside)).all())


def _halt(tracks: list[_Track], step: int) -> bool:
    """Whether motion comes to a halt with a step, as far as a coder that refines its picture shows it."""
    moved = any(track.standing_out(LEAST_STEP_PX, LEAST_STEP)[step - 1] for track in tracks)
    before, size = np.nan_to_num([track.size_px[step - 1 : step + 1] for track in tracks]).T
    return moved and bool((size < np.maximum(REFINED_PX, STILL * before)).all())


def _are_repeats(tracks: list[_Track], steps: Bools) -> bool:
    """Whether some steps (F-1,), here and there, stand still between their neighbours."""
    shares = []
    for track in tracks:
        moving = track.standing_out(REGULAR_PX, REGULAR_NOISE)
        between = track.between(moving)
        shares.append((between & track.pausing(REGULAR))[steps & (between | moving)])
    still = np.concatenate(shares)
    return len(still) >= LEAST_REGULAR and bool(still.mean() > REGULAR_SHARE)
