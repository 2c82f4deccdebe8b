"""Who may talk to the server: this computer's browser, on pages this server served, and nobody else.

A web page from elsewhere can send requests to 127.0.0.1. So the host must be a loopback name (against rebinding of
names), a request that changes something must come from our own origin and carry a header that no form can send, and
pages may load nothing but what this server has.
"""

from __future__ import annotations

from urllib.parse import SplitResult, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.errors import Refused, error_response

LOOPBACK = ("127.0.0.1", "localhost", "::1")
HEADER = "X-Rooftrack"
SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; font-src 'self'; "
    "connect-src 'self'; frame-src 'self'; worker-src 'self' blob:; form-action 'none'; base-uri 'none'; "
    "frame-ancestors 'self'"
)


class Guard:
    """ASGI middleware that holds the rules above for every request."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request, or pass it on and add the headers that hold the browser to the rules."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        refusal = _refusal(scope, headers)
        if refusal is not None and scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008})
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                _protect(MutableHeaders(scope=message))
            await send(message)

        if refusal is not None:
            await error_response(refusal)(scope, receive, send_guarded)
            return
        await self._app(scope, receive, send_guarded)


def same_origin(headers: Headers) -> bool:
    """Whether the request says it comes from a page of this very server."""
    origin = headers.get("origin")
    return origin is not None and _parts(origin).netloc == headers.get("host")


def host_name(host: str) -> str:
    """Return the name in a Host header, without its port."""
    return _parts(f"//{host}").hostname or ""


def _parts(address: str) -> SplitResult:
    """Return the parts of an address; all of them empty where it is none."""
    try:
        return urlsplit(address)
    except ValueError:
        return urlsplit("")


def _refusal(scope: Scope, headers: Headers) -> Refused | None:
    host = headers.get("host", "")
    if host_name(host) not in LOOPBACK:
        return Refused(f"{host}: is not this computer; open Rooftrack at 127.0.0.1.", path="Host")
    if scope["type"] == "websocket":
        return None if same_origin(headers) else Refused("The page that asks is not Rooftrack's.", path="Origin")
    if scope["method"] in SAFE_METHODS:
        return None
    if headers.get("origin") is not None and not same_origin(headers):
        return Refused("The page that asks is not Rooftrack's; nothing was changed.", path="Origin")
    if headers.get(HEADER) != "1":
        return Refused(f"The header {HEADER}: 1 is missing; nothing was changed.", path=HEADER)
    return None


def _protect(headers: MutableHeaders) -> None:
    headers.setdefault("Content-Security-Policy", PAGE_POLICY)
    headers.setdefault("X-Content-Type-Options", "nosniff")
    headers.setdefault("Referrer-Policy", "no-referrer")
    headers.setdefault("Cross-Origin-Resource-Policy", "same-origin")
    headers.setdefault("Cross-Origin-Opener-Policy", "same-origin")
    headers.setdefault("X-Frame-Options", "SAMEORIGIN")
