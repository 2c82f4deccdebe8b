"""Files under addresses, read from storage that fsspec knows; one of them tells what was fetched."""

import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import fsspec
import numpy as np
import pytest
from fsspec.registry import known_implementations
from fsspec.spec import AbstractBufferedFile, AbstractFileSystem

from core import storage
from core.errors import InputError
from core.storage import FarFile, content_identity, file_at, opened, state_of, write_atomically
from core.video import frame_index, probe, read_frame, read_frames
from tests.core.test_video import FRAMES, number_of, write


class BucketFile(AbstractBufferedFile):
    def _fetch_range(self, start, end):
        with open(self.path, "rb") as stream:
            stream.seek(start)
            content = stream.read(end - start)
        self.fs.fetched.append(len(content))
        return content


class Bucket(AbstractFileSystem):
    """An object store that hands out ranges of bytes and counts them."""

    protocol = "bucket"
    fetched: ClassVar[list[int]] = []

    def info(self, path, **options):
        state = os.stat(path)
        return {"name": path, "size": state.st_size, "type": "file", "changed": state.st_mtime_ns}

    def _open(self, path, mode="rb", block_size=None, **options):
        return BucketFile(self, path, mode, block_size)


@pytest.fixture
def bucket():
    fsspec.register_implementation("bucket", Bucket, clobber=True)
    Bucket.fetched.clear()
    return Bucket


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return write(tmp_path_factory.mktemp("far") / "video.mp4", frames=100)


def test_a_name_is_an_address_or_a_path_seen_from_the_project(tmp_path):
    assert file_at(tmp_path, "s3://campaign/eq7.mp4") == FarFile("s3://campaign/eq7.mp4")
    assert file_at(tmp_path, "../footage/eq7.mp4") == tmp_path / "../footage/eq7.mp4"
    assert file_at(tmp_path, "/footage/eq7.mp4") == Path("/footage/eq7.mp4")
    assert FarFile("s3://campaign/eq7.mp4").name == "eq7.mp4"


def test_far_away_a_video_is_the_same(video, bucket):
    far = FarFile(f"bucket://{video}")
    assert probe(far) == probe(video)
    assert frame_index(far) == frame_index(video)
    assert content_identity(far) == content_identity(video)
    near, distant = list(read_frames(video, 70, 90)), list(read_frames(far, 70, 90))
    assert [(frame.index, frame.time_s) for frame in distant] == [(frame.index, frame.time_s) for frame in near]
    assert all((one.luma == other.luma).all() for one, other in zip(near, distant, strict=True))


def test_only_what_is_needed_is_fetched(tmp_path, bucket, monkeypatch):
    video = write(
        tmp_path / "large.mp4", frames=150, size=(640, 360), codec="mjpeg", pix_fmt="yuvj420p", options={"bf": "0"}
    )
    monkeypatch.setattr(storage, "BLOCK_BYTES", 1 << 14)
    index = frame_index(video)
    last = read_frame(FarFile(f"bucket://{video}"), 148, index=index)
    assert number_of(last.luma) == 148
    assert 0 < sum(bucket.fetched) < 0.3 * video.stat().st_size


def test_a_file_in_memory_serves_as_well(tmp_path):
    content = write(tmp_path / "video.mp4").read_bytes()
    fsspec.filesystem("memory").pipe("/campaign/video.mp4", content)
    far = FarFile("memory://campaign/video.mp4")
    assert len(frame_index(far)) == FRAMES
    assert [number_of(frame.luma) for frame in read_frames(far, 20, 24)] == [20, 21, 22, 23]
    assert state_of(far).size == len(content)


def test_content_has_a_name_that_goes_with_it(tmp_path):
    first, copy, other = (tmp_path / name for name in ("first.csv", "copy.csv", "other.csv"))
    first.write_text("0, 1, 2\n")
    copy.write_text("0, 1, 2\n")
    other.write_text("0, 1, 3\n")
    os.utime(copy, (1.0, 1.0))
    assert content_identity(first) == content_identity(copy) != content_identity(other)
    with pytest.raises(FileNotFoundError):
        content_identity(tmp_path / "gone.csv")


def test_a_changed_file_is_noticed(tmp_path, bucket):
    near = write(tmp_path / "video.mp4", frames=20)
    far = FarFile(f"bucket://{near}")
    before = state_of(far)
    assert len(frame_index(far)) == 20
    write(near, frames=30)
    assert state_of(far) != before
    assert len(frame_index(far)) == 30


def test_what_keeps_it_from_being_read_is_said(tmp_path, bucket):
    (tmp_path / "text.mp4").write_text("This is no video. " * 100)
    for address, said in {
        "bucket:///nowhere/gone.mp4": r"bucket:///nowhere/gone\.mp4: not found; correct inputs\.video",
        f"bucket://{tmp_path / 'text.mp4'}": r"text\.mp4: cannot be opened as a video",
        "nonsense://campaign/eq7.mp4": r"no address that fsspec knows .*; correct inputs\.video",
    }.items():
        with pytest.raises(InputError, match=said):
            probe(FarFile(address))


def test_errors_of_the_storage_are_told(monkeypatch, bucket):
    def refused(self, path, **options):
        raise ConnectionRefusedError("no key for this bucket")

    monkeypatch.setattr(Bucket, "info", refused)
    with pytest.raises(InputError, match=r"no key for this bucket.*; see that this machine may read it"):
        state_of(FarFile("bucket://campaign/eq7.mp4"))
    with (
        pytest.raises(InputError, match="no key for this bucket"),
        opened(FarFile("bucket://campaign/eq7.mp4")),
    ):
        pass


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(
        known_implementations, "rare", {"class": "no_such_package.Storage", "err": "Install rarefs to access it"}
    )
    with pytest.raises(InputError, match=r"needs a package of its own \(Install rarefs to access it\)"):
        probe(FarFile("rare://campaign/eq7.mp4"))
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(InputError, match=r"needs fsspec; install it with `pip install rooftrack\[cluster\]`"):
        probe(FarFile("memory://campaign/eq7.mp4"))


@pytest.mark.parametrize("address", ["s3://key:secret@campaign/eq7.mp4", "filecache::s3://key:secret@campaign/eq7.mp4"])
def test_passwords_have_no_place_in_a_project(tmp_path, address):
    with pytest.raises(InputError, match="an address holds a password") as refused:
        file_at(tmp_path, address)
    assert "secret" not in str(refused.value)


def test_what_lies_here_does_not_load_fsspec(video):
    code = (
        "import sys; from pathlib import Path; from core import run, video; "
        f"video.probe(Path({str(video)!r})); sys.exit('fsspec' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_frames_far_away_have_their_own_times(tmp_path, bucket):
    ticks = np.cumsum(30 + 20 * (np.arange(40) % 3)).tolist()
    near = write(tmp_path / "uneven.mp4", frames=40, ticks=ticks)
    times = [frame.time_s for frame in read_frames(FarFile(f"bucket://{near}"), 30)]
    np.testing.assert_allclose(times, (np.array(ticks[30:]) - ticks[0]) / 1000, atol=1e-9)


# --- writing ---------------------------------------------------------------------------------------------------------


def test_a_file_that_cannot_be_written_stays_as_it_was_and_leaves_no_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "deep" / "file.json"
    write_atomically(file, b"old")

    def no_room(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_room)
    with pytest.raises(OSError, match="No space left") as refused:
        write_atomically(file, b"new")
    assert refused.value.filename == str(file)
    assert file.read_bytes() == b"old"
    assert [each.name for each in file.parent.iterdir()] == ["file.json"]
