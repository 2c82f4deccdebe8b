"""Pictures of single frames, quick enough to step and scrub through: decoded once, kept for a while.

Whoever looks at a frame looks next at the one after it, or before it: both are decoded before they are asked for.
"""

from __future__ import annotations

import hashlib
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from app.seeking import SeekingReader
from core.errors import InputError
from core.lens import Lens
from core.storage import FarFile, File, FileState, content_identity, file_at, state_of

Picture = NDArray[np.uint8]
Fingerprint = tuple[str, int, int | str]

JPEG_QUALITY = 90
# As decoded, a frame of 4K takes 12 MB: enough for a group of pictures and those fetched before and after.
_DECODED_BYTES = 448 << 20
_PICTURE_BYTES = 80 << 20
_JPEG_BYTES = 96 << 20
_OPEN_VIDEOS = 3
# A file that lies far away is looked at again after so many seconds.
_ASKED_AGAIN_S = 30.0
_AHEAD = 3
_BEHIND = 6


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
        self._decoded = ByteCache(_DECODED_BYTES, _size_of)
        self._pictures = ByteCache(_PICTURE_BYTES, lambda picture: int(picture.nbytes))
        self._jpegs = ByteCache(_JPEG_BYTES, len)
        self._videos: OrderedDict[Fingerprint, _Video] = OrderedDict()
        self._lock = threading.Lock()
        self._ahead = ThreadPoolExecutor(1, thread_name_prefix="frames ahead")
        self._wanted: tuple[Fingerprint, int] | None = None
        self._undistorting: tuple[Any, tuple[Picture, Picture]] | None = None

    def frame(self, video: File, number: int) -> Picture:
        """Return a frame, (height, width, 3) RGB upright.

        Raises:
            InputError: there is no such video or no such frame.
        """
        key = (fingerprint(video), number)
        found = self._pictures.get(key)
        if found is None:
            found = _upright(self._video(video).onwards.frame(number))
            self._pictures.put(key, found)
        return cast(Picture, found)

    def jpeg(self, video: File, number: int, *, width: int | None = None, lens: Lens | None = None) -> bytes:
        """Return a frame as JPEG, undistorted where a lens is given, scaled down to `width` where that is smaller.

        Raises:
            InputError: there is no such video or no such frame.
        """
        key = _jpeg_key(video, number, width, lens)
        found = self._jpegs.get(key)
        if found is None:
            frame = self.frame(video, number)
            if lens is not None:
                frame = self._undistorted(frame, lens)
            found = jpeg_of(scaled_to(frame, width))
            self._jpegs.put(key, found)
        self._wanted = (fingerprint(video), number)
        self._ahead.submit(self._prepare, video, number)
        return cast(bytes, found)

    def close(self) -> None:
        """Let go of all files."""
        self._wanted = None
        self._ahead.shutdown(wait=True, cancel_futures=True)
        with self._lock:
            videos = list(self._videos.values())
            self._videos.clear()
        for video in videos:
            video.close()

    def _video(self, file: File) -> _Video:
        key = fingerprint(file)
        with self._lock:
            video = self._videos.pop(key, None) or _Video(file, key, self._decoded)
            self._videos[key] = video
            idle = [self._videos.popitem(last=False)[1] for _ in range(len(self._videos) - _OPEN_VIDEOS)]
        for forgotten in idle:
            forgotten.close()
        return video

    def _prepare(self, file: File, number: int) -> None:
        """Decode what is likely to be asked for next; stops when something else is."""
        video = self._video(file)
        for following in range(number + 1, min(number + 1 + _AHEAD, len(video.onwards.index))):
            if self._wanted == (video.key, number) and video.onwards.is_next(following):
                video.onwards.frame(following)
        missing = [before for before in range(max(0, number - _BEHIND), number) if not video.has(before)]
        for before in missing:
            if self._wanted != (video.key, number):
                return
            video.backwards.frame(before)

    def _undistorted(self, frame: Picture, lens: Lens) -> Picture:
        key = _lens_key(lens)
        maps = self._undistorting
        if maps is None or maps[0] != key:
            K, size = np.array(lens.camera_matrix), lens.image_size_px
            rows, columns = cv2.initUndistortRectifyMap(K, np.array(lens.distortion), None, K, size, cv2.CV_16SC2)
            maps = self._undistorting = (key, (cast(Picture, rows), cast(Picture, columns)))
        return cast(Picture, cv2.remap(frame, *maps[1], cv2.INTER_LINEAR))


