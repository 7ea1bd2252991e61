"""Errors of the HTTP API as RFC 9457 problem documents."""

import logging
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from fleetmap import errors

_log = logging.getLogger(__name__)

_STATUS: tuple[tuple[type[errors.FleetmapError], HTTPStatus], ...] = (
    (errors.ChangedError, HTTPStatus.PRECONDITION_FAILED),
    (errors.StateError, HTTPStatus.CONFLICT),
    (errors.ForbiddenError, HTTPStatus.FORBIDDEN),
    (errors.InvalidValueError, HTTPStatus.UNPROCESSABLE_ENTITY),
    (errors.UsageError, HTTPStatus.NOT_FOUND),  # the path names an unknown site or version
    (errors.GateRefusedError, HTTPStatus.CONFLICT),
    (errors.StoreError, HTTPStatus.SERVICE_UNAVAILABLE),
    (errors.MapFormatError, HTTPStatus.INTERNAL_SERVER_ERROR),  # damaged bytes in the server's own store
)


_CONTENT = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
PROBLEM_RESPONSES: dict[int | str, dict[str, Any]] = {
    "4XX": {"description": "The request is invalid or not allowed, or its target does not exist.", "content": _CONTENT},
    "5XX": {"description": "The store cannot be read or written; see the server's log.", "content": _CONTENT},
}
"""Error responses of every endpoint, for the OpenAPI document."""


def problem(status: int, detail: str, path: str, headers: dict[str, str] | None = None) -> JSONResponse:
    """Return a problem document; its type is about:blank, so its title is the status's phrase."""
    kind = {"type": "about:blank", "title": HTTPStatus(status).phrase, "status": status}
    content = kind | {"detail": detail, "instance": path}
    return JSONResponse(content, status, headers=headers, media_type="application/problem+json")


def install(app: FastAPI) -> None:
    """Make every error of `app` a problem document."""
    for kind in (errors.FleetmapError, HTTPException, RequestValidationError, Exception):
        app.add_exception_handler(kind, _answer)


def _answer(request: Request, error: Exception) -> Response:
    """Return the problem document of an error; what is no fault of the request is logged."""
    path = request.url.path
    if isinstance(error, HTTPException):
        return problem(error.status_code, str(error.detail), path, dict(error.headers or {}))
    if isinstance(error, RequestValidationError):
        faults = (f"{'.'.join(str(part) for part in fault['loc'])}: {fault['msg']}" for fault in error.errors())
        return problem(HTTPStatus.UNPROCESSABLE_ENTITY, "; ".join(faults), path)
    if isinstance(error, errors.FleetmapError):
        status = next((status for kind, status in _STATUS if isinstance(error, kind)), HTTPStatus.INTERNAL_SERVER_ERROR)
        if status >= HTTPStatus.INTERNAL_SERVER_ERROR:
            _log.error("%s %r: %s", request.method, path, error)
        return problem(status, str(error), path)
    _log.error("%s %r failed", request.method, path, exc_info=error)
    return problem(HTTPStatus.INTERNAL_SERVER_ERROR, "an internal error; see the server's log", path)
