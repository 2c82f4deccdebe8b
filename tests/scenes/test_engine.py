"""The whole engine on small clips whose truth is known: how exact, how repeatable, how it takes mistakes."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import wave
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app import cli
from core import measure as measuring
from core.chunks import Chunk
from core.errors import Cancelled, InputError
from core.lens import read_lens, write_lens
from core.locks import take_lock
from core.measure import make_measurer, measure_chunk
from core.measurements import MeasurementStore
from core.progress import CancelToken
from core.project import read_project
from core.results import Status, read_history_csv
from core.run import FRAMES_FILE, RELIEF_FILE, load_inputs, run_project
from core.solve import solve
from core.video import read_frames
from sample_data import happenings
from sample_data.accuracy import apparent_displacement
from sample_data.scene import Recording
from tests.packets import repacked
from tests.scenes.clips import (
    BRIEF,
    displacement,
    filmed_anew,
    measured,
    measured_history,
    project_copy,
    rendered,
    roof_pixel_m,
    true_displacement,
    truth,
    with_measurements,
)

ROOT = Path(__file__).parents[2]
# The contract's: what resuming, workers and clusters may change.
SAME_M = 1e-5
BLACK_S = (2.95, 3.15)
ALL_FRAMES = 168


def _with_black_frames(scene):
    """The exposure fails for a fifth of a second in the strongest shaking."""
    light = scene.light.exposure

    def exposure(time_s):
        return np.where((time_s >= BLACK_S[0]) & (time_s <= BLACK_S[1]), 0.0, light(time_s))

    return replace(scene, light=replace(scene.light, exposure=exposure))


@pytest.fixture(scope="session")
def clip(tmp_path_factory):
    return rendered(tmp_path_factory, "hard", BRIEF, change=_with_black_frames)


@pytest.fixture(scope="session")
def run(clip, tmp_path_factory):
    """The clip measured by one uninterrupted run of the program, with all its results."""
    folder = project_copy(clip, tmp_path_factory.mktemp("run") / "hard")
    assert cli.main(["run", str(folder)]) == 0
    return folder


@pytest.fixture(scope="session")
def history(run):
    return read_history_csv(run / "results" / "roof.csv")


def largest_difference_m(one, other):
    """Return the largest difference of two histories that must agree on frames, times and status."""
    np.testing.assert_array_equal(one.frame, other.frame)
    # A history read from its file has times rounded to a microsecond.
    np.testing.assert_allclose(one.time_s, other.time_s, rtol=0, atol=5.1e-7)
    np.testing.assert_array_equal(one.status, other.status)
    return float(np.nanmax(np.abs(displacement(one) - displacement(other))))


# --- how exact -------------------------------------------------------------------------------------------------------


def test_displacement_is_true_to_a_tenth_of_a_pixel(clip, run, history):
    true = true_displacement(clip)
    error = displacement(history) - true
    # A strip's middle is found to better than a tenth of a pixel at this size, and the camera's place, learnt from
    # hundreds of ground patches, adds less than that.
    limit_m = 0.1 * roof_pixel_m(BRIEF)
    assert np.sqrt(np.nanmean(error**2, axis=0)).max() < limit_m
    start, end = read_project(run).intervals_s.residual
    residual = np.nanmean(error[(history.time_s >= start) & (history.time_s <= end)], axis=0)
    assert np.abs(residual).max() < limit_m


def test_both_axes_and_the_rotation_have_the_right_sign(clip, history):
    seen = np.isfinite(history.rotation_rad)
    true = truth(clip)
    pairs = [
        (history.p1_m[:, 0], true["roof_p1_m"][:, 0]),
        (history.p1_m[:, 1], true["roof_p1_m"][:, 1]),
        (history.rotation_rad, true["roof_rotation_rad"]),
    ]
    for got, expected in pairs:
        assert np.corrcoef(got[seen], expected[seen])[0, 1] > 0.95
        # Slope of the regression: neither mirrored nor scaled. The rotation is a few pixels' worth over the roof.
        assert np.polyfit(expected[seen], got[seen], 1)[0] == pytest.approx(1.0, abs=0.1)


def test_every_frame_has_its_row_and_its_own_time(clip, history):
    np.testing.assert_array_equal(history.frame, np.arange(ALL_FRAMES))
    np.testing.assert_allclose(history.time_s, truth(clip)["time_s"], atol=1e-6)
    assert np.ptp(np.diff(history.time_s)) > 0.01


def test_black_frames_are_lost_and_the_roof_is_found_again_at_once(clip, run, history):
    black = (history.time_s >= BLACK_S[0]) & (history.time_s <= BLACK_S[1])
    assert black.sum() >= 3
    assert (history.status[black] == Status.LOST).all()
    assert np.isnan(displacement(history)[black]).all()
    assert np.isfinite(displacement(history)[~black]).all()
    rows = (run / "results" / "roof.csv").read_text().splitlines()[1:]
    assert all(row.split(",", 3)[3] == "," * 14 for row, dark in zip(rows, black, strict=True) if dark)


def test_a_picture_that_freezes_in_the_shaking_is_lost(clip, tmp_path):
    frozen = slice(105, 120)

    def with_repeats(pictures):
        shown = list(pictures)
        shown[frozen] = [pictures[frozen.start - 1]] * (frozen.stop - frozen.start)
        return shown

    history = measured_history(filmed_anew(clip, tmp_path / "frozen", with_repeats))
    assert (history.status[frozen] == Status.LOST).all()
    assert (history.status[[*range(70, 85), *range(120, 168)]] != Status.LOST).all()
    error = displacement(history) - true_displacement(clip)
    assert np.nanmax(np.abs(error)) < roof_pixel_m(BRIEF)


def test_the_published_way_shows_the_exact_apparent_motion(clip, tmp_path):
    folder = project_copy(clip, tmp_path / "paper", method="paper")
    inputs = load_inputs(folder)
    setup = inputs.setup()
    measurer = make_measurer(setup)
    with MeasurementStore(folder / "results" / FRAMES_FILE) as store:
        number = store.begin("paper", setup.fingerprint, measurer.reference)
        for frame in measure_chunk(setup, Chunk(104, 120), measurer=measurer):
            store.append(number, frame)
        store.commit()
        recording = store.load(number)
    history = solve(recording, inputs.project, inputs.lens, inputs.relief).histories["roof"]
    apparent = apparent_displacement(truth(clip), "roof", inputs.project)[104:120]
    got = np.stack([history.p1_raw_m, history.p2_raw_m], axis=1)
    error = got - apparent
    assert np.isfinite(error).all(axis=(1, 2)).mean() > 0.9
    # Two strips a few pixels wide, seen by Canny's edges: a fifth of a pixel at roof level.
    assert np.sqrt(np.nanmean(error**2, axis=0)).max() < 0.2 * roof_pixel_m(BRIEF)


@pytest.fixture
def many_processes(monkeypatch):
    """Have all workers measure, however short the clip and however few the cores."""
    monkeypatch.setattr(measuring, "processes_for", lambda frames, workers, cores, pixels: workers or 1)


@pytest.mark.usefixtures("many_processes")
def test_a_noisy_clip_is_compared_with_a_mean_of_frames(tmp_path_factory, tmp_path):
    brief = replace(BRIEF, texture=0.3, noise=(8.0, 0.0), recording=Recording(bit_rate=10_000_000))
    clip = rendered(tmp_path_factory, "noisy", brief)
    alone, shared = (project_copy(clip, tmp_path / name) for name in ("alone", "shared"))
    for folder in (alone, shared):
        (folder / "results").mkdir()
    history = measured_history(alone)
    true = true_displacement(clip)
    start, end = read_project(clip).intervals_s.pre_event
    rest = (history.time_s >= start) & (history.time_s <= end)
    error = displacement(history) - (true - true[rest].mean(axis=0))
    assert np.isfinite(error).all()
    # By its reference frame alone the clip is measured to one and a half pixels.
    assert np.sqrt((error**2).mean()) < 0.25 * roof_pixel_m(brief)
    assert largest_difference_m(history, measured_history(shared, workers=2)) < SAME_M


def test_a_clip_that_starts_in_mid_shaking_finds_its_own_lines(tmp_path_factory):
    brief = replace(BRIEF, starts_s=3.0, recording=Recording(bit_rate=8_000_000))
    folder = rendered(tmp_path_factory, "mid-shaking", brief)
    true = true_displacement(folder)
    history = measured_history(folder)
    start, end = read_project(folder).intervals_s.pre_event
    rest = true[(history.time_s >= start) & (history.time_s <= end)].mean(axis=0)
    assert np.isfinite(displacement(history)).all()
    assert np.abs(displacement(history) - (true - rest)).max() < 0.5 * roof_pixel_m(BRIEF)


def test_a_hidden_line_is_no_neighbouring_line(tmp_path_factory):
    brief = replace(BRIEF, post_event_s=2.4, recording=Recording(bit_rate=8_000_000), extras=(happenings.hidden_line,))
    folder = rendered(tmp_path_factory, "hidden-line", brief)
    history = measured_history(folder)
    error = displacement(history) - true_displacement(folder)
    # The neighbouring strip lies 1.2 m away; whatever is stated must be about that line and no other.
    assert np.nanmax(np.abs(error)) < roof_pixel_m(BRIEF)
    assert (history.status[~truth(folder)["hidden"]] != Status.LOST).mean() > 0.98


def test_a_clip_stored_on_its_side_is_measured_upright(tmp_path_factory):
    brief = replace(
        BRIEF,
        size_px=(540, 960),
        pre_event_s=1.2,
        event_s=1.0,
        post_event_s=0.6,
        roof_size_m=(8.6, 7.4),
        recording=Recording(bit_rate=8_000_000, turned=True),
    )
    folder = rendered(tmp_path_factory, "portrait", brief)
    inputs = load_inputs(folder)
    assert (inputs.info.width, inputs.info.height, inputs.info.rotation_deg) == (540, 960, 90)
    history = measured(inputs).histories["roof"]
    error = displacement(history) - true_displacement(folder)
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.1 * roof_pixel_m(brief)


# --- how repeatable --------------------------------------------------------------------------------------------------


def test_the_same_inputs_give_the_same_file(clip, run, tmp_path):
    folder = project_copy(clip, tmp_path / "again")
    run_project(folder)
    assert (folder / "results" / "roof.csv").read_bytes() == (run / "results" / "roof.csv").read_bytes()


KILLED_RUN = """
import os, signal, sys, time
from pathlib import Path
from core import run

