"""Admission control: which requests begin when, and where the work of each model runs.

`Backlog` bounds the requests that wait to be read. In one tick of the event loop it starts as many
requests as took `TICK` together in earlier ticks, and at most `PACE` less the pending ones. It
refuses at most `REFUSALS` a tick. Without these bounds hundreds of simultaneous requests would hold
up the event loop, and health checks with it. A request is refused when the backlog is full, when it
would spend much of its time waiting, and when its deadline has passed.

`WorkQueue` bounds the work of one model in rows. Each question is computed by itself, so an answer
never depends on other requests. A cheap one is computed at once, on the event loop: a hop to a
thread costs as much as most questions. A question that is expected to take longer than `CHEAP`, or
whose kind was never measured, runs on the one worker thread of its model; compiled loops release
the interpreter's lock. Drawings, which may take seconds, share one other thread. Questions of
streams take turns, one a tick. A question whose deadline has passed, or whose client has left, is
dropped when its turn comes.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from time import monotonic, thread_time
from typing import Final, Generic, TypeVar
from weakref import WeakSet

from app.serving.errors import DeadlinePassedError, DisconnectedError, QueueFullError

T = TypeVar("T")

TICK: Final = 8e-3
"""Seconds that the requests begun in one tick may hold up the event loop."""

PACE: Final = 32
"""Most requests begun in one tick, less those begun before whose work is still pending."""

REFUSALS: Final = 8
"""Requests refused in one tick."""

CHEAP: Final = 2e-3
"""Seconds that a job may hold up the event loop."""

# Seconds between two checks of whether the models have caught up.
_PAUSE: Final = 5e-3
# Share of its time that a request may expect to wait: the pace may still drop to a third.
_PATIENCE: Final = 0.25
# Share of the newest measurement in the measured pace and in the time that a request takes.
_NEWEST_PACE: Final = 0.1
# Seconds between two checks of whether the client of costly work is still there.
_LOOK: Final = 0.25
# Kinds and orders of size whose cost is remembered.
_MAX_COSTS: Final = 4096
# Share of the newest measurement in the expected cost.
_NEWEST: Final = 0.2

# Arrival times and wake-ups, oldest first.
_Line = deque[tuple[float, asyncio.Future[None]]]


class Backlog:
    """Requests that wait to be read, in the order of their arrival.

    Args:
        limit: most requests that wait.

    Attributes:
        pending: questions of requests that wait for a thread or are computed by one; drawings and
            questions of streams are not counted.
        draining: nothing new is begun.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.pending = 0
        self.draining = False
        self._ticking = False
        self._places = self._begun = 0
        self._began_at = self._seconds = 0.0
        self._interval = 0.0
        self._moved_at: float | None = None
        self._waiting: _Line = deque()
        self._refused: _Line = deque()

    async def enter(self, allowed: float, deadline: float) -> None:
        """Wait until the request may begin.

        Args:
            allowed: seconds that the request has in all.
            deadline: when they end, by `time.monotonic`.

        Raises:
            QueueFullError: too many wait, or the wait would take too long.
            DeadlinePassedError: the deadline passed first.
        """
        if not self._ticking:
            self._begin_tick()
        if not self._waiting and self._places:
            self._places -= 1
            self._begun += 1
            return
        if self._is_full(allowed):
            count = len(self._waiting)
            await _wait(self._refused)
            raise QueueFullError(f"{count} requests wait already.")
        await _wait(self._waiting)
        if monotonic() >= deadline:
            raise DeadlinePassedError("The deadline passed before the request was read.")

    def _is_full(self, allowed: float) -> bool:
        if not self._waiting:
            return False
        # The last of a long line waits about as long as its first has waited.
        wait = max(monotonic() - self._waiting[0][0], len(self._waiting) * self._interval)
        return len(self._waiting) >= self.limit or wait > _PATIENCE * allowed

    def _begin_tick(self) -> None:
        now = monotonic()
        if self._begun and self._ticking:
            took = (now - self._began_at) / self._begun
            share = _NEWEST_PACE if self._seconds else 1.0
            self._seconds += share * (took - self._seconds)
        self._began_at = now
        fit = max(1, int(TICK / self._seconds)) if PACE * self._seconds > TICK else PACE
        self._places = max(0, min(fit, PACE - self.pending))
        begun = self._begun = _wake(self._waiting, self._places) if self._waiting else 0
        self._places -= begun
        if begun or self._moved_at is not None or self._waiting:
            self._measure_pace(begun)
        if self._refused:
            _wake(self._refused, REFUSALS)
        loop = asyncio.get_running_loop()
        # One more tick after the last: requests that arrive in this one are counted in it.
        if begun or not self._ticking:
            self._ticking = True
            loop.call_soon(self._begin_tick)
        elif self._waiting or self._refused:
            loop.call_later(_PAUSE, self._begin_tick)
        else:
            self._ticking = False

    def _measure_pace(self, begun: int) -> None:
        now = monotonic()
        if begun and self._moved_at is not None:
            self._interval += _NEWEST_PACE * ((now - self._moved_at) / begun - self._interval)
        if begun or not self._waiting:
            self._moved_at = now if self._waiting else None


