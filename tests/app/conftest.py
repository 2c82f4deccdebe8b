"""A server over a workspace with one project in it, talked to in the same process."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from app.context import Context
from app.server import create_app
from tests.small_project import document, write_document, write_inputs

with warnings.catch_warnings():
    # It works with httpx as with its successor, but says on import that it would rather have that.
    warnings.simplefilter("ignore")
    from fastapi.testclient import TestClient

ADDRESS = "http://127.0.0.1:8000"
WRITE = {"X-Rooftrack": "1"}


@pytest.fixture(scope="session")
def inputs_made_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_inputs(folder)
    return folder


@pytest.fixture
def workspace(tmp_path: Path, inputs_made_once: Path) -> Path:
    folder = tmp_path / "workspace" / "small"
    folder.mkdir(parents=True)
    for file in inputs_made_once.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    write_document(folder, document())
    return folder.parent


@pytest.fixture
def client(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    monkeypatch.setenv("HOME", str(workspace.parent / "home"))
    app = create_app(workspace)
    with TestClient(app, base_url=ADDRESS, headers=WRITE) as client:
        yield client


@pytest.fixture
def context(client: TestClient) -> Context:
    found: Context = client.app.state.context  # type: ignore[attr-defined]
    return found


@pytest.fixture
def finished(client: TestClient) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Wait for a job and return it as it ended."""

    def wait(job: dict[str, Any]) -> dict[str, Any]:
        deadline = time.monotonic() + 60
        while job["state"] == "running":
            assert time.monotonic() < deadline, f"the job does not end: {job}"
            time.sleep(0.05)
            job = client.get(f"/api/jobs/{job['id']}").json()["job"]
        return job

    return wait