def watch(stage, done, total):
    if stage == "measuring" and done == 60:
        time.sleep(1.0)  # longer than what a run may lose
    if stage == "measuring" and done == 75:
        os.kill(os.getpid(), signal.SIGKILL)

run.run_project(Path(sys.argv[1]), progress=watch)
"""

INTERRUPTED_RUN = """
import os, signal, sys
from app import cli
from core import run

unwatched = run.run_project

def run_project(folder, progress, **settings):
    def watch(stage, done, total):
        progress(stage, done, total)
        if stage == "measuring" and done == 60:
            os.kill(os.getpid(), signal.SIGINT)
    return unwatched(folder, progress=watch, **settings)

run.run_project = run_project
sys.exit(cli.main(["run", sys.argv[1]]))
"""


def program(script, *arguments):
    command = [sys.executable, "-c", script, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)


def frames_kept(folder):
    with sqlite3.connect(folder / "results" / FRAMES_FILE) as db:
        return db.execute("SELECT count(*) FROM frames").fetchone()[0]


def test_a_killed_run_goes_on_as_if_nothing_had_happened(clip, history, tmp_path):
    folder = project_copy(clip, tmp_path / "killed")
    assert program(KILLED_RUN, folder).returncode == -signal.SIGKILL
    assert 55 <= frames_kept(folder) <= 75
    assert not (folder / "results" / "roof.csv").exists()
    assert largest_difference_m(measured_history(folder), history) < SAME_M


def test_ctrl_c_keeps_what_was_measured(clip, history, tmp_path):
    folder = project_copy(clip, tmp_path / "interrupted")
    ended = program(INTERRUPTED_RUN, folder)
    assert ended.returncode == 130
    assert "partial results kept" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert frames_kept(folder) == 60
    assert largest_difference_m(measured_history(folder), history) < SAME_M


@pytest.mark.usefixtures("many_processes")
def test_two_workers_measure_the_same(clip, history, tmp_path):
    folder = project_copy(clip, tmp_path / "workers")
    assert largest_difference_m(measured_history(folder, workers=2), history) < SAME_M


@pytest.mark.parametrize("workers", [2, None])
@pytest.mark.parametrize(("cores", "helping"), [(2, 0), (4, 1)])
def test_a_short_clip_gets_help_only_where_cores_are_idle(clip, tmp_path, monkeypatch, workers, cores, helping):
    counts = []

    def counted(work, count):
        counts.append(count)
        raise Cancelled

    monkeypatch.setattr(measuring, "available_cores", lambda: cores)
    monkeypatch.setattr(measuring, "Helpers", counted)
    with pytest.raises(Cancelled):
        measured_history(project_copy(clip, tmp_path / "short"), workers=workers)
    assert counts == [helping]


@pytest.mark.usefixtures("many_processes")
def test_a_chunk_may_begin_anywhere(clip, history, tmp_path, monkeypatch):
    black = np.flatnonzero((history.time_s >= BLACK_S[0]) & (history.time_s <= BLACK_S[1]))
    # In the black, right behind it, in the strongest shaking, and where no key frame is near.
    edges = [0, 41, int(black[1]), int(black[-1]) + 2, int(black[-1]) + 12, 133, ALL_FRAMES]
    chunks = [Chunk(start, stop) for start, stop in itertools.pairwise(edges)]
    monkeypatch.setattr(measuring, "missing_chunks", lambda done, index, parts, head_start: chunks)
    folder = project_copy(clip, tmp_path / "pieces")
    assert largest_difference_m(measured_history(folder, workers=2), history) < SAME_M


MEMORY_OF_A_RUN = """
import sys
from pathlib import Path
from core.measure import measure
from core.measurements import MeasurementStore
from core.run import load_inputs

