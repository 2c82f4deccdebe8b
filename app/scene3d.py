"""The 3D scene, and the only door to viser.

viser 1.1 answers anybody who reaches its port, takes another server's address from a link, and opens a tunnel to the
internet when a client asks. So it listens on loopback at a port nobody is told, answers only who holds this process's
token, has its tunnel handlers taken out, and is reached through `app.api.viser` alone, which checks where a request
comes from.

The scene shows one project at a time, relative to a local origin, since a browser draws in single precision.
"""

from __future__ import annotations

import contextlib
import io
import secrets
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import viser
import viser._messages as viser_messages
import websockets.asyncio.server as websocket_server
from numpy.typing import NDArray
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from core.coordinates import Floats, OrthoGrid

TOKEN_HEADER = "X-Viser-Token"
CLIENT_FILE = Path(viser.__file__).parent / "client" / "build" / "index.html"
MAX_POINTS = 5_000_000
# Green, blue and yellow of Okabe and Ito, which no roof line has; the ground is green in the report too.
_GROUND_COLOUR, _PATH_COLOUR, _FRUSTUM_COLOUR = (0, 158, 115), (0, 114, 178), (240, 228, 66)
_REST_COLOUR = (150, 150, 150)

Pick = Callable[[Floats, Floats], None]


@dataclass(frozen=True, eq=False)
class CloudView:
    """Points to be shown: (N, 3) float32 relative to `origin_m`, and their colours (N, 3) uint8."""

    points_m: NDArray[np.float32]
    colours: NDArray[np.uint8]
    spacing_m: float


@dataclass(frozen=True, eq=False)
class GroundView:
    """The ground plane about its middle, and how far the ground strays from it."""

    middle_m: Floats
    slope: tuple[float, float]
    size_m: float
    label: str


@dataclass(frozen=True, eq=False)
class DrapeView:
    """A picture lying on the ground."""

    grid: OrthoGrid
    ground_z_m: float
    rgba: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class CameraView:
    """A camera: rotation (3, 3) camera from world, centre (3,), opening, and what it saw."""

    R: Floats
    centre_m: Floats
    vertical_fov_rad: float
    aspect: float
    picture: NDArray[np.uint8] | None
    reach_m: float


@dataclass(eq=False)
class _Shown:
    project: str | None = None
    origin_m: Floats = field(default_factory=lambda: np.zeros(3))
    keys: dict[str, Any] = field(default_factory=dict)
    nodes: dict[str, list[Any]] = field(default_factory=dict)
    visible: dict[str, bool] = field(default_factory=dict)
    points: int = 0


@cache
def line_colours() -> dict[str, tuple[int, int, int]]:
    """Return the colours of L1, L2 and T1 as red, green, blue: those of the report."""
    from core import figures  # takes a moment to import, which a server that shows no scene should not wait for

    return {name: _rgb(colour) for name, colour in figures.LINE_COLOURS.items()}


def _rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue of a colour such as `#56B4E9`."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


