from __future__ import annotations

import errno
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core import export
from core.errors import InputError
from core.export import Results, fitted_lines, write_results
from core.gps_record import GpsRecord
from core.project import Project
from core.report import ReportFigure
from core.results import read_history_csv
from core.solution import Solution
from core.solve import solve
from core.video import probe
from tests import exact_scene as scene
from tests.small_project import write_video

ANTENNA_M = scene.SITE_M + scene.ROOF_M + [0.5, 0.1]
GPS = {"file": "gps.csv", "at_m": ANTENNA_M.tolist()}
WITH_GPS = {"inputs": {"video": "video.mp4", "lens": "lens.yaml", "gps": GPS}}


@lru_cache
def solved() -> Solution:
    return solve(scene.recording(), scene.project_document(), scene.LENS)


@pytest.fixture(scope="session")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("inputs") / "video.mp4"
    write_video(file, scene.SIZE, frames=2)
    return file


def gps_record(lag_s: float = -40.0) -> GpsRecord:
    """The antenna's true path, every third frame, in UTM and by a clock of its own."""
    turned = scene.truth().rotation_rad[:, None] * np.array([-0.1, 0.5])
    middle = (scene.truth().p1_m + scene.truth().p2_m) / 2
    arm = scene.truth().rotation_rad[:, None] * np.array([0.0, -0.4]) + turned
    return GpsRecord("gps.csv", np.arange(0, 120, 3) / scene.RATE_HZ - lag_s, (ANTENNA_M + middle + arm)[::3])


