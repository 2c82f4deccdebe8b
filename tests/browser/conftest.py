"""One browser for all tests here: each test opens windows of its own in it. And the sample, for a test to change."""

from __future__ import annotations

import json
import re
import shutil

import pytest

from tests.browser.live import SAMPLE, chromium, free_port, serving


@pytest.fixture(scope="session")
def browser():
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A workspace and the address of the server over it."""
    workspace = tmp_path_factory.mktemp("workspace")
    shutil.copytree(SAMPLE, workspace / "footage", ignore=shutil.ignore_patterns("project.json", "results"))
    with serving(workspace, free_port()) as address:
        yield workspace, address


@pytest.fixture
def project(server, request):
    """The sample as a project of its own for each test: its folder and its pages' address."""
    workspace, address = server
    name = re.sub(r"[^a-z0-9]+", "-", request.node.name)[-40:].strip("-")
    folder = workspace / name
    folder.mkdir()
    document = json.loads((SAMPLE / "project.json").read_text())
    document["inputs"] = {"video": "../footage/video.mp4", "lens": "../footage/lens.yaml"}  # no cloud: nothing to read
    (folder / "project.json").write_text(json.dumps(document))
    return folder, f"{address}/p/{name}"
