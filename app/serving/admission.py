"""Admission control: when a request starts, and in which thread its work runs.

`Backlog` bounds the number of requests that wait to start. In one tick of the event loop it starts
at most `PACE` requests, minus the pending ones. It starts fewer requests if they would hold up the
event loop for more than `TICK` seconds. It refuses at most `REFUSALS` requests per tick. Without
these bounds, hundreds of simultaneous requests would delay health checks. A request is refused for
three reasons: the backlog is full, the expected wait is too long, or the deadline has passed.

`WorkQueue` bounds the rows (scenes) that wait for one model or are computed by it. Each question is
computed separately, so an answer never depends on other requests. A cheap question runs on the
event loop, because a change of thread costs as much as most questions. A costly question runs on
the worker thread of its model: its expected time exceeds `CHEAP`, or its kind was never measured.
Compiled loops release the interpreter's lock, so the event loop can continue. Drawing scenes may
take seconds, so all models share another thread for it. Questions of streams run one at a time, one
per tick. A question is dropped if its deadline has passed or its client has disconnected before it
starts.
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
"""Seconds for which the requests of one tick may block the event loop."""

PACE: Final = 32
"""Maximum number of requests started in one tick. Pending requests are subtracted."""

REFUSALS: Final = 8
"""Maximum number of requests refused in one tick."""

CHEAP: Final = 2e-3
"""Seconds for which one job may block the event loop."""

# Seconds between two ticks if the last one could not start a request.
_PAUSE: Final = 5e-3
# Maximum expected wait, as a share of the request's time. Even a wait three times as long then ends
# before the deadline.
_PATIENCE: Final = 0.25
# Weight of the newest measurement in the moving averages of the backlog.
_NEWEST_PACE: Final = 0.1
# Seconds between two checks whether the client of costly work is still connected.
_LOOK: Final = 0.25
# Maximum number of remembered costs.
_MAX_COSTS: Final = 4096
# Weight of the newest measurement in the expected cost.
_NEWEST: Final = 0.2

# Arrival times and wake-up futures, oldest first.
_Line = deque[tuple[float, asyncio.Future[None]]]


class Backlog:
    """Requests that wait to start, in the order of their arrival.

    Args:
        limit: maximum number of waiting requests.

    Attributes:
        pending: number of started questions without a result. Drawings and questions of streams
            are not counted.
        draining: whether the service has stopped accepting requests.
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
        """Wait until the request may start.

        Args:
            allowed: total time of the request in seconds.
            deadline: value of `time.monotonic` at the end of this time.

        Raises:
            QueueFullError: too many requests wait, or the expected wait is too long.
            DeadlinePassedError: the deadline passed during the wait.
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
            raise QueueFullError(f"{count} requests are already waiting.")
        await _wait(self._waiting)
        if monotonic() >= deadline:
            raise DeadlinePassedError("The deadline passed before the request started.")

    def _is_full(self, allowed: float) -> bool:
        if not self._waiting:
            return False
        # A new request waits about as long as the oldest waiting request has waited.
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
        # The next tick follows at once: requests that arrive before it count towards this tick.
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
    """Wake at most `most` requests, oldest first, and return their number.

    Cancelled requests are skipped.
    """
    count = 0
    while line and count < most:
        _, turn = line.popleft()
        if not turn.done():
            turn.set_result(None)
            count += 1
    return count


# Not frozen: creating a frozen dataclass takes three times as long.
@dataclass(slots=True)
class Ticket:
    """The deadline of a request, and a check of its client's connection.

    Attributes:
        deadline: value of `time.monotonic` at the deadline; work that starts later is dropped.
        is_gone: function that returns whether the client has disconnected; called before and
            during costly work.
    """

    deadline: float
    is_gone: Callable[[], Awaitable[bool]] | None = None

    def check(self) -> None:
        """Check the deadline.

        Raises:
            DeadlinePassedError: the deadline has passed.
        """
        if monotonic() >= self.deadline:
            raise DeadlinePassedError("The deadline passed before the computation started.")

    async def check_there(self) -> None:
        """Check the connection to the client.

        Raises:
            DisconnectedError: the client has disconnected.
        """
        if self.is_gone is not None and await self.is_gone():
            raise DisconnectedError("The client has disconnected.")


@dataclass(slots=True)
class Done(Generic[T]):
    """The result of a job, with its times in seconds.

    Attributes:
        result: return value of the job.
        waited: time before the job started.
        computed: duration of the job.
        processor: processor time of the job. Waiting for other processes or, in a worker thread,
            for the interpreter's lock is not counted.
    """

    result: T
    waited: float
    computed: float
    processor: float


class _Costs:
    """Average cost of questions in seconds per unit of size, by kind and order of magnitude.

    Small scenes cost more per unit than large ones. So each order of magnitude has its own average.
    """

    def __init__(self) -> None:
        self._per_unit: dict[tuple[str, int], float] = {}

    def expected(self, kind: str, size: int) -> float:
        """Expected seconds; infinite before the first measurement."""
        return self._per_unit.get((kind, size.bit_length()), math.inf) * size

    def learn(self, kind: str, size: int, seconds: float) -> None:
        if len(self._per_unit) >= _MAX_COSTS:
            self._per_unit.clear()  # clients can create many kinds; each is soon measured again
        key, measured = (kind, size.bit_length()), seconds / size
        known = self._per_unit.get(key, measured)
        # The bound keeps one slow measurement from sending all later questions to the thread.
        self._per_unit[key] = known + _NEWEST * (min(measured, 2 * known) - known)


def _one_thread(name: str) -> Executor:
    return ThreadPoolExecutor(1, thread_name_prefix=name)


@dataclass(frozen=True, slots=True)
class Threads:
    """The worker threads of a process.

    Attributes:
        drawing: thread that draws scenes, shared by all models.
    """

    drawing: Executor = field(default_factory=partial(_one_thread, "drawing"))
    _costly: WeakSet[Executor] = field(default_factory=WeakSet)

    def for_model(self) -> Executor:
        """Create a thread for the costly questions of one model.

        The thread ends when its executor is garbage-collected.
        """
        executor = _one_thread("costly work")
        self._costly.add(executor)
        return executor

    def stop(self) -> None:
        """Stop the threads and drop pending work."""
        for executor in (self.drawing, *self._costly):
            executor.shutdown(wait=False, cancel_futures=True)


@dataclass(eq=False)
class WorkQueue:
    """The work of one model.

    A row is one scene, or one scene to draw.

    Attributes:
        limit: maximum number of rows that wait or are computed.
        threads: worker threads for costly work.
        backlog: the backlog that counts pending questions.
        rows: current number of rows.
    """

    limit: int
    threads: Threads
    backlog: Backlog
    rows: int = 0
    _costs: _Costs = field(default_factory=_Costs)
    _costly: Executor = field(init=False)
    # Questions of streams run one at a time, so that a request waits for at most one of them.
    _turn: asyncio.Lock = field(default_factory=asyncio.Lock)

    def __post_init__(self) -> None:
        self._costly = self.threads.for_model()

    def take(self, rows: int) -> None:
        """Reserve rows, until `give_back` releases them.

        Raises:
            QueueFullError: too few rows are free.
        """
        if self.rows + rows > self.limit:
            raise QueueFullError(f"{self.rows} of {self.limit} rows of this model are in use.")
        self.rows += rows

    def give_back(self, rows: int) -> None:
        """Release reserved rows."""
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
        """Compute the answer to a question.

        Args:
            call: the computation; it may run in another thread.
            ticket: deadline and client of the request.
            kind: kind of the question; the expected cost depends on kind and size.
            size: size of the question, at least 1.
            low_priority: whether the question belongs to a stream. Other questions can run between
                two of these.

        Raises:
            DeadlinePassedError: the deadline passed before the result was there.
            DisconnectedError: the client has disconnected.
            Exception: any error of `call`.
        """
        came = monotonic()

        def measured(_: Callable[[], bool] | None = None) -> Done[T]:
            # The cost is measured here, since the request may have ended before the computation.
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
            call: the work for the drawing thread. Its argument returns whether the request has
                ended; long work should call it from time to time.
            ticket: deadline and client of the request.

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
    """Hold the lock for low-priority jobs.

    Raises:
        DeadlinePassedError: the deadline passed before the lock was free.
    """
    left = ticket.deadline - monotonic()
    try:
        await asyncio.wait_for(lock.acquire(), left if left < math.inf else None)
    except TimeoutError:
        raise DeadlinePassedError("The deadline passed before the computation started.") from None
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
        # Abandoned work stays in the executor's queue, and is skipped here.
        if given_up:
            raise DeadlinePassedError("The request ended before the computation started.")
        return call(lambda: given_up)

    future = asyncio.get_running_loop().run_in_executor(executor, unless_given_up)
    try:
        while True:
            left = ticket.deadline - monotonic()
            await asyncio.wait([future], timeout=min(left, _LOOK))
            if future.done():
                return future.result()
            if left <= _LOOK:
                raise DeadlinePassedError("The deadline passed before the computation finished.")
            await ticket.check_there()
    finally:
        given_up = True
        future.cancel()
        # The frame, the future and its error form a reference cycle. It would keep the whole
        # request in memory until the garbage collector runs.
        del future
