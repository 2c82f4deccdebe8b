"""Pictures of single frames, quick enough to step and scrub through: decoded once, kept for a while.

A reader stays open where it last was, so that the next frame costs one decoding step. Going back decodes a short
stretch before the frame asked for, so that the following steps back cost nothing.
"""

from __future__ import annotations

import bisect
import threading
from collections import OrderedDict
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from core.errors import InputError
from core.lens import Lens
from core.video import FrameIndex, frame_index, read_frames_rgb

Picture = NDArray[np.uint8]
Fingerprint = tuple[str, int, int]

JPEG_QUALITY = 90
_FRAME_BYTES = 320 << 20
_JPEG_BYTES = 96 << 20
# Reading on this many frames is quicker than opening the file anew and decoding from a key frame.
_READ_ON = 40
_OPEN_READERS = 3
_AHEAD = 3


class ByteCache:
    """Keeps what was used last, up to a number of bytes."""

    def __init__(self, limit: int, size_of: Callable[[Any], int]) -> None:
        self._limit, self._size_of = limit, size_of
        self._items: OrderedDict[Any, Any] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def get(self, key: Any) -> Any:
        """Return an item, or None."""
        with self._lock:
            if key in self._items:
                self._items.move_to_end(key)
            return self._items.get(key)

    def put(self, key: Any, item: Any) -> None:
        """Keep an item, forgetting the ones not used for longest."""
        with self._lock:
            if key in self._items:
                self._bytes -= self._size_of(self._items.pop(key))
            self._items[key] = item
            self._bytes += self._size_of(item)
            while self._bytes > self._limit and len(self._items) > 1:
                self._bytes -= self._size_of(self._items.popitem(last=False)[1])


class FrameStore:
    """Frames of all videos that are being looked at."""

    def __init__(self) -> None:
        self._frames = ByteCache(_FRAME_BYTES, lambda frame: int(frame.nbytes))
        self._jpegs = ByteCache(_JPEG_BYTES, len)
        self._readers: OrderedDict[Fingerprint, _Reader] = OrderedDict()
        self._lock = threading.Lock()
        self._ahead = ThreadPoolExecutor(1, thread_name_prefix="frames ahead")
        self._undistorting: tuple[Any, tuple[Picture, Picture]] | None = None

    def frame(self, video: Path, number: int) -> Picture:
        """Return a frame, (height, width, 3) RGB upright.

        Raises:
            InputError: there is no such video or no such frame.
        """
        return self._reader(video).frame(number)

    def jpeg(self, video: Path, number: int, *, width: int | None = None, lens: Lens | None = None) -> bytes:
        """Return a frame as JPEG, undistorted where a lens is given, scaled down to `width` where that is smaller.

        Raises:
            InputError: there is no such video or no such frame.
        """
        key = (fingerprint(video), number, width, _lens_key(lens))
        found = self._jpegs.get(key)
        if found is None:
            frame = self.frame(video, number)
            if lens is not None:
                frame = self._undistorted(frame, lens)
            found = jpeg_of(scaled_to(frame, width))
            self._jpegs.put(key, found)
        self._ahead.submit(self._read_ahead, video, number)
        return cast(bytes, found)

    def close(self) -> None:
        """Let go of all files."""
        self._ahead.shutdown(wait=True, cancel_futures=True)
        with self._lock:
            readers = list(self._readers.values())
            self._readers.clear()
        for reader in readers:
            reader.close()

    def _reader(self, video: Path) -> _Reader:
        key = fingerprint(video)
        with self._lock:
            reader = self._readers.pop(key, None) or _Reader(video, key, self._frames)
            self._readers[key] = reader
            idle = [self._readers.popitem(last=False)[1] for _ in range(len(self._readers) - _OPEN_READERS)]
        for forgotten in idle:
            forgotten.close()
        return reader

    def _read_ahead(self, video: Path, number: int) -> None:
        reader = self._reader(video)
        for following in range(number + 1, min(number + 1 + _AHEAD, reader.count)):
            if reader.is_next(following):
                reader.frame(following)

    def _undistorted(self, frame: Picture, lens: Lens) -> Picture:
        key = _lens_key(lens)
        maps = self._undistorting
        if maps is None or maps[0] != key:
            K, size = np.array(lens.camera_matrix), lens.image_size_px
            rows, columns = cv2.initUndistortRectifyMap(K, np.array(lens.distortion), None, K, size, cv2.CV_16SC2)
            maps = self._undistorting = (key, (cast(Picture, rows), cast(Picture, columns)))
        return cast(Picture, cv2.remap(frame, *maps[1], cv2.INTER_LINEAR))


