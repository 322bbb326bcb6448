"""What routes are given: the runtime, and the view of it that one request keeps."""

from __future__ import annotations

from typing import Annotated, cast

from fastapi import Depends
from starlette.requests import Request

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


RuntimeDep = Annotated[Runtime, Depends(_runtime)]
SessionDep = Annotated[Session, Depends(_session)]
RequestId = Annotated[str, Depends(_request_id)]
