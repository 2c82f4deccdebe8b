from __future__ import annotations

import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from core.apparent import Apparent
from core.errors import InputError
from core.measurements import FrameMeasurement, MeasurementStore, Reference, discard_unreadable

# Raw pixels are kept to this part of a pixel.
TICK_PX = 1 / 8192


def reference() -> Reference:
    random = np.random.default_rng(0)
    return Reference(
        random.uniform(0, 3840, (30, 2)),
        {"roof": random.uniform(0, 3840, (3, 16, 2, 2)), "table": random.uniform(0, 3840, (12, 2))},
        {"roof": random.uniform(0, 3840, (7, 2))},
    )


def measured(frame: int) -> FrameMeasurement:
    random = np.random.default_rng(frame)
    ground = random.uniform(-5, 3845, (30, 2))
    ground[frame % 7] = np.nan
    roof = random.uniform(0, 3840, (3, 16, 2, 2))
    roof[2, 5:9] = np.nan
    return FrameMeasurement(
        frame=frame,
        time_s=frame / 29.97,
        H_ray_ray0=np.eye(3) + random.normal(scale=1e-3, size=(3, 3)),
        ground_raw=ground,
        targets_raw={"roof": roof, "table": random.uniform(0, 3840, (12, 2))},
        apparent={"roof": Apparent(random.normal(size=2), 0.01 * frame), "table": None},
        texture_raw={"roof": random.uniform(0, 3840, (7, 2))},
    )


def fill(file: Path, frames: range, method: str = "geometric", fingerprint: str = "a") -> int:
    with MeasurementStore(file) as store:
        recording = store.begin(method, fingerprint, reference())
        for frame in frames:
            store.append(recording, measured(frame))
    return recording


def test_what_goes_in_comes_out(tmp_path: Path) -> None:
    file = tmp_path / "results" / "frames.sqlite"
    recording = fill(file, range(5))
    with MeasurementStore(file) as store:
        loaded, one = store.load(recording), store.frame(recording, 3)
        np.testing.assert_allclose(store.reference(recording).ground_raw, reference().ground_raw, atol=TICK_PX)
        assert store.frame(recording, 9) is None
    assert loaded.method == "geometric"
    assert not loaded.finished
    assert loaded.frame.tolist() == [0, 1, 2, 3, 4]
    assert loaded.time_s.tolist() == [frame / 29.97 for frame in range(5)]
    assert list(loaded.targets_raw) == ["roof", "table"]
    for frame in range(5):
        np.testing.assert_allclose(loaded.ground_raw[frame], measured(frame).ground_raw, atol=TICK_PX)
        np.testing.assert_array_equal(loaded.H_ray_ray0[frame], measured(frame).H_ray_ray0)
        for name in ("roof", "table"):
            np.testing.assert_allclose(loaded.targets_raw[name][frame], measured(frame).targets_raw[name], atol=TICK_PX)
        texture_raw = measured(frame).texture_raw["roof"]
        np.testing.assert_allclose(loaded.texture_raw["roof"][frame], texture_raw, atol=TICK_PX)
    np.testing.assert_allclose(loaded.reference.texture_raw["roof"], reference().texture_raw["roof"], atol=TICK_PX)
    assert loaded.texture_raw["table"].shape == (5, 0, 2)
    assert one is not None
    apparent = one.apparent["roof"]
    assert apparent is not None
    np.testing.assert_array_equal(apparent.shift, measured(3).apparent["roof"].shift)
    assert apparent.rotation_rad == 0.03
    assert one.apparent["table"] is None


def test_lost_frames_stay_lost(tmp_path: Path) -> None:
    file = tmp_path / "frames.sqlite"
    nothing = replace(
        measured(0),
        H_ray_ray0=np.full((3, 3), np.nan),
        ground_raw=np.full((30, 2), np.nan),
        targets_raw={"roof": np.full((3, 16, 2, 2), np.nan), "table": np.full((12, 2), np.nan)},
        apparent={"roof": None, "table": None},
    )
    with MeasurementStore(file) as store:
        recording = store.begin("geometric", "a", reference())
        store.append(recording, nothing)
        loaded = store.load(recording)
    assert np.isnan(loaded.H_ray_ray0).all()
    assert np.isnan(loaded.ground_raw).all()
    assert np.isnan(loaded.targets_raw["roof"]).all()


def test_frames_come_in_any_order_and_twice(tmp_path: Path) -> None:
    file = tmp_path / "frames.sqlite"
    with MeasurementStore(file) as store:
        recording = store.begin("geometric", "a", reference())
        for frame in (7, 2, 9, 2):
            store.append(recording, measured(frame))
        assert store.measured_frames(recording) == [2, 7, 9]
        assert store.load(recording).frame.tolist() == [2, 7, 9]
        assert store.load(recording, only=[9, 2, 40]).frame.tolist() == [2, 9]
        assert store.load(recording, only=[]).frame.tolist() == []


def test_a_new_recording_takes_the_place_of_its_method_only(tmp_path: Path) -> None:
    file = tmp_path / "frames.sqlite"
    fill(file, range(3), "geometric", "a")
    fill(file, range(4), "paper", "a")
    fill(file, range(2), "geometric", "b")
    with MeasurementStore(file) as store:
        assert store.find("geometric", "a") is None
        new, paper = store.find("geometric", "b"), store.find("paper", "a")
        assert new is not None
        assert paper is not None
        assert len(store.measured_frames(new)) == 2
        assert len(store.measured_frames(paper)) == 4
    with sqlite3.connect(file) as database:
        assert database.execute("SELECT count(*) FROM frames").fetchone() == (6,)


