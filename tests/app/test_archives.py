"""A project as one file: packed in a stream, unpacked without trust."""

from __future__ import annotations

import errno
import io
import json
import os
import stat
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app import archives
from app.archives import archive_stream
from app.context import Context
from core.locks import LOCK_FILE

SMALL = "/api/projects/small"


def packed(files: dict[str, bytes], project: bytes | None = None, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        if project is not None:
            archive.writestr("project.json", project)
        for name, content in files.items():
            archive.writestr(name, content)
    return stream.getvalue()


def restore(client: TestClient, archive: bytes) -> Any:
    return client.post("/api/projects/restore", content=archive)


@pytest.fixture
def project(workspace: Path) -> bytes:
    return (workspace / "small" / "project.json").read_bytes()


def names(workspace: Path) -> list[str]:
    return sorted(path.name for path in workspace.iterdir() if path.name != LOCK_FILE)


def test_an_archive_comes_back_as_it_was(client: TestClient, workspace: Path) -> None:
    (workspace / "small" / "results").mkdir()
    (workspace / "small" / "results" / "roof.csv").write_text("frame\n")
    answer = client.get(f"{SMALL}/archive")
    assert answer.headers["content-disposition"].startswith('attachment; filename="small.zip"')
    made = restore(client, answer.content).json()["id"]
    assert made == "small-2"
    for file in ("video.mp4", "lens.yaml", "site.csv", "gps.csv", "results/roof.csv"):
        assert (workspace / made / file).read_bytes() == (workspace / "small" / file).read_bytes()
    before, after = (client.get(f"/api/projects/{name}").json()["project"] for name in ("small", made))
    assert before == after


def test_inputs_from_elsewhere_travel_along_and_may_stay_behind(client: TestClient, workspace: Path) -> None:
    video = workspace / "small" / "video.mp4"
    made = client.post("/api/projects", json={"name": "afar", "video": str(video)}).json()["id"]
    with_inputs = restore(client, client.get(f"/api/projects/{made}/archive").content).json()["id"]
    inputs = client.get(f"/api/projects/{with_inputs}").json()["project"]["inputs"]
    assert inputs["video"] == "inputs/video/video.mp4"
    assert (workspace / with_inputs / inputs["video"]).read_bytes() == video.read_bytes()
    light = client.get(f"{SMALL}/archive", params={"inputs": 0}).content
    assert "video.mp4" not in zipfile.ZipFile(io.BytesIO(light)).namelist()


def test_the_archive_of_a_large_project_is_never_held_in_memory(context: Context, workspace: Path) -> None:
    with (workspace / "small" / "large.mp4").open("wb") as large:
        large.truncate(300 << 20)
    folder = context.workspace.open("small")
    tracemalloc.start()
    size = sum(len(piece) for piece in archive_stream(folder, inputs=True))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert size > 300 << 20
    assert peak < 20 << 20


@pytest.mark.parametrize(
    "name", ["../outside.txt", "/absolute.txt", "a/../../outside.txt", "..\\outside.txt", "C:/outside.txt"]
)
def test_a_name_that_leads_outside_is_refused(client: TestClient, workspace: Path, project: bytes, name: str) -> None:
    before = names(workspace)
    answer = restore(client, packed({name: b"x"}, project))
    assert answer.status_code == 422
    assert "leads outside" in answer.json()["error"]["message"]
    assert names(workspace) == before
    assert not (workspace.parent / "outside.txt").exists()


def test_a_link_is_refused(client: TestClient, workspace: Path, project: bytes) -> None:
    link = zipfile.ZipInfo("secret")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("project.json", project)
        archive.writestr(link, "/etc/passwd")
    assert restore(client, stream.getvalue()).status_code == 422
    assert names(workspace) == ["small"]


def test_a_bomb_is_refused_before_it_goes_off(client: TestClient, workspace: Path, project: bytes) -> None:
    answer = restore(client, packed({"zeros.bin": bytes(200 << 20)}, project))
    assert "beyond all measure" in answer.json()["error"]["message"]
    assert names(workspace) == ["small"]


def test_an_archive_that_lies_about_a_size_is_refused(client: TestClient, workspace: Path, project: bytes) -> None:
    honest = packed({"notes.txt": b"n" * 1000}, project)
    # The size of the unpacked file stands in its local header and in the directory at the end.
    lying = honest.replace((1000).to_bytes(4, "little"), (10).to_bytes(4, "little"))
    assert lying != honest
    assert restore(client, lying).status_code == 422
    assert names(workspace) == ["small"]


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"no zip at all", "no zip file"), (packed({"a.txt": b"a"}), "no project.json"), (b"", "empty or incomplete")],
)
def test_what_is_no_project_is_refused(client: TestClient, workspace: Path, content: bytes, message: str) -> None:
    assert message in restore(client, content).json()["error"]["message"]
    assert names(workspace) == ["small"]


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_an_archive_damaged_in_what_was_packed_is_refused(
    client: TestClient, workspace: Path, project: bytes, method: int
) -> None:
    content = packed({"notes.txt": b"\n".join(b"%d" % number for number in range(5000))}, project, method)
    place = content.find(b"notes.txt") + 50
    answer = restore(client, content[:place] + b"\xff" * 20 + content[place + 20 :])
    assert (answer.status_code, "damaged" in answer.json()["error"]["message"]) == (422, True)
    assert names(workspace) == ["small"]


