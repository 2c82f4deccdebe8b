"""The viser client and its WebSocket, relayed on our own port so that our own rules hold (see `app.scene3d`)."""

from __future__ import annotations

import asyncio
import contextlib

from fastapi import APIRouter, Request, WebSocket
from fastapi.responses import FileResponse, RedirectResponse, Response
from starlette.websockets import WebSocketState
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from app.context import Context
from app.guards import same_origin
from app.scene3d import CLIENT_FILE, TOKEN_HEADER

router = APIRouter()

_CLIENT = "/viser/?hideViserLogo"
# With these a link could point the client at another server, whose messages may run JavaScript on our origin.
_STRIPPED = {"websocket", "playbackpath"}


@router.get("/viser")
def without_slash() -> RedirectResponse:
    """Lead to the client."""
    return RedirectResponse(_CLIENT)


@router.get("/viser/")
def client(request: Request) -> Response:
    """Return viser's client: one file, which may talk to this server only."""
    if _STRIPPED & {name.lower() for name in request.query_params}:
        return RedirectResponse(_CLIENT)
    # Without 'unsafe-eval', so that no message becomes script. One module of the client, which sorts Gaussian splats,
    # wants to build functions from text, is refused, and says so on the console; nothing that we show needs it.
    policy = (
        "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob: data:; worker-src blob:; "
        "style-src 'unsafe-inline'; img-src blob: data:; font-src data:; base-uri 'none'; form-action 'none'; "
        f"frame-ancestors 'self'; connect-src ws://{request.headers['host']} blob: data:"
    )
    headers = {"Content-Security-Policy": policy, "Cache-Control": "private, no-cache"}
    return FileResponse(CLIENT_FILE, media_type="text/html", headers=headers)


@router.websocket("/viser")
async def relay(socket: WebSocket) -> None:
    """Relay between the client and viser; the client leaves out the trailing slash."""
    context: Context = socket.app.state.context
    protocols = [name for name in socket.scope.get("subprotocols", []) if name.startswith("viser-v")]
    if not same_origin(socket.headers) or not protocols:
        await socket.close(1008)
        return
    port = await asyncio.to_thread(lambda: context.scene.port)
    async with connect(
        f"ws://127.0.0.1:{port}",
        subprotocols=protocols[:1],
        compression=None,
        max_size=None,
        additional_headers={TOKEN_HEADER: context.scene.token},
        proxy=None,
    ) as viser:
        await socket.accept(subprotocol=viser.subprotocol)
        directions = [asyncio.create_task(_down(viser, socket)), asyncio.create_task(_up(socket, viser))]
        try:
            await asyncio.wait(directions, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in directions:
                task.cancel()
            await asyncio.gather(*directions, return_exceptions=True)
    if socket.application_state is WebSocketState.CONNECTED and socket.client_state is WebSocketState.CONNECTED:
        with contextlib.suppress(RuntimeError):
            await socket.close()


async def _down(viser: ClientConnection, socket: WebSocket) -> None:
    with contextlib.suppress(ConnectionClosed):
        async for data in viser:
            await (socket.send_bytes(data) if isinstance(data, bytes) else socket.send_text(data))


async def _up(socket: WebSocket, viser: ClientConnection) -> None:
    while True:
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            return
        content = message.get("bytes")
        await viser.send(content if content is not None else message["text"])
