"""The browser interface: one server on this computer over a folder of projects."""

from __future__ import annotations

import contextlib
import logging
import socket
import sys
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any
from urllib.parse import quote

import uvicorn
from fastapi import FastAPI, Request
from fastapi.responses import FileResponse, RedirectResponse
from fastapi.staticfiles import StaticFiles
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response
from starlette.types import Scope

from app.api import drift, events, frames, geometry, inputs, orthoimage, projects, results, scene, trash, viser
from app.context import Context, Here
from app.errors import ApiError, Missing, install_error_handlers
from app.events import Hub
from app.frames import FrameStore
from app.growing import Growing
from app.guards import LOOPBACK, Guard
from app.jobs import Jobs
from app.outcome import Outcomes
from app.places import Places
from app.scene3d import Scene3D
from app.sites import Sites
from app.steps import SETTLED, STEPS, steps_of
from app.store import ProjectFolder, Workspace
from core.errors import InputError
from core.locks import take_lock
from core.version import program_version

STATIC = Path(__file__).resolve().parent.parent / "static"
DEFAULT_PORT = 8000
_PORTS_TRIED = 20
# Where videos lie that are not on the computer's own disk.
_DRIVES = ("/media", "/run/media", "/mnt", "/Volumes")

log = logging.getLogger("rooftrack")


def create_app(workspace: Path, roots: Sequence[Path] = ()) -> FastAPI:
    """Return the interface over a folder of projects.

    Args:
        workspace: made if it is not there.
        roots: folders whose files may be chosen, besides the workspace and the home folder.
    """
    workspace.mkdir(parents=True, exist_ok=True)
    workspace = workspace.resolve()
    places = Places([workspace, Path.home(), *roots])
    hub = Hub()
    jobs = Jobs(hub)
    context = Context(
        workspace=Workspace(workspace, places),
        places=places,
        hub=hub,
        jobs=jobs,
        frames=FrameStore(),
        sites=Sites(jobs),
        outcomes=Outcomes(),
        growing=Growing(),
        scene=Scene3D(),
    )
    app = FastAPI(title="Rooftrack", lifespan=_life, docs_url=None, redoc_url=None, openapi_url=None)
    app.state.context = context
    install_error_handlers(app)
    for part in (projects, trash, events, inputs, frames, orthoimage, geometry, results, drift, scene, viser):
        app.include_router(part.router)
    _add_pages(app)
    app.add_middleware(Guard)
    return app


@contextlib.asynccontextmanager
async def _life(app: FastAPI) -> AsyncIterator[None]:
    context: Context = app.state.context
    charge = take_lock(context.workspace.folder)
    try:
        if charge is not None:
            await run_in_threadpool(_tidy_and_go_on, context)
        yield
    finally:
        context.hub.close()
        await run_in_threadpool(_stop, context)
        if charge is not None:
            charge.close()


def _tidy_and_go_on(context: Context) -> None:
    for part in context.workspace.folder.glob(".incoming-*"):
        part.unlink(missing_ok=True)
    context.workspace.empty_trash()
    for project_id in context.workspace.ids():
        try:
            _tidy_project(context, context.workspace.open(project_id))
        except (ApiError, InputError, OSError) as error:
            log.warning("%s was left as it is: %s", project_id, error)


def _tidy_project(context: Context, folder: ProjectFolder) -> None:
    folder.remove_parts()
    job = context.jobs.go_on(folder, results.finish_track(context))
    if job is not None:
        context.growing.follow(context.hub, folder, job)


def _stop(context: Context) -> None:
    context.jobs.close()
    context.scene.close()
    context.frames.close()