def test_finished_is_remembered(tmp_path: Path) -> None:
    file = tmp_path / "frames.sqlite"
    recording = fill(file, range(2))
    with MeasurementStore(file) as store:
        assert not store.is_finished(recording)
        store.finish(recording)
    with MeasurementStore(file) as store:
        assert store.is_finished(recording)
        assert store.load(recording).finished


def test_an_empty_recording_has_arrays_of_no_frames(tmp_path: Path) -> None:
    file = tmp_path / "frames.sqlite"
    recording = fill(file, range(0))
    with MeasurementStore(file) as store:
        loaded = store.load(recording)
    assert loaded.ground_raw.shape == (0, 30, 2)
    assert loaded.H_ray_ray0.shape == (0, 3, 3)
    assert loaded.targets_raw["roof"].shape == (0, 3, 16, 2, 2)


def test_what_was_committed_survives_a_kill(tmp_path: Path) -> None:
    file = tmp_path / "frames.sqlite"
    code = (
        "import os, sys; sys.path.insert(0, os.getcwd())\n"
        "from pathlib import Path\n"
        "from core.measurements import MeasurementStore\n"
        "from tests.core.test_measurements import measured, reference\n"
        f"store = MeasurementStore(Path({str(file)!r}))\n"
        "recording = store.begin('geometric', 'a', reference())\n"
        "for frame in range(6): store.append(recording, measured(frame))\n"
        "store.commit()\n"
        "for frame in range(6, 9): store.append(recording, measured(frame))\n"
        "os.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], check=False)
    assert done.returncode == -9
    with MeasurementStore(file) as store:
        recording = store.find("geometric", "a")
        assert recording is not None
        assert store.measured_frames(recording)[:6] == list(range(6))


def test_a_full_disk_is_said_and_keeps_what_is_there(tmp_path: Path) -> None:
    file = tmp_path / "frames.sqlite"
    recording = fill(file, range(20))

    def fill_on() -> None:
        with MeasurementStore(file) as store:
            # SQLite then answers as on a full disk.
            pages = store._db.execute("PRAGMA page_count").fetchone()[0]
            store._db.execute(f"PRAGMA max_page_count = {pages + 2}")
            for frame in range(20, 60):
                store.append(recording, measured(frame))

    with pytest.raises(InputError, match=r"frames\.sqlite: cannot be written .* make room"):
        fill_on()
    with MeasurementStore(file) as store:
        assert store.measured_frames(recording)[:20] == list(range(20))


def test_a_file_that_is_something_else_is_refused_and_kept(tmp_path: Path) -> None:
    file = tmp_path / "frames.sqlite"
    file.write_bytes(b"this is no database, but long enough to be looked at" * 40)
    with pytest.raises(InputError, match=r"frames\.sqlite: is not readable .* delete it, it can be measured again"):
        MeasurementStore(file)
    assert file.read_bytes().startswith(b"this is no database")


def spoil_pages(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[8192:-4096] = bytes(len(content) - 12288)
    file.write_bytes(content)


def other_tables(file: Path) -> None:
    file.unlink()
    with closing(sqlite3.connect(file)) as made:
        made.execute("CREATE TABLE recordings (id INTEGER PRIMARY KEY, name TEXT)")


def spoil_a_frame(file: Path) -> None:
    with closing(sqlite3.connect(file)) as made, made:
        made.execute("UPDATE frames SET measured = substr(measured, 1, 300) WHERE frame = 7")


@pytest.mark.parametrize("damage", [spoil_pages, other_tables, spoil_a_frame])
def test_damage_is_told_with_its_remedy(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    file = tmp_path / "frames.sqlite"
    fill(file, range(60))
    damage(file)

    def read_all() -> None:
        with MeasurementStore(file) as store:
            found = store.find("geometric", "a")
            assert found is not None
            store.load(found)

    with pytest.raises(InputError, match=r"frames\.sqlite: is not readable .* delete it, it can be measured again"):
        read_all()


def test_what_cannot_be_read_makes_room_for_a_fresh_start(tmp_path: Path) -> None:
    file = tmp_path / "frames.sqlite"
    discard_unreadable(file)
    recording = fill(file, range(60))
    discard_unreadable(file)
    with MeasurementStore(file) as store:
        assert len(store.measured_frames(recording)) == 60
    spoil_pages(file)
    discard_unreadable(file)
    assert not file.exists()


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="open files are listed by Linux only")
def test_a_file_that_is_refused_is_let_go_of(tmp_path: Path) -> None:
    file = tmp_path / "frames.sqlite"
    file.write_bytes(b"this is no database, but long enough to be looked at" * 40)
    with pytest.raises(InputError):
        MeasurementStore(file)
    assert file.resolve() not in {link.resolve() for link in Path("/proc/self/fd").iterdir()}


def test_a_file_that_cannot_be_opened_is_not_to_be_deleted(tmp_path: Path) -> None:
    (tmp_path / "frames.sqlite").mkdir()
    with pytest.raises(InputError, match=r"frames\.sqlite: cannot be opened .* make room for it, or move away what is"):
        MeasurementStore(tmp_path / "frames.sqlite")
