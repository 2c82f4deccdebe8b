"""One browser for all tests here: each test opens windows of its own in it. And the sample, for a test to change."""

from __future__ import annotations

import json
import shutil

import pytest
from playwright.sync_api import expect

from tests.browser.live import SAMPLE, chromium, folder_name, free_port, measured_sample, serving, shared_folder

# What is awaited comes sooner or later: a busy computer makes nothing wrong.
expect.set_options(timeout=30_000)


@pytest.fixture(scope="session")
def browser():
    with chromium() as found:
        yield found


@pytest.fixture(scope="session")
def headless(tmp_path_factory):
    """The folder of the sample with the headless engine's results, which no test changes."""
    return measured_sample(shared_folder(tmp_path_factory) / "measured-sample")


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A workspace with what an engineer brings, and the address of the server over it."""
    workspace = tmp_path_factory.mktemp("workspace")
    shutil.copytree(
        SAMPLE, workspace / "footage", ignore=shutil.ignore_patterns("project.json", "results", "truth.csv")
    )
    with serving(workspace, free_port()) as address:
        yield workspace, address


@pytest.fixture
def measured(headless, server, request):
    """The measured sample as a project of its own for each test: its folder and its pages' address."""
    workspace, address = server
    name = folder_name(request)
    shutil.copytree(headless, workspace / name)
    return workspace / name, f"{address}/p/{name}"


@pytest.fixture
def project(server, request):
    """The sample as a project of its own for each test: its folder and its pages' address."""
    workspace, address = server
    name = folder_name(request)
    folder = workspace / name
    folder.mkdir()
    document = json.loads((SAMPLE / "project.json").read_text())
    document["inputs"] = {"video": "../footage/video.mp4", "lens": "../footage/lens.yaml"}  # no cloud: nothing to read
    (folder / "project.json").write_text(json.dumps(document))
    return folder, f"{address}/p/{name}"