async def _wait(line: _Line) -> None:
    turn = asyncio.get_running_loop().create_future()
    line.append((monotonic(), turn))
    await turn


def _wake(line: _Line, most: int) -> int:
    """Wake the first of a line; how many there were that had not been cancelled."""
    count = 0
    while line and count < most:
        _, turn = line.popleft()
        if not turn.done():
            turn.set_result(None)
            count += 1
    return count


# Not frozen: a frozen one takes three times as long to make.
@dataclass(slots=True)
class Ticket:
    """How long a request may take, and whether its client still waits.

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
        processor: seconds of processor time: `computed` without waiting for other processes and, in
            a worker thread, for the interpreter.
    """

    result: T
    waited: float
    computed: float
    processor: float


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
        # One slow measurement must not send all later questions to the thread.
        self._per_unit[key] = known + _NEWEST * (min(measured, 2 * known) - known)


def _one_thread(name: str) -> Executor:
    return ThreadPoolExecutor(1, thread_name_prefix=name)


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
        """Stop them; pending work is dropped."""
        for executor in (self.drawing, *self._costly):
            executor.shutdown(wait=False, cancel_futures=True)


@dataclass(eq=False)
class WorkQueue:
    """Jobs of one model.

    Attributes:
        limit: most rows (scenes, or drawn scenes) that may wait or be computed.
        threads: for work that is not cheap.
        backlog: counts the questions of requests.
        rows: how many there are now.
    """

    limit: int
    threads: Threads
    backlog: Backlog
    rows: int = 0
    _costs: _Costs = field(default_factory=_Costs)
    _costly: Executor = field(init=False)
    # One question of a stream at a time, so that requests wait for one at most.
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
        low_priority: bool = False,
    ) -> Done[T]:
        """Answer a question.

        Args:
            call: the work; it may run in another thread.
            kind: questions of one kind and about one size, at least 1, cost alike.
            low_priority: of streams; others run between two of them.

        Raises:
            DeadlinePassedError: the deadline passed first; the work is dropped, or its result.
            DisconnectedError: the client has left.
            Exception: whatever the work raises.
        """
        came = monotonic()

        def measured(_: Callable[[], bool] | None = None) -> Done[T]:
            # Measured here: after a timeout the request may have ended already.
            began, busy = monotonic(), thread_time()
            result = call()
            done = Done(result, began - came, monotonic() - began, thread_time() - busy)
            self._costs.learn(kind, size, done.processor)
            return done

        async def compute() -> Done[T]:
            if self._costs.expected(kind, size) > CHEAP:
                return await _in_thread(measured, ticket, self._costly)
            ticket.check()
            done = measured()
            ticket.check()
            return done

        if low_priority:
            async with _turn(self._turn, ticket):
                await asyncio.sleep(0)
                return await compute()
        self.backlog.pending += 1
        try:
            return await compute()
        finally:
            self.backlog.pending -= 1

    async def draw(self, call: Callable[[Callable[[], bool]], T], ticket: Ticket) -> Done[T]:
        """Draw scenes.

        Args:
            call: the work, for the drawing thread. Its argument says whether the result has been
                given up; long work asks from time to time.

        Raises:
            DeadlinePassedError, DisconnectedError, Exception: see `run`.
        """
        came = monotonic()

        def drawn(given_up: Callable[[], bool]) -> Done[T]:
            began, busy = monotonic(), thread_time()
            result = call(given_up)
            return Done(result, began - came, monotonic() - began, thread_time() - busy)

        return await _in_thread(drawn, ticket, self.threads.drawing)


@asynccontextmanager
async def _turn(lock: asyncio.Lock, ticket: Ticket) -> AsyncIterator[None]:
    """Hold the lock for jobs of low priority, if it is free before the deadline."""
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
        # The thread's own queue holds abandoned work until its turn, and no longer.
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
        # The error refers to this frame, and the future to the error: they would keep the whole
        # request until the collector runs.
        del future
