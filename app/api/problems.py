"""Problem documents (RFC 9457) for all failures.

A problem document never contains a traceback, a file name or a copy of the input.
"""

import logging
from difflib import get_close_matches
from typing import Final

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from app.errors import ERRORS, BodiesFullError, InternalError, NotFoundError, ServiceError

MEDIA_TYPE: Final = "application/problem+json"

_logger = logging.getLogger("app.api")

# RFC 9110 requires the first header (section 11.6.1) and recommends the second (section 15.5.9).
_HEADERS: Final = {401: {"WWW-Authenticate": "Bearer"}, 408: {"Connection": "close"}}
_OF_STATUS: Final = {kind.status: kind for kind in ERRORS.values() if "http" in kind.steps}


def from_exception(error: Exception, request_id: str) -> ServiceError:
    """Return the error of the service for any exception. Log an unexpected one: it is a defect."""
    if isinstance(error, ServiceError):
        return error
    if isinstance(error, MemoryError):
        _logger.error("not enough memory for a request")
        return BodiesFullError("The service has not enough memory for this request now.")
    if isinstance(error, HTTPException) and error.status_code in _OF_STATUS:
        headers = error.headers or {}
        detail = f"This route accepts only {headers['Allow']}." if "Allow" in headers else ""
        return _OF_STATUS[error.status_code](detail, headers=headers)
    _logger.error("request failed", exc_info=error, extra={"entry": {"request_id": request_id}})
    return InternalError("The service failed. Its log contains the error.")


def _respond(request: Request, error: ServiceError) -> Response:
    """Return a response with the problem. Store the slug of the error in the request's record."""
    state = request.scope["state"]
    state["record"].outcome = error.slug
    headers = {**(error.headers or {}), **_HEADERS.get(error.status, {})}
    if error.status in (429, 503):
        headers["Retry-After"] = str(request.app.state.settings.retry_after)
    return Response(
        error.describe(state["request_id"]).model_dump_json(exclude_none=True),
        error.status,
        headers=headers,
        media_type=MEDIA_TYPE,
    )


async def answer(error: ServiceError, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a request with a problem."""
    await _respond(Request(scope), error)(scope, receive, send)


async def handle(request: Request, error: Exception) -> Response:
    """Answer an exception of Starlette with a problem. The gateway answers all other exceptions."""
    problem = from_exception(error, request.scope["state"]["request_id"])
    if problem is not error and isinstance(problem, NotFoundError):
        path, paths = request.scope["path"][:64].lower(), request.app.state.paths
        if similar := get_close_matches(path, paths):
            problem.detail += f" Similar paths: {', '.join(similar)}."
        if any(path.endswith(route) for route in paths if len(route) > 1):
            problem.detail += (
                " If a proxy adds a prefix to paths, the proxy must strip it, and SCENE_ROOT_PATH "
                "must name it."
            )
    return _respond(request, problem)
