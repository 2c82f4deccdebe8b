from __future__ import annotations

import itertools
import threading
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.stream import Disposition
from av.video.frame import PictureType

from core.errors import InputError
from core.video import FramesAhead, Luma, frame_index, luma_of, probe, read_frame, read_frames, video_warnings
from tests.packets import repacked, shown_by

SIZE = (96, 64)
FRAMES = 50


def picture(number: int, size: tuple[int, int] = SIZE) -> Luma:
    """A frame that shows its own number in twelve blocks, brightest in the top left corner."""
    width, height = size
    luma = np.full((height, width), 60, dtype=np.uint8)
    luma[: height // 4, : width // 4] = 235
    for bit in range(8):
        luma[height // 2 :, bit * width // 8 : (bit + 1) * width // 8] = 200 if number >> bit & 1 else 20
    return luma


def number_of(luma: Luma) -> int:
    height, width = luma.shape
    middles = [luma[3 * height // 4, (2 * bit + 1) * width // 16] > 110 for bit in range(8)]
    return sum(1 << bit for bit, on in enumerate(middles) if on)


def write(
    file: Path,
    *,
    frames: int = FRAMES,
    size: tuple[int, int] = SIZE,
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    ticks: list[int] | None = None,
    rotation: int = 0,
    options: dict[str, str] | None = None,
) -> Path:
    """Write a video with B-frames and a key frame every twelve frames; ticks are thousandths of a second."""
    with av.open(str(file.absolute()), "w") as container:
        stream = container.add_stream(codec, rate=25, options={"bf": "3", "g": "12", **(options or {})})
        stream.width, stream.height = size
        stream.pix_fmt = pix_fmt
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for number in range(frames):
            frame = av.VideoFrame.from_ndarray(picture(number, size), format="gray").reformat(format=pix_fmt)
            frame.pts = ticks[number] if ticks else 40 * number
            frame.time_base = Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    if rotation:
        _turned(file, rotation)
    return file


def _turned(file: Path, rotation: int) -> None:
    """Set the display matrix of an MP4 file: the turn, clockwise, that a player must make."""
    cosine, sine = {90: (0, 1), 180: (-1, 0), 270: (0, -1)}[rotation]
    shown_by(file, (cosine, sine, -sine, cosine))


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("video") / "video.mp4")


# --- every frame, once, in order -------------------------------------------------------------------------------------


def test_what_the_container_says(video: Path) -> None:
    info = probe(video)
    assert (info.width, info.height, info.frames, info.rotation_deg) == (96, 64, FRAMES, 0)
    assert info.codec == "h264"
    assert info.rate_hz == pytest.approx(25.0)
    assert info.duration_s == pytest.approx(2.0, abs=0.05)


def test_index_without_decoding_is_that_of_decoding(video: Path) -> None:
    index = frame_index(video)
    frames = list(read_frames(video))
    assert len(index) == len(frames) == FRAMES
    np.testing.assert_allclose(index.time_s, [frame.time_s for frame in frames], atol=1e-9)
    np.testing.assert_allclose(index.time_s, np.arange(FRAMES) / 25, atol=1e-9)
    assert len(index.key_ticks) >= 4


def test_frames_come_in_presentation_order(video: Path) -> None:
    frames = list(read_frames(video))
    assert [frame.index for frame in frames] == list(range(FRAMES))
    assert [number_of(frame.luma) for frame in frames] == list(range(FRAMES))
    assert frames[0].luma.shape == (64, 96)
    assert frames[0].luma.dtype == np.uint8


def test_only_pictures_that_no_other_is_told_from_keep_the_edges_of_their_blocks(tmp_path: Path) -> None:
    file = write(tmp_path / "coarse.mp4", options={"crf": "38", "b-pyramid": "none", "x264-params": "scenecut=0"})
    with av.open(str(file)) as container:
        shown = [(frame.pict_type, luma_of(frame).copy()) for frame in container.decode(video=0)]
    referred = [kind != PictureType.B for kind, _ in shown]
    as_shown = [bool((frame.luma == luma).all()) for frame, (_, luma) in zip(read_frames(file), shown, strict=True)]
    assert np.array(as_shown)[referred].all()
    assert not all(as_shown)


@pytest.mark.parametrize("start", [1, 11, 12, 13, 37, FRAMES - 1])
def test_a_part_is_the_same_as_in_the_whole(video: Path, start: int) -> None:
    whole = list(read_frames(video))[start : start + 5]
    part = list(read_frames(video, start, start + 5, threads=1))
    assert [frame.index for frame in part] == [frame.index for frame in whole]
    assert [frame.time_s for frame in part] == [frame.time_s for frame in whole]
    for one, other in zip(part, whole, strict=True):
        np.testing.assert_array_equal(one.luma, other.luma)


@pytest.mark.parametrize("start", [0, 24, 40])
def test_pictures_of_another_size_than_the_first_are_refused(tmp_path: Path, start: int) -> None:
    # As a recorder makes it that changes its settings: transport streams can simply be put one behind the other.
    options = {"bf": "0"}
    large = write(tmp_path / "large.ts", frames=25, options=options, ticks=[40 * n for n in range(25)])
    small = write(
        tmp_path / "small.ts", frames=25, size=(64, 48), options=options, ticks=[40 * n for n in range(25, 50)]
    )
    file = tmp_path / "both.ts"
    file.write_bytes(large.read_bytes() + small.read_bytes())
    assert len(frame_index(file)) == 50
    assert [frame.index for frame in read_frames(file, 5, 20)] == list(range(5, 20))
    expected = r"both.ts: frame \d+ \(1\.\d\d s\) is 64 x 48 pixels, but the video begins with 96 x 64; cut it there\."
    with pytest.raises(InputError, match=expected):
        list(read_frames(file, start))


def test_single_frames(video: Path) -> None:
    for number in (0, 25, 49):
        assert number_of(read_frame(video, number).luma) == number


def test_uneven_timestamps_are_the_containers_own(tmp_path: Path) -> None:
    ticks = np.cumsum(np.random.default_rng(0).integers(25, 90, 30)) + 700
    file = write(tmp_path / "uneven.mp4", frames=30, ticks=ticks.tolist())
    expected = (ticks - ticks[0]) / 1000
    np.testing.assert_allclose([frame.time_s for frame in read_frames(file)], expected, atol=1e-4)
    np.testing.assert_allclose(frame_index(file).time_s, expected, atol=1e-4)
    assert [number_of(frame.luma) for frame in read_frames(file, 17, 20)] == [17, 18, 19]


# --- upright ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rotation", "corner"), [(90, (0, -1)), (180, (-1, -1)), (270, (-1, 0))])
def test_turned_frames_are_made_upright(tmp_path: Path, rotation: int, corner: tuple[int, int]) -> None:
    file = write(tmp_path / "turned.mp4", frames=3, rotation=rotation)
    info = probe(file)
    assert info.rotation_deg == rotation
    assert (info.width, info.height) == ((96, 64) if rotation == 180 else (64, 96))
    luma = read_frame(file, 1).luma
    assert luma.shape == (info.height, info.width)
    # The bright corner was at the top left; it turns clockwise with the picture.
    assert luma[corner] > 200


@pytest.mark.parametrize(
    ("matrix", "how"),
    [((-1, 0, 0, 1), "mirrored"), ((0, 1, 1, 0), "mirrored"), ((0.7071, 0.7071, -0.7071, 0.7071), "turned by 45 deg")],
)
def test_what_is_not_to_be_shown_in_quarter_turns_is_refused(
    tmp_path: Path, matrix: tuple[float, float, float, float], how: str
) -> None:
    file = write(tmp_path / "shown.mp4", frames=3)
    shown_by(file, matrix)
    with pytest.raises(InputError, match=f"shown.mp4: says that it is to be shown {how}"):
        probe(file)


# --- what is said of a video before it is measured -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "codec", "pix_fmt", "options"),
    [
        ("fields.mp4", "libx264", "yuv420p", {"x264-params": "tff=1"}),
        ("fields.mkv", "libx264", "yuv420p", {"x264-params": "bff=1"}),
        ("fields.mp4", "libx265", "yuv420p", {"x265-params": "interlace=tff"}),
        ("fields.mov", "prores_ks", "yuv422p10le", {"flags": "+ildct", "bf": "0"}),
    ],
)
def test_interlaced_footage_is_told(
    tmp_path: Path, name: str, codec: str, pix_fmt: str, options: dict[str, str]
) -> None:
    info = probe(write(tmp_path / name, frames=12, codec=codec, pix_fmt=pix_fmt, options=options))
    (warning,) = video_warnings(name, info, info.duration_s)
    assert warning.startswith(f"{name}: says that it is interlaced")
    assert warning.endswith("or deinterlace it, with FFmpeg's bwdif for instance.")


@pytest.mark.parametrize(
    ("codec", "pix_fmt"), [("libx264", "yuv420p"), ("libx265", "yuv420p"), ("prores_ks", "yuv422p10le")]
)
def test_of_progressive_footage_there_is_nothing_to_tell(tmp_path: Path, codec: str, pix_fmt: str) -> None:
    info = probe(write(tmp_path / "frames.mkv", frames=12, codec=codec, pix_fmt=pix_fmt, options={"bf": "0"}))
    assert video_warnings("frames.mkv", info, info.duration_s) == []


def test_frames_that_end_before_the_container_says_are_told(video: Path) -> None:
    info = replace(probe(video), duration_s=4.0)
    (warning,) = video_warnings("video.mp4", info, 1.96)
    assert warning.startswith("video.mp4: says that it lasts 4.0 s, but its frames end at 2.0 s")
    assert video_warnings("video.mp4", info, None) == []


# --- other pictures --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("codec", "pix_fmt", "name"),
    [
        ("libx264", "yuv444p", "v.mp4"),
        ("mpeg4", "yuv420p", "v.avi"),
        ("ffv1", "gray", "v.mkv"),
        ("ffv1", "yuv420p10le", "v.mkv"),
    ],
)
def test_other_pixels_than_eight_bit_420(tmp_path: Path, codec: str, pix_fmt: str, name: str) -> None:
    options = {"bf": "0"} if codec != "libx264" else {}
    file = write(tmp_path / name, frames=6, codec=codec, pix_fmt=pix_fmt, options=options)
    assert [number_of(frame.luma) for frame in read_frames(file)] == list(range(6))
    assert all(frame.luma.dtype == np.uint8 for frame in read_frames(file))


def test_odd_sizes_have_no_padding(tmp_path: Path) -> None:
    file = write(tmp_path / "odd.mkv", frames=2, size=(98, 66), codec="ffv1")
    luma = read_frame(file, 1).luma
    assert luma.shape == (66, 98)
    np.testing.assert_allclose(luma.astype(int), picture(1, (98, 66)), atol=25)  # full against studio range


# --- bad videos ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["eq7-12:30:05.mp4", "file:b.mp4", "http:c.mp4"])
def test_a_colon_in_a_name_is_no_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    write(tmp_path / name, frames=3)
    monkeypatch.chdir(tmp_path)
    assert probe(Path(name)).width == SIZE[0]
    assert read_frame(Path(name), 1).luma.shape == SIZE[::-1]


def test_no_such_file(tmp_path: Path) -> None:
    for read in (probe, frame_index, lambda file: read_frame(file, 0)):
        with pytest.raises(InputError, match=r"gone\.mp4: not found; correct inputs\.video"):
            read(tmp_path / "gone.mp4")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
def test_a_picture_is_no_film_whatever_it_is_called(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / "video.mp4"
    file.write_bytes(cv2.imencode(suffix, picture(0))[1].tobytes())
    with pytest.raises(InputError, match=r"video\.mp4: is a picture and no video"):
        probe(file)


@pytest.mark.parametrize(
    ("name", "codec", "pix_fmt", "called"),
    [
        ("video.mp4", "libx265", "yuv420p10le", "hevc"),
        ("video.mov", "libx264", "yuv422p10le", "h264"),
        ("video.mp4", "libx264", "yuv444p", "h264"),
        ("video.webm", "libvpx-vp9", "yuv420p", "vp9"),
        ("video.mkv", "libsvtav1", "yuv420p", "av1"),
        ("video.mkv", "mpeg4", "yuv420p", "mpeg4"),
    ],
)
def test_other_codecs_and_depths_give_all_their_frames(
    tmp_path: Path, name: str, codec: str, pix_fmt: str, called: str
) -> None:
    options = {"bf": "0", "preset": "8", "crf": "20"} if codec == "libsvtav1" else {"bf": "0"}
    file = write(tmp_path / name, codec=codec, pix_fmt=pix_fmt, size=(192, 128), options=options)
    assert probe(file).codec == called
    assert [number_of(frame.luma) for frame in read_frames(file)] == list(range(FRAMES))


def test_no_video_at_all(tmp_path: Path) -> None:
    file = tmp_path / "text.mp4"
    file.write_text("not a video" * 100)
    with pytest.raises(InputError, match=r"text\.mp4: cannot be opened as a video"):
        probe(file)
    file.write_bytes(b"")
    with pytest.raises(InputError, match=r"text\.mp4"):
        probe(file)


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_of_several_streams_the_one_with_the_largest_frames_is_the_film(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"video.{suffix}"
    with av.open(str(file), "w") as container:
        streams = [(container.add_stream("libx264", rate=25), size) for size in ((48, 32), SIZE, (64, 48))]
        for stream, (stream.width, stream.height) in streams:
            stream.pix_fmt = "yuv420p"
        for stream, size in streams:
            for number in range(FRAMES if size == SIZE else 1):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(number, size), format="gray")))
            container.mux(stream.encode())
    assert (probe(file).width, probe(file).height) == SIZE
    assert [number_of(frame.luma) for frame in read_frames(file)] == list(range(FRAMES))