held = {}
def watch(stage, done, total):
    if done in (150, total):
        status = Path("/proc/self/status").read_text()
        held[done] = int(status.split("VmRSS:")[1].split()[0]) / 1024

folder = Path(sys.argv[1])
with MeasurementStore(folder / "frames.sqlite") as store:
    measure(load_inputs(folder).setup(), store, progress=watch)
print(*held, *held.values())
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="this system does not tell")
def test_memory_stays_the_same_however_long_the_clip(tmp_path):
    folder = tmp_path / "sample"
    shutil.copytree(ROOT / "sample_data" / "sample", folder)
    ended = program(MEMORY_OF_A_RUN, folder)
    assert ended.returncode == 0, ended.stderr
    early, late, early_mb, late_mb = map(float, ended.stdout.split())
    frame_mb = 960 * 540 * 1.5 / 2**20
    assert late_mb - early_mb < 0.1 * (late - early) * frame_mb
    assert late_mb < 400


# --- measure once, solve many times ----------------------------------------------------------------------------------


def _moved_band(project):
    target = json.loads(project.targets[0].model_dump_json())
    target["lines"]["L1"]["from_m"][0] += 0.1
    return {"targets": [target]}


def _moved_region(project):
    region = [[u + 3.0, v] for u, v in project.moving_regions_px[0]]
    return {"moving_regions_px": [region, *project.moving_regions_px[1:]]}