class _Reader:
    """One video, open where it was read last."""

    def __init__(self, video: Path, key: Fingerprint, frames: ByteCache) -> None:
        self._video, self._key, self._frames = video, key, frames
        self._stream: Generator[tuple[int, Picture], None, None] | None = None
        self._next = 0
        self._lock = threading.Lock()

    @cached_property
    def _index(self) -> FrameIndex:
        return frame_index(self._video)

    @property
    def count(self) -> int:
        return len(self._index)

    @cached_property
    def _key_frames(self) -> list[int]:
        return [bisect.bisect_left(self._index.ticks, tick) for tick in self._index.key_ticks]

    def frame(self, number: int) -> Picture:
        # The first picture of a video that was just added is there at once: only others need to know where they lie.
        if number != 0 and not 0 <= number < self.count:
            raise InputError(
                f"{self._video.name}: has frames 0 to {self.count - 1}, so there is no frame {number}; choose another."
            )
        found = self._frames.get((self._key, number))
        if found is not None:
            return cast(Picture, found)
        with self._lock:
            found = self._frames.get((self._key, number))
            return cast(Picture, found) if found is not None else self._read(number)

    def is_next(self, number: int) -> bool:
        return self._stream is not None and self._next == number

    def close(self) -> None:
        with self._lock:
            self._close()

    def _read(self, number: int) -> Picture:
        if self._stream is None or not self._may_read_on(number):
            self._open(self._start_for(number))
        assert self._stream is not None
        for index, picture in self._stream:
            self._next = index + 1
            picture.flags.writeable = False
            self._frames.put((self._key, index), picture)
            if index >= number:
                return picture
        self._close()
        raise InputError(f"{self._video.name}: frame {number} cannot be decoded; export the video again.")

    def _may_read_on(self, number: int) -> bool:
        if number == self._next:
            return True
        gap = number - self._next
        key_frame = self._key_frame_before(number)
        return gap >= 0 and (gap <= _READ_ON or key_frame <= self._next) and not key_frame > self._next + 8

    def _start_for(self, number: int) -> int:
        """Where to begin so that steps back from here are quick: a few frames earlier, if they were just asked for."""
        if number == 0:
            return 0
        stepping_back = self._stream is not None and number < self._next <= number + _READ_ON
        if not stepping_back:
            return number
        sample = self._frames.get((self._key, number + 1))
        stretch = _FRAME_BYTES // (3 * sample.nbytes) if sample is not None else 1
        return max(0, number - min(stretch, _READ_ON), self._key_frame_before(number))

    def _key_frame_before(self, number: int) -> int:
        place = bisect.bisect_right(self._key_frames, number)
        return self._key_frames[place - 1] if place else 0

    def _open(self, start: int) -> None:
        self._close()
        self._stream = cast(Generator[tuple[int, Picture], None, None], read_frames_rgb(self._video, start))
        self._next = start

    def _close(self) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None


def fingerprint(file: Path) -> Fingerprint:
    """Return what changes with a file's content.

    Raises:
        InputError: it is not there.
    """
    try:
        state = file.stat()
    except OSError:
        raise InputError(f"{file}: not found; choose it again in the inputs.") from None
    return str(file), state.st_size, state.st_mtime_ns


def scaled_to(picture: Picture, width: int | None) -> Picture:
    """Return a picture no wider than `width`, averaged, so that fine lines do not flicker."""
    height_now, width_now = picture.shape[:2]
    if width is None or width >= width_now:
        return picture
    size = (width, max(1, round(height_now * width / width_now)))
    return cast(Picture, cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def jpeg_of(picture: Picture) -> bytes:
    """Return an RGB or grey picture as JPEG."""
    bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if picture.ndim == 3 else picture
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def png_of(rgb: Picture, opacity: Picture) -> bytes:
    """Return a picture with transparent places as PNG."""
    bgra = np.dstack([rgb[..., ::-1], opacity])
    return cv2.imencode(".png", bgra, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes()


def _lens_key(lens: Lens | None) -> Any:
    if lens is None:
        return None
    return lens.camera_matrix.tobytes() + lens.distortion.tobytes(), lens.image_size_px
