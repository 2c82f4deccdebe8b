"""From the button to the numbers: a clip is tracked in a worker, looked at, cancelled, gone on with."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.context import Context
from app.jobs import JOB_FILE
from app.outcome import recorded_of
from app.server import create_app
from core.lens import Lens, write_lens
from core.project import Drift
from core.results import CSV_HEADER
from core.solve import filtered
from tests.app.conftest import ADDRESS, WRITE, TestClient
from tests.app.measured import FOCAL_PX, SIZE, displacement_m, write_measurable
from tests.scenes.clips import measured_history

FRAMES = 40
CLIP = "/api/projects/clip"


def wait_for(client: TestClient, job: dict[str, Any]) -> dict[str, Any]:
    deadline = time.monotonic() + 120
    while job["state"] == "running":
        assert time.monotonic() < deadline, f"the job does not end: {job}"
        time.sleep(0.05)
        job = client.get(f"/api/jobs/{job['id']}").json()["job"]
    return job


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A server over a clip that has been tracked through it."""
    workspace = tmp_path_factory.mktemp("tracked")
    write_measurable(workspace / "clip", FRAMES)
    with TestClient(create_app(workspace), base_url=ADDRESS, headers=WRITE) as client:
        job = wait_for(client, client.post(f"{CLIP}/track", json={}).json()["job"])
        assert job["state"] == "done", job["message"]
        yield client


def test_tracking_leaves_results_that_fit_the_project(tracked: TestClient) -> None:
    results = tracked.get(f"{CLIP}/results").json()
    assert results["ready"]
    assert not results["stale"]
    assert results["targets"] == ["roof"]
    assert results["methods"] == ["geometric"]
    assert {"roof.csv", "summary.json", "report.html"} <= {file["name"] for file in results["files"]}
    assert not any(file["name"].endswith("sqlite") for file in results["files"])
    steps = tracked.get(CLIP).json()["steps"]
    assert steps["track"]["status"] == "done"
    assert steps["export"]["status"] == "done"


def test_the_history_is_the_one_of_the_csv_and_follows_the_truth(tracked: TestClient) -> None:
    columns = tracked.get(f"{CLIP}/results/roof").json()
    assert not columns.pop("is_earlier")
    assert ",".join(columns) == CSV_HEADER
    rows = list(csv.DictReader(io.StringIO(tracked.get(f"{CLIP}/files/roof.csv").text)))
    assert [float(row["p1_dx_m"]) for row in rows] == columns["p1_dx_m"]
    truth = np.array([displacement_m(time_s) for time_s in columns["time_s"]])
    # A tenth of a pixel at the roof, where a pixel is 32 mm: far above what the engine does, far below any mistake.
    assert np.array(columns["p1_dx_m"]) == pytest.approx(truth, abs=0.0032)


def test_the_state_after_tracking_holds_the_whole_history(tracked: TestClient) -> None:
    state = tracked.get(f"{CLIP}/track").json()
    assert (state["frames_done"], state["frames_total"], state["resumable"]) == (FRAMES, FRAMES, False)
    assert [row[0] for row in state["preview"]["roof"]] == list(range(FRAMES))


