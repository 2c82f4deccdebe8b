"""Frames in any order are those of reading on, whatever the group of pictures they lie in."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from app.frames import FrameStore
from app.seeking import SeekingReader
from core.errors import InputError
from core.video import read_frames
from tests.core.test_video import FRAMES, write
from tests.packets import repacked

ORDER = (0, 30, 29, 12, 11, 13, 36, 49, 5, 23, 24, 25, 2, 1, 0, 48)


@pytest.mark.parametrize("options", [{}, {"x264-params": "open-gop=1:keyint=12:bframes=3"}], ids=["closed", "open"])
@pytest.mark.parametrize("rotation", [0, 90])
def test_frames_asked_for_in_any_order_are_those_of_reading_on(
    tmp_path: Path, options: dict[str, str], rotation: int
) -> None:
    file = write(tmp_path / "clip.mp4", options=options, rotation=rotation)
    with av.open(str(file)) as container:
        shown = container.decode(video=0)
        forwards = [np.rot90(picture.to_ndarray(format="rgb24"), picture.rotation // 90) for picture in shown]
    store = FrameStore()
    for number in ORDER:
        assert np.array_equal(store.frame(file, number), forwards[number]), number
        store.jpeg(file, number)  # meanwhile frames before and after are fetched by a thread
    store.close()
    with pytest.raises(InputError, match=f"has frames 0 to {FRAMES - 1}"):
        FrameStore().frame(file, FRAMES)


def test_what_lies_on_the_way_to_a_frame_is_decoded_once(tmp_path: Path) -> None:
    decoded: dict[int, object] = {}
    twice: list[int] = []

    def keep(number: int, frame: object) -> None:
        if number in decoded:
            twice.append(number)
        decoded[number] = frame

    reader = SeekingReader(write(tmp_path / "clip.mp4"), decoded.get, keep)  # type: ignore[arg-type]
    for number in (33, 32, 31, 30, 29, 28, 27, 26, 25, 24):
        reader.frame(number)
    assert (min(decoded), max(decoded), twice) == (24, 33, [])
    reader.close()


def test_a_file_that_is_no_video_is_refused_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"not a video")
    for number in (0, 3):
        with pytest.raises(InputError, match=r"clip\.mp4: .*copy it again if it was cut off, or export it"):
            FrameStore().frame(tmp_path / "clip.mp4", number)


def test_another_picture_is_not_shown_as_the_first(tmp_path: Path) -> None:
    noise = np.random.default_rng(1)
    with av.open(str(tmp_path / "clip.mp4"), "w") as made:
        stream = made.add_stream("libx264", rate=30, options={"g": "10", "bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        grey = cv2.GaussianBlur(noise.integers(0, 255, (240, 320)).astype(np.uint8), (0, 0), 3) // 4
        for number in range(40):
            picture = np.stack([grey + np.uint8(4 * number)] * 3, axis=-1)
            made.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        made.mux(stream.encode())

    def damaged(number: int, packet: bytes) -> bytes:
        half = len(packet) // 2
        return packet[:half] + noise.bytes(len(packet) - half) if number == 0 else packet

    clip = repacked(tmp_path / "clip.mp4", tmp_path / "damaged.mp4", damaged)
    assert next(read_frames(clip)).index > 0
    with pytest.raises(InputError, match="frame 0 cannot be decoded"):
        FrameStore().frame(clip, 0)
