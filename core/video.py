"""Video in: upright luma planes with the container's own timestamps, in presentation order, in constant memory.

Everything is measured on luma, which a decoder delivers without any conversion. Frame numbers count presentation
order from 0; times are seconds since the first presented frame. Edit lists and rotation flags are honoured.
"""

from __future__ import annotations

import ctypes
import itertools
import queue
import sys
import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import av
import numpy as np
from av.container import InputContainer
from av.sidedata.sidedata import SideData
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from numpy.typing import NDArray

from core.errors import InputError
from core.parallel import available_cores
from core.storage import File, FileState, opened, state_of

Luma = NDArray[np.uint8]
# Frames decoded ahead of the one being measured: enough to keep the decoder busy, 12 MB each at 4K.
READ_AHEAD = 6
# A decoder's threads wait for each other and for whoever takes the frames: several for each core keep it busy.
THREADS_PER_CORE = 3
MOST_THREADS = 16
# Smoothing the blocks' edges of pictures that no other is told from takes a decoder up to a tenth of its time, and
# nothing that is measured gains by it (rendered clips, with and without: the same errors to a hundredth).
AS_MEASURED = {"skip_loop_filter": "noref"}
# Pictures that tell whether a video is shown in another order than its times say: several times as many as any encoder
# puts off.
JUDGED_BY = 32
# What is larger is a picture: its memory is the system's and not an arena's. What is smaller is needed again for the
# next frame, so an arena keeps some of it. The other two are glibc's numbers for these settings.
PICTURE_BYTES = 1 << 20
KEPT_BYTES = 1 << 24
_M_MMAP_THRESHOLD = -3
_M_TRIM_THRESHOLD = -1
# Containers round, count the sound, and add how long the last frame is shown; this is more than all of that.
_MISSING_S = 1.0
EIGHT_BIT_LUMA = ("yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "nv12", "gray")


@dataclass(frozen=True)
class VideoInfo:
    """What a container says of its video, upright.

    Attributes:
        frames: as declared by the container; None where it does not say.
        rotation_deg: clockwise turn that was applied to make frames upright (0, 90, 180, 270).
        is_interlaced: whether even and odd rows of a frame were filmed one after the other.
    """

    width: int
    height: int
    frames: int | None
    duration_s: float
    rate_hz: float
    codec: str
    rotation_deg: int
    is_interlaced: bool


@dataclass(frozen=True)
class Frame:
    """One presented frame: `luma` is (height, width), raw pixels, read-only by convention."""

    index: int
    time_s: float
    luma: Luma


@dataclass(frozen=True)
class FrameIndex:
    """Where every presented frame lies: timestamps in stream ticks, ascending, and which may be decoded first."""

    ticks: tuple[int, ...]
    key_ticks: tuple[int, ...]
    tick_s: float

    def __len__(self) -> int:
        return len(self.ticks)

    @property
    def key_frames(self) -> list[int]:
        """Numbers of the frames that decoding can begin with, ascending."""
        return [int(number) for number in np.searchsorted(self.ticks, self.key_ticks)]

    @property
    def time_s(self) -> NDArray[np.float64]:
        """(F,) seconds since the first presented frame."""
        return (np.array(self.ticks, dtype=np.float64) - self.ticks[0]) * self.tick_s

    def time_s_of(self, number: int) -> float:
        """Return seconds from the first presented frame to another."""
        return float((self.ticks[number] - self.ticks[0]) * self.tick_s)

    def number_at(self, tick: int | None) -> int | None:
        """Return the number of the frame that bears a timestamp, or None where none does."""
        place = len(self) if tick is None else bisect_left(self.ticks, tick)
        return place if place < len(self) and self.ticks[place] == tick else None


@contextmanager
def opened_video(path: File) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open a video and its stream of pictures: of several, as with a thumbnail, the one with the largest frames.

    Raises:
        InputError: as `probe`, but for what only decoding tells.
    """
    with ExitStack() as stack:
        # FFmpeg opens what lies on this machine itself; what a name begins with, up to a colon, is a protocol to it.
        source = str(path.absolute()) if isinstance(path, Path) else stack.enter_context(opened(path))
        container = stack.enter_context(_container(path, source))
        if _is_picture(container):
            raise InputError(f"{path}: is a picture and no video; choose the file with the film.")
        if not container.streams.video:
            raise InputError(f"{path}: holds no video stream; choose the file with the pictures.")
        yield container, max(container.streams.video, key=_is_film_and_size)


def _is_picture(container: InputContainer) -> bool:
    """Whether FFmpeg reads it by what it calls a pipe of pictures, of which this one is the first and last."""
    return container.format.name.endswith("_pipe") or container.format.name == "image2"


def _is_film_and_size(stream: VideoStream) -> tuple[bool, int]:
    """Order streams of pictures: a cover picture, however large, comes before any film."""
    return not stream.disposition & Disposition.attached_pic, stream.width * stream.height


def _container(path: File, source: str | BinaryIO) -> InputContainer:
    try:
        return av.open(source, "r")
    except FileNotFoundError:
        raise InputError(f"{path}: not found; correct inputs.video or put the file there.") from None
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be opened as a video ({_reason(error)}); copy it again if it was cut off, or "
            "export it as MP4."
        ) from None


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)


def probe(path: File) -> VideoInfo:
    """Return what the container and its first frame say, without reading the rest.

    Raises:
        InputError: no such file, no container, no video stream, no frame that can be decoded, or one to be mirrored.
    """
    with opened_video(path) as (container, stream):
        frame = next(decoded_pictures(container, stream), None)
        if frame is None:
            raise InputError(f"{path}: not one frame can be decoded; export the video again as H.264 MP4.")
        _require_turned_only(path, frame)
        quarter_turned = frame.rotation % 180 != 0
        width, height = (frame.height, frame.width) if quarter_turned else (frame.width, frame.height)
        duration_s = _duration_s(container, stream)
        rate_hz = float(stream.average_rate or stream.guessed_rate or 0)
        return VideoInfo(
            width=width,
            height=height,
            frames=stream.frames or None,
            duration_s=duration_s,
            rate_hz=rate_hz,
            codec=stream.codec_context.codec.canonical_name,
            rotation_deg=-frame.rotation % 360,
            # Of what the stream says besides, not every codec fills in the order of fields.
            is_interlaced=frame.interlaced_frame,
        )


def _require_turned_only(path: File, frame: VideoFrame) -> None:
    """Refuse a video that is to be shown in another way than as filmed or in quarter turns of it.

    Source: FFmpeg, libavutil/display.h: the matrix's first two rows hold two numbers each and one for perspective.
    """
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if not isinstance(matrix, SideData):
        return
    a, b, _, c, d = np.frombuffer(memoryview(matrix), dtype=np.int32)[:5].astype(np.float64)
    mirrored = a * d - b * c < 0
    if mirrored or frame.rotation % 90:
        how = "mirrored" if mirrored else f"turned by {abs(frame.rotation)} degrees"
        raise InputError(
            f"{path}: says that it is to be shown {how}, which frames are not measured in; export it again the way the "
            "camera saw it."
        )


def _duration_s(container: InputContainer, stream: VideoStream) -> float:
    if stream.duration is not None and stream.time_base is not None:
        return float(stream.duration * stream.time_base)
    return float(container.duration or 0) / av.time_base


def video_warnings(name: str, info: VideoInfo, last_s: float | None) -> list[str]:
    """Return what an engineer must know of a video that can be measured, in sentences that begin with its name.

    Args:
        last_s: time of the last frame, None where that is not known yet.
    """
    warnings = []
    if info.is_interlaced:
        warnings.append(
            f"{name}: says that it is interlaced, so even and odd rows of a frame show two moments, and what moves is "
            "measured between the two; film without interlacing, or deinterlace it, with FFmpeg's bwdif for instance."
        )
    if last_s is not None and info.duration_s - last_s >= _MISSING_S:
        warnings.append(
            f"{name}: says that it lasts {info.duration_s:.1f} s, but its frames end at {last_s:.1f} s, "
            "as in a file that was cut off; copy it again."
        )
    return warnings


def frame_index(path: File) -> FrameIndex:
    """Return the index of all presented frames, read from the packets without decoding; kept while the file stays.

    Raises:
        InputError: as `probe`.
    """
    try:
        state = state_of(path)
    except OSError:
        raise InputError(f"{path}: not found; correct inputs.video or put the file there.") from None
    return _frame_index(path.resolve() if isinstance(path, Path) else path, state)


@lru_cache(maxsize=16)
def _frame_index(path: File, state: FileState) -> FrameIndex:
    ticks: list[int] = []
    keys: list[int] = []
    first_key: int | None = None
    with opened_video(path) as (container, stream):
        for packet in _packets(container, stream):
            if packet.pts is None:
                continue
            if packet.is_keyframe and first_key is None:
                first_key = packet.pts
            if packet.is_discard:
                continue
            ticks.append(packet.pts)
            if packet.is_keyframe:
                keys.append(packet.pts)
        tick_s = float(stream.time_base or 0)
        reorders = stream.codec_context.has_b_frames
    if reorders and ticks == sorted(ticks):
        _require_times_as_shown(path)
    if first_key is not None:
        # A clip cut out of a longer one may begin with frames that need others from before the cut.
        ticks = [tick for tick in ticks if tick >= first_key]
    if not ticks:
        raise InputError(f"{path}: its video stream holds no frames that bear a time; export the video again as MP4.")
    if repeated := len(ticks) - len(set(ticks)):
        raise InputError(
            f"{path}: {repeated} of its {len(ticks)} frames bear the time of another; export the video again, with "
            "timestamps that increase from frame to frame."
        )
    return FrameIndex(ticks=tuple(sorted(ticks)), key_ticks=tuple(sorted(keys)), tick_s=tick_s)


def _require_times_as_shown(path: File) -> None:
    """Refuse a video whose pictures come out of the decoder, which puts them in order, with times that run backwards.

    Raises:
        InputError: its container knows only when frames are decoded.
    """
    with opened_video(path) as (container, stream):
        shown = [picture.pts or 0 for picture in itertools.islice(decoded_pictures(container, stream), JUDGED_BY)]
    if shown != sorted(shown):
        raise InputError(
            f"{path}: its frames bear the times at which they are decoded and not those at which they are shown, as "
            "AVI files do; export the video again as MP4."
        )


class FramesAhead:
    """Frames `start` to `stop` (exclusive; None for all), decoded ahead in a thread of its own from now on.

    A context, at whose end the thread is gone. Frames that are damaged are left out, which their numbers show.

    Args:
        threads: decoder threads, 0 for as many as keep all cores busy while somebody works on the frames.
        index: of the file, where it is known already; read where None.

    Attributes:
        start: number of the first frame.
    """

    def __init__(
        self, path: File, start: int = 0, stop: int | None = None, *, threads: int = 0, index: FrameIndex | None = None
    ) -> None:
        _give_pictures_back()
        self.start = start
        index = index or frame_index(path)
        self._ahead: queue.Queue[Frame | Exception | None] = queue.Queue(maxsize=READ_AHEAD)
        self._seen: deque[Frame] = deque()
        self._ended = False
        self._stopped = threading.Event()
        threads = threads or min(MOST_THREADS, THREADS_PER_CORE * available_cores())
        decoded = _decoded(path, index, start=start, stop=stop, threads=threads)
        frames = (Frame(number, index.time_s_of(number), luma_of(picture)) for number, picture in decoded)
        self._thread = threading.Thread(target=self._decode, args=(frames,), name="video decoder", daemon=True)
        self._thread.start()

    def __enter__(self) -> FramesAhead:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopped.set()
        self._thread.join()

    def peek(self) -> Iterator[Frame]:
        """Yield the frames to come, all of which will be yielded all the same.

        Raises:
            InputError: as when they are yielded.
        """
        for number in itertools.count():
            if number == len(self._seen):
                if (frame := self._next()) is None:
                    return
                self._seen.append(frame)
            yield self._seen[number]

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames in order.

        Raises:
            InputError: the file cannot be read, or `start` lies beyond its end.
        """
        while (frame := self._seen.popleft() if self._seen else self._next()) is not None:
            yield frame

    def _next(self) -> Frame | None:
        item = None if self._ended else self._ahead.get()
        self._ended = item is None or isinstance(item, Exception)
        if isinstance(item, Exception):
            raise item
        return item

    def _decode(self, frames: Iterator[Frame]) -> None:
        try:
            for frame in frames:
                if not self._hand_over(frame):
                    return
            self._hand_over(None)
        except Exception as error:  # handed to the reading thread, which raises it
            self._hand_over(error)

    def _hand_over(self, item: Frame | Exception | None) -> bool:
        while not self._stopped.is_set():
            try:
                self._ahead.put(item, timeout=0.1)
            except queue.Full:
                continue
            return True
        return False


@cache
def _give_pictures_back() -> None:
    """Have the memory of pictures go back to the system when they do; glibc would keep it for threads that are gone."""
    if sys.platform == "linux" and (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(_M_MMAP_THRESHOLD, PICTURE_BYTES)
        mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES)


def read_frames(
    path: File, start: int = 0, stop: int | None = None, *, threads: int = 0, index: FrameIndex | None = None
) -> Iterator[Frame]:
    """Yield frames `start` to `stop`; see `FramesAhead`.

    Raises:
        InputError: the file cannot be read, or `start` lies beyond its end.
    """
    with FramesAhead(path, start, stop, threads=threads, index=index) as frames:
        yield from frames


def read_frame(path: File, number: int, *, index: FrameIndex | None = None) -> Frame:
    """Return one frame by its number.

    Args:
        index: as for `read_frames`.

    Raises:
        InputError: as `read_frames`, or the frame is damaged.
    """
    for frame in read_frames(path, number, number + 1, threads=available_cores(), index=index):
        return frame
    raise InputError(f"{path}: frame {number} cannot be decoded; choose another, or export the video again.")


def _decoded(
    path: File, index: FrameIndex, *, start: int, stop: int | None, threads: int
) -> Iterator[tuple[int, VideoFrame]]:
    """Yield numbers and pictures of what can be decoded of frames `start` to `stop`.

    A decoder tells of damage before it yields a key frame that it holds back; the number that is then missing tells of
    it once more.

    Raises:
        InputError: there is no such frame, the file cannot be read on, or pictures of another size begin in it.
    """
    if start >= len(index):
        raise InputError(f"{path}: has {len(index)} frames, so there is no frame {start}; choose a smaller number.")
    with opened_video(path) as (container, stream):
        stream.codec_context.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        stream.codec_context.options = dict(AS_MEASURED)
        size = stream.width, stream.height
        if start > 0:
            _seek(container, stream, index, start)
        whole, expected = True, len(index)
        for picture in decoded_pictures(container, stream):
            number = index.number_at(picture.pts)
            if number is None:
                continue
            whole = picture.key_frame or (whole and number <= expected)
            expected = number + 1
            if stop is not None and number >= stop:
                return
            if number < start or not whole:
                continue
            if (picture.width, picture.height) != size:
                raise InputError(
                    f"{path}: frame {number} ({index.time_s_of(number):.2f} s) is {picture.width} x "
                    f"{picture.height} pixels, but the video begins with {size[0]} x {size[1]}; cut it there."
                )
            yield number, picture


def decoded_pictures(container: InputContainer, stream: VideoStream) -> Iterator[VideoFrame]:
    """Yield all pictures from where a video stands on; what is damaged, or builds on what is, is left out.

    Pictures between key frames are told by what changed since others. Where one of those is missing, a decoder takes
    what it has instead, and the picture is that of another moment or drifts away.

    Raises:
        InputError: the file cannot be read on.
    """
    whole = True
    for packet in _packets(container, stream):
        try:
            pictures = packet.decode()
        except av.error.InvalidDataError:
            whole = False
            continue
        for picture in pictures:
            whole = (whole or picture.key_frame) and not picture.is_corrupt
            if whole:
                yield picture


def _packets(container: InputContainer, stream: VideoStream) -> Iterator[av.Packet[VideoStream]]:
    """Yield packets to the end of the file, or to where its structure is broken."""
    packets = container.demux(stream)
    while True:
        try:
            yield next(packets)
        except (StopIteration, av.error.InvalidDataError):
            return
        except (av.error.FFmpegError, OSError) as error:
            raise InputError(f"{container.name}: cannot be read on ({_reason(error)}); try again.") from None


def _seek(container: InputContainer, stream: VideoStream, index: FrameIndex, start: int) -> None:
    """Go to the last key frame at or before frame `start`."""
    keys = [tick for tick in index.key_ticks if tick <= index.ticks[start]]
    if keys:
        container.seek(keys[-1], stream=stream, backward=True)


def luma_of(picture: VideoFrame) -> Luma:
    """Return a picture's luma plane, (height, width) upright, copied only where it must be turned or converted."""
    if picture.format.name in EIGHT_BIT_LUMA:
        plane = picture.planes[0]
        rows = np.frombuffer(memoryview(plane), dtype=np.uint8).reshape(-1, plane.line_size)
        luma: Luma = rows[: picture.height, : picture.width]
    else:
        luma = np.asarray(picture.to_ndarray(format="gray"), dtype=np.uint8)
    return np.ascontiguousarray(np.rot90(luma, picture.rotation // 90)) if picture.rotation else luma
