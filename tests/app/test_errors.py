"""Every error has the one JSON shape, whatever route it comes from."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient

from app.errors import install_error_handlers
from core.errors import Cancelled, InputError


def api_routes(client: TestClient) -> list[tuple[str, str]]:
    app = client.app
    assert isinstance(app, FastAPI)
    routes = [route for route in _flat(app.routes) if isinstance(route, APIRoute) and route.path.startswith("/api")]
    return [(method, route.path) for route in routes for method in sorted(route.methods or ())]


def _flat(routes: list[Any]) -> list[Any]:
    found = []
    for route in routes:
        inner = getattr(route, "original_router", None)
        found += _flat(inner.routes) if inner is not None else [route]
    return found


def assert_shape(answer: Any, what: str) -> None:
    assert answer.status_code >= 400, what
    body = answer.json()
    assert set(body["error"]) == {"message", "path", "kind"}, what
    assert body["error"]["kind"] in ("input", "conflict", "missing", "busy", "disk", "internal"), what
    message = body["error"]["message"]
    assert message.endswith("."), f"{what}: {message!r} is no sentence"
    assert "Traceback" not in message
    assert "\n" not in message


def test_all_routes_are_walked(client: TestClient) -> None:
    walked = api_routes(client)
    assert len(walked) > 30
    assert ("GET", "/api/projects/{project_id}/frames/{number}.jpg") in walked


def test_every_route_refuses_a_project_that_is_not_there_in_the_one_shape(client: TestClient) -> None:
    for method, path in api_routes(client):
        if "{" not in path:
            continue
        address = path.replace("{project_id}", "none").replace("{number}", "0").replace("{kind}", "lens")
        address = address.replace("{frame}", "0").replace("{", "").replace("}", "")
        answer = client.request(method, address, json={} if method in ("POST", "PUT") else None)
        assert_shape(answer, f"{method} {address}")


def test_every_route_refuses_nonsense_in_the_one_shape(client: TestClient) -> None:
    for method, path in api_routes(client):
        if method in ("POST", "PUT") and "untrash" not in path:
            address = (
                path.replace("{project_id}", "small").replace("{kind}", "nonsense").replace("{", "").replace("}", "")
            )
            answer = client.request(
                method, address, content=b"\xff not json", headers={"Content-Type": "application/json"}
            )
            if answer.status_code >= 400:
                assert_shape(answer, f"{method} {address}")


@pytest.mark.parametrize("path", ["/api/none", "/nowhere", "/p/small/nonsense", "/p/none", "/static/js/none.js"])
def test_what_is_not_there_has_the_one_shape(client: TestClient, path: str) -> None:
    answer = client.get(path)
    assert answer.status_code == 404
    assert_shape(answer, path)


def test_a_person_with_a_wrong_address_is_led_to_the_project(client: TestClient) -> None:
    wrong = "/p/small/no-such-step"
    led = client.get(wrong, headers={"Accept": "text/html"}, follow_redirects=False)
    assert (led.status_code, led.headers["location"]) == (307, "/p/small")
    assert client.get(wrong).status_code == 404


def test_a_method_that_does_not_exist_has_the_one_shape(client: TestClient) -> None:
    assert_shape(client.patch("/api/projects"), "PATCH")


@pytest.mark.parametrize(
    ("raised", "status", "kind", "message"),
    [
        (InputError("video.mp4: is empty; copy it again."), 422, "input", "video.mp4: is empty; copy it again."),
        (Cancelled(), 409, "conflict", "The work was cancelled; start it again to go on."),
        (ValueError("secret path"), 500, "internal", "Rooftrack itself failed (ValueError); its terminal tells more."),
    ],
)
def test_what_the_engine_raises_becomes_an_answer(raised: Exception, status: int, kind: str, message: str) -> None:
    app = FastAPI()
    install_error_handlers(app)

    @app.get("/")
    def fails() -> None:
        raise raised

    answer = TestClient(app, raise_server_exceptions=False).get("/")
    assert (answer.status_code, answer.json()["error"]["kind"]) == (status, kind)
    assert answer.json()["error"]["message"] == message


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOSPC, "The disk is full"),
        (errno.EACCES, "does not allow writing to project.json"),
        (errno.EISDIR, "project.json: no; move away what lies in its place"),
    ],
)
def test_a_disk_that_refuses_is_told_in_a_sentence_and_the_edit_is_not_lost(
    client: TestClient, workspace: Path, monkeypatch: pytest.MonkeyPatch, code: int, words: str
) -> None:
    before = (workspace / "small" / "project.json").read_bytes()
    state = client.get("/api/projects/small").json()

    def refuse(folder: Path, project: Any) -> None:
        raise OSError(code, "no", str(folder / "project.json"))

    monkeypatch.setattr("app.store.write_project", refuse)
    edit = {"project": state["project"] | {"name": "other"}, "revision": state["revision"]}
    answer = client.put("/api/projects/small", json=edit)
    assert_shape(answer, "a refusing disk")
    assert (answer.status_code, answer.json()["error"]["kind"]) == (507, "disk")
    assert words in answer.json()["error"]["message"]
    assert (workspace / "small" / "project.json").read_bytes() == before