def test_a_frame_is_shown_as_it_was_measured(tracked: TestClient) -> None:
    still, moved = (tracked.get(f"{CLIP}/review/{frame}").json() for frame in (0, 14))
    assert len(still["ground"]["used"]) > 50
    for review in (still, moved):
        roof = review["targets"]["roof"]
        assert set(roof["edges_raw"]) == set(roof["lines_raw"]) == set(roof["bands_raw"]) == {"L1", "L2", "T1"}
        assert review["status"] == {"roof": "ok"}
        assert review["camera"]["centre_m"][2] == pytest.approx(20.0, abs=0.05)
    shift = np.subtract(moved["targets"]["roof"]["p1_raw"], still["targets"]["roof"]["p1_raw"])
    expected = displacement_m(14 / 20) * 500 / 16
    assert shift == pytest.approx([expected, 0.0], abs=0.1)
    band = np.array(moved["targets"]["roof"]["bands_raw"]["T1"]) - still["targets"]["roof"]["bands_raw"]["T1"]
    assert band.mean(axis=0) == pytest.approx([expected, 0.0], abs=0.3)
    between = [np.array(review["targets"]["roof"]["points_raw"]["used"]) for review in (still, moved)]
    counted = tracked.get(f"{CLIP}/files/summary.json").json()["targets"]["roof"]["texture_patches"]
    assert len(between[0]) == len(between[1]) == counted > 10
    assert (between[1] - between[0]).mean(axis=0) == pytest.approx([expected, 0.0], abs=0.1)
    answer = tracked.get(f"{CLIP}/review/{FRAMES}")
    assert (answer.status_code, answer.json()["error"]["kind"]) == (404, "missing")


def test_drift_is_looked_at_without_changing_anything(tracked: TestClient) -> None:
    wanted = {"target": "roof", "corner_hz": 0.8, "interval": [0.0, 0.5]}
    answer = tracked.post(f"{CLIP}/drift", json=wanted).json()
    assert len(answer["raw"]["dx"]) == len(answer["filtered"]["dy"]) == len(answer["time_s"]) == FRAMES
    assert answer["filtered_pre_event_rms_m"]["dx"] >= 0.0
    sweep = tracked.get(f"{CLIP}/drift/sweep", params={"target": "roof", "start": 0.0, "end": 0.5}).json()
    assert len(sweep["corners_hz"]) == len(sweep["rms_m"]["dx"])
    spectrum = tracked.get(f"{CLIP}/drift/spectrum", params={"target": "roof", "start": 0.5, "end": 1.95}).json()
    peak_hz = spectrum["frequency_hz"][int(np.argmax(spectrum["dx_m"]))]
    assert peak_hz == pytest.approx(1 / 0.8, abs=0.7)
    nonsense = tracked.post(f"{CLIP}/drift", json=wanted | {"corner_hz": 40.0})
    assert (nonsense.status_code, nonsense.json()["error"]["kind"]) == (422, "input")


def test_what_geometry_measured_stays_to_be_seen_when_the_filter_is_applied(tracked: TestClient) -> None:
    wanted = {"target": "roof", "corner_hz": 0.8, "interval": [0.0, 0.5]}
    at_rest = tracked.post(f"{CLIP}/drift", json=wanted).json()["geometric_pre_event_rms_m"]
    unfiltered = tracked.get(f"{CLIP}/results/roof", params={"unfiltered": True}).json()
    assert unfiltered == tracked.get(f"{CLIP}/results/roof").json()
    with changed(tracked, drift={"filter": "high-pass", "corner_hz": 0.8, "order": 4}):
        filtered = tracked.get(f"{CLIP}/results/roof").json()
        kept = tracked.get(f"{CLIP}/results/roof", params={"unfiltered": True}).json()
        assert tracked.post(f"{CLIP}/drift", json=wanted).json()["geometric_pre_event_rms_m"] == pytest.approx(
            at_rest, abs=1e-7
        )
    shift = np.subtract(filtered["p1_dx_m"], unfiltered["p1_dx_m"])
    assert np.abs(shift).max() > 0.01
    np.testing.assert_allclose(kept["p1_dx_m"], unfiltered["p1_dx_m"], atol=1e-6)


def test_gps_is_laid_over_the_video(tracked: TestClient) -> None:
    answer = tracked.get(f"{CLIP}/validation", params={"target": "roof"}).json()
    assert answer["lag_s"] == pytest.approx(-100.0, abs=0.02)
    assert answer["rms_m"]["x"] < 0.004
    assert len(answer["video"]["time_s"]) == FRAMES
    assert {row["quantity"] for row in answer["table"]} == {"peak_positive", "peak_negative"}