def _damaged(clip, folder):
    """Return a project with a damaged packet in its video, and the numbers of the frames that this takes away."""
    project_copy(clip, folder)
    (folder / "video.mp4").unlink()
    repacked(clip / "video.mp4", folder / "video.mp4", lambda n, data: bytes(len(data)) if n == 100 else data)
    decoded = [frame.index for frame in read_frames(folder / "video.mp4")]
    return folder, np.setdiff1d(np.arange(ALL_FRAMES), decoded)


@pytest.mark.usefixtures("many_processes")
@pytest.mark.parametrize("workers", [1, 2])
def test_damaged_frames_are_lost_and_those_behind_them_keep_their_numbers(clip, history, tmp_path, workers):
    folder, missing = _damaged(clip, tmp_path / "damaged")
    assert 0 < len(missing) < 40
    found = measured_history(folder, workers=workers)
    np.testing.assert_array_equal(found.frame, history.frame)
    np.testing.assert_allclose(found.time_s, history.time_s, rtol=0, atol=5.1e-7)
    assert (found.status[missing] == Status.LOST).all()
    # Before the damage everything is as it was, and long after it again.
    untouched = [*range(int(missing[0]) - 1), *range(ALL_FRAMES - 10, ALL_FRAMES)]
    assert np.nanmax(np.abs(displacement(found) - displacement(history))[untouched]) < roof_pixel_m(BRIEF) / 10
    assert frames_of_finished(folder) == ALL_FRAMES


