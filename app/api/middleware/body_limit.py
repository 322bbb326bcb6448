"""How large a body may be, and how slow."""

from __future__ import annotations

import asyncio

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api import catalogue
from app.api.problems import ProblemError, respond


class BodyLimit:
    """Refuses bodies over ``limit`` bytes, and those that take longer than ``patience`` seconds.

    By Content-Length at once, chunked ones as they come.
    """

    def __init__(self, app: ASGIApp, *, limit: int, patience: float) -> None:
        self.app = app
        self.limit = limit
        self.patience = patience

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
            received += len(message.get("body", b""))
            if received > self.limit:
                raise self._too_large()
            complete = not message.get("more_body", False)
            return message

        await self.app(scope, receive_within_limits, send)

    def _too_large(self) -> ProblemError:
        return ProblemError(
            catalogue.BODY_TOO_LARGE, f"The body must not be larger than {self.limit} bytes."
        )

    def _too_slow(self) -> ProblemError:
        return ProblemError(
            catalogue.REQUEST_TIMEOUT,
            f"The body did not come within {self.patience:g} seconds.",
            headers={"Connection": "close"},
        )
