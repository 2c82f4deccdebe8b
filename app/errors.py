"""What can go wrong in a request, and the one JSON shape in which the browser hears of it."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from core.errors import DISK_FULL, OBSTRUCTED, Cancelled, InputError, disk_problem

FORBIDDEN = (errno.EROFS, errno.EACCES, errno.EPERM)


class ApiError(Exception):
    """A request that cannot be answered, with the sentence a person reads."""

    status = 500
    kind = "internal"

    def __init__(self, message: str, *, path: str | None = None, **more: Any) -> None:
        super().__init__(message)
        self.message = message
        self.path = path
        self.more = more


class Invalid(ApiError):
    """What was sent cannot be used."""

    status, kind = 422, "input"


class Refused(ApiError):
    """A place outside the allowed folders, or a request from another site."""

    status, kind = 403, "input"


class Missing(ApiError):
    """There is no such thing, or not yet."""

    status, kind = 404, "missing"


class NotYet(ApiError):
    """An earlier step has to be done first."""

    status, kind = 409, "missing"


class Conflict(ApiError):
    """An edit of a state that is no longer the newest one."""

    status, kind = 409, "conflict"


class Busy(ApiError):
    """Another job of this project is running."""

    status, kind = 423, "busy"


def error_body(message: str, *, kind: str, path: str | None = None, **more: Any) -> dict[str, Any]:
    """Return the body of every error answer: `{"error": {"message", "path", "kind"}}` and what belongs to it."""
    return {"error": {"message": message, "path": path, "kind": kind}, **more}


def error_response(error: ApiError) -> JSONResponse:
    """Return an error as the browser gets it."""
    body = error_body(error.message, kind=error.kind, path=error.path, **error.more)
    return JSONResponse(body, status_code=error.status)


def install_error_handlers(app: FastAPI) -> None:
    """Give every exception a route can raise the one JSON shape."""

    @app.exception_handler(ApiError)
    def _api(request: Request, error: ApiError) -> JSONResponse:
        return error_response(error)

    @app.exception_handler(InputError)
    def _input(request: Request, error: InputError) -> JSONResponse:
        return error_response(Invalid(str(error)))

    @app.exception_handler(Cancelled)
    def _cancelled(request: Request, error: Cancelled) -> JSONResponse:
        return error_response(Conflict("The work was cancelled; start it again to go on."))

    @app.exception_handler(RequestValidationError)
    def _request(request: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        path = _place(first)
        return error_response(Invalid(f"{path}: {_reason(first)}.", path=path))

    @app.exception_handler(HTTPException)
    def _http(request: Request, error: HTTPException) -> JSONResponse:
        kinds = {404: "missing", 405: "missing", 409: "conflict", 423: "busy"}
        kind = kinds.get(error.status_code, "input" if error.status_code < 500 else "internal")
        message = f"{request.url.path}: {str(error.detail).lower()}."
        return JSONResponse(error_body(message, kind=kind), status_code=error.status_code, headers=error.headers)

    @app.exception_handler(OSError)
    def _disk(request: Request, error: OSError) -> JSONResponse:
        if error.errno in DISK_FULL:
            words = "The disk is full, so nothing was written; make room, then do it again."
        elif error.errno in FORBIDDEN:
            name = Path(str(error.filename or "the project's folder")).name
            words = f"The computer does not allow writing to {name}, or reading it; allow it, then do it again."
        elif error.errno in OBSTRUCTED:
            words = disk_problem(error)
        else:
            raise error
        return JSONResponse(error_body(words, kind="disk"), status_code=507)

    @app.exception_handler(Exception)
    def _unexpected(request: Request, error: Exception) -> JSONResponse:
        message = f"Rooftrack itself failed ({type(error).__name__}); its terminal tells more."
        return JSONResponse(error_body(message, kind="internal"), status_code=500)


def _place(error: Mapping[str, Any]) -> str:
    parts = [str(part) for part in error["loc"] if part not in ("body", "query", "path")]
    return ".".join(parts) or str(error["loc"][0])


def _reason(error: Mapping[str, Any]) -> str:
    message = str(error["msg"]).removeprefix("Value error, ").rstrip(".")
    return message[:1].lower() + message[1:]
