"""Any frame of a video, quickly: the file stays open, and what is decoded on the way to a frame is kept.

A frame can only be decoded after all those since the key frame before it. So a jump costs up to a group of pictures,
and the steps after it, onwards and back, cost nothing where they lie in the same group.
"""

from __future__ import annotations

import bisect
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cached_property

from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from core.errors import InputError
from core.storage import File
from core.video import FrameIndex, decoded_pictures, frame_index, opened_video

# Decoding on over so many frames is quicker than seeking to a key frame, which empties the decoder's threads.
_READ_ON = 8


class SeekingReader:
    """One video, open where it was read last."""

    def __init__(
        self, video: File, kept: Callable[[int], VideoFrame | None], keep: Callable[[int, VideoFrame], None]
    ) -> None:
        """Read a video; `kept` and `keep` fetch and store decoded frames by number, wherever that is done."""
        self._video, self._kept, self._keep = video, kept, keep
        self._opened_now: tuple[InputContainer, VideoStream] | None = None
        self._closing = ExitStack()
        self._pictures: Iterator[VideoFrame] | None = None
        self._first = self._next = 0
        self._lock = threading.Lock()

    @cached_property
    def index(self) -> FrameIndex:
        """Where every frame lies."""
        return frame_index(self._video)

    @cached_property
    def _key_frames(self) -> list[int]:
        return self.index.key_frames

    def frame(self, number: int) -> VideoFrame:
        """Return a frame as decoded.

        Raises:
            InputError: there is no such video or no such frame.
        """
        # The first picture of a video that was just added is there at once: only others need to know where they lie.
        if number != 0 and not 0 <= number < len(self.index):
            last = len(self.index) - 1
            raise InputError(
                f"{self._video.name}: has frames 0 to {last}, so there is no frame {number}; choose another."
            )
        found = self._kept(number)
        if found is not None:
            return found
        with self._lock:
            return self._kept(number) or self._decoded(number)

    def is_next(self, number: int) -> bool:
        """Whether a frame is the next one to be decoded."""
        return self._pictures is not None and self._next == number

    def key_frame_before(self, number: int) -> int:
        """Return the last frame up to this one that can be decoded by itself."""
        place = bisect.bisect_right(self._key_frames, number)
        return self._key_frames[place - 1] if place else 0

    def close(self) -> None:
        """Let go of the file."""
        with self._lock:
            self._close()

    def _decoded(self, number: int) -> VideoFrame:
        if self._pictures is None or not self._may_read_on(number):
            self._seek(number)
        assert self._pictures is not None
        for picture in self._pictures:
            at = 0 if number == 0 and self._begins_with(picture) else self.index.number_at(picture.pts)
            if at is None or at < self._first:
                continue
            self._next = at + 1
            self._keep(at, picture)
            if at == number:
                return picture
            if at > number:
                break
        self._close()
        raise InputError(f"{self._video.name}: frame {number} cannot be decoded; export the video again.")

    def _begins_with(self, picture: VideoFrame) -> bool:
        """Whether a picture is known to be the first without the whole file being looked through."""
        _, stream = self._opened()
        return picture.key_frame and picture.pts is not None and picture.pts == stream.start_time

    def _may_read_on(self, number: int) -> bool:
        if number < self._next:
            return False
        return number - self._next <= _READ_ON or self.key_frame_before(number) <= self._next

    def _seek(self, number: int) -> None:
        container, stream = self._opened()
        # In an open group of pictures, frames that follow the key frame in the file are shown before it, and cannot be
        # decoded from it: they are left to whoever asks for them, and starts a key frame earlier.
        self._first = self.key_frame_before(number) if number > 0 else 0
        if number > 0:
            container.seek(self.index.ticks[self._first], stream=stream, backward=True)
        elif self._pictures is not None:
            container.seek(0)
        self._pictures = decoded_pictures(container, stream)
        self._next = self._first

    def _opened(self) -> tuple[InputContainer, VideoStream]:
        if self._opened_now is None:
            self._opened_now = self._closing.enter_context(opened_video(self._video))
            self._opened_now[1].codec_context.thread_type = "AUTO"
        return self._opened_now

    def _close(self) -> None:
        self._pictures = self._opened_now = None
        self._closing.close()
