"""Problem documents (RFC 9457) for all failures.

A problem document never contains a traceback, a file name or a copy of the input.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any, Final

from fastapi import FastAPI
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from app import errors as serving
from app.api import catalogue
from app.api.catalogue import ProblemType
from scene_client.schemas import Failure, FieldError, Problem
from scene_client.validation import MAX_ERRORS, pointer

MEDIA_TYPE: Final = "application/problem+json"

_logger = logging.getLogger("app.api")

_OF_STATUS: Final = {
    400: catalogue.BAD_REQUEST,
    404: catalogue.NOT_FOUND,
    405: catalogue.METHOD_NOT_ALLOWED,
    413: catalogue.BODY_TOO_LARGE,
}
_OF_ERROR: Final[Mapping[type[serving.ServingError], ProblemType]] = {
    serving.AliasConflictError: catalogue.ALIAS_CONFLICT,
    serving.DeadlinePassedError: catalogue.DEADLINE_PASSED,
    serving.DisconnectedError: catalogue.BAD_REQUEST,
    serving.DrainingError: catalogue.DRAINING,
    serving.ModelUnavailableError: catalogue.MODEL_UNAVAILABLE,
    serving.ModelUnusableError: catalogue.MODEL_UNUSABLE,
    serving.NotReadyError: catalogue.NOT_READY,
    serving.QueueFullError: catalogue.QUEUE_FULL,
    serving.StoreBusyError: catalogue.STORE_BUSY,
    serving.StoreNotWritableError: catalogue.STORE_NOT_WRITABLE,
    serving.UnknownModelError: catalogue.MODEL_NOT_FOUND,
}
_OF_REASON: Final = {
    serving.Reason.INVALID: catalogue.INVALID_REQUEST,
    serving.Reason.UNKNOWN_LABELS: catalogue.UNKNOWN_LABELS,
    serving.Reason.CONTRADICTION: catalogue.CONTRADICTORY_EVIDENCE,
    serving.Reason.ANSWER_TOO_LARGE: catalogue.ANSWER_TOO_LARGE,
}


class ProblemError(HTTPException):
    """A failure with its problem type.

    This class extends `HTTPException`, because Starlette wraps all other exceptions that occur
    while Starlette reads a body.
    """

    def __init__(
        self,
        kind: ProblemType,
        detail: str,
        *,
        errors: Sequence[FieldError] = (),
        failures: Sequence[Failure] = (),
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(kind.status, detail, dict(headers) if headers else None)
        self.kind = kind
        self.errors = list(errors[:MAX_ERRORS])
        self.failures = list(failures)

    def describe(self, request_id: str) -> Problem:
        """Return the problem document that the client receives."""
        return Problem(
            type=self.kind.uri,
            title=self.kind.title,
            status=self.kind.status,
            detail=self.detail,
            instance=f"{self.kind.uri}#{request_id}",
            request_id=request_id,
            errors=self.errors or None,
            failures=self.failures or None,
        )


def from_exception(
    error: Exception, *, at: serving.Location = (), body: Any = None
) -> ProblemError:
    """Return the problem for an exception, or an internal error for an unexpected exception.

    Args:
        error: the raised exception.
        at: location of the scene in the body of a batch request. It is empty for other requests.
        body: the scene as the client sent it, for the pointers of errors; see `pointer`.
    """
    match error:
        case ProblemError():
            return error
        case serving.RequestError():
            kind = _OF_REASON[error.reason]
            errors = [
                FieldError(
                    pointer=pointer(at) + pointer(fault.location, body)[1:],
                    message=fault.message,
                    suggestions=list(fault.suggestions),
                )
                for fault in error.faults[:MAX_ERRORS]
            ]
            return invalid(kind, errors)
        case serving.RefreshRefusedError():
            detail = "The service still serves the previous versions. `failures` gives the reasons."
            return ProblemError(catalogue.REFRESH_REFUSED, detail, failures=error.failures)
        case serving.ServingError():
            return ProblemError(_OF_ERROR[type(error)], str(error))
        case HTTPException() if error.status_code in _OF_STATUS:
            kind, headers = _OF_STATUS[error.status_code], error.headers or {}
            detail = f"{kind.title}."
            if "Allow" in headers:
                detail = f"This route accepts only {headers['Allow']}."
            return ProblemError(kind, detail, headers=headers)
        case _:
            return ProblemError(
                catalogue.INTERNAL_ERROR, "The service failed. Its log contains the error."
            )


def invalid(kind: ProblemType, errors: list[FieldError]) -> ProblemError:
    """Return the problem for a request with these errors. Only `MAX_ERRORS` errors are listed."""
    count = len(errors)
    most = "at least " * (count >= MAX_ERRORS)
    detail = f"The request has {most}{count} error{'' if count == 1 else 's'}, listed in `errors`."
    if kind is catalogue.UNKNOWN_LABELS:
        detail += (
            " GET /models/{name}/vocabulary lists the known names. With `unknown_labels` set to "
            "`ignore`, the service leaves unknown names out."
        )
    return ProblemError(kind, detail, errors=errors)


def report_defect(error: Exception, request_id: str) -> None:
    """Log an internal error. The client receives only the problem type, without details."""
    _logger.error("request failed", exc_info=error, extra={"request_id": request_id})


def respond(request: Request, problem: ProblemError) -> Response:
    """Return a response with the problem. Store the problem's slug in the request's record."""
    state = request.scope.get("state", {})
    if (record := state.get("record")) is not None:
        record.outcome = problem.kind.slug
    headers = dict(problem.headers or {})
    if problem.status_code in (429, 503):
        headers["Retry-After"] = str(request.app.state.settings.retry_after)
    return Response(
        problem.describe(state.get("request_id", "")).model_dump_json(exclude_none=True),
        problem.status_code,
        headers=headers,
        media_type=MEDIA_TYPE,
    )


async def answer(problem: ProblemError, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a request with a problem."""
    await respond(Request(scope), problem)(scope, receive, send)


async def _handle(request: Request, error: Exception) -> Response:
    problem = from_exception(error)
    if problem is not error and problem.kind is catalogue.NOT_FOUND:
        path = request.scope["path"][:64].lower()
        similar = get_close_matches(path, request.app.state.paths)
        if similar:
            problem.detail += f" Similar paths: {', '.join(similar)}."
    return respond(request, problem)


def install(app: FastAPI) -> None:
    """Replace the exception handlers of FastAPI by handlers that answer with problems.

    `app.api.gateway.Gateway` answers unexpected exceptions. FastAPI would answer an unexpected
    exception and then raise the exception again. The server would then close the connection.
    """
    for kind in (HTTPException, serving.ServingError):
        app.add_exception_handler(kind, _handle)