def test_another_method_that_was_not_measured_is_told(tracked: TestClient) -> None:
    answer = tracked.get(f"{CLIP}/results/roof", params={"method": "paper"})
    assert (answer.status_code, answer.json()["error"]["kind"]) == (409, "missing")


def test_files_lead_nowhere_else(tracked: TestClient) -> None:
    report = tracked.get(f"{CLIP}/files/report.html")
    assert "sandbox" in report.headers["content-security-policy"]
    assert tracked.get(f"{CLIP}/files/figures%2Froof-displacement.png").headers["content-type"] == "image/png"
    for name in ("..%2Fproject.json", "%2Fetc%2Fpasswd", "frames.sqlite", "job.json", "..%2F..%2Fclip%2Flens.yaml"):
        assert tracked.get(f"{CLIP}/files/{name}").status_code == 404, name


def test_a_changed_project_makes_files_stale_and_is_solved_at_once(tracked: TestClient) -> None:
    state = tracked.get(CLIP).json()
    project = state["project"] | {"excluded_frames": [[5, 7]]}
    edit = {"project": project, "revision": state["revision"], "label": "exclude 5 to 7"}
    changed = tracked.put(CLIP, json=edit).json()
    try:
        assert tracked.get(f"{CLIP}/results").json()["stale"]
        assert changed["steps"]["track"]["status"] == "stale"
        columns = tracked.get(f"{CLIP}/results/roof").json()
        assert columns["status"][4:9] == ["ok", "excluded", "excluded", "excluded", "ok"]
        assert columns["p1_dx_m"][6] is None
    finally:
        tracked.post(f"{CLIP}/undo", json={"revision": changed["revision"]})
    assert not tracked.get(f"{CLIP}/results").json()["stale"]


@contextlib.contextmanager
def changed(client: TestClient, **change: Any) -> Iterator[None]:
    """The project with a change that is undone afterwards."""
    state = client.get(CLIP).json()
    edit = {"project": state["project"] | change, "revision": state["revision"], "label": "change"}
    revision = client.put(CLIP, json=edit).json()["revision"]
    try:
        yield
    finally:
        client.post(f"{CLIP}/undo", json={"revision": revision})


def test_a_result_of_an_earlier_state_is_told_as_such(tracked: TestClient) -> None:
    wanted = {"target": "roof", "corner_hz": 0.3, "interval": [0.0, 0.5]}
    regions = tracked.get(CLIP).json()["project"]["moving_regions_px"]
    with changed(tracked, moving_regions_px=[*regions, [[5, 5], [9, 5], [9, 9]]]):  # nothing is measured with these
        assert tracked.get(f"{CLIP}/results/roof").json()["is_earlier"]
        assert tracked.post(f"{CLIP}/drift", json=wanted).json()["is_earlier"]
    with changed(tracked, excluded_frames=[[5, 7]]):
        assert not tracked.get(f"{CLIP}/results/roof").json()["is_earlier"]
        assert not tracked.post(f"{CLIP}/drift", json=wanted).json()["is_earlier"]


def test_drift_is_drawn_though_nothing_is_measured_at_rest(tracked: TestClient) -> None:
    wanted = {"target": "roof", "corner_hz": 0.3, "interval": [0.0, 0.5]}
    with changed(tracked, excluded_frames=[[0, 12]]):
        answer = tracked.post(f"{CLIP}/drift", json=wanted).json()
        assert answer["filtered_pre_event_rms_m"] is None
        assert any("no measured frame" in warning for warning in answer["warnings"])
        assert answer["raw"]["dx"][20] is not None
    with changed(tracked, excluded_frames=[[0, FRAMES - 1]]):
        answer = tracked.post(f"{CLIP}/drift", json=wanted).json()
        assert set(answer["status"]) == {"excluded"}