class _Video:
    """A video opened twice: where a person looks, and where the frames before are fetched from meanwhile."""

    def __init__(self, file: File, key: Fingerprint, decoded: ByteCache) -> None:
        self.key, self._decoded = key, decoded
        self.onwards, self.backwards = (SeekingReader(file, self._kept, self._keep) for _ in range(2))

    def has(self, number: int) -> bool:
        """Whether a frame is decoded."""
        return self._kept(number) is not None

    def close(self) -> None:
        self.onwards.close()
        self.backwards.close()

    def _kept(self, number: int) -> VideoFrame | None:
        return cast("VideoFrame | None", self._decoded.get((self.key, number)))

    def _keep(self, number: int, frame: VideoFrame) -> None:
        self._decoded.put((self.key, number), frame)


def _size_of(frame: VideoFrame) -> int:
    return sum(plane.buffer_size for plane in frame.planes)


def _upright(frame: VideoFrame) -> Picture:
    """Return (height, width, 3) RGB; with a converter of its own, since two threads may ask for one frame."""
    rgb = VideoReformatter().reformat(frame, format="rgb24").to_ndarray()
    picture = np.ascontiguousarray(np.rot90(rgb, frame.rotation // 90))
    picture.flags.writeable = False
    return cast(Picture, picture)


def fingerprint(file: File) -> Fingerprint:
    """Return what changes with a file's content; see `file_of`.

    Raises:
        InputError: it is not there.
    """
    if isinstance(file, FarFile):
        far = _far_state(file, int(time.monotonic() / _ASKED_AGAIN_S))
        return str(file), far.size, far.version
    try:
        state = file.stat()
    except OSError:
        raise InputError(f"{file}: not found; choose it again in the inputs.") from None
    return str(file), state.st_size, state.st_mtime_ns


@lru_cache(maxsize=32)
def _far_state(file: FarFile, moment: int) -> FileState:
    """Return the state of a file that lies far away; asked for only once a moment, since every page needs it."""
    return state_of(file)


def file_of(key: Fingerprint) -> File:
    """Return the file a fingerprint was taken of."""
    return file_at(Path(), key[0])


def identity(file: File) -> str:
    """Return a name for a file's content; its bytes are looked at only where its size or time has changed.

    Raises:
        InputError: it is not there.
    """
    return _identity(fingerprint(file))


@lru_cache(maxsize=256)
def _identity(key: Fingerprint) -> str:
    try:
        return content_identity(file_of(key))
    except OSError as error:
        raise InputError(f"{key[0]}: cannot be read ({error.strerror}); choose it again in the inputs.") from None


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


def jpeg_tag(video: File, number: int, *, width: int | None = None, lens: Lens | None = None) -> str:
    """Return what changes with the JPEG of a frame, without decoding it.

    Raises:
        InputError: there is no such video.
    """
    return hashlib.sha256(repr((JPEG_QUALITY, *_jpeg_key(video, number, width, lens))).encode()).hexdigest()[:32]


def _jpeg_key(video: File, number: int, width: int | None, lens: Lens | None) -> Any:
    return fingerprint(video), number, width, _lens_key(lens)


def _lens_key(lens: Lens | None) -> Any:
    if lens is None:
        return None
    return lens.camera_matrix.tobytes() + lens.distortion.tobytes(), lens.image_size_px
