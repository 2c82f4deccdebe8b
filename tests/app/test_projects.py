"""Projects: edits that cannot be lost, states that can be gone back to, copies and the trash."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from fastapi.testclient import TestClient

from app.context import Context
from app.server import create_app
from core.coordinates import OrthoGrid
from core.orthoimage import ORTHOIMAGE_FILE, Orthoimage, write_geotiff
from tests.app.conftest import ADDRESS, WRITE

SMALL = "/api/projects/small"


def get(client: TestClient) -> dict[str, Any]:
    found: dict[str, Any] = client.get(SMALL).json()
    return found


def rename(client: TestClient, name: str, revision: int, **more: Any) -> Any:
    project = get(client)["project"] | {"name": name}
    return client.put(SMALL, json={"project": project, "revision": revision, "label": f"rename to {name}", **more})


def on_disk(workspace: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((workspace / "small" / "project.json").read_text())
    return found


def test_a_project_is_listed_with_the_state_of_its_eight_steps(client: TestClient) -> None:
    (project,) = client.get("/api/projects").json()
    assert (project["id"], project["name"]) == ("small", "small")
    statuses = {name: step["status"] for name, step in project["steps"].items()}
    assert statuses == {
        "inputs": "done",
        "orthoimage": "todo",
        "correspondences": "warn",
        "regions": "done",
        "track": "todo",
        "review": "todo",
        "drift": "todo",
        "export": "todo",
    }


def test_the_inputs_step_is_done_only_when_every_input_can_be_read(client: TestClient, workspace: Path) -> None:
    def inputs() -> tuple[str, str]:
        step = get(client)["steps"]["inputs"]
        return step["status"], step["message"]

    assert inputs()[0] == "done"
    for name, content, said in (
        ("gps.csv", "time_s,east_m\n0,0\n", "gps.csv: has no column"),
        ("lens.yaml", "%YAML:1.0\nimage_width: 4\n", "lens.yaml: "),
        ("video.mp4", "no video", "video.mp4: "),
    ):
        (workspace / "small" / name).write_text(content)
        status, message = inputs()
        assert (status, message[: len(said)]) == ("error", said)


def test_a_project_made_without_a_video_claims_no_file(client: TestClient, workspace: Path) -> None:
    made = client.post("/api/projects", json={"name": "empty"}).json()["id"]
    pages = f"/api/projects/{made}"
    assert client.get(f"{pages}/inputs").json()["video"] is None
    told = [*client.get(pages).json()["problems"], client.get(f"{pages}/frames/0.jpg").json()["error"]["message"]]
    assert [words for words in told if "video.mp4" in words] == []
    assert "inputs.video: none is given yet; choose the video in the inputs." in told
    (workspace / made / "video.mp4").write_bytes((workspace / "small" / "video.mp4").read_bytes())
    assert client.get(f"{pages}/inputs").json()["video"]["file"] == "video.mp4"


def test_a_step_that_was_not_done_is_not_called_done(client: TestClient) -> None:
    made = client.post("/api/projects", json={"name": "empty"}).json()["id"]
    steps = client.get(f"/api/projects/{made}").json()["steps"]
    assert {step["status"] for step in steps.values()} == {"todo"}
    state = get(client)
    typed = state["project"] | {"inputs": state["project"]["inputs"] | {"cloud": None}}
    client.put(SMALL, json={"project": typed, "revision": state["revision"]})
    assert get(client)["steps"]["orthoimage"]["status"] == "unneeded"


def test_an_edit_is_on_the_disk_and_has_a_new_revision(client: TestClient, workspace: Path) -> None:
    before = get(client)
    after = rename(client, "other", before["revision"]).json()
    assert after["revision"] > before["revision"]
    assert after["undo_label"] == "rename to other"
    assert on_disk(workspace)["name"] == "other"


def test_an_edit_of_an_older_state_is_told_and_changes_nothing(client: TestClient, workspace: Path) -> None:
    seen = get(client)["revision"]
    first = rename(client, "first tab", seen)
    second = rename(client, "second tab", seen)
    assert (first.status_code, second.status_code) == (200, 409)
    assert second.json()["error"]["kind"] == "conflict"
    assert second.json()["revision"] == first.json()["revision"]
    assert second.json()["project"]["name"] == "first tab"
    assert on_disk(workspace)["name"] == "first tab"


def test_undo_and_redo_survive_a_restart(client: TestClient, workspace: Path) -> None:
    revision = get(client)["revision"]
    for name in ("one", "two"):
        revision = rename(client, name, revision).json()["revision"]
    with TestClient(create_app(workspace), base_url=ADDRESS, headers=WRITE) as restarted:
        state = get(restarted)
        assert state["revision"] == revision
        state = restarted.post(f"{SMALL}/undo", json={"revision": revision}).json()
        assert (state["project"]["name"], state["redo_label"]) == ("one", "rename to two")
        state = restarted.post(f"{SMALL}/undo", json={"revision": state["revision"]}).json()
        assert (state["project"]["name"], state["can_undo"]) == ("small", False)
        assert on_disk(workspace)["name"] == "small"
        state = restarted.post(f"{SMALL}/redo", json={"revision": state["revision"]}).json()
        assert state["project"]["name"] == "one"
        state = rename(restarted, "three", state["revision"]).json()
        assert not state["can_redo"]


def _all_garbage(file: Path) -> None:
    file.write_bytes(b"garbage" * 1000)


def _one_page_garbage(file: Path) -> None:
    """Spoil a page of the states and leave the header alone, so that the file opens and fails later."""
    with closing(sqlite3.connect(file)) as database:
        (page,) = database.execute("SELECT rootpage FROM sqlite_schema WHERE name = 'states'").fetchone()
        (size,) = database.execute("PRAGMA page_size").fetchone()
    content = bytearray(file.read_bytes())
    content[(page - 1) * size : page * size] = b"\xff" * size
    file.write_bytes(content)


@pytest.mark.parametrize(("spoil", "answers"), [(_all_garbage, [200]), (_one_page_garbage, [422, 200])])
def test_a_damaged_history_is_moved_aside_and_takes_nothing_else_down(
    client: TestClient, workspace: Path, spoil: Callable[[Path], None], answers: list[int]
) -> None:
    get(client)
    spoil(workspace / "small" / "history.sqlite")
    for answer in answers:
        listed = client.get("/api/projects")
        assert listed.status_code == 200
        assert listed.json()[0]["steps"]["inputs"]["status"] == ("done" if answer == 200 else "error")
    assert (workspace / "small" / "history.sqlite.damaged").is_file()
    edited = rename(client, "second", get(client)["revision"]).json()
    assert edited["undo_label"] == "rename to second"


def test_a_history_that_cannot_be_written_is_told(client: TestClient, workspace: Path) -> None:
    (workspace / "small" / "history.sqlite").mkdir()
    answer = client.get(SMALL)
    assert answer.status_code == 422
    assert "history.sqlite: cannot be used" in answer.json()["error"]["message"]
    assert client.get("/api/projects").status_code == 200


def test_undo_of_an_older_state_and_undo_of_nothing_are_conflicts(client: TestClient) -> None:
    revision = get(client)["revision"]
    nothing = client.post(f"{SMALL}/undo", json={"revision": revision})
    assert (nothing.status_code, nothing.json()["error"]["message"]) == (409, "There is nothing to undo.")
    rename(client, "other", revision)
    assert client.post(f"{SMALL}/undo", json={"revision": revision}).status_code == 409


def test_a_nudge_merges_with_the_one_before(client: TestClient) -> None:
    state = get(client)
    for u in (10.1, 10.2, 10.3):
        state["project"]["correspondences"][0]["frame_px"][0] = u
        edit = {"project": state["project"], "revision": state["revision"], "label": "nudge 1", "merge": True}
        state = client.put(SMALL, json=edit).json()
    entries = client.get(f"{SMALL}/history").json()["entries"]
    assert [entry["label"] for entry in entries] == ["created", "nudge 1"]
    undone = client.post(f"{SMALL}/undo", json={"revision": state["revision"]}).json()
    assert undone["project"]["correspondences"][0]["frame_px"][0] == pytest.approx(9.5)


def test_an_edit_by_hand_becomes_a_state_of_its_own(client: TestClient, workspace: Path) -> None:
    revision = get(client)["revision"]
    document = on_disk(workspace) | {"name": "by hand"}
    (workspace / "small" / "project.json").write_text(json.dumps(document))
    state = get(client)
    assert state["revision"] > revision
    assert (state["project"]["name"], state["undo_label"]) == ("by hand", "changed outside")
    assert client.post(f"{SMALL}/undo", json={"revision": revision}).status_code == 409


def test_every_problem_of_an_edit_is_told_and_nothing_is_written(client: TestClient, workspace: Path) -> None:
    before = on_disk(workspace)
    state = get(client)
    wrong = state["project"] | {"method": "guess", "colour": "red"}
    answer = client.put(SMALL, json={"project": wrong, "revision": state["revision"]})
    assert answer.status_code == 422
    assert {problem.partition(":")[0] for problem in answer.json()["problems"]} == {"method", "colour"}
    assert on_disk(workspace) == before


def test_an_input_outside_the_roots_is_refused(client: TestClient, tmp_path: Path, workspace: Path) -> None:
    secret = tmp_path / "secret.yaml"
    secret.write_text("x: 1")
    (workspace / "small" / "link.yaml").symlink_to(secret)
    state = get(client)
    for lens in (str(secret), "../../secret.yaml", "link.yaml"):
        project = state["project"] | {"inputs": state["project"]["inputs"] | {"lens": lens}}
        answer = client.put(SMALL, json={"project": project, "revision": state["revision"]})
        assert answer.status_code == 403, lens
    assert get(client)["revision"] == state["revision"]


def test_an_absolute_input_is_stored_relative(client: TestClient, workspace: Path) -> None:
    (workspace / "shared.yaml").write_bytes((workspace / "small" / "lens.yaml").read_bytes())
    state = get(client)
    project = state["project"] | {"inputs": state["project"]["inputs"] | {"lens": str(workspace / "shared.yaml")}}
    saved = client.put(SMALL, json={"project": project, "revision": state["revision"]}).json()
    assert saved["project"]["inputs"]["lens"] == "../shared.yaml"


def test_a_project_is_made_from_files_or_from_nothing(client: TestClient, workspace: Path) -> None:
    files = {"video": "video.mp4", "lens": "lens.yaml", "gps": "gps.csv"}
    named = {kind: str(workspace / "small" / file) for kind, file in files.items()}
    made = client.post("/api/projects", json={"name": "Eq 7 / über", **named}).json()["id"]
    state = client.get(f"/api/projects/{made}").json()
    assert state["project"]["name"] == "Eq 7 / über"
    inputs = state["project"]["inputs"]
    assert inputs | {"gps": inputs["gps"]["file"]} == {
        "video": "../small/video.mp4", "cloud": None, "lens": "../small/lens.yaml", "gps": "../small/gps.csv"
    }  # fmt: skip
    empty = client.post("/api/projects", json={"name": "empty"}).json()["id"]
    assert client.get(f"/api/projects/{empty}").json()["steps"]["inputs"]["status"] == "todo"
    again = client.post("/api/projects", json={"name": "empty"}).json()["id"]
    assert again != empty


@pytest.mark.parametrize(
    ("name", "folder"),
    [
        ("Écho bâtiment 3", "Écho bâtiment 3"),
        ("E\u0301cho", "Écho"),
        ("東京 7", "東京 7"),
        ("Σεισμός: 5/3?", "Σεισμός- 5-3"),
        ("con", "project con"),
        ("LPT1.x", "project LPT1.x"),
        ("..roof. ", "roof"),
        ("ü" * 90, "ü" * 60),
    ],
)
def test_a_folder_is_named_as_its_project_in_any_script(
    client: TestClient, workspace: Path, name: str, folder: str
) -> None:
    made = client.post("/api/projects", json={"name": name}).json()["id"]
    assert made == folder
    assert (workspace / folder / "project.json").is_file()
    address = f"/p/{quote(folder, safe='')}"
    assert client.get(address, follow_redirects=False).headers["location"] == f"{address}/inputs"
    archive = client.get(f"/api/projects/{quote(folder, safe='')}/archive")
    assert archive.status_code == 200


def test_a_folder_named_by_hand_is_a_project_too(client: TestClient, workspace: Path) -> None:
    for folder in ("_brouillon #2 (été)", ".hidden"):
        (workspace / folder).mkdir()
        shutil.copy(workspace / "small" / "project.json", workspace / folder)
    assert [found["id"] for found in client.get("/api/projects").json()] == ["_brouillon #2 (été)", "small"]
    address = f"/p/{quote('_brouillon #2 (été)')}"
    assert client.get(address).status_code == 200


def test_a_video_that_was_there_is_missed(client: TestClient, workspace: Path) -> None:
    (workspace / "small" / "video.mp4").rename(workspace / "small" / "elsewhere.mp4")
    state = get(client)
    assert state["steps"]["inputs"] == {"status": "error", "message": "Not found: video; choose it again."}
    assert any("video.mp4" in problem for problem in state["problems"])


def test_what_lies_in_the_place_of_results_is_told_until_it_is_gone(client: TestClient, workspace: Path) -> None:
    assert get(client)["problems"] == []
    (workspace / "small" / "results").write_text("somebody's notes")
    (problem,) = get(client)["problems"]
    assert problem.startswith("results: File exists; move away what lies in its place")
    (workspace / "small" / "results").unlink()
    assert get(client)["problems"] == []


def test_a_project_that_cannot_be_made_leaves_nothing(client: TestClient, workspace: Path) -> None:
    answer = client.post("/api/projects", json={"name": "gone", "video": str(workspace / "none.mp4")})
    assert answer.status_code == 404
    assert not (workspace / "gone").exists()
    assert client.post("/api/projects", json={"name": " ./ "}).status_code == 422


def test_a_copy_is_a_project_of_its_own(client: TestClient, workspace: Path) -> None:
    copy = client.post(f"{SMALL}/duplicate", json={"name": "copy"}).json()["id"]
    rename(client, "changed", get(client)["revision"])
    assert client.get(f"/api/projects/{copy}").json()["project"]["name"] == "copy"
    assert (workspace / copy / "video.mp4").read_bytes() == (workspace / "small" / "video.mp4").read_bytes()
    other = (workspace / "small" / "lens.yaml").read_bytes() + b"\n"
    assert client.put(f"{SMALL}/upload/lens?filename=lens.yaml", content=other).status_code == 200
    assert (workspace / copy / "lens.yaml").read_bytes() != b"other"


def test_the_trash_gives_back_what_it_took(client: TestClient, workspace: Path) -> None:
    token = client.delete(SMALL).json()["undo_token"]
    assert client.get("/api/projects").json() == []
    assert client.get(SMALL).status_code == 404
    assert client.post("/api/projects/untrash", json={"undo_token": token}).json() == {"id": "small"}
    assert get(client)["project"]["name"] == "small"
    assert client.post("/api/projects/untrash", json={"undo_token": token}).status_code == 404
    assert client.post("/api/projects/untrash", json={"undo_token": "../../etc"}).status_code == 404


def test_the_trash_tells_what_it_holds_and_until_when(client: TestClient, workspace: Path) -> None:
    assert client.get("/api/trash").json() == []
    small, other = (client.delete(f"/api/projects/{name}").json()["undo_token"] for name in _two_projects(client))
    hour_ago_s = time.time() - 3600
    os.utime(workspace / ".trash" / small, (hour_ago_s, hour_ago_s))
    (workspace / ".trash" / other / "other" / "project.json").write_text("{")
    last, first = client.get("/api/trash").json()
    assert (last["undo_token"], last["id"], last["name"]) == (other, "other", "other")
    assert (first["undo_token"], first["id"], first["name"]) == (small, "small", "small")
    assert first["deleted_s"] == pytest.approx(hour_ago_s, abs=1)
    assert first["kept_until_s"] == pytest.approx(hour_ago_s + 31 * 86_400, abs=1)
    client.post("/api/projects/untrash", json={"undo_token": small})
    assert [project["id"] for project in client.get("/api/trash").json()] == ["other"]


def test_a_broken_project_file_is_listed_with_its_problem(client: TestClient, workspace: Path) -> None:
    (workspace / "small" / "project.json").write_text("{")
    (project,) = client.get("/api/projects").json()
    assert project["steps"]["inputs"]["status"] == "error"
    assert "line 1" in project["steps"]["inputs"]["message"]
    answer = client.get(SMALL)
    assert (answer.status_code, answer.json()["error"]["kind"]) == (422, "input")


def test_an_orthoimage_of_a_cloud_out_of_reach_hides_no_project(client: TestClient, workspace: Path) -> None:
    document = json.loads((workspace / "small" / "project.json").read_text())
    document["inputs"]["cloud"] = "/var/site.laz"
    (workspace / "small" / "project.json").write_text(json.dumps(document))
    # A run from the terminal may read any file.
    rgb, empty = np.zeros((30, 40, 3), np.uint8), np.zeros((30, 40), dtype=np.bool_)
    grid = OrthoGrid(west_m=0.0, north_m=0.3, pixel_size_m=0.01, width=40, height=30)
    image = Orthoimage(grid, rgb, empty, measured_share=1.0, filled_share=0.0, spacing_m=0.01, fill_limit_m=0.1)
    (workspace / "small" / "results").mkdir(exist_ok=True)
    write_geotiff(workspace / "small" / "results" / ORTHOIMAGE_FILE, image)
    (project,) = client.get("/api/projects").json()
    assert project["steps"]["orthoimage"]["status"] == "stale"
    assert client.get(SMALL).status_code == 200


def test_a_project_that_leads_elsewhere_is_listed_with_its_problem_and_keeps_no_server_from_starting(
    workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (workspace / "small").rename(tmp_path / "elsewhere")
    (workspace / "small").symlink_to(tmp_path / "elsewhere")
    half_sent = workspace / "near" / ".incoming-0123456789abcdef"
    half_sent.parent.mkdir()
    half_sent.touch()
    (workspace / "near" / "project.json").write_bytes((tmp_path / "elsewhere" / "project.json").read_bytes())
    with TestClient(create_app(workspace), base_url=ADDRESS, headers=WRITE) as client:
        listed = {project["id"]: project for project in client.get("/api/projects").json()}
    assert "outside the folders" in listed["small"]["steps"]["inputs"]["message"]
    assert listed["near"]["name"] == "small"
    assert not half_sent.exists()


def test_the_trash_is_emptied_after_a_month(client: TestClient, context: Context, workspace: Path) -> None:
    old, new = (client.delete(f"/api/projects/{name}").json()["undo_token"] for name in _two_projects(client))
    month_ago_s = time.time() - 32 * 86_400
    os.utime(workspace / ".trash" / old, (month_ago_s, month_ago_s))
    context.workspace.empty_trash()
    assert client.post("/api/projects/untrash", json={"undo_token": old}).status_code == 404
    assert client.post("/api/projects/untrash", json={"undo_token": new}).status_code == 200


def _two_projects(client: TestClient) -> list[str]:
    return ["small", client.post("/api/projects", json={"name": "other"}).json()["id"]]