def test_a_cover_picture_is_no_film_however_large(tmp_path: Path) -> None:
    file, large = tmp_path / "video.mp4", (SIZE[0] * 4, SIZE[1] * 4)
    with av.open(str(file), "w") as container:
        cover = container.add_stream("mjpeg", rate=1)
        cover.disposition = Disposition.attached_pic
        film = container.add_stream("libx264", rate=25)
        cover.width, cover.height = large
        film.width, film.height = SIZE
        cover.pix_fmt, film.pix_fmt = "yuvj420p", "yuv420p"
        container.mux(cover.encode(av.VideoFrame.from_ndarray(picture(0, large), format="gray")))
        for number in range(5):
            container.mux(film.encode(av.VideoFrame.from_ndarray(picture(number), format="gray")))
        container.mux(film.encode())
    assert (probe(file).width, probe(file).height) == SIZE
    assert len(frame_index(file)) == 5


def test_sound_alone(tmp_path: Path) -> None:
    file = tmp_path / "sound.wav"
    with av.open(str(file), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), dtype=np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(InputError, match="holds no video stream"):
        probe(file)


def test_frames_without_times_of_their_own(tmp_path: Path) -> None:
    file = write(tmp_path / "repeated.mkv", frames=5, codec="ffv1", ticks=[0, 40, 40, 80, 80])
    with pytest.raises(InputError, match="2 of its 5 frames bear the time of another; export the video again"):
        frame_index(file)


