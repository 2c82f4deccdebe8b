"""Chunks on a real Dask scheduler with workers of their own, one of which dies in the middle."""

from __future__ import annotations

import hashlib
import re
import signal
import sqlite3
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from app import cli
from core import cluster as tasks
from core.measurements import MeasurementStore, Reference
from core.project import read_project
from core.results import read_history_csv
from core.run import FRAMES_FILE, load_inputs
from tests.scenes.clips import BRIEF, displacement, measured, measured_history, project_copy, rendered

ROOT = Path(__file__).parents[2]
SAME_M = 1e-5
WORKERS = 2


@pytest.fixture(scope="session")
def clip(tmp_path_factory):
    return rendered(tmp_path_factory, "cluster", BRIEF)


@pytest.fixture(scope="session")
def sequential(clip, tmp_path_factory):
    return measured_history(project_copy(clip, tmp_path_factory.mktemp("sequential") / "clip"))


@contextmanager
def dask(command, *arguments, until):
    """Run a part of Dask until it says what is waited for; yield the process and that line's match."""
    process = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli." + command, *arguments],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        said = []
        for line in process.stderr:
            said.append(line)
            if found := re.search(until, line):
                break
        else:
            pytest.fail(f"{command} ended: {''.join(said)}")
        # What it says afterwards must not fill the pipe.
        threading.Thread(target=process.stderr.read, daemon=True).start()
        yield process, found
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


@pytest.fixture
def cluster():
    """Address of a scheduler on this machine, and its worker processes."""
    with dask(
        "dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", until=r"Scheduler at:\s+(\S+)"
    ) as (_, found):
        address = found[1]
        options = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1")
        with (
            dask("dask_worker", address, *options, until=r"Registered to") as (first, _),
            dask("dask_worker", address, *options, until=r"Registered to") as (second, _),
        ):
            yield address, [first, second]


def frame_numbers(folder):
    with sqlite3.connect(folder / "results" / FRAMES_FILE) as db:
        return [row[0] for row in db.execute("SELECT frame FROM frames ORDER BY frame")]


def test_a_worker_that_dies_costs_time_and_nothing_else(clip, sequential, cluster, tmp_path, monkeypatch):
    address, workers = cluster
    folder = project_copy(clip, tmp_path / "clip")
    # Chunks short enough that each worker has several of them.
    monkeypatch.setattr(tasks, "TASK_FRAMES", 24)
    seen = []

    def watch(stage, done, total):
        seen.append(done)
        if done == 30:
            workers[0].send_signal(signal.SIGKILL)

    history = measured(load_inputs(folder), scheduler=address, progress=watch).histories["roof"]
    assert workers[0].wait(timeout=20) == -signal.SIGKILL
    assert frame_numbers(folder) == list(range(len(sequential.frame)))
    assert seen == list(range(len(sequential.frame) + 1))
    np.testing.assert_array_equal(history.time_s, sequential.time_s)
    np.testing.assert_array_equal(history.status, sequential.status)
    difference_m = np.abs(displacement(history) - displacement(sequential))
    assert float(np.nanmax(difference_m)) < SAME_M


def test_a_workspace_is_measured_one_project_after_the_other(clip, sequential, cluster, tmp_path):
    address, _ = cluster
    workspace = tmp_path / "workspace"
    names = ("first", "second")
    for name in names:
        project_copy(clip, workspace / name)
    assert cli.main(["run", str(workspace), "--scheduler", address]) == 0
    for name in names:
        history = read_history_csv(workspace / name / "results" / "roof.csv")
        # The file is rounded to micrometres.
        difference_m = np.abs(displacement(history) - displacement(sequential))
        assert float(np.nanmax(difference_m)) < SAME_M


def test_workers_read_videos_from_where_they_are_stored(clip, sequential, cluster, tmp_path):
    address, _ = cluster
    inputs = read_project(clip).inputs.model_copy(update={"video": (clip / "video.mp4").resolve().as_uri()})
    folder = project_copy(clip, tmp_path / "clip", inputs=inputs.model_dump())
    (folder / "video.mp4").unlink()
    assert cli.main(["run", str(folder), "--scheduler", address]) == 0
    history = read_history_csv(folder / "results" / "roof.csv")
    assert float(np.nanmax(np.abs(displacement(history) - displacement(sequential)))) < SAME_M
    summary = (folder / "results" / "summary.json").read_text()
    assert hashlib.sha256((clip / "video.mp4").read_bytes()).hexdigest() in summary


def test_a_scheduler_that_is_not_there_is_named_and_nothing_is_lost_to_it(clip, tmp_path, capsys):
    folder = project_copy(clip, tmp_path / "clip")
    inputs = load_inputs(folder)
    with MeasurementStore(folder / "results" / FRAMES_FILE) as store:
        store.begin(inputs.setup().method, "of another day", Reference(np.zeros((4, 2)), {}))
    assert cli.main(["run", str(folder), "--scheduler", "tcp://127.0.0.1:9"]) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "tcp://127.0.0.1:9" in said
    assert "no Dask scheduler answers" in said
    with MeasurementStore(folder / "results" / FRAMES_FILE) as store:
        assert store.find(inputs.setup().method, "of another day") is not None
