"""The program as a person starts and stops it."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from app.jobs import JOB_FILE
from tests.app.measured import write_measurable


@contextmanager
def served(workspace: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    command = [sys.executable, "-m", "app.cli", "serve", str(workspace), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            yield server, server.stdout.readline().strip()
        finally:
            server.kill()


@pytest.mark.skipif(sys.platform == "win32", reason="there Ctrl-C cannot be sent to another process")
def test_ctrl_c_stops_the_server_and_its_workers_in_order(tmp_path: Path) -> None:
    write_measurable(tmp_path / "clip", 300)
    clip = "api/projects/clip"
    with served(tmp_path) as (server, address):
        assert address.startswith("http://127.0.0.1:")
        assert address.endswith("/")
        with urllib.request.urlopen(f"{address}{clip}/events") as stream:
            assert stream.readline() == b"event: hello\n"
            start = urllib.request.Request(f"{address}{clip}/track", b"{}", method="POST")
            start.add_header("X-Rooftrack", "1")
            start.add_header("Content-Type", "application/json")
            with urllib.request.urlopen(start) as answer:
                assert json.load(answer)["job"]["state"] == "running"
            heard = b""
            while b'"measuring' not in heard:
                heard += stream.readline()
            asked_s = time.monotonic()
            server.send_signal(signal.SIGINT)
            assert server.wait(timeout=30) == 0
            assert time.monotonic() - asked_s < 20
    note = json.loads((tmp_path / "clip" / "results" / JOB_FILE).read_text())
    assert (note["kind"], note["state"]) == ("track", "interrupted")


@pytest.mark.skipif(sys.platform == "win32", reason="there Ctrl-C cannot be sent to another process")
def test_ctrl_c_in_the_middle_of_an_upload_is_no_error(tmp_path: Path) -> None:
    write_measurable(tmp_path / "clip", 30)
    with served(tmp_path) as (server, address):
        host = address.removeprefix("http://").rstrip("/")
        with socket.create_connection(tuple(host.split(":"))) as line:
            head = (
                f"PUT /api/projects/clip/upload/lens?filename=new.yaml HTTP/1.1\r\nHost: {host}\r\nX-Rooftrack: 1\r\n"
            )
            line.sendall(f"{head}Content-Length: 1000\r\n\r\nhalf of it".encode())
            time.sleep(0.5)
            server.send_signal(signal.SIGINT)
            assert server.wait(timeout=30) == 0
        assert server.stderr is not None
        assert server.stderr.read() == ""
    assert not [file for file in (tmp_path / "clip").iterdir() if file.name.startswith(".") or "new" in file.name]


def test_a_host_that_is_not_this_computer_is_refused_in_one_sentence(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "app.cli", "serve", str(tmp_path), "--host", "0.0.0.0"]
    refused = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert refused.returncode == 1
    assert "listens on this computer only" in refused.stderr
    assert "Traceback" not in refused.stderr
