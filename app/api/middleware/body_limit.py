"""How large a body may be, how slow, and how much all bodies together."""

from __future__ import annotations

import asyncio
from typing import Final

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api import catalogue
from app.api.problems import ProblemError, respond

SMALL: Final = 64 * 1024
"""Bytes of a body that is accepted whatever else is held, if it has arrived when it is read.

Unfinished bodies of one client do not refuse the usual requests of the others.
"""


class BodyLimit:
    """Bounds the size of each body, its time, and the bytes of all bodies held at once.

    Declared sizes are judged at once, chunked bodies as they arrive. A body is held until its
    request is answered.

    Args:
        app: the application.
        limit: bytes of one body.
        budget: bytes of all bodies.
        patience: seconds in which a body must arrive.
    """

    def __init__(self, app: ASGIApp, *, limit: int, budget: int, patience: float) -> None:
        self.app = app
        self.limit = limit
        self.budget = budget
        self.patience = patience
        self.held = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        declared = Headers(scope=scope).get("content-length", "")
        # Servers have checked that it is a number; len() guards int() where one has not.
        if declared.isdecimal() and (len(declared) > 18 or int(declared) > self.limit):
            await respond(Request(scope), self._too_large())(scope, receive, send)
            return
        received = 0
        deadline = asyncio.get_running_loop().time() + self.patience
        complete = False

        async def receive_within_limits() -> Message:
            nonlocal received, complete
            if complete:
                # Whoever waits now waits for the client to leave, which may take any time.
                return await receive()
            try:
                async with asyncio.timeout_at(deadline):
                    message = await receive()
            except TimeoutError:
                raise self._too_slow() from None
            size = len(message.get("body", b""))
            received += size
            self.held += size
            complete = not message.get("more_body", False)
            if received > self.limit:
                raise self._too_large()
            if self.held > self.budget and not (complete and received == size <= SMALL):
                raise self._too_many()
            return message

        try:
            await self.app(scope, receive_within_limits, send)
        finally:
            self.held -= received

    def _too_large(self) -> ProblemError:
        return ProblemError(
            catalogue.BODY_TOO_LARGE, f"The body must not be larger than {self.limit} bytes."
        )

    def _too_many(self) -> ProblemError:
        return ProblemError(
            catalogue.BODIES_FULL, f"All bodies together must not exceed {self.budget} bytes."
        )

    def _too_slow(self) -> ProblemError:
        return ProblemError(
            catalogue.REQUEST_TIMEOUT,
            f"The body did not come within {self.patience:g} seconds.",
            headers={"Connection": "close"},
        )
