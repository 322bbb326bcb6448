"""The work of one model: a queue drained once per tick of the event loop, bounded in rows.

What arrives within one tick is computed in the next, each job by itself, so an answer never depends
on what it waited beside. Cheap jobs run where they stand: a hop to a thread costs as much as most
of them. A job that is expected to take longer than `CHEAP`, or whose like was never measured, goes
to the worker thread of its model, where compiled loops let the event loop go on.
The system shares the processors fairly among these threads: no model waits for the costly work of
another. Drawings, which may take seconds, have a thread of their own: nobody who asks about a scene
waits for them.

Questions of streams give way to those of requests: a stream has an answer under way all the time,
and what it says next is about the newest state anyway.

A job whose deadline has passed, or whose client has gone, is dropped when its turn comes.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import asynccontextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from time import monotonic, thread_time
from typing import Any, Final, Generic, TypeVar
from weakref import WeakSet

from app.serving.errors import DeadlinePassedError, DisconnectedError, QueueFullError

T = TypeVar("T")

CHEAP: Final = 1e-3
"""Seconds that a job may hold up the event loop."""

# Seconds between two looks at whether anybody still waits for costly work.
_LOOK: Final = 0.25
# So long a tick computes before others get their turn: health checks, and requests to be read.
_TICK: Final = 2e-3
# So many kinds and orders of size are remembered.
_MAX_COSTS: Final = 4096
# Share of the newest measurement in the expected cost.
_NEWEST: Final = 0.2


# Whatever is made for every request is not frozen: that would take three times as long.
@dataclass(slots=True)
class Ticket:
    """What a request may take, made once and never changed.

    Attributes:
        deadline: by `time.monotonic`; work that has not begun by then is dropped.
        is_gone: whether the client has left; asked before costly work.
    """

    deadline: float
    is_gone: Callable[[], Awaitable[bool]] | None = None

    def check(self) -> None:
        """Return if there is time left.

        Raises:
            DeadlinePassedError: there is none.
        """
        if monotonic() >= self.deadline:
            raise DeadlinePassedError("The deadline passed before the answer was begun.")

    async def check_there(self) -> None:
        """Return if the client still waits.

        Raises:
            DisconnectedError: it does not.
        """
        if self.is_gone is not None and await self.is_gone():
            raise DisconnectedError("The client has gone.")


@dataclass(slots=True)
class Done(Generic[T]):
    """A job that has been done.

    Attributes:
        waited, computed: seconds before it was begun, and that it took.
        processor: seconds that it kept a processor busy: `computed` without waiting for other
            processes and, in a worker thread, for the interpreter.
    """

    result: T
    waited: float
    computed: float
    processor: float


def _one_thread(name: str) -> Executor:
    return ThreadPoolExecutor(1, thread_name_prefix=name)


@dataclass(slots=True, eq=False)
class _Job:
    call: Callable[[], Done[Any]]
    ticket: Ticket
    future: asyncio.Future[Any]


class _Costs:
    """Seconds that questions took so far, per unit of size, by kind and order of size.

    Small scenes cost more a unit than large ones, and must not make these look costly.
    """

    def __init__(self) -> None:
        self._per_unit: dict[tuple[str, int], float] = {}

    def expected(self, kind: str, size: int) -> float:
        """Seconds; infinite where none of this kind and order has been measured."""
        return self._per_unit.get((kind, size.bit_length()), math.inf) * size

    def learn(self, kind: str, size: int, seconds: float) -> None:
        if len(self._per_unit) >= _MAX_COSTS:
            self._per_unit.clear()  # clients choose the kinds; all are soon measured again
        key, measured = (kind, size.bit_length()), seconds / size
        known = self._per_unit.get(key, measured)
        # One that was held up by something else must not send its like to the thread.
        self._per_unit[key] = known + _NEWEST * (min(measured, 2 * known) - known)


@dataclass(frozen=True, slots=True)
class Threads:
    """The worker threads of a process.

    Attributes:
        drawing: for drawings, shared by all models.
    """

    drawing: Executor = field(default_factory=partial(_one_thread, "drawing"))
    _costly: WeakSet[Executor] = field(default_factory=WeakSet)

    def for_model(self) -> Executor:
        """A thread for the costly questions to one model; it ends when nothing refers to it."""
        executor = _one_thread("costly work")
        self._costly.add(executor)
        return executor

    def stop(self) -> None:
        """Let go of them; what they have not begun is dropped."""
        for executor in (self.drawing, *self._costly):
            executor.shutdown(wait=False, cancel_futures=True)


@dataclass(eq=False)
class WorkQueue:
    """Jobs of one model.

    Attributes:
        limit: most rows (scenes, or drawn scenes) that may wait or be under way.
        threads: for work that is not cheap.
        rows: how many there are now.
        backlog: how many questions of requests wait or are under way; drawings and streams are not
            counted.
    """

    limit: int
    threads: Threads
    rows: int = 0
    backlog: int = 0
    _waiting: deque[_Job] = field(default_factory=deque)
    _giving_way: deque[_Job] = field(default_factory=deque)
    _draining: bool = False
    _costs: _Costs = field(default_factory=_Costs)
    _costly: Executor = field(init=False)
    # Of those that give way, one is in the thread at a time: all others wait for one at most.
    _turn: asyncio.Lock = field(default_factory=asyncio.Lock)

    def __post_init__(self) -> None:
        self._costly = self.threads.for_model()

    def take(self, rows: int) -> None:
        """Take room for so many rows, until they are given back.

        Raises:
            QueueFullError: there is not enough.
        """
        if self.rows + rows > self.limit:
            raise QueueFullError(f"{self.rows} of {self.limit} rows of this model are taken.")
        self.rows += rows

    def give_back(self, rows: int) -> None:
        """Give back room that was taken."""
        self.rows -= rows

    async def run(
        self,
        call: Callable[[], T],
        ticket: Ticket,
        *,
        kind: str,
        size: int,
        gives_way: bool = False,
    ) -> Done[T]:
        """Let a question be answered.

        Args:
            call: the work; it may run in another thread.
            kind: jobs of one kind and about one size, at least 1, cost alike.
            gives_way: to all those that do not.

        Raises:
            DeadlinePassedError: the deadline passed first; the work is dropped, or its result.
            DisconnectedError: nobody waits for the answer any more.
            Exception: whatever the job raises.
        """

        came = monotonic()

        def learnt() -> Done[T]:
            # Here, since nobody may be left to hear of a job that took too long.
            done = _do(call, came)
            self._costs.learn(kind, size, done.processor)
            return done

        counted = 0 if gives_way else 1
        self.backlog += counted
        try:
            if self._costs.expected(kind, size) > CHEAP:
                async with _turn(self._turn, ticket) if gives_way else nullcontext():
                    return await _in_thread(lambda _: learnt(), ticket, self._costly)
            line = self._giving_way if gives_way else self._waiting
            return await self._in_tick(learnt, ticket, line)
        finally:
            self.backlog -= counted

    async def draw(self, call: Callable[[Callable[[], bool]], T], ticket: Ticket) -> Done[T]:
        """Let scenes be drawn.

        Args:
            call: the work, for the drawing thread. What it is given says whether the result has
                been given up, which long work asks from time to time.

        Raises:
            DeadlinePassedError, DisconnectedError, Exception: see `run`.
        """
        came = monotonic()

        def drawn(given_up: Callable[[], bool]) -> Done[T]:
            return _do(lambda: call(given_up), came)

        return await _in_thread(drawn, ticket, self.threads.drawing)

    async def _in_tick(
        self, call: Callable[[], Done[T]], ticket: Ticket, line: deque[_Job]
    ) -> Done[T]:
        loop = asyncio.get_running_loop()
        job = _Job(call, ticket, loop.create_future())
        line.append(job)
        if not self._draining:
            self._draining = True
            loop.call_soon(self._drain)
        try:
            found: Done[T] = await job.future
        finally:
            del job  # see `_settle`
        # Others may have had their turns meanwhile.
        ticket.check()
        return found

    def _drain(self) -> None:
        end = monotonic() + _TICK
        while line := self._waiting or self._giving_way:
            _settle(line.popleft())
            if (self._waiting or self._giving_way) and monotonic() > end:
                asyncio.get_running_loop().call_soon(self._drain)
                return
        self._draining = False


@asynccontextmanager
async def _turn(lock: asyncio.Lock, ticket: Ticket) -> AsyncIterator[None]:
    """The turn of one that gives way, if it comes before the deadline."""
    left = ticket.deadline - monotonic()
    try:
        await asyncio.wait_for(lock.acquire(), left if left < math.inf else None)
    except TimeoutError:
        raise DeadlinePassedError("The deadline passed before the answer was begun.") from None
    try:
        yield
    finally:
        lock.release()


async def _in_thread(
    call: Callable[[Callable[[], bool]], Done[T]], ticket: Ticket, executor: Executor
) -> Done[T]:
    ticket.check()
    await ticket.check_there()
    given_up = False

    def unless_given_up() -> Done[T]:
        # The thread's own queue holds what is given up until its turn, and no longer.
        if given_up:
            raise DeadlinePassedError("given up")
        return call(lambda: given_up)

    future = asyncio.get_running_loop().run_in_executor(executor, unless_given_up)
    try:
        while True:
            left = ticket.deadline - monotonic()
            await asyncio.wait([future], timeout=min(left, _LOOK))
            if future.done():
                return future.result()
            if left <= _LOOK:
                raise DeadlinePassedError("The deadline passed before the answer was there.")
            await ticket.check_there()
    finally:
        given_up = True
        future.cancel()
        del future  # see `_settle`


def _do(call: Callable[[], T], came: float) -> Done[T]:
    """The work, which came at that time by `time.monotonic`."""
    began, busy = monotonic(), thread_time()
    result = call()
    return Done(result, began - came, monotonic() - began, thread_time() - busy)


def _settle(job: _Job) -> None:
    try:
        if not job.future.done():
            job.ticket.check()
            job.future.set_result(job.call())
    except Exception as error:  # noqa: BLE001 - it belongs to the request, which raises it
        job.future.set_exception(error)
    finally:
        # The error knows this frame, and the future the error: with the job in the frame they would
        # keep the whole request until the collector comes.
        del job
