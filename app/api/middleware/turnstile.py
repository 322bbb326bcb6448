"""Which requests are read when: so many in one tick of the event loop, and until their deadline.

Reading and answering a request takes a fraction of a millisecond, and so does refusing it. Were
hundreds that arrive at once all begun or refused at once, the event loop would be away for a tenth
of a second: every answer as late as the last, and health checks with them. So a few are begun in
each tick, in the order of their arrival, and no more than the models keep up with; health checks
pass by. What is too much is refused before any of it has been read, a few in each tick: when the
line is full, and when it moves so slowly that a request would spend much of its time in it. What
waited longer than its deadline is refused too.
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
"""Requests begun in one tick, less those begun before whose work is still to be done."""

REFUSALS: Final = 8
"""Requests refused in one tick."""

TIMEOUT_HEADER: Final = "X-Request-Timeout-Ms"

_TIMEOUT: Final = re.compile(r"[1-9][0-9]{0,5}")
# Seconds between two looks at whether the models have caught up.
_PAUSE: Final = 5e-3
# Of its time, what a request may expect to spend in the line: a pace that drops to a third must not
# make those late who stand in it already.
_PATIENCE: Final = 0.25
# Share of the newest measurement in the pace at which the line moves.
_NEWEST: Final = 0.1

# When somebody joined it, and who.
_Line = deque[tuple[float, asyncio.Future[None]]]

# By their ends, whatever prefix a proxy has left on; a path that only ends so is no route.
_PASSING: Final = ("/health/live", "/health/ready", "/metrics")


class Turnstile:
    """Plain ASGI middleware, which also says when the deadline of a request is.

    Args:
        limit: most requests that wait.
        timeout: seconds that a request has that sends no header of its own.
        longest_ms: most milliseconds that a header may ask for.
        backlog: how many of those begun are still worked for.
        is_draining: whether nothing new is to be begun.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        limit: int,
        timeout: float,
        longest_ms: int,
        backlog: Callable[[], int] = lambda: 0,
        is_draining: Callable[[], bool] = lambda: False,
    ) -> None:
        self.app = app
        self.limit = limit
        self.timeout = timeout
        self.longest_ms = longest_ms
        self.backlog = backlog
        self.is_draining = is_draining
        self._ticking = False
        self._places = 0
        self._interval = 0.0
        self._moved_at: float | None = None
        self._waiting: _Line = deque()
        self._too_many: _Line = deque()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http" or scope["path"].endswith(_PASSING):
            await self.app(scope, receive, send)
            return
        try:
            if self.is_draining():
                detail = "The service finishes what it has begun, and then ends."
                # Without the header a client would send its next request here as well.
                raise ProblemError(catalogue.DRAINING, detail, headers={"Connection": "close"})
            allowed = self._timeout(scope)
            deadline = monotonic() + allowed
            scope.setdefault("state", {})["deadline"] = deadline
            await self._turn(allowed, deadline)
        except ProblemError as problem:
            await respond(Request(scope), problem)(scope, receive, send)
            return
        await self.app(scope, receive, send)

    def _timeout(self, scope: Scope) -> float:
        given = Headers(scope=scope).get(TIMEOUT_HEADER)
        if given is None:
            return self.timeout
        if not _TIMEOUT.fullmatch(given) or int(given) > self.longest_ms:
            raise ProblemError(
                catalogue.BAD_REQUEST,
                f"{TIMEOUT_HEADER} must be a whole number, from 1 to "
                f"{self.longest_ms} milliseconds.",
            )
        return int(given) / 1e3

    async def _turn(self, allowed: float, deadline: float) -> None:
        """Wait until the request may begin."""
        if not self._ticking:
            self._begin_tick()
        if self._is_full(allowed):
            count = len(self._waiting)
            await _wait(self._too_many)
            raise ProblemError(catalogue.QUEUE_FULL, f"{count} requests wait already.")
        if self._waiting or not self._places:
            await _wait(self._waiting)
            if monotonic() >= deadline:
                detail = "The deadline passed before the request was read."
                raise ProblemError(catalogue.DEADLINE_PASSED, detail)
        else:
            self._places -= 1

    def _is_full(self, allowed: float) -> bool:
        if not self._waiting:
            return False
        # What the first has waited is about what the last will have to, once the line is long.
        wait = max(monotonic() - self._waiting[0][0], len(self._waiting) * self._interval)
        return len(self._waiting) >= self.limit or wait > _PATIENCE * allowed

    def _begin_tick(self) -> None:
        self._places = max(0, PACE - self.backlog())
        begun = _let_go(self._waiting, self._places)
        self._places -= begun
        self._learn(begun)
        _let_go(self._too_many, REFUSALS)
        loop = asyncio.get_running_loop()
        # One more after the last: whoever comes in this tick is counted in it.
        if begun or not self._ticking:
            self._ticking = True
            loop.call_soon(self._begin_tick)
        elif self._waiting or self._too_many:
            # The models are behind: looking all the time would only hold them up.
            loop.call_later(_PAUSE, self._begin_tick)
        else:
            self._ticking = False

    def _learn(self, begun: int) -> None:
        """How long the line takes to move on by one, as far as there is one."""
        now = monotonic()
        if begun and self._moved_at is not None:
            self._interval += _NEWEST * ((now - self._moved_at) / begun - self._interval)
        if begun or not self._waiting:
            self._moved_at = now if self._waiting else None


async def _wait(line: _Line) -> None:
    turn = asyncio.get_running_loop().create_future()
    line.append((monotonic(), turn))
    await turn


def _let_go(line: _Line, most: int) -> int:
    """Let the first of a line go on; how many there were that had not gone by themselves."""
    count = 0
    while line and count < most:
        _, turn = line.popleft()
        if not turn.done():
            turn.set_result(None)
            count += 1
    return count