def test_times_of_decoding_are_not_taken_for_those_of_showing(tmp_path: Path) -> None:
    """An AVI numbers its frames as they are decoded; where the encoder put some off, pictures would change places."""
    with pytest.raises(InputError, match=r"v\.avi: its frames bear the times at which they are decoded .* as MP4\."):
        frame_index(write(tmp_path / "v.avi"))


def test_frames_beyond_the_end(video: Path) -> None:
    with pytest.raises(InputError, match="has 50 frames, so there is no frame 50"):
        list(read_frames(video, FRAMES))
    with pytest.raises(InputError, match="there is no frame 70"):
        read_frame(video, 70)


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
@pytest.mark.parametrize("damaged", [5, 24, 31])
def test_frames_behind_a_damaged_one_keep_their_numbers(tmp_path: Path, codec: str, damaged: int) -> None:
    options = {"x265-params": "keyint=12:min-keyint=12:log-level=0"} if codec == "libx265" else {}
    whole = write(tmp_path / "whole.mp4", codec=codec, options=options)
    file = repacked(
        whole, tmp_path / "damaged.mp4", lambda number, data: bytes(len(data)) if number == damaged else data
    )
    frames = list(read_frames(file))
    numbers = [frame.index for frame in frames]
    missing = set(range(FRAMES)) - set(numbers)
    # A key frame takes with it what is decoded from it, pictures shown just before it among them.
    assert 0 < len(missing) <= 12 + 3
    assert [number_of(frame.luma) for frame in frames[-8:]] == numbers[-8:] == list(range(FRAMES - 8, FRAMES))
    np.testing.assert_allclose([frame.time_s for frame in frames], np.array(numbers) / 25, atol=1e-9)
    assert [frame.index for frame in read_frames(file, 3)] == numbers[3 - len([n for n in missing if n < 3]) :]
    with pytest.raises(InputError, match=f"frame {min(missing)} cannot be decoded; choose another"):
        read_frame(file, min(missing))


