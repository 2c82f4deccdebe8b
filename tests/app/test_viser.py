"""viser's holes, each held shut."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import viser._messages as viser_messages
from fastapi.testclient import TestClient
from matplotlib.colors import to_rgb
from starlette.websockets import WebSocketDisconnect
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from app import scene3d
from app.context import Context
from app.scene3d import CLIENT_FILE, TOKEN_HEADER, CloudView, Scene3D, line_colours
from app.scenes import _ground
from app.sites import Site
from core import figures
from core.cloud import make_cloud
from core.ground_plane import GroundPlane

HOST = {"Host": "127.0.0.1:8000"}
ORIGIN = HOST | {"Origin": "http://127.0.0.1:8000"}
PROTOCOL = "viser-v1.1.1"


@pytest.fixture(scope="module")
def scene() -> Any:
    found = Scene3D()
    yield found
    found.close()


def test_viser_listens_on_loopback_only(scene: Scene3D) -> None:
    server = scene._started()._websock_server
    assert server._host == "127.0.0.1"
    others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)} - {"127.0.0.1"}
    for address in others:
        with socket.socket() as probe:
            probe.settimeout(1.0)
            assert probe.connect_ex((address, scene.port)) != 0


@pytest.mark.parametrize("token", [None, "", "wrong"])
def test_visers_port_answers_nobody_without_the_token(scene: Scene3D, token: str | None) -> None:
    async def knock() -> None:
        headers = {} if token is None else {TOKEN_HEADER: token}
        async with connect(f"ws://127.0.0.1:{scene.port}", additional_headers=headers, proxy=None):
            pass

    with pytest.raises(InvalidStatus) as refusal:
        asyncio.run(knock())
    assert refusal.value.response.status_code == 403


def test_viser_serves_no_page_of_its_own_without_the_token(scene: Scene3D) -> None:
    with socket.create_connection(("127.0.0.1", scene.port)) as line:
        line.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert b" 403 " in line.recv(200)


def test_the_tunnel_to_the_internet_is_taken_out(scene: Scene3D) -> None:
    handlers = scene._started()._websock_server._incoming_handlers
    for message in (viser_messages.ShareUrlRequest, viser_messages.ShareUrlDisconnect):
        assert not handlers.get(message)


def test_the_websocket_library_is_left_as_it_was(scene: Scene3D) -> None:
    import websockets.asyncio.server as library

    assert scene.port
    assert library.serve.__module__ == "websockets.asyncio.server"


@pytest.mark.parametrize(
    "query",
    [
        "websocket=ws://evil.example",
        "playbackPath=http://evil.example/x",
        "hideViserLogo&WebSocket=ws://evil",
        "playbackpath=x",
    ],
)
def test_a_link_cannot_point_the_client_elsewhere(client: TestClient, query: str) -> None:
    answer = client.get(f"/viser/?{query}", follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (307, "/viser/?hideViserLogo")


def test_the_client_may_talk_to_this_server_only(client: TestClient) -> None:
    answer = client.get("/viser/?hideViserLogo")
    assert answer.content == CLIENT_FILE.read_bytes()
    policy = dict(part.strip().split(" ", 1) for part in answer.headers["content-security-policy"].split(";"))
    assert policy["default-src"] == "'none'"
    assert policy["connect-src"].split()[0] == "ws://127.0.0.1:8000"
    assert "http" not in policy["connect-src"].replace("ws://127.0.0.1:8000", "")
    assert policy["frame-ancestors"] == "'self'"
    assert client.get("/viser", follow_redirects=False).headers["location"].startswith("/viser/")


@pytest.mark.parametrize(
    "headers",
    [
        HOST,
        HOST | {"Origin": "http://evil.example"},
        HOST | {"Origin": "null"},
        HOST | {"Origin": "http://127.0.0.1:9999"},
        ORIGIN | {"Host": "evil.example"},
    ],
)
def test_another_sites_page_cannot_open_the_relay(client: TestClient, headers: dict[str, str]) -> None:
    with pytest.raises(WebSocketDisconnect), client.websocket_connect("/viser", [PROTOCOL], headers=dict(headers)):
        pass


def test_the_relay_speaks_visers_language_only(client: TestClient) -> None:
    for protocols in ([], ["chat"]):
        with pytest.raises(WebSocketDisconnect), client.websocket_connect("/viser", protocols, headers=dict(ORIGIN)):
            pass


def test_our_own_page_sees_the_scene(client: TestClient, context: Context) -> None:
    protocol = f"viser-v{__import__('viser').__version__}"
    with client.websocket_connect("/viser", [protocol], headers=dict(ORIGIN)) as line:
        assert line.accepted_subprotocol == protocol
        assert line.receive_bytes()
    with contextlib.suppress(Exception):
        context.scene.close()


def test_points_in_utm_keep_their_millimetres(scene: Scene3D) -> None:
    origin = np.array([500_000.0, 5_400_000.0, 300.0])
    scene.open("utm", origin, lambda start, along: None)
    local = np.array([[0.001, 0.002, 0.003], [40.001, -40.002, 18.303]])
    view = CloudView(local.astype(np.float32), np.zeros((2, 3), np.uint8), 0.1)
    scene.set_cloud(view, "key")
    shown = scene._started().scene.get_handle_by_name("/cloud")
    assert shown.points.dtype == np.float32
    assert np.asarray(shown.points, dtype=float) == pytest.approx(local, abs=2e-6)


def test_roof_lines_have_the_colours_of_the_report_and_nothing_else_has(scene: Scene3D) -> None:
    scene.open("colours", np.zeros(3), lambda start, along: None)
    ends = {f"roof/{name}": np.array([[0.0, 0.0, 4.0], [1.0, 0.0, 4.0]]) for name in figures.LINE_COLOURS}
    scene.set_lines(ends, {}, "key")
    shown = scene._started().scene
    for name, colour in figures.LINE_COLOURS.items():
        drawn = shown.get_handle_by_name(f"/lines/moved/roof/{name}").colors
        assert np.unique(drawn.reshape(-1, 3), axis=0) == pytest.approx(np.array(to_rgb(colour))[None] * 255)
    assert not set(line_colours().values()) & {scene3d._GROUND_COLOUR, scene3d._PATH_COLOUR, scene3d._FRUSTUM_COLOUR}


def test_a_click_is_given_in_world_coordinates(scene: Scene3D) -> None:
    clicked: list[Any] = []
    origin = np.array([1000.0, 2000.0, 100.0])
    scene.open("clicked", origin, lambda start, along: clicked.append((start, along)))

    class Event:
        ray_origin = (1.0, 2.0, 30.0)
        ray_direction = (0.0, 0.0, -1.0)

    scene._clicked(Event())  # type: ignore[arg-type]
    ((start, along),) = clicked
    assert start.tolist() == [1001.0, 2002.0, 130.0]
    assert along.tolist() == [0.0, 0.0, -1.0]


def test_a_click_in_the_scene_tells_the_tabs_the_height(
    client: TestClient, context: Context, finished: Callable[[dict[str, Any]], dict[str, Any]]
) -> None:
    small = "/api/projects/small"
    reading = client.post(f"{small}/scene", json={"points": 1000}).json()
    assert (reading["ready"], reading["message"][:23]) == (False, "The cloud is being read")
    job = context.jobs.latest("small", "cloud")
    assert job is not None
    finished(job.as_json())
    shown = client.post(f"{small}/scene", json={"points": 1000}).json()
    assert shown["ready"]
    assert 500 < shown["points_shown"] <= 1000
    assert shown["points_total"] == 6400
    again = client.post(f"{small}/scene", json={"points": 1000}).json()
    assert again["points_shown"] == shown["points_shown"]  # as many as are drawn, not as many as were asked for
    told: list[Any] = []
    context.hub.publish = lambda project, event, data: told.append((event, data))  # type: ignore[method-assign]

    class Event:
        ray_origin = tuple(np.array([2.0, 3.0, 40.0]) - context.scene.origin_m)
        ray_direction = (0.0, 0.0, -1.0)

    context.scene._clicked(Event())  # type: ignore[arg-type]
    ((event, data),) = told
    assert event == "pick"
    assert data["xyz_m"][:2] == pytest.approx([2.0, 3.0], abs=0.2)
    assert data["height_m"] == pytest.approx(0.0, abs=0.03)


def test_one_scene_is_handed_from_project_to_project_and_never_holds_two(
    client: TestClient, context: Context, finished: Callable[[dict[str, Any]], dict[str, Any]]
) -> None:
    client.post("/api/projects", json={"name": "empty"})
    context.sites.begin(context.workspace.open("small"), context.workspace.open("small").load().project)
    job = context.jobs.latest("small", "cloud")
    assert job is not None
    finished(job.as_json())
    told: list[Any] = []
    context.hub.publish = lambda project, event, data: told.append((project, event, data))  # type: ignore[method-assign]

    def show(project: str, **more: Any) -> Any:
        return client.post(f"/api/projects/{project}/scene", json={"points": 1000, **more}).json()

    assert show("small", take=True)["owner"] == "small"
    left = show("empty")
    assert (left["ready"], left["owner"]) == (False, "small")
    assert "cloud" in context.scene._shown.nodes
    taken = show("empty", take=True)
    assert (taken["ready"], taken["owner"]) == (False, "empty")
    assert "point cloud" in taken["message"]
    assert context.scene._shown.nodes == {}
    assert context.scene._pick is None
    assert ("small", "scene", {"owner": "empty"}) in told
    assert (show("small")["ready"], show("small")["points_shown"]) == (False, 0)
    assert show("small", take=True)["ready"]


def test_a_ground_at_zero_has_no_sign() -> None:
    plane = GroundPlane(
        at_m=(0.0, 0.0, -0.001),
        slope=(0.0, 0.0),
        elevation_std_m=0.0,
        elevation_p5_m=0.0,
        elevation_p95_m=0.0,
        ground_points=10,
        area_m2=1.0,
    )
    cloud = make_cloud(np.zeros((4, 3)))
    assert "z = 0.00 m" in _ground(Site("key", cloud, plane)).label