class Scene3D:
    """One viser server, started when somebody first looks."""

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(24)
        self._server: viser.ViserServer | None = None
        self._shown = _Shown()
        self._pick: Pick | None = None
        self._lock = threading.RLock()
        self._turn = threading.Lock()

    @property
    def port(self) -> int:
        """Port on loopback where viser answers who holds the token."""
        return int(self._started().get_port())

    @property
    def project(self) -> str | None:
        """Which project is shown."""
        return self._shown.project

    @property
    def origin_m(self) -> Floats:
        """(3,) world place that is the scene's origin."""
        return self._shown.origin_m

    @property
    def points(self) -> int:
        """How many points of the cloud are drawn."""
        return self._shown.points

    @contextlib.contextmanager
    def turn(self, project: str, *, take: bool) -> Iterator[bool]:
        """Hold the scene for a project, cleared of any other; yield False where another has it and keeps it.

        There is one scene for all windows, so without this one project's points would be drawn among another's.
        """
        with self._turn:
            mine = take or self._shown.project in (None, project)
            if mine and self._shown.project != project:
                self.clear(project)
            yield mine

    def clear(self, project: str) -> None:
        """Show nothing, as a project's scene."""
        with self._lock:
            self._pick = None
            for nodes in self._shown.nodes.values():
                _remove(nodes)
            self._shown = _Shown(project)

    def open(self, project: str, origin_m: Floats, pick: Pick) -> None:
        """Show a project; `pick` gets the ray, world origin and direction, of every click into the scene."""
        with self._lock:
            server = self._started()
            if self._shown.project != project or not np.array_equal(self._shown.origin_m, origin_m):
                self.clear(project)
                self._shown.origin_m = np.asarray(origin_m, dtype=np.float64)
            self._pick = pick
            server.scene.world_axes.visible = False

    def close(self) -> None:
        """Stop viser."""
        with self._lock:
            if self._server is not None:
                with contextlib.redirect_stdout(io.StringIO()):
                    self._server.stop()
                self._server = None

    def look(self, at_m: Floats, size_m: float) -> None:
        """Set where new viewers look from: south of the middle, half-way up."""
        with self._lock:
            camera = self._started().initial_camera
            # Half-way up to the camera in the sky, so that ground, building and flight are in view together.
            middle = at_m - self.origin_m + np.array([0.0, 0.0, 0.4 * size_m])
            camera.position = tuple(middle + np.array([0.35, -1.4, 0.55]) * size_m)
            camera.look_at = tuple(middle)
            camera.up = (0.0, 0.0, 1.0)

    def show(self, visible: Mapping[str, bool]) -> None:
        """Show or hide the parts: cloud, ground, orthoimage, camera, lines."""
        with self._lock:
            self._shown.visible.update(visible)
            for part, nodes in self._shown.nodes.items():
                for node in nodes:
                    node.visible = self._shown.visible.get(part, True)

    def has(self, part: str, key: Any) -> bool:
        """Whether a part is already shown as `key` describes it."""
        with self._lock:
            return part in self._shown.nodes and self._shown.keys.get(part) == key

    def set_cloud(self, view: CloudView, key: Any) -> None:
        """Show the cloud; float32, since viser's default has steps of 31 mm at 40 m."""
        with self._replacing("cloud", key) as (scene, add):
            add(
                scene.add_point_cloud(
                    "/cloud",
                    view.points_m,
                    view.colours,
                    point_size=max(0.01, 0.7 * view.spacing_m),
                    precision="float32",
                    point_shading="flat",
                    point_shape="square",
                )
            )
        self._shown.points = len(view.points_m)

    def set_ground(self, view: GroundView, key: Any) -> None:
        """Show the fitted ground plane, with what it is and how far the ground strays from it in words."""
        with self._replacing("ground", key) as (scene, add):
            normal = np.array([-view.slope[0], -view.slope[1], 1.0])
            add(
                scene.add_grid(
                    "/ground/plane",
                    width=view.size_m,
                    height=view.size_m,
                    plane="xy",
                    cell_size=1.0,
                    section_size=10.0,
                    cell_color=_GROUND_COLOUR,
                    section_color=_GROUND_COLOUR,
                    wxyz=_turn_from_z(normal),
                    position=tuple(view.middle_m - self.origin_m),
                )
            )
            edge = view.middle_m - self.origin_m + np.array([0.0, -view.size_m / 2, 0.3])
            add(scene.add_label("/ground/label", view.label, position=tuple(edge), anchor="top-center"))

    def set_orthoimage(self, view: DrapeView, key: Any) -> None:
        """Lay the orthoimage on the ground."""
        with self._replacing("orthoimage", key) as (scene, add):
            west, south, east, north = view.grid.extent_m
            # A hand's breadth above the plane, so that the two do not flicker through one another.
            middle = np.array([(west + east) / 2, (south + north) / 2, view.ground_z_m + 0.05]) - self.origin_m
            add(
                scene.add_image(
                    "/orthoimage",
                    view.rgba,
                    east - west,
                    north - south,
                    format="png",
                    # viser's images stand with u along x and v along -y when turned by 180 degrees about x.
                    wxyz=(0.0, 1.0, 0.0, 0.0),
                    position=tuple(middle),
                )
            )

    def set_camera(self, view: CameraView, path_m: Floats | None, key: Any) -> None:
        """Show where the camera is with the frame it sees, and the path it flew."""
        with self._replacing("camera", key) as (scene, add):
            add(
                scene.add_camera_frustum(
                    "/camera/frustum",
                    fov=view.vertical_fov_rad,
                    aspect=view.aspect,
                    scale=view.reach_m,
                    color=_FRUSTUM_COLOUR,
                    image=view.picture,
                    format="jpeg",
                    jpeg_quality=80,
                    wxyz=_quaternion(view.R.T),
                    position=tuple(view.centre_m - self.origin_m),
                )
            )
            if path_m is not None and len(path_m) > 1:
                points = (path_m - self.origin_m).astype(np.float32)
                segments = np.stack([points[:-1], points[1:]], axis=1)
                add(scene.add_line_segments("/camera/path", segments, _PATH_COLOUR, **_thick(2.0)))

    def set_lines(self, lines_m: Mapping[str, Floats], rest_m: Mapping[str, Floats], key: Any) -> None:
        """Show roof lines, named `target/L1`: (2, 3) ends each, world; and, thin, where they are at rest."""
        with self._replacing("lines", key) as (scene, add):
            for name, ends in lines_m.items():
                colour = line_colours().get(name.rpartition("/")[2], (230, 230, 230))
                segment = (ends - self.origin_m).astype(np.float32)[None]
                add(scene.add_line_segments(f"/lines/moved/{name}", segment, colour, **_thick(5.0)))
            for name, ends in rest_m.items():
                segment = (ends - self.origin_m).astype(np.float32)[None]
                add(scene.add_line_segments(f"/lines/rest/{name}", segment, _REST_COLOUR, **_thick(1.5)))

    def drop(self, part: str) -> None:
        """Take a part out of the scene."""
        with self._lock:
            _remove(self._shown.nodes.pop(part, []))
            self._shown.keys.pop(part, None)

    @contextlib.contextmanager
    def _replacing(self, part: str, key: Any) -> Iterator[tuple[viser.SceneApi, Callable[[Any], None]]]:
        """Hand out the scene to add the nodes of a part, which take the place of the ones before."""
        with self._lock, self._started().atomic():
            nodes: list[Any] = []
            before = self._shown.nodes.get(part, [])
            yield self._started().scene, nodes.append
            names = {node.name for node in nodes}
            _remove([node for node in before if node.name not in names])
            for node in nodes:
                node.visible = self._shown.visible.get(part, True)
            self._shown.nodes[part], self._shown.keys[part] = nodes, key

    def _started(self) -> viser.ViserServer:
        with self._lock:
            if self._server is None:
                self._server = _guarded_viser(self.token)
                self._server.scene.on_click()(self._clicked)
            return self._server

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        pick = self._pick
        if pick is not None:
            pick(np.array(event.ray_origin) + self.origin_m, np.array(event.ray_direction))


