"""Who may talk to the server, held guard by guard."""

from __future__ import annotations

from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from app.guards import LOOPBACK
from app.server import serve
from core.errors import InputError

SMALL = "/api/projects/small"


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "", "192.168.0.7:8000", "[", "[::1"])
def test_a_name_that_is_not_this_computer_is_refused(client: TestClient, host: str) -> None:
    answer = client.get("/api/projects", headers={"Host": host})
    assert (answer.status_code, answer.json()["error"]["path"]) == (403, "Host")


@pytest.mark.parametrize("host", ["127.0.0.1:8000", "localhost:8000", "[::1]:8000"])
def test_this_computer_by_any_of_its_names_is_served(client: TestClient, host: str) -> None:
    assert client.get("/api/projects", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:9999", "http://localhost:8000", "http://["]
)
def test_another_sites_page_cannot_change_anything(client: TestClient, origin: str) -> None:
    answer = client.delete(SMALL, headers={"Origin": origin})
    assert (answer.status_code, answer.json()["error"]["path"]) == (403, "Origin")
    assert client.get(SMALL).status_code == 200


def test_a_form_that_cannot_send_our_header_changes_nothing(client: TestClient) -> None:
    del client.headers["X-Rooftrack"]
    for method in ("POST", "PUT", "DELETE", "PATCH"):
        answer = client.request(method, SMALL)
        assert (answer.status_code, answer.json()["error"]["path"]) == (403, "X-Rooftrack")


def test_our_own_page_may(client: TestClient) -> None:
    answer = client.post("/api/projects", json={"name": "new"}, headers={"Origin": "http://127.0.0.1:8000"})
    assert answer.status_code == 200


def test_every_answer_tells_the_browser_to_load_nothing_from_elsewhere(client: TestClient) -> None:
    for path in ("/", "/api/projects", "/api/none", "/static/js/none.js"):
        headers = client.get(path).headers
        policy = dict(part.strip().split(" ", 1) for part in headers["content-security-policy"].split(";"))
        assert policy["default-src"] == "'none'"
        assert policy["script-src"] == policy["connect-src"] == policy["style-src"] == "'self'"
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["cross-origin-resource-policy"] == "same-origin"


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.0.7", "example.com"])
def test_the_server_listens_on_this_computer_only(tmp_path: Path, host: str) -> None:
    assert host not in LOOPBACK
    with pytest.raises(InputError, match="ssh -L"):
        serve(tmp_path, host)


def test_a_taken_port_is_told(tmp_path: Path) -> None:
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(InputError, match="is taken"):
            serve(tmp_path, "127.0.0.1", taken.getsockname()[1])


def test_the_walls_of_browsing(client: TestClient, workspace: Path, tmp_path: Path) -> None:
    (workspace / ".hidden").mkdir()
    (workspace / "leads out").symlink_to(tmp_path)
    here = client.get("/api/browse").json()
    assert here["dir"] == str(workspace)
    assert [entry["name"] for entry in here["entries"]] == ["leads out", "small"]
    video = workspace / "small" / "video.mp4"
    assert client.get("/api/browse/which", params={"path": str(video)}).json() == {"file": str(video)}
    assert client.get("/api/browse/which", params={"path": str(workspace)}).json() == {"file": None}
    inside = client.get("/api/browse", params={"dir": str(workspace / "small"), "kind": "video"}).json()
    assert [(entry["name"], entry["kind"]) for entry in inside["entries"]] == [("video.mp4", "video")]
    assert inside["parent"] == str(workspace)
    for outside in (
        tmp_path,
        workspace / "..",
        workspace / "leads out",
        Path("/etc"),
        Path("relative"),
        Path("~nobody-here/a"),
    ):
        assert client.get("/api/browse", params={"dir": str(outside)}).status_code == 403, outside
        assert client.get("/api/browse/which", params={"path": str(outside)}).status_code == 403, outside
    assert client.get("/api/browse", params={"dir": str(workspace / "none")}).status_code == 404