def frames_of_finished(folder):
    """Return how many frames a finished recording holds."""
    with MeasurementStore(folder / "results" / FRAMES_FILE) as store:
        setup = load_inputs(folder).setup()
        recording = store.find(setup.method, setup.fingerprint)
        assert store.is_finished(recording)
        return len(store.measured_frames(recording))


def test_a_damaged_reference_frame_is_named(clip, tmp_path):
    folder, missing = _damaged(clip, tmp_path / "damaged")
    _edit(folder, lambda d: d.update(reference_frame=int(missing[0])))
    with pytest.raises(InputError, match=f"frame {missing[0]} cannot be decoded; choose another reference_frame"):
        measured_history(folder)


def test_one_process_at_a_time_measures_a_project(run, tmp_path):
    folder = with_measurements(run, tmp_path / "busy")
    lock = take_lock(folder / "results")
    with lock, pytest.raises(InputError, match="busy: is being measured by another process; wait for its end"):
        run_project(folder)
    assert run_project(folder).frames_measured == 0


@pytest.mark.parametrize("stage", ["solving", "drawing figures"])
def test_a_run_that_is_stopped_behind_the_measuring_writes_nothing(run, tmp_path, stage):
    folder = with_measurements(run, tmp_path / "stopped")
    cancel = CancelToken()

    def stop(told, done, total):
        if told == stage:
            cancel.cancel()

    with pytest.raises(Cancelled):
        run_project(folder, progress=stop, cancel=cancel)
    assert not (folder / "results" / "summary.json").exists()
    assert frames_kept(folder) == ALL_FRAMES


def test_what_only_geometry_needs_never_reads_the_video_again(run, history, tmp_path):
    project = read_project(run)
    pairs = [json.loads(pair.model_dump_json()) for pair in project.correspondences]
    pairs[3]["frame_px"][0] += 1.0
    pairs[5]["enabled"] = False
    target = json.loads(project.targets[0].model_dump_json())
    target["height_m"] += 0.05
    folder = with_measurements(
        run,
        tmp_path / "changed",
        correspondences=pairs,
        targets=[target],
        intervals_s={"pre_event": [0.1, 2.2], "event": [2.4, 4.0], "residual": [4.9, 5.4]},
        excluded_frames=[[10, 14]],
        drift={"filter": "high-pass", "corner_hz": 0.5, "order": 6},
    )
    lens = read_lens(folder / "lens.yaml")
    (folder / "lens.yaml").unlink()
    write_lens(folder / "lens.yaml", replace(lens, distortion=lens.distortion * 1.02))
    summary = run_project(folder)
    assert summary.frames == ALL_FRAMES
    assert summary.frames_measured == 0
    new = read_history_csv(folder / "results" / "roof.csv")
    assert np.nanmax(np.abs(new.p1_m - history.p1_m)) > 1e-4
    assert (new.status[10:15] == Status.EXCLUDED).all()
    assert np.isnan(displacement(new)[10:15]).all()
    assert np.isfinite(new.p1_m[15]).all()


