"""Run load on a server for a period of time (a window), and measure rate and latency.

The load is a number of connections that send without pauses, or a fixed number of requests per
second. At a fixed rate, the latency of a request runs from its scheduled time, not from its sending
time. If the server stalls, delayed requests therefore count with their whole delay (no coordinated
omission).
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
    """Results of one window of load.

    Attributes:
        seconds: length of the window.
        latency: (answers,) latency of each answer in seconds.
        statuses: number of answers by HTTP status. Status 0 means a broken connection.
    """

    seconds: float
    latency: NDArray[np.float64]
    statuses: Counter[int]

    @property
    def rate(self) -> float:
        """Number of answers with status 200 per second."""
        return self.statuses[200] / self.seconds

    @property
    def errors(self) -> int:
        """Number of answers with another status than 200, and of broken connections."""
        return sum(self.statuses.values()) - self.statuses[200]

    def quantile(self, q: float) -> float:
        """Return a quantile of the latency in seconds. `q` is between 0 and 1."""
        return float(np.quantile(self.latency, q)) if len(self.latency) else float("nan")


def joined(windows: Sequence[Window]) -> Window:
    """Join the answers of several windows into one window."""
    return Window(
        sum(window.seconds for window in windows),
        np.concatenate([window.latency for window in windows]),
        sum((window.statuses for window in windows), Counter()),
    )


async def at_concurrency(
    port: int,
    requests: Sequence[bytes],
    connections: int,
    seconds: float,
    address: str = "127.0.0.1",
) -> Window:
    """Run a window in which each connection sends its next request directly after an answer.

    Args:
        address: loopback address of the client. The service tells clients apart by it.
    """
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

    pool = await connect(port, connections, answered, address)
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
    """Run a window with a fixed number of requests per second, without waiting for answers.

    Args:
        rate: requests per second.
        seconds: length of the window.
        connections: number of connections. Requests wait if all connections are busy.
    """
    count = max(1, round(rate * seconds))
    return await at_times(port, requests, np.arange(count) / rate, connections)


async def at_times(
    port: int, requests: Sequence[bytes], times: NDArray[np.float64], connections: int = 64
) -> Window:
    """Run a window with requests at given times, without waiting for answers.

    Args:
        times: times in seconds from the start of the window, ascending.
        connections: number of connections. Requests wait if all connections are busy.
    """
    latency: list[float] = []
    statuses: Counter[int] = Counter()
    due: dict[Connection, float] = {}
    waiting: deque[float] = deque()
    finished = asyncio.Event()
    count = len(times)
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
    for time in times.tolist():
        when = start + time
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
