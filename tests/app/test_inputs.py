"""Inputs: sent in pieces or not at all, understood, refused in sentences."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import fsspec
import numpy as np
import pytest
import uvicorn

from app import sites
from app.context import Context
from app.errors import NotYet
from app.server import create_app
from core.cloud import CLOUD_SUFFIXES
from core.lens import Lens, write_lens
from core.lens_calibration import IMAGE_SUFFIXES
from core.locks import take_lock
from core.progress import CancelToken, silent
from core.video import frame_index
from tests.app.conftest import ADDRESS, WRITE, TestClient
from tests.small_project import SIZE, write_interlaced_video

SMALL = "/api/projects/small"


def send(client: TestClient, kind: str, name: str, content: Any) -> Any:
    return client.put(f"{SMALL}/upload/{kind}", params={"filename": name}, content=content)


def test_a_file_that_is_sent_becomes_the_input(client: TestClient, workspace: Path) -> None:
    lens = (workspace / "small" / "lens.yaml").read_bytes()
    pieces = (lens[start : start + 7] for start in range(0, len(lens), 7))
    answer = send(client, "lens", "my lens.yaml", pieces).json()
    assert (workspace / "small" / "my lens.yaml").read_bytes() == lens
    state = client.get(SMALL).json()
    assert state["project"]["inputs"]["lens"] == "my lens.yaml"
    assert (state["revision"], state["undo_label"]) == (answer["revision"], "take in lens my lens.yaml")


@pytest.mark.parametrize(
    ("kind", "name", "kept", "free"),
    [
        ("gps", "site.csv", "cloud", "site-2.csv"),
        ("lens", "video.mp4", "video", "video-2.mp4"),
        ("lens", "lens.yaml", None, "lens.yaml"),
        ("lens", "notes.yaml", None, "notes-2.yaml"),
    ],
)
def test_a_file_that_is_sent_replaces_nothing_but_that_very_input(
    client: TestClient, workspace: Path, kind: str, name: str, kept: str | None, free: str
) -> None:
    (workspace / "small" / "notes.yaml").write_text("no input, but somebody's file")
    before = {path.name: path.read_bytes() for path in (workspace / "small").iterdir() if path.is_file()}
    new = (workspace / "small" / ("gps.csv" if kind == "gps" else "lens.yaml")).read_bytes() + b"\n"
    assert send(client, kind, name, new).json()["file"] == free
    assert (workspace / "small" / free).read_bytes() == new
    for other in before.keys() - {free, "project.json", "history.sqlite"}:
        assert (workspace / "small" / other).read_bytes() == before[other]
    inputs = client.get(SMALL).json()["project"]["inputs"]
    assert (inputs["gps"]["file"] if kind == "gps" else inputs[kind]) == free
    assert kept is None or inputs[kept] == name


def test_a_name_kept_for_an_input_that_is_still_to_come_is_not_free(client: TestClient, workspace: Path) -> None:
    made = client.post("/api/projects", json={"name": "empty"}).json()["id"]
    for kind, given, free in (("lens", "lens.yaml", "video-2.mp4"), ("video", "video.mp4", "video.mp4")):
        content = (workspace / "small" / given).read_bytes()
        sent = client.put(f"/api/projects/{made}/upload/{kind}", params={"filename": "video.mp4"}, content=content)
        assert sent.json()["file"] == free


def test_a_gps_record_keeps_the_names_of_its_columns(client: TestClient, workspace: Path) -> None:
    send(client, "gps", "again.csv", (workspace / "small" / "gps.csv").read_bytes())
    gps = client.get(SMALL).json()["project"]["inputs"]["gps"]
    assert (gps["file"], gps["time"], gps["x"]) == ("again.csv", "time_s", "east_m")


def test_what_to_know_of_a_video_stands_beside_what_was_understood_of_it(client: TestClient, workspace: Path) -> None:
    assert client.get(f"{SMALL}/inputs").json()["video"]["warnings"] == []
    write_interlaced_video(workspace / "small" / "video.mp4")
    (warning,) = client.get(f"{SMALL}/inputs").json()["video"]["warnings"]
    assert warning.startswith("video.mp4: says that it is interlaced")


@pytest.mark.parametrize("name", ["../../evil.yaml", "a/b/evil.yaml", "..\\..\\evil.yaml", "C:\\evil.yaml"])
def test_a_name_that_leads_elsewhere_stays_in_the_project(client: TestClient, workspace: Path, name: str) -> None:
    lens = (workspace / "small" / "lens.yaml").read_bytes()
    assert send(client, "lens", name, lens).json()["file"] == "evil.yaml"
    assert (workspace / "small" / "evil.yaml").is_file()


@pytest.mark.parametrize("name", ["project.json", "PROJECT.JSON", "history.sqlite", "results", "..", "", "/"])
def test_a_name_the_project_itself_uses_is_refused(client: TestClient, workspace: Path, name: str) -> None:
    before = sorted(path.name for path in (workspace / "small").iterdir())
    answer = send(client, "lens", name, b"x")
    assert (answer.status_code, answer.json()["error"]["path"]) == (422, "filename")
    assert sorted(path.name for path in (workspace / "small").iterdir() if "sqlite" not in path.name) == [
        name for name in before if "sqlite" not in name
    ]


def test_an_empty_file_is_refused(client: TestClient, workspace: Path) -> None:
    assert send(client, "lens", "empty.yaml", b"").status_code == 422
    assert not (workspace / "small" / "empty.yaml").exists()


@pytest.mark.parametrize(
    ("kind", "name", "sent"),
    [
        ("video", "video.mp4", "gps.csv"),
        ("video", "again.mp4", "lens.yaml"),
        ("lens", "lens.yaml", "gps.csv"),
        ("gps", "gps.csv", "video.mp4"),
        ("gps", "again.csv", "lens.yaml"),
        ("cloud", "site.laz", "gps.csv"),
        ("cloud", "site.csv", "lens.yaml"),
        ("cloud", "site.mp4", "video.mp4"),
    ],
)
def test_a_file_that_is_something_else_is_refused_and_the_one_before_stays(
    client: TestClient, workspace: Path, kind: str, name: str, sent: str
) -> None:
    def files() -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in (workspace / "small").iterdir() if "sqlite" not in path.name}

    before, inputs = files(), client.get(SMALL).json()["project"]["inputs"]
    answer = send(client, kind, name, before[sent])
    assert (answer.status_code, answer.json()["error"]["path"]) == (422, f"inputs.{kind}")
    assert answer.json()["error"]["message"].startswith(f"{name}: ")
    assert files() == before
    assert client.get(SMALL).json()["project"]["inputs"] == inputs


def test_a_file_of_this_computer_that_is_something_else_is_refused_too(client: TestClient, workspace: Path) -> None:
    state = client.get(SMALL).json()
    project = state["project"] | {"inputs": state["project"]["inputs"] | {"video": "gps.csv"}}
    answer = client.put(SMALL, json={"project": project, "revision": state["revision"], "label": "Choose video"})
    assert (answer.status_code, answer.json()["error"]["path"]) == (422, "inputs.video")
    assert client.get(SMALL).json()["revision"] == state["revision"]
    new = {"name": "wrong", "video": str(workspace / "small" / "gps.csv")}
    assert client.post("/api/projects", json=new).status_code == 422
    assert not (workspace / "wrong").exists()


@pytest.fixture
def address(workspace: Path) -> Iterator[tuple[str, int]]:
    """A real server: what breaks off on the network cannot be shown in one process."""
    config = uvicorn.Config(create_app(workspace), port=0, log_level="error", lifespan="on")
    server = uvicorn.Server(config)
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        until(lambda: server.started)
        yield listening.getsockname()
        server.should_exit = True
        thread.join()


def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_transfer_that_breaks_off_leaves_nothing(address: tuple[str, int], workspace: Path) -> None:
    folder = workspace / "small"
    with socket.create_connection(address) as line:
        head = (
            f"PUT {SMALL}/upload/video?filename=large.mp4 HTTP/1.1\r\nHost: 127.0.0.1:{address[1]}\r\n"
            "X-Rooftrack: 1\r\nContent-Length: 90000000\r\n\r\n"
        )
        line.sendall(head.encode() + bytes(5_000_000))
        until(lambda: any(folder.glob(".incoming-*")))
        line.sendall(bytes(5_000_000))
    until(lambda: not any(folder.glob(".incoming-*")))
    assert not (folder / "large.mp4").exists()


def test_what_a_killed_server_left_half_sent_is_removed(workspace: Path) -> None:
    half = workspace / "small" / ".incoming-0123456789abcdef"
    half.write_bytes(b"half")
    with TestClient(create_app(workspace), base_url=ADDRESS, headers=WRITE):
        assert not half.exists()


def test_a_disk_without_room_is_told_before_anything_is_sent(
    client: TestClient, workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from app import uploads

    class Full:
        free = 1000

    monkeypatch.setattr(uploads.shutil, "disk_usage", lambda place: Full)
    answer = send(client, "video", "large.mp4", b"x" * 100)
    assert "make room" in answer.json()["error"]["message"]
    assert not list((workspace / "small").glob(".incoming-*"))


def test_every_input_is_understood(client: TestClient) -> None:
    inputs = client.get(f"{SMALL}/inputs").json()
    video, lens, gps = inputs["video"], inputs["lens"], inputs["gps"]
    assert (video["width"], video["height"], video["frames"], video["codec"]) == (160, 120, 40, "h264")
    assert video["rate_hz"] == pytest.approx(20.0)
    assert not video["variable_rate"]
    assert lens["focal_px"] == [150.0, 150.0]
    assert (gps["rows"], gps["rate_hz"]) == (20, pytest.approx(10.0))


def test_a_cloud_is_read_beside_the_server_and_known_from_then_on(
    client: TestClient, context: Context, finished: Callable[[dict[str, Any]], dict[str, Any]]
) -> None:
    assert client.get(f"{SMALL}/inputs").json()["cloud"]["reading"]
    job = context.jobs.latest("small", "cloud")
    assert job is not None
    assert finished(job.as_json())["state"] == "done"
    cloud = client.get(f"{SMALL}/inputs").json()["cloud"]
    assert cloud["points"] == 80 * 80
    assert cloud["ground"]["spread_m"] == pytest.approx(0.01, abs=0.002)
    height = client.get(f"{SMALL}/height", params={"x": 1.0, "y": 2.0}).json()
    assert height["height_m"] == pytest.approx(0.0, abs=0.02)
    assert client.get(f"{SMALL}/height", params={"x": 500.0, "y": 0.0}).status_code == 422
    made = finished(client.post(f"{SMALL}/orthoimage").json()["job"])
    assert made["state"] == "done", made["message"]
    state = client.get(f"{SMALL}/orthoimage").json()
    assert (state["ready"], state["stale"], state["job"]) == (True, False, None)
    picture = client.get(f"{SMALL}/orthoimage.png", params={"w": 200})
    pixels = cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert (pixels.shape[1], pixels.shape[2]) == (200, 4)
    project = client.get(SMALL).json()
    project["project"]["orthoimage"]["pixel_size_m"] = 0.02
    client.put(SMALL, json={"project": project["project"], "revision": project["revision"]})
    assert client.get(f"{SMALL}/orthoimage").json()["stale"]


def test_a_job_waits_for_another_that_reads_the_cloud_and_nobody_opens_what_is_being_replaced(
    client: TestClient, context: Context, workspace: Path, finished: Callable[[dict[str, Any]], dict[str, Any]]
) -> None:
    client.get(f"{SMALL}/inputs")
    job = context.jobs.latest("small", "cloud")
    assert job is not None
    assert finished(job.as_json())["state"] == "done"
    folder = workspace / "small"
    cache = folder / "results" / "cache"
    facts = json.loads((cache / "cloud.json").read_text())
    with pytest.raises(NotYet):  # another key: that other job has just kept another cloud
        sites._load(cache, "another key")
    for array in cache.glob("cloud_*.npy"):
        array.unlink()
    with pytest.raises(NotYet):
        sites._load(cache, facts["key"])
    other_job = take_lock(cache)
    assert other_job is not None
    order = {"cloud": str(folder / "site.csv"), "key": facts["key"], "ground_z_m": None}
    reading = threading.Thread(target=sites.read_site, args=(folder, order, silent, CancelToken()))
    reading.start()
    reading.join(1.0)
    assert reading.is_alive()
    assert not list(cache.glob("cloud_*.npy"))
    other_job.close()
    reading.join()
    assert len(sites._load(cache, facts["key"]).cloud) == 80 * 80


def test_a_cloud_asked_for_twice_at_once_is_read_once_and_no_error(
    client: TestClient, context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert client.get(f"{SMALL}/inputs").json()["cloud"]["reading"]
    known, asked = context.jobs.running, []

    def not_yet_heard_of(project: str, kind: str) -> Any:
        asked.append(kind)
        return None if len(asked) == 1 else known(project, kind)

    monkeypatch.setattr(context.jobs, "running", not_yet_heard_of)
    assert client.get(f"{SMALL}/inputs").json()["cloud"]["reading"]
    assert len(asked) > 1


def test_inputs_that_cannot_be_used_are_told_one_by_one(client: TestClient, workspace: Path) -> None:
    (workspace / "small" / "video.mp4").write_bytes(b"no video")
    (workspace / "small" / "lens.yaml").write_text("%YAML:1.0\nimage_width: 4\n")
    (workspace / "small" / "gps.csv").unlink()
    inputs = client.get(f"{SMALL}/inputs").json()
    assert "cannot be opened as a video" in inputs["video"]["error"]["message"]
    assert "lens.yaml" in inputs["lens"]["error"]["message"]
    assert "not found" in inputs["gps"]["error"]["message"]


def test_checkerboard_pictures_are_kept_listed_and_removed(client: TestClient) -> None:
    picture = cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes()
    assert send(client, "checkerboard", "one.png", picture).json()["file"] == "checkerboard/one.png"
    assert send(client, "checkerboard", "one.txt", picture).status_code == 422
    assert [image["name"] for image in client.get(f"{SMALL}/lens/images").json()["images"]] == ["one.png"]
    assert client.get(f"{SMALL}/lens/images/one.png").content == picture
    for name in ("..%2Flens.yaml", "two.png", "..%2F..%2Fsmall%2Flens.yaml"):
        assert client.get(f"{SMALL}/lens/images/{name}").status_code == 404
    assert client.delete(f"{SMALL}/lens/images/one.png").json() == {"images": []}


def test_a_calibration_that_fails_says_why_and_changes_nothing(
    client: TestClient, finished: Callable[[dict[str, Any]], dict[str, Any]]
) -> None:
    wanted = {"files": "uploaded", "board": "9x6", "square_m": 0.025}
    assert "no checkerboard pictures" in client.post(f"{SMALL}/lens/calibrate", json=wanted).json()["error"]["message"]
    send(client, "checkerboard", "black.png", cv2.imencode(".png", np.zeros((90, 120), np.uint8))[1].tobytes())
    assert client.post(f"{SMALL}/lens/calibrate", json=wanted | {"board": "nine"}).status_code == 422
    revision = client.get(SMALL).json()["revision"]
    job = finished(client.post(f"{SMALL}/lens/calibrate", json=wanted).json()["job"])
    assert job["state"] == "failed"
    assert job["message"].endswith(".")
    assert client.get(SMALL).json()["revision"] == revision
    none_yet = client.get(f"{SMALL}/lens/report")
    assert (none_yet.status_code, none_yet.json()) == (200, None)


def test_a_large_video_is_read_through_meanwhile(
    client: TestClient, context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = threading.Event()
    publish = context.hub.publish

    def listen(project_id: str, event: str, data: Any) -> None:
        publish(project_id, event, data)
        if (project_id, event, data) == ("small", "inputs", {"kind": "video"}):
            told.set()

    def slowly(path: Path) -> Any:
        assert asked.wait(timeout=20)
        return frame_index(path)

    asked = threading.Event()
    monkeypatch.setattr(context.hub, "publish", listen)
    monkeypatch.setattr("app.videos._AT_ONCE_BYTES", 0)
    monkeypatch.setattr("app.videos.frame_index", slowly)
    before = client.get(f"{SMALL}/inputs").json()["video"]
    assert (before["width"], before["frames"], before["variable_rate"]) == (160, 40, None)
    assert client.get(SMALL).json()["problems"] is None  # not looked for before the video is read
    assert client.get(f"{SMALL}/frames/0.jpg").status_code == 200
    asked.set()
    assert told.wait(timeout=20)
    after = client.get(f"{SMALL}/inputs").json()["video"]
    assert (after["frames"], after["variable_rate"]) == (40, False)
    assert client.get(SMALL).json()["problems"] is not None


def test_frames_are_shown_raw_undistorted_and_smaller(client: TestClient) -> None:
    for number in (0, 1, 2, 30, 29, 28, 5):
        picture = client.get(f"{SMALL}/frames/{number}.jpg")
        pixels = cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_COLOR)
        assert pixels.shape == (120, 160, 3)
    small = client.get(f"{SMALL}/frames/3.jpg", params={"w": 80, "und": 1}).content
    assert cv2.imdecode(np.frombuffer(small, np.uint8), cv2.IMREAD_COLOR).shape == (60, 80, 3)
    answer = client.get(f"{SMALL}/frames/40.jpg")
    assert (answer.status_code, answer.json()["error"]["kind"]) == (422, "input")


def test_a_frame_is_sent_again_only_where_the_picture_is_another(
    client: TestClient, workspace: Path, context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ask(tag: str = "", **options: int) -> Any:
        return client.get(f"{SMALL}/frames/3.jpg", params=options, headers={"If-None-Match": tag})

    answers = {und: ask(und=und) for und in (0, 1)}
    tags = {und: answer.headers["ETag"] for und, answer in answers.items()}
    assert {answer.headers["Cache-Control"] for answer in answers.values()} == {"private, no-cache"}
    with monkeypatch.context() as patched:
        patched.setattr(context.frames, "jpeg", None)  # nothing is decoded for a picture that the browser has
        for und in (0, 1):
            kept = ask(tags[und], und=und)
            assert (kept.status_code, kept.content, kept.headers["ETag"]) == (304, b"", tags[und])
    other = replace(Lens.ideal(SIZE, 150.0), distortion=np.array([-0.2, 0.0, 0.0, 0.0, 0.0]))
    write_lens(workspace / "small" / "lens.yaml", other)
    assert ask(tags[0]).status_code == 304
    undistorted = ask(tags[1], und=1)
    assert undistorted.status_code == 200
    assert undistorted.content != answers[1].content
    assert ask(tags[0], w=80).status_code == ask(tags[1]).status_code == 200


def test_pictures_of_a_calibration_from_this_computer_are_shown_too(client: TestClient, workspace: Path) -> None:
    picture = np.full((6, 8, 3), 90, np.uint8)
    cv2.imwrite(str(workspace / "board.tif"), picture)
    (workspace / "small" / "results").mkdir()
    report = {"files": [str(workspace / "board.tif"), "/etc/hostname.png"]}
    (workspace / "small" / "results" / "lens_report.json").write_text(json.dumps(report))
    answer = client.get(f"{SMALL}/lens/images/board.tif")
    assert answer.headers["content-type"] == "image/png"
    assert np.array_equal(cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR), picture)
    assert client.get(f"{SMALL}/lens/images/hostname.png").status_code == 403


# --- videos that lie far away ----------------------------------------------------------------------------------------


def name_video(workspace: Path, address: str) -> None:
    file = workspace / "small" / "project.json"
    document = json.loads(file.read_text("utf-8"))
    document["inputs"]["video"] = address
    file.write_text(json.dumps(document), "utf-8")


def test_a_video_far_away_is_shown_as_one_that_lies_here(client: TestClient, workspace: Path) -> None:
    here = client.get(f"{SMALL}/inputs").json()["video"]
    pictures = [client.get(f"{SMALL}/frames/{number}.jpg").content for number in (0, 31)]
    assert all(picture.startswith(b"\xff\xd8") for picture in pictures)
    address = "memory://campaign/small.mp4"
    fsspec.filesystem("memory").pipe("/campaign/small.mp4", (workspace / "small" / here["file"]).read_bytes())
    name_video(workspace, address)
    far = client.get(f"{SMALL}/inputs").json()["video"]
    assert far == {**here, "file": address, "path": address}
    assert client.get(SMALL).json()["steps"]["inputs"]["status"] == "done"
    assert [client.get(f"{SMALL}/frames/{number}.jpg").content for number in (0, 31)] == pictures


def test_a_video_that_is_not_there_any_more_is_said_so(client: TestClient, workspace: Path) -> None:
    name_video(workspace, "memory://campaign/gone.mp4")
    answer = client.get(f"{SMALL}/frames/0.jpg")
    assert answer.status_code == 422
    assert "memory://campaign/gone.mp4: not found" in answer.json()["error"]["message"]
    assert "not found" in client.get(f"{SMALL}/inputs").json()["video"]["error"]["message"]


@pytest.mark.parametrize("address", ["file:///etc/hostname", "filecache::local:///etc/hostname"])
def test_an_address_leads_to_no_file_of_this_computer(client: TestClient, workspace: Path, address: str) -> None:
    name_video(workspace, address)
    answer = client.get(f"{SMALL}/frames/0.jpg")
    assert answer.status_code == 403
    assert "name it by its path" in answer.json()["error"]["message"]


def test_an_address_that_is_typed_is_kept_as_it_is(client: TestClient, workspace: Path) -> None:
    def typed(address: str) -> Any:
        state = client.get(SMALL).json()
        project = state["project"] | {"inputs": state["project"]["inputs"] | {"video": address}}
        return client.put(SMALL, json={"project": project, "revision": state["revision"]})

    address = "memory://campaign/typed.mp4"
    assert typed(address).json()["project"]["inputs"]["video"] == address
    assert json.loads((workspace / "small" / "project.json").read_text())["inputs"]["video"] == address
    refused = typed("file:///etc/hostname")
    assert (refused.status_code, "name it by its path" in refused.json()["error"]["message"]) == (403, True)
    assert typed(str(workspace / "small" / "video.mp4")).json()["project"]["inputs"]["video"] == "video.mp4"


@pytest.mark.parametrize(("kind", "suffixes"), [("cloud", CLOUD_SUFFIXES), ("image", IMAGE_SUFFIXES)])
def test_every_file_that_the_engine_reads_may_be_chosen(
    client: TestClient, workspace: Path, kind: str, suffixes: tuple[str, ...]
) -> None:
    for suffix in suffixes:
        (workspace / f"a{suffix}").touch()
    seen = client.get("/api/browse", params={"dir": str(workspace), "kind": kind}).json()["entries"]
    assert {f"a{suffix}" for suffix in suffixes} <= {entry["name"] for entry in seen}