class _Static(StaticFiles):
    """Files that a browser asks for anew each time, and gets only when they have changed."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        response.headers["Cache-Control"] = "no-cache"
        return response


def _add_pages(app: FastAPI) -> None:
    for folder in ("css", "js", "vendor", "img"):
        app.mount(f"/static/{folder}", _Static(directory=STATIC / folder, check_dir=False), name=folder)

    @app.get("/api/about")
    def about(here: Here) -> dict[str, Any]:
        """Return what this server is."""
        return {
            "version": program_version(),
            "workspace": str(here.workspace.folder),
            "roots": [str(root) for root in here.places.roots],
        }

    @app.get("/")
    def index() -> FileResponse:
        """Return the page with the list of projects."""
        return _page("index")

    @app.get("/p/{project_id}")
    def first_open_step(project_id: str, here: Here) -> RedirectResponse:
        """Lead to the first step that is not done."""
        try:
            folder = here.workspace.open(project_id)
            steps = steps_of(here, folder, folder.load().project, look=False).steps
            step = next((name for name in STEPS if steps[name]["status"] not in SETTLED), STEPS[-1])
        except (InputError, Missing):
            step = STEPS[0]
        return RedirectResponse(f"/p/{quote(project_id, safe='')}/{step}")

    @app.get("/p/{project_id}/{step}")
    def page(project_id: str, step: str, here: Here, request: Request) -> Response:
        """Return the page of a step; people with a wrong address are led to one, which says if there is no project."""
        is_person = "text/html" in request.headers.get("accept", "")
        if step not in STEPS:
            if is_person:
                return RedirectResponse(f"/p/{quote(project_id, safe='')}")
            raise Missing(f"{step}: there is no such page.", path=step)
        try:
            here.workspace.open(project_id)
        except Missing:
            if not is_person:
                raise
            return _page(step, status_code=404)
        return _page(step)


def _page(name: str, *, status_code: int = 200) -> FileResponse:
    file = STATIC / f"{name}.html"
    if not file.is_file():
        raise Missing(f"{name}: there is no such page.", path=name)
    return FileResponse(file, status_code, media_type="text/html", headers={"Cache-Control": "no-cache"})


class _Server(uvicorn.Server):
    """Says where it listens once it does, and ends open event streams when it is asked to stop."""

    def __init__(self, config: uvicorn.Config, hub: Hub, address: str) -> None:
        super().__init__(config)
        self._hub, self._address = hub, address

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            print(self._address, flush=True)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        self._hub.close()
        # What Ctrl-C breaks off is wanted, and no error that would need a traceback.
        logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
        super().handle_exit(sig, frame)


def serve(workspace: Path, host: str = "127.0.0.1", port: int | None = None, *, roots: Sequence[Path] = ()) -> None:
    """Serve the interface over a folder of projects until Ctrl-C; print its address when it is ready.

    Whoever reaches the port can read and change every project, so only this computer can: there are no passwords.

    Args:
        host: a name of this computer's own; anything else is refused.
        port: to listen at; None takes 8000 or the next free one.
        roots: folders whose files may be chosen, besides the workspace, the home folder and mounted drives.

    Raises:
        InputError: the host is not this computer, or the port is taken.
    """
    if host not in LOOPBACK:
        raise InputError(
            f"--host {host}: the interface has no passwords, so it listens on this computer only; from elsewhere use "
            f"`ssh -L {port or DEFAULT_PORT}:127.0.0.1:{port or DEFAULT_PORT} THIS_COMPUTER` and open "
            f"http://127.0.0.1:{port or DEFAULT_PORT}/ there."
        )
    listening = _listen(host, port)
    drives = [Path(drive) for drive in _DRIVES if Path(drive).is_dir()]
    app = create_app(workspace, [*roots, *drives])
    shown = f"[{host}]" if ":" in host else host
    address = f"http://{shown}:{listening.getsockname()[1]}/"
    config = uvicorn.Config(
        app,
        log_level="warning",
        ws_per_message_deflate=False,
        ws_max_size=64 << 20,
        timeout_graceful_shutdown=5,
        server_header=False,
    )
    context: Context = app.state.context
    with contextlib.suppress(KeyboardInterrupt):
        _Server(config, context.hub, address).run(sockets=[listening])


def _listen(host: str, port: int | None) -> socket.socket:
    """Return a listening socket: bound here, so that no other program can take the port in between."""
    wanted = [port] if port is not None else list(range(DEFAULT_PORT, DEFAULT_PORT + _PORTS_TRIED))
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    for number in wanted:
        listening = socket.socket(family, socket.SOCK_STREAM)
        if sys.platform != "win32":  # there it would let two programs share the port
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((host, number))
        except OSError:
            listening.close()
            continue
        listening.listen(256)
        return listening
    taken = f"--port {port}: is taken" if port is not None else f"ports {wanted[0]} to {wanted[-1]} are all taken"
    raise InputError(f"{taken} or not allowed; choose another with --port.")
