"""What routes are given: the runtime, and the view of it that one request keeps."""

from __future__ import annotations

from typing import Annotated, cast

from fastapi import Depends
from starlette.requests import Request

from app.api import catalogue
from app.api.middleware.turnstile import TIMEOUT_HEADER
from app.api.problems import ProblemError
from app.serving.queue import Ticket
from app.serving.runtime import Runtime
from app.serving.session import Session

# All of these are coroutines: the framework runs plain functions in a thread, at 100 µs a hop.


async def _runtime(request: Request) -> Runtime:
    return cast("Runtime", request.app.state.runtime)


async def _request_id(request: Request) -> str:
    return cast("str", request.state.request_id)


async def _session(request: Request) -> Session:
    state = request.state
    ticket = Ticket(state.deadline, request.is_disconnected)
    return (await _runtime(request)).session(state.request_id, ticket, state.record)


async def limit_deadline(request: Request) -> None:
    """Refuse a request whose deadline is later than the operator allows.

    Raises:
        ProblemError: of kind `catalogue.BAD_REQUEST`.
    """
    most = request.app.state.settings.max_request_timeout_ms
    # The middleware has checked that it is a number, and gives health checks no deadline.
    has_deadline = hasattr(request.state, "deadline")
    if has_deadline and int(request.headers.get(TIMEOUT_HEADER, 1)) > most:
        raise ProblemError(
            catalogue.BAD_REQUEST, f"{TIMEOUT_HEADER} must not be above {most} milliseconds."
        )


RuntimeDep = Annotated[Runtime, Depends(_runtime)]
SessionDep = Annotated[Session, Depends(_session)]
RequestId = Annotated[str, Depends(_request_id)]