def results(video: Path, project: Project, solution: Solution, **changes: Any) -> Results:
    made = Results(
        project=project,
        folder=video.parent,
        recording=scene.recording(names=tuple(solution.targets)),
        solution=solution,
        gps=None,
        video=video,
        info=probe(video),
        sha256={"video.mp4": "ab" * 32, "lens.yaml": "cd" * 32, "gps.csv": "ef" * 32},
        identity={"video.mp4": "12" * 32, "lens.yaml": "34" * 32, "gps.csv": "56" * 32},
        version="0.1.0",
        frames_measured=scene.FRAMES,
        measuring_s=6.0,
        solving_s=0.5,
    )
    return replace(made, **changes)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the figures out, which take longer than all the rest."""
    monkeypatch.setattr(export, "_draw", lambda results, check, progress: {"roof-orbit": ReportFigure("", b"PNG")})


@pytest.fixture(scope="module")
def written(video: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], list[str]]:
    folder, stages = tmp_path_factory.mktemp("results"), []
    project = scene.project_document(**WITH_GPS)
    summary = write_results(
        folder,
        results(video, project, solved(), gps=gps_record()),
        lambda stage, done, total: stages.append(f"{stage} {done}/{total}"),
    )
    return folder, summary, stages


def test_everything_is_there(written: tuple[Path, dict[str, Any], list[str]]) -> None:
    folder, _, stages = written
    names = {file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file()}
    drawn = ("tracked", "displacement", "orbit", "pre_event", "corner_sweep", "corner_effect", "gps")
    assert names == {
        "roof.csv", "summary.json", "report.html", "figures/camera.png", *(f"figures/roof-{name}.png" for name in drawn)
    }  # fmt: skip
    assert all(file.read_bytes().startswith(b"\x89PNG") for file in (folder / "figures").iterdir())
    assert stages[0] == "drawing figures 0/8"
    assert stages[-1] == "drawing figures 8/8"


def test_csv_holds_the_true_motion(written: tuple[Path, dict[str, Any], list[str]]) -> None:
    history = read_history_csv(written[0] / "roof.csv")
    assert history.counts() == {"ok": scene.FRAMES, "weak": 0, "lost": 0, "excluded": 0}
    # Without noise what remains is the stop of the iterations: micrometres.
    np.testing.assert_allclose(history.p1_m, scene.truth().p1_m, atol=5e-6)
    np.testing.assert_allclose(history.p2_m, scene.truth().p2_m, atol=5e-6)
    np.testing.assert_allclose(history.rotation_rad, scene.truth().rotation_rad, atol=5e-7)


def test_summary_says_what_the_contract_asks(written: tuple[Path, dict[str, Any], list[str]]) -> None:
    folder, summary, _ = written
    stored = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert stored.keys() == summary.keys()
    roof, truth = stored["targets"]["roof"], scene.truth()
    peak = int(np.argmax(truth.p1_m[45:91, 0])) + 45
    assert roof["peak_positive_m"]["x"]["value"] == pytest.approx(truth.p1_m[peak, 0], abs=1e-5)
    assert roof["peak_positive_m"]["x"]["time_s"] == pytest.approx(peak / scene.RATE_HZ)
    assert roof["residual_m"]["x"] == pytest.approx(scene.RESIDUAL_M, abs=1e-5)
    assert roof["pre_event_rms_m"]["x"] < 5e-6
    assert roof["counts"]["ok"] == scene.FRAMES
    assert roof["height_m"] == pytest.approx(scene.HEIGHT_M, abs=1e-3)
    np.testing.assert_allclose(roof["rest_m"]["p1"], scene.SITE_M + scene.ROOF_M + [0.4, 0.6], atol=1e-3)
    assert stored["reference_fit"]["rms_px"] < 1e-6
    assert stored["reference_fit"]["left_out_rms_px"] < 1e-6
    np.testing.assert_allclose(stored["reference_fit"]["camera_m"], scene.truth().centre_m[0], atol=1e-5)
    assert len(stored["reference_fit"]["pairs"]) == 10
    ground = stored["ground_fit"]
    assert ground["frames"] == scene.FRAMES
    assert ground["median_inliers"] == ground["least_inliers"] == ground["features"]
    assert ground["features_left_out"] == 0
    assert ground["rms_px"] < 1e-3
    assert (stored["frames"], stored["seconds"], stored["frames_per_second"]) == (120, 6.0, 20.0)
    assert stored["version"] == "0.1.0"
    assert stored["sha256"]["video.mp4"] == "ab" * 32
    assert stored["settings"] == scene.project_document(**WITH_GPS).model_dump(mode="json")
    assert stored["warnings"] == []
    corrected = stored["self_calibration"]
    assert corrected["refused"] is None
    assert [entry["name"] for entry in corrected["corrections"]][:2] == ["fx", "fy"]
    assert all(abs(entry["in_priors"]) < 0.05 for entry in corrected["corrections"])
    assert set(stored["flight"]) == {"x", "y", "z"}
    # An exact scene has no noise but what is assumed at least.
    assert 0 < stored["flight"]["z"]["noise_m"] < 1e-4


def test_gps_is_compared_at_its_antenna_and_by_its_own_clock(
    written: tuple[Path, dict[str, Any], list[str]],
) -> None:
    gps = written[1]["targets"]["roof"]["gps"]
    assert gps["lag_s"] == pytest.approx(-40.0, abs=1e-3)
    # The record is exact but for the second order of the roof's turn: 2 mrad squared, half a metre away.
    assert max(gps["rms_m"].values()) < 1e-4
    assert gps["residual_m"]["x"]["error"] == pytest.approx(0.0, abs=1e-4)


def test_report_tells_the_same(written: tuple[Path, dict[str, Any], list[str]]) -> None:
    html = (written[0] / "report.html").read_text(encoding="utf-8")
    assert html.count("<img ") == 8
    for words in ("120 frames in 6.0 s", "SHA-256 " + "cd" * 32, "120 of 120", "height of roof", "8.00",
                  "960 × 540 pixels", "40 positions"):  # fmt: skip
        assert words in html, words


@pytest.mark.usefixtures("undrawn")
def test_csv_and_report_are_the_same_byte_for_byte(video: Path, tmp_path: Path) -> None:
    for folder in ("one", "two"):
        write_results(tmp_path / folder, results(video, scene.project_document(), solved()))
    for name in ("roof.csv", "summary.json", "report.html"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


@pytest.mark.usefixtures("undrawn")
def test_what_is_no_target_any_more_is_removed_and_nothing_else(video: Path, tmp_path: Path) -> None:
    write_results(tmp_path, results(video, scene.project_document(), solved()))
    (tmp_path / "roof.csv").rename(tmp_path / "table.csv")
    (tmp_path / "notes.csv").write_text("my own,notes\n")
    (tmp_path / "figures" / "table-orbit.png").write_bytes(b"")
    (tmp_path / "frames.sqlite").write_bytes(b"kept")
    write_results(tmp_path, results(video, scene.project_document(), solved()))
    names = {file.relative_to(tmp_path).as_posix() for file in tmp_path.rglob("*") if file.is_file()}
    assert names == {
        "roof.csv", "notes.csv", "frames.sqlite", "summary.json", "report.html", "figures/roof-orbit.png"
    }  # fmt: skip


def all_lost(solution: Solution) -> Solution:
    """The same as if no frame had been recognised."""
    ground = replace(
        solution.ground,
        usable=np.zeros(scene.FRAMES, dtype=bool),
        inliers=np.zeros(scene.FRAMES, dtype=np.int64),
        weight=np.zeros_like(solution.ground.weight),
    )
    lost = replace(solution.histories["roof"], status=np.full(scene.FRAMES, "lost"))
    targets = {"roof": replace(solution.targets["roof"], history=lost)}
    return replace(solution, ground=ground, targets=targets, histories={"roof": lost}, flight=None)


def test_a_video_without_one_good_frame_is_told_in_nulls(video: Path, tmp_path: Path) -> None:
    project = scene.project_document(**WITH_GPS)
    write_results(tmp_path, results(video, project, all_lost(solved()), gps=gps_record(), frames_measured=0))
    stored = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    roof = stored["targets"]["roof"]
    assert roof["counts"]["lost"] == scene.FRAMES
    assert roof["peak_positive_m"] == {"x": None, "y": None}
    assert roof["residual_m"] is roof["pre_event_rms_m"] is roof["gps"] is None
    assert stored["ground_fit"]["median_inliers"] is stored["ground_fit"]["rms_px"] is None
    assert stored["frames_per_second"] is None
    assert any("not one of 120 frames" in sentence for sentence in stored["warnings"])
    assert any("GPS was not compared" in sentence for sentence in stored["warnings"])
    assert len((tmp_path / "roof.csv").read_text().splitlines()) == 1 + scene.FRAMES
    assert "0 of 120" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_paper_has_neither_poses_nor_calibration(video: Path, tmp_path: Path) -> None:
    solution = replace(
        solved(),
        ground=replace(solved().ground, poses=None),
        heights_m={"roof": None},
        self_calibration=None,
        flight=None,
        reference=replace(solved().reference, pose=None),
    )
    project = scene.project_document(method="paper", intervals_s={})
    summary = write_results(tmp_path, results(video, project, solution))
    assert summary["self_calibration"] is summary["flight"] is summary["reference_fit"]["camera_m"] is None
    assert summary["targets"]["roof"]["height_m"] is None
    assert not (tmp_path / "figures" / "camera.png").exists()
    assert "did not run" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.usefixtures("undrawn")
def test_filter_that_eats_the_residual_is_warned_of(video: Path, tmp_path: Path) -> None:
    project = scene.project_document(drift={"filter": "high-pass", "corner_hz": 0.5})
    solution = solve(scene.recording(), project, scene.LENS)
    warnings = write_results(tmp_path, results(video, project, solution))["warnings"]
    assert any(sentence.startswith("roof: The filter removes the residual") for sentence in warnings)


@pytest.mark.usefixtures("undrawn")
def test_gps_knows_no_table(video: Path, tmp_path: Path) -> None:
    roof = scene.project_document().targets[0]
    table = roof.model_copy(update={"name": "table", "height_m": 0.1})
    relative = roof.model_copy(update={"relative_to": "table"})
    project = scene.project_document(targets=(relative, table), **WITH_GPS)
    base = solved().targets["roof"]
    targets = {"roof": base, "table": replace(base, history=replace(base.history, name="table"))}
    still = replace(base.history, p1_m=0 * base.history.p1_m, p2_m=0 * base.history.p2_m)
    solution = replace(
        solved(),
        targets=targets,
        heights_m={"roof": 12.0, "table": 0.1},
        histories={"roof": still, "table": targets["table"].history},
    )
    summary = write_results(tmp_path, results(video, project, solution, gps=gps_record()))
    assert summary["targets"]["table"]["gps"] is None
    assert max(summary["targets"]["roof"]["gps"]["rms_m"].values()) < 1e-4
    assert summary["targets"]["roof"]["peak_positive_m"]["x"]["value"] == 0.0
    assert any("not with its motion relative to table" in sentence for sentence in summary["warnings"])


@pytest.mark.usefixtures("undrawn")
def test_gps_of_another_day_leaves_earlier_results_alone(video: Path, tmp_path: Path) -> None:
    write_results(tmp_path, results(video, scene.project_document(), solved()))
    before = {file: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()}
    noise = np.random.default_rng(0).normal(scale=1e-3, size=(40, 2))
    record = GpsRecord("gps.csv", np.arange(40) / 5 + 9000.0, noise)
    with pytest.raises(InputError, match=r"gps\.csv: its times"):
        write_results(tmp_path, results(video, scene.project_document(**WITH_GPS), solved(), gps=record))
    assert {file: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()} == before


def test_points_and_their_region_are_drawn(video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = scene.project_document().targets[0]
    corners = [(-3.0, -2.0), (3.0, -2.0), (3.0, 2.0), (-3.0, 2.0)]
    region = tuple(tuple(np.array(corner) + scene.ROOF_M + scene.SITE_M) for corner in corners)
    target = lines.model_copy(update={"kind": "points", "lines": None, "region_m": region})
    recording = scene.recording()
    patches = recording.reference.targets_raw["roof"].reshape(-1, 2)
    recording = replace(recording, reference=replace(recording.reference, targets_raw={"roof": patches}))
    drawn: dict[str, Any] = {}
    original: Callable[..., Any] = export._tracked_figure
    project = scene.project_document(targets=(target,))

    from core import figures

    def remember(image: Any, **content: Any) -> Any:
        drawn.update(content)
        return frame_figure(image, **content)

    frame_figure = figures.frame_figure
    monkeypatch.setattr(figures, "frame_figure", remember)
    luma = np.zeros(scene.SIZE[::-1], dtype=np.uint8)
    figure = original(results(video, project, solved(), recording=recording), target, luma)
    assert figures.encoded(figure).startswith(b"\x89PNG")
    np.testing.assert_array_equal(drawn["edges_px"]["region"], patches)
    assert drawn["lines_px"]["region"].shape == (5, 2)
    expected = fitted_lines(scene.recording().reference.targets_raw["roof"], scene.LENS)[1]
    for name in ("P1", "P2"):
        np.testing.assert_allclose(drawn["points_px"][name], expected[name], atol=0.05)


def test_lines_are_drawn_where_they_lie() -> None:
    edges = scene.recording().reference.targets_raw["roof"].copy()
    edges[0, :7] = np.nan
    lines, points = fitted_lines(edges, scene.LENS)
    for name, edge in zip(("L1", "L2", "T1"), edges, strict=True):
        middle = edge.mean(axis=1)
        nearest = np.linalg.norm(middle[:, None] - lines[name], axis=2).min(axis=1)
        # A polyline of 33 points along a few hundred pixels: nearest points lie within half a step.
        assert np.nanmax(nearest) < np.linalg.norm(lines[name][1] - lines[name][0])
    roof = np.array([[0.4, 0.6], [0.4, -0.6]]) + scene.ROOF_M
    seen = scene.seen(0, np.column_stack([roof, np.full(2, scene.HEIGHT_M)]))
    np.testing.assert_allclose([points["P1"], points["P2"]], seen, atol=0.01)


def test_nothing_is_drawn_with_before_it_must_be() -> None:
    code = "import sys, core.export; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], check=False).returncode == 0


@pytest.mark.usefixtures("undrawn")
def test_a_video_that_ends_before_it_says_is_told(video: Path, tmp_path: Path) -> None:
    announced = replace(probe(video), duration_s=scene.FRAMES / scene.RATE_HZ + 2)
    made = results(video, scene.project_document(), solved(), info=announced)
    warnings = write_results(tmp_path, made)["warnings"]
    assert warnings[0].startswith("video.mp4: says that it lasts")
    assert warnings[0].endswith("as in a file that was cut off; copy it again.")


@pytest.mark.usefixtures("undrawn")
def test_a_video_that_is_interlaced_is_told(video: Path, tmp_path: Path) -> None:
    made = results(video, scene.project_document(), solved(), info=replace(probe(video), is_interlaced=True))
    assert write_results(tmp_path, made)["warnings"][0].startswith("video.mp4: says that it is interlaced")


@pytest.mark.usefixtures("undrawn")
def test_results_that_find_no_room_leave_the_earlier_ones(
    video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = results(video, scene.project_document(), solved())
    write_results(tmp_path, made)
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}

    def no_room(path: Path, summary: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(export, "write_summary", no_room)
    with pytest.raises(OSError, match="No space left") as refused:
        write_results(tmp_path, replace(made, version="0.2.0"))
    assert refused.value.filename == str(tmp_path)
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before


@pytest.mark.usefixtures("undrawn")
def test_results_that_find_their_place_taken_leave_the_earlier_ones(video: Path, tmp_path: Path) -> None:
    made = results(video, scene.project_document(), solved())
    write_results(tmp_path, made)
    (tmp_path / "report.html").unlink()
    (tmp_path / "report.html").mkdir()
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    with pytest.raises(IsADirectoryError) as refused:
        write_results(tmp_path, replace(made, version="0.2.0"))
    assert refused.value.filename == str(tmp_path / "report.html")
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before


@pytest.mark.usefixtures("undrawn")
def test_what_a_killed_run_was_writing_is_cleared_away(video: Path, tmp_path: Path) -> None:
    left_over = tmp_path / f"{export.BEING_WRITTEN}abc" / "figures"
    left_over.mkdir(parents=True)
    write_results(tmp_path, results(video, scene.project_document(), solved()))
    assert [file.name for file in tmp_path.iterdir() if file.name.startswith(".")] == []


def test_the_summary_comes_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved: list[str] = []
    replace_file = Path.replace
    monkeypatch.setattr(Path, "replace", lambda file, place: (moved.append(place.name), replace_file(file, place))[1])
    with export._all_or_none(tmp_path) as made:
        for name in ("summary.json", "a.csv", "z.csv"):
            (made / name).touch()
    assert sorted(moved[:2]) == ["a.csv", "z.csv"]
    assert moved[2] == "summary.json"