def _guarded_viser(token: str) -> viser.ViserServer:
    # Its greeting names an address that would refuse whoever tried it.
    with _answering_only(token), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    for request in (viser_messages.ShareUrlRequest, viser_messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(request)
    # Dark in both themes, like the surround of every picture: colours of the cloud and thin lines read better on it.
    server.gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=True)
    server.gui.set_panel_label("Scene")
    server.gui.main_panel.minimize()
    server.scene.set_up_direction("+z")
    return server


@contextlib.contextmanager
def _answering_only(token: str) -> Iterator[None]:
    """Make the port viser opens meanwhile refuse whoever does not hold the token; viser 1.1 has no setting for it."""
    serve = websocket_server.serve

    def guarded_serve(handler: Any, *args: Any, process_request: Any = None, **options: Any) -> Any:
        def guard(connection: Any, request: Request) -> Any:
            if not secrets.compare_digest(request.headers.get(TOKEN_HEADER, ""), token):
                return Response(403, "Forbidden", Headers(), b"")
            return process_request(connection, request) if process_request else None

        return serve(handler, *args, process_request=guard, **options)

    websocket_server.serve = guarded_serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websocket_server.serve = serve  # type: ignore[misc]


def _thick(pixels: float) -> dict[str, Any]:
    return {"thickness": pixels, "thickness_units": "screen"}


def _remove(nodes: list[Any]) -> None:
    for node in nodes:
        with contextlib.suppress(KeyError, ValueError):
            node.remove()


def _quaternion(R: Floats) -> tuple[float, float, float, float]:
    """Return (w, x, y, z) of a rotation matrix."""
    return tuple(viser.transforms.SO3.from_matrix(np.asarray(R)).wxyz.tolist())


def _turn_from_z(normal: Floats) -> tuple[float, float, float, float]:
    """Return the quaternion that turns the z axis onto a normal that points up."""
    n = normal / np.linalg.norm(normal)
    half = np.array([1.0 + n[2], -n[1], n[0], 0.0])
    return tuple((half / np.linalg.norm(half)).tolist())
