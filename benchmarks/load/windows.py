"""Windows of load: so many connections without pause, or so many requests a second.

At a rate, a request's time runs from when it was due, not from when a connection was free: a server
that stalls is charged for all that waited (no coordinated omission).
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from benchmarks.load.connections import Connection, connect


@dataclass(frozen=True, eq=False)
class Window:
    """What a window of load saw.

    Attributes:
        seconds: its length.
        latency: (N,) seconds of each answer.
        statuses: how many answers had which status; 0 stands for broken connections.
    """

    seconds: float
    latency: NDArray[np.float64]
    statuses: Counter[int]

    @property
    def rate(self) -> float:
        """Answers of status 200 a second."""
        return self.statuses[200] / self.seconds

    @property
    def errors(self) -> int:
        """Answers of any other status."""
        return sum(self.statuses.values()) - self.statuses[200]

    def quantile(self, q: float) -> float:
        """Seconds."""
        return float(np.quantile(self.latency, q)) if len(self.latency) else float("nan")


def joined(windows: Sequence[Window]) -> Window:
    """Several windows as one."""
    return Window(
        sum(window.seconds for window in windows),
        np.concatenate([window.latency for window in windows]),
        sum((window.statuses for window in windows), Counter()),
    )


async def at_concurrency(
    port: int, requests: Sequence[bytes], connections: int, seconds: float
) -> Window:
    """Each connection sends its next request as soon as it has its answer."""
    latency: list[float] = []
    statuses: Counter[int] = Counter()
    began: dict[Connection, float] = {}
    turn = 0
    finished = asyncio.Event()
    end = float("inf")

    def send(connection: Connection) -> None:
        nonlocal turn
        turn += 1
        began[connection] = perf_counter()
        connection.send(requests[turn % len(requests)])

    def answered(connection: Connection, status: int, _: bytes) -> None:
        now = perf_counter()
        latency.append(now - began.pop(connection))
        statuses[status] += 1
        if now < end and status:
            send(connection)
        elif not began:
            finished.set()

    pool = await connect(port, connections, answered)
    start = perf_counter()
    end = start + seconds
    for connection in pool:
        send(connection)
    await finished.wait()
    elapsed = perf_counter() - start
    for connection in pool:
        connection.close()
    return Window(elapsed, np.array(latency), statuses)


async def at_rate(
    port: int, requests: Sequence[bytes], rate: float, seconds: float, connections: int = 64
) -> Window:
    """Requests due at even times, whatever became of those before."""
    latency: list[float] = []
    statuses: Counter[int] = Counter()
    due: dict[Connection, float] = {}
    waiting: deque[float] = deque()
    finished = asyncio.Event()
    count = max(1, round(rate * seconds))
    sent = answers = 0

    def send(connection: Connection, when: float) -> None:
        nonlocal sent
        due[connection] = when
        connection.send(requests[sent % len(requests)])
        sent += 1

    def answered(connection: Connection, status: int, _: bytes) -> None:
        nonlocal answers
        latency.append(perf_counter() - due.pop(connection))
        statuses[status] += 1
        answers += 1
        if waiting and status:
            send(connection, waiting.popleft())
        elif status:
            free.append(connection)
        if answers == count:
            finished.set()

    pool = await connect(port, connections, answered)
    free = list(pool)
    start = perf_counter()
    for number in range(count):
        when = start + number / rate
        while (pause := when - perf_counter()) > 0:  # noqa: ASYNC110 - a clock, not an event
            await asyncio.sleep(pause if pause > 0.002 else 0)
        if free:
            send(free.pop(), when)
        else:
            waiting.append(when)
    await finished.wait()
    elapsed = perf_counter() - start
    for connection in pool:
        connection.close()
    return Window(elapsed, np.array(latency), statuses)