@pytest.mark.parametrize("damaged", [12, 13, 27])
@pytest.mark.parametrize("seed", range(3))
def test_pictures_that_build_on_a_damaged_one_are_left_out(tmp_path: Path, damaged: int, seed: int) -> None:
    """A decoder that misses a picture takes another in its place, and shows an earlier moment as if it were now."""
    whole = write(tmp_path / "whole.mp4", options={"bf": "0", "x264-params": "scenecut=0"})
    noise = np.random.default_rng(seed)

    def edit(number: int, data: bytes) -> bytes:
        third = len(data) // 3
        return data[:third] + noise.bytes(len(data) - third) if number == damaged else data

    shown = {frame.index: frame.luma for frame in read_frames(repacked(whole, tmp_path / "damaged.mp4", edit))}
    truth = {frame.index: frame.luma for frame in read_frames(whole)}
    assert all((truth[number] == luma).all() for number, luma in shown.items())
    assert set(truth) - set(shown) <= set(range(damaged, 12 * (damaged // 12 + 1)))


@pytest.mark.parametrize(
    ("codec", "open_groups"), [("libx264", "open_gop=1:b-adapt=0"), ("libx265", "open-gop=1:log-level=0")]
)
def test_a_clip_cut_out_of_a_longer_one_begins_with_its_key_frame(tmp_path: Path, codec: str, open_groups: str) -> None:
    groups = f"keyint=12:min-keyint=12:bframes=3:scenecut=0:{open_groups}"
    whole = write(tmp_path / "whole.mkv", codec=codec, options={f"{codec[3:]}-params": groups})
    with av.open(str(whole)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.pts is not None]
    key = [number for number, packet in enumerate(packets) if packet.is_keyframe][1]
    # Frames shown before the key frame follow it in the file, and need the group before.
    assert any((packet.pts or 0) < (packets[key].pts or 0) for packet in packets[key:])
    file = repacked(whole, tmp_path / "cut.mkv", lambda number, data: None if number < key else data)
    from_start = {frame.index: number_of(frame.luma) for frame in read_frames(file)}
    assert list(from_start) == list(range(len(frame_index(file))))
    assert from_start[0] == sorted(packet.pts or 0 for packet in packets).index(packets[key].pts or 0)
    assert {frame.index: number_of(frame.luma) for frame in read_frames(file, 9)} == {
        number: shown for number, shown in from_start.items() if number >= 9
    }


def test_a_file_cut_off_gives_what_came_before(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.ts", frames=FRAMES)
    cut = tmp_path / "cut.ts"
    content = whole.read_bytes()
    cut.write_bytes(content[: len(content) * 2 // 3])
    frames = list(read_frames(cut))
    assert 10 < len(frames) < FRAMES
    assert [number_of(frame.luma) for frame in frames[:10]] == list(range(10))


def test_frames_looked_at_before_they_are_taken_are_taken_all_the_same(video: Path) -> None:
    with FramesAhead(video, 3, 6) as frames:
        assert [frame.index for frame in itertools.islice(frames.peek(), 2)] == [3, 4]
        assert [frame.index for frame in frames.peek()] == [3, 4, 5]
        taken = [(frame.index, number_of(frame.luma)) for frame in frames]
        assert taken == [(3, 3), (4, 4), (5, 5)]
        assert list(frames.peek()) == list(frames) == []


def test_who_stops_reading_leaves_no_thread_behind(video: Path) -> None:
    reading = read_frames(video)
    assert next(reading).index == 0
    assert any(thread.name == "video decoder" for thread in threading.enumerate())
    reading.close()
    assert not any(thread.name == "video decoder" for thread in threading.enumerate())