def test_another_filter_of_a_motion_that_is_known_is_not_solved_anew(
    tracked: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    context: Context = tracked.app.state.context  # type: ignore[attr-defined]
    folder = context.workspace.open("clip")
    project = folder.load().project
    filters = [Drift(filter="high-pass", corner_hz=0.5, order=2), Drift(filter="high-pass", corner_hz=0.7, order=2)]
    motion = context.outcomes.solved(folder, project).solution.histories["roof"].p1_m
    monkeypatch.setattr("app.outcome.solve", lambda *_, **__: pytest.fail("solved anew"))
    for chosen in (*filters, project.drift):
        found = context.outcomes.solved(folder, project.model_copy(update={"drift": chosen}))
        assert found.inputs.project.drift == chosen
        expected = filtered(found.solution.targets["roof"].history, chosen).p1_m
        np.testing.assert_array_equal(found.solution.histories["roof"].p1_m, expected)
        assert np.array_equal(expected, motion, equal_nan=True) == (chosen == project.drift)


def test_results_are_fresh_while_the_content_of_every_input_is_that_of_the_run(tracked: TestClient) -> None:
    workspace: Path = tracked.app.state.context.workspace.folder  # type: ignore[attr-defined]
    lens = workspace / "clip" / "lens.yaml"
    measured_with, made_s = lens.read_text(), lens.stat().st_mtime

    def is_stale(text: str, modified_s: float) -> bool:
        lens.write_text(text)
        os.utime(lens, (modified_s, modified_s))
        return bool(tracked.get(f"{CLIP}/results").json()["stale"])

    other = measured_with + "# another lens\n"
    try:
        assert is_stale(other, made_s - 86_400)
        assert is_stale(other, made_s + 86_400)
        assert not is_stale(measured_with, made_s + 86_400)
    finally:
        assert not is_stale(measured_with, made_s)


def test_results_are_fresh_when_they_come_back_from_an_archive(tracked: TestClient) -> None:
    made = tracked.post("/api/projects/restore", content=tracked.get(f"{CLIP}/archive").content).json()["id"]
    assert not tracked.get(f"/api/projects/{made}/results").json()["stale"]


def test_what_is_solved_rests_on_the_inputs_of_the_very_project_asked_for(tracked: TestClient) -> None:
    context: Context = tracked.app.state.context  # type: ignore[attr-defined]
    folder = context.workspace.open("clip")
    stored = folder.load().project
    write_lens(folder.folder / "longer.yaml", Lens.ideal(SIZE, 1.1 * FOCAL_PX))
    asked = stored.model_copy(update={"inputs": stored.inputs.model_copy(update={"lens": "longer.yaml"})})
    for project, focal_px in ((asked, 1.1 * FOCAL_PX), (stored, FOCAL_PX)):
        found = context.outcomes.solved(folder, project)
        assert found.inputs.project == project
        assert found.inputs.lens.focal_px == pytest.approx(focal_px)


def test_a_filter_that_is_not_applied_makes_nothing_stale(tracked: TestClient) -> None:
    state = tracked.get(CLIP).json()
    for drift, stale in (({"corner_hz": 0.4, "order": 6}, False), ({"filter": "high-pass"}, True)):
        project = state["project"] | {"drift": state["project"]["drift"] | drift}
        edit = {"project": project, "revision": state["revision"], "label": "drift"}
        changed = tracked.put(CLIP, json=edit).json()
        assert tracked.get(f"{CLIP}/results").json()["stale"] == stale
        assert (changed["steps"]["export"]["status"] == "stale") == stale
        state = tracked.post(f"{CLIP}/undo", json={"revision": changed["revision"]}).json()


def test_the_scene_shows_camera_and_roof_lines_in_step_with_a_frame(tracked: TestClient) -> None:
    scene = tracked.app.state.context.scene  # type: ignore[attr-defined]
    tall = {"frame": 14, "exaggeration": 10.0}
    assert tracked.post(f"{CLIP}/scene", json={"frame": 14}).json()["ready"]
    once = _line_points(scene, "moved/roof/T1")
    tracked.post(f"{CLIP}/scene", json=tall)
    tenfold = _line_points(scene, "moved/roof/T1")
    rest = _line_points(scene, "rest/roof/T1")
    moved_m = displacement_m(14 / 20)
    assert (once - rest)[:, 0] == pytest.approx([moved_m, moved_m], abs=0.004)
    assert (tenfold - rest)[:, 0] == pytest.approx([10 * moved_m] * 2, abs=0.04)
    assert rest[:, 2] == pytest.approx([4.0, 4.0], abs=0.01)
    frustum = scene._started().scene.get_handle_by_name("/camera/frustum")
    assert (np.array(frustum.position) + scene.origin_m)[2] == pytest.approx(20.0, abs=0.05)
    assert frustum.aspect == pytest.approx(SIZE[0] / SIZE[1])


def _line_points(scene: Any, name: str) -> Any:
    handle = scene._started().scene.get_handle_by_name(f"/lines/{name}")
    return np.array(handle.points)[0].astype(float) + scene.origin_m


def test_tracking_is_cancelled_goes_on_by_itself_after_a_restart_and_ends_as_if_uninterrupted(
    tracked: TestClient, tmp_path: Path
) -> None:
    frames = 800  # more than the engine measures in the seconds after which it is stopped
    write_measurable(tmp_path / "clip", frames)
    with TestClient(create_app(tmp_path), base_url=ADDRESS, headers=WRITE) as client:
        folder = client.app.state.context.workspace.open("clip")  # type: ignore[attr-defined]
        project = folder.load().project

        def measured() -> int:
            return recorded_of(folder, project, "geometric").frames

        # A person cancels: what was measured stays, and nothing goes on by itself.
        job = client.post(f"{CLIP}/track", json={}).json()["job"]
        second = client.post(f"{CLIP}/orthoimage")
        assert second.status_code in (404, 423)
        assert client.post(f"{CLIP}/track", json={}).status_code == 423
        _until(lambda: measured() > 10)
        client.delete(f"{CLIP}/track")
        assert wait_for(client, job)["state"] == "cancelled"
        kept = measured()
        assert 10 < kept < frames
        state = client.get(f"{CLIP}/track").json()
        assert (state["resumable"], state["frames_done"]) == (True, kept)
        assert len(state["preview"]["roof"]) == kept
        assert client.get(CLIP).json()["steps"]["track"]["status"] == "warn"
        # It goes on, and the server stops in the middle.
        client.post(f"{CLIP}/track", json={})
        _until(lambda: measured() > kept)
    note = json.loads((tmp_path / "clip" / "results" / JOB_FILE).read_text())
    assert (note["kind"], note["state"]) == ("track", "interrupted")
    stopped = measured()
    assert kept < stopped < frames
    with TestClient(create_app(tmp_path), base_url=ADDRESS, headers=WRITE) as client:
        job = client.get(f"{CLIP}/track").json()["job"]
        assert job["state"] == "running"
        ended = wait_for(client, job)
        assert ended["state"] == "done", ended["message"]
        assert ended["result"]["frames_measured"] == frames - stopped
    whole = tmp_path / "whole"
    shutil.copytree(tmp_path / "clip", whole / "clip", ignore=shutil.ignore_patterns("results"))
    at_once = measured_history(whole / "clip").p1_m
    in_pieces = np.stack([_column(tmp_path / "clip", name) for name in ("p1_dx_m", "p1_dy_m")], axis=1)
    assert in_pieces == pytest.approx(at_once, abs=1e-5)


def _until(true: Any) -> None:
    deadline = time.monotonic() + 60
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def _column(folder: Path, name: str) -> Any:
    with (folder / "results" / "roof.csv").open() as stream:
        return np.array([float(row[name]) for row in csv.DictReader(stream)])