@pytest.mark.parametrize("change", [_moved_band, _moved_region])
def test_another_place_to_look_at_is_measured_anew(run, tmp_path, change):
    folder = with_measurements(run, tmp_path / "changed", **change(read_project(run)))
    setup = load_inputs(folder).setup()
    with MeasurementStore(folder / "results" / FRAMES_FILE) as store:
        assert store.find(setup.method, setup.fingerprint) is None


# --- mistakes --------------------------------------------------------------------------------------------------------


def _no_video_stream(folder):
    (folder / "video.mp4").unlink()
    with wave.open(str(folder / "video.mp4"), "wb") as sound:
        sound.setnchannels(1)
        sound.setsampwidth(2)
        sound.setframerate(8000)
        sound.writeframes(b"\0" * 16000)


def _no_video_at_all(folder):
    (folder / "video.mp4").unlink()
    (folder / "video.mp4").write_text("not a video")


def _lens_of_another_size(folder):
    text = (folder / "lens.yaml").read_text()
    (folder / "lens.yaml").unlink()
    (folder / "lens.yaml").write_text(text.replace("image_width: 960", "image_width: 1920"))


def _edit(folder, change):
    file = folder / "project.json"
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))


def _three_pairs(folder):
    _edit(folder, lambda d: d.update(correspondences=d["correspondences"][:3]))


def _collinear_pairs(folder):
    def change(document):
        for number, pair in enumerate(document["correspondences"]):
            pair["ground_m"] = [float(number), 2.0 * number]

    _edit(folder, change)


def _band_without_line(folder):
    def change(document):
        band = document["targets"][0]["lines"]["L1"]
        band["from_m"], band["to_m"] = [14.0, 9.0], [16.0, 9.3]

    _edit(folder, change)


def _cloud_without_ground(folder):
    (folder / "site.laz").unlink()
    rng = np.random.default_rng(4)
    # A wall and nothing else.
    wall = np.column_stack([rng.uniform(-20, 20, 5000), rng.normal(0, 0.01, 5000), rng.uniform(0, 30, 5000)])
    np.savetxt(folder / "wall.csv", wall, delimiter=",", header="x,y,z", comments="", fmt="%.3f")
    _edit(folder, lambda d: d["inputs"].update(cloud="wall.csv"))


def _unknown_key(folder):
    _edit(folder, lambda d: d["targets"][0].update(hieght_m=18.3))


def _interval_outside(folder):
    _edit(folder, lambda d: d["intervals_s"].update(residual=[29.0, 32.0]))


@pytest.mark.parametrize(
    ("mistake", "place"),
    [
        (_no_video_stream, "video.mp4"),
        (_no_video_at_all, "video.mp4"),
        (_lens_of_another_size, "lens.yaml"),
        (_three_pairs, "correspondences"),
        (_collinear_pairs, "collinear"),
        (_band_without_line, "targets.roof.lines.L1"),
        (_cloud_without_ground, "without ground"),
        (_unknown_key, "hieght_m"),
        (_interval_outside, "intervals_s.residual"),
    ],
)
def test_a_mistake_gets_one_sentence_and_destroys_nothing(run, tmp_path, capsys, mistake, place):
    folder = project_copy(run, tmp_path / "mistaken")
    shutil.copytree(run / "results", folder / "results")
    earlier = results_of(folder)
    mistake(folder)
    decided = (folder / "project.json").read_bytes()
    assert cli.main(["run", "--fresh", str(folder)]) == 1
    said = capsys.readouterr().err.strip()
    assert place in said
    assert said.count("\n") == 0, said
    assert said.endswith(".")
    assert "Traceback" not in said
    assert "unexpected" not in said
    assert (folder / "project.json").read_bytes() == decided
    assert results_of(folder) == earlier


def results_of(folder):
    """Return all results but what is kept only to be quicker."""
    files = [file for file in (folder / "results").rglob("*") if file.is_file() and RELIEF_FILE not in file.name]
    return {str(file): file.read_bytes() for file in files}