def test_a_disk_that_fills_up_is_not_the_archives_fault(
    client: TestClient, workspace: Path, project: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(archives, "_unpack", full)
    answer = restore(client, packed({}, project))
    assert answer.status_code == 507
    assert "The disk is full" in answer.json()["error"]["message"]
    assert names(workspace) == ["small"]


def test_an_archive_with_a_broken_project_is_refused(client: TestClient, workspace: Path, project: bytes) -> None:
    wrong = json.dumps(json.loads(project) | {"colour": "red"}).encode()
    answer = restore(client, packed({}, wrong))
    assert 'unknown key "colour"' in answer.json()["error"]["message"]
    assert names(workspace) == ["small"]


def test_what_only_this_computer_may_have_made_is_left_out(client: TestClient, workspace: Path, project: bytes) -> None:
    planted = {"results/job.json": b"{}", "history.sqlite": b"x", "results/cache/cloud.json": b"{}", ".x": b"x"}
    made = restore(client, packed(planted | {"results/roof.csv": b"frame"}, project)).json()["id"]
    found = {path.relative_to(workspace / made).as_posix() for path in (workspace / made).rglob("*") if path.is_file()}
    assert found == {"project.json", "results/roof.csv"}


def test_a_folder_packed_by_hand_is_taken_too(client: TestClient, project: bytes) -> None:
    archive = packed({"eq7/project.json": project, "eq7/notes.txt": b"n"})
    assert restore(client, archive).status_code == 200


@pytest.mark.parametrize("inside", ["Écho bâtiment/", "a/b/", ""])
def test_what_a_system_adds_while_a_person_packs_is_left_out(
    client: TestClient, workspace: Path, project: bytes, inside: str
) -> None:
    files = {f"{inside}project.json": project, f"{inside}vidéo.txt": b"v", f"{inside}.DS_Store": b"x"}
    archive = packed(files | {f"__MACOSX/{inside}._project.json": b"x", f"{inside}Thumbs.db": b"x"})
    made = restore(client, archive).json()["id"]
    found = {path.relative_to(workspace / made).as_posix() for path in (workspace / made).rglob("*") if path.is_file()}
    assert found == {"project.json", "vidéo.txt"}


def test_a_broken_project_is_said_to_be_the_archives(client: TestClient) -> None:
    message = restore(client, packed({}, b'{"rooftrack": 1')).json()["error"]["message"]
    assert message.startswith("The project.json in the archive cannot be used: line 1")


def test_files_keep_their_times(client: TestClient, workspace: Path) -> None:
    """By them it is told whether results are older than inputs."""
    for age_s, file in enumerate(("video.mp4", "lens.yaml"), start=1):
        os.utime(workspace / "small" / file, (1.7e9 + 5000 * age_s,) * 2)
    made = restore(client, client.get(f"{SMALL}/archive").content).json()["id"]
    for file in ("video.mp4", "lens.yaml"):
        times = [(workspace / name / file).stat().st_mtime for name in ("small", made)]
        assert times[0] == pytest.approx(times[1], abs=2.0)
