"""Which requests are read when: so many in one tick of the event loop, and until their deadline.

Reading and answering a request takes a fraction of a millisecond. Were hundreds that arrive at once
all begun at once, the event loop would be away for a tenth of a second: every answer as late as
the last, and health checks with them. So a few are begun in each tick, in the order of their
arrival; health checks pass by; what is too much is refused before any of it has been read, and
what waited longer than its deadline too.
"""

from __future__ import annotations

import asyncio
import re
from collections import deque
from collections.abc import Callable
from time import monotonic
from typing import Final

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from app.api import catalogue
from app.api.problems import ProblemError, respond

PACE: Final = 32
"""Requests begun in one tick."""

TIMEOUT_HEADER: Final = "X-Request-Timeout-Ms"
MAX_TIMEOUT_MS: Final = 600_000

_TIMEOUT: Final = re.compile(r"[1-9][0-9]{0,5}")
# By their ends, whatever prefix a proxy has left on; a path that only ends so is no route.
_PASSING: Final = ("/health/live", "/health/ready", "/metrics")


class Turnstile:
    """Plain ASGI middleware, which also says when the deadline of a request is.

    Args:
        limit: most requests that wait.
        timeout: seconds that a request has that sends no header of its own.
        is_draining: whether nothing new is to be begun.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        limit: int,
        timeout: float,
        is_draining: Callable[[], bool] = lambda: False,
    ) -> None:
        self.app = app
        self.limit = limit
        self.timeout = timeout
        self.is_draining = is_draining
        self._begun = 0
        self._waiting: deque[asyncio.Future[None]] = deque()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http" or scope["path"].endswith(_PASSING):
            await self.app(scope, receive, send)
            return
        try:
            self._check()
            deadline = monotonic() + self._timeout(scope)
            scope.setdefault("state", {})["deadline"] = deadline
            if not self._begin():
                turn = asyncio.get_running_loop().create_future()
                self._waiting.append(turn)
                await turn
                if monotonic() >= deadline:
                    detail = "The deadline passed before the request was read."
                    raise ProblemError(catalogue.DEADLINE_PASSED, detail)
        except ProblemError as problem:
            await respond(Request(scope), problem)(scope, receive, send)
            return
        await self.app(scope, receive, send)

    def _check(self) -> None:
        if self.is_draining():
            detail = "The service finishes what it has begun, and then ends."
            # Without the header a client would send its next request here as well.
            raise ProblemError(catalogue.DRAINING, detail, headers={"Connection": "close"})
        if len(self._waiting) >= self.limit:
            raise ProblemError(catalogue.QUEUE_FULL, f"{self.limit} requests wait already.")

    def _timeout(self, scope: Scope) -> float:
        given = Headers(scope=scope).get(TIMEOUT_HEADER)
        if given is None:
            return self.timeout
        if not _TIMEOUT.fullmatch(given) or int(given) > MAX_TIMEOUT_MS:
            raise ProblemError(
                catalogue.BAD_REQUEST,
                f"{TIMEOUT_HEADER} must be a whole number of milliseconds from 1 to "
                f"{MAX_TIMEOUT_MS}.",
            )
        return int(given) / 1e3

    def _begin(self) -> bool:
        """Whether a request may begin in this tick."""
        if self._waiting or self._begun >= PACE:
            return False
        if not self._begun:
            asyncio.get_running_loop().call_soon(self._next_tick)
        self._begun += 1
        return True

    def _next_tick(self) -> None:
        self._begun = 0
        while self._waiting and self._begun < PACE:
            turn = self._waiting.popleft()
            if not turn.done():
                turn.set_result(None)
                self._begun += 1
        if self._begun:
            asyncio.get_running_loop().call_soon(self._next_tick)
