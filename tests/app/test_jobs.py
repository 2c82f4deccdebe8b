"""Jobs when the computer fails them: no room on the disk, no memory for another process, a worker that is killed."""

from __future__ import annotations

import errno
import io
import json
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app import jobs, worker
from app.context import Context

SMALL = "/api/projects/small"


@pytest.fixture
def workers(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[str]]:
    """Every worker that is started."""
    started: list[subprocess.Popen[str]] = []
    spawn = jobs._spawn

    def kept() -> subprocess.Popen[str]:
        started.append(spawn())
        return started[-1]

    monkeypatch.setattr(jobs, "_spawn", kept)
    return started


def wait_until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def no_memory() -> Any:
    raise OSError(12, "Cannot allocate memory")


def full_disk(*_: Any) -> None:
    raise OSError(28, "No space left on device")


def test_a_full_disk_hides_no_end_of_a_job(
    client: TestClient, context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[tuple[str, str]] = []
    monkeypatch.setattr(context.hub, "publish", lambda project, event, data: said.append((event, data.get("state"))))
    job = context.jobs.get(client.post(f"{SMALL}/track").json()["job"]["id"])
    monkeypatch.setattr(jobs, "write_atomically", full_disk)
    wait_until(lambda: not job.is_running)
    wait_until(lambda: ("job", job.state) in said)
    assert context.jobs.running("small", "track") is None


@pytest.mark.parametrize(
    ("part", "fails", "told"),
    [("_spawn", no_memory, "Cannot allocate memory"), ("write_atomically", full_disk, "No space left on device")],
)
def test_a_job_that_cannot_be_started_is_told_and_blocks_no_other(
    client: TestClient,
    workers: list[subprocess.Popen[str]],
    finished: Callable[[dict[str, Any]], dict[str, Any]],
    part: str,
    fails: Callable[..., Any],
    told: str,
) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(jobs, part, fails)
        answer = client.post(f"{SMALL}/track")
    assert answer.status_code == 422
    assert answer.json()["error"]["message"].startswith("Tracking could not be started")
    assert told in answer.json()["error"]["message"]
    assert client.get(f"{SMALL}/track").json()["job"] is None
    assert all(worker.poll() is not None for worker in workers)
    assert finished(client.post(f"{SMALL}/track").json()["job"])["state"] in ("done", "failed")


def test_a_killed_reading_of_the_cloud_is_told_and_begins_anew_when_asked_to(
    client: TestClient, context: Context, workers: list[subprocess.Popen[str]]
) -> None:
    def cloud(**asked: int) -> dict[str, Any]:
        found: dict[str, Any] = client.get(f"{SMALL}/inputs", params=asked).json()["cloud"]
        return found

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(jobs, "_send", lambda worker, line: worker.kill())
        assert cloud()["reading"]
    wait_until(lambda: context.jobs.running("small", "cloud") is None)
    assert "broke off unexpectedly" in cloud()["error"]["message"]
    scene = client.post(f"{SMALL}/scene", json={"frame": 0}).json()
    assert (scene["ready"], "broke off" in scene["message"]) == (False, True)
    assert len(workers) == 1
    assert cloud(again=1)["reading"]
    wait_until(lambda: "points" in cloud())


def test_a_disk_that_refuses_a_job_is_told_as_the_disks_fault(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def work(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "eq7/results")

    reports = io.StringIO()
    order = {"kind": "track", "folder": str(tmp_path), "parameters": {}}
    monkeypatch.setattr("app.work.WORK", {"track": work})
    monkeypatch.setattr("app.worker._own_stdout", lambda: reports)
    monkeypatch.setattr("sys.stdin", io.StringIO(json.dumps(order) + "\n"))
    assert worker.main() == 0
    told = json.loads(reports.getvalue().splitlines()[-1])
    assert told == {"failed": "eq7/results: No space left on device; make room on the disk, then do it again."}
