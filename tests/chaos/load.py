"""Requests under way on many connections while something else happens to the service."""

from __future__ import annotations

import asyncio
import json
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from types import TracebackType
from typing import Any

from benchmarks.load.connections import Connection, connect


@dataclass
class Tally:
    """What came back.

    Attributes:
        sent: how many requests.
        statuses: of the answers; 0 stands for a connection that broke.
        seconds: what each answer took, by its status.
        faults: what the judge said, as far as it said anything.
    """

    sent: int = 0
    statuses: Counter[int] = field(default_factory=Counter)
    seconds: dict[int, list[float]] = field(default_factory=lambda: defaultdict(list))
    faults: list[str] = field(default_factory=list)


class ConstantLoad:
    """So many connections, in a thread of their own, each of which always has a request under way.

    Args:
        port: of the service.
        requests: sent in turn.
        judge: called with (number of the request, status, answer); says what is wrong, or nothing.
    """

    def __init__(
        self,
        port: int,
        requests: Sequence[bytes],
        judge: Callable[[int, int, Any], str | None],
        connections: int = 8,
    ) -> None:
        self.tally = Tally()
        self._port = port
        self._requests = requests
        self._judge = judge
        self._connections = connections
        self._ending = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()))

    def __enter__(self) -> ConstantLoad:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None
    ) -> None:
        self._ending.set()
        self._thread.join(timeout=60)
        assert kind is not None or not self._thread.is_alive(), "an answer is lost"

    async def _run(self) -> None:
        asked: dict[Connection, tuple[int, float]] = {}
        finished = asyncio.Event()

        def send(connection: Connection) -> None:
            number = self.tally.sent % len(self._requests)
            asked[connection] = number, perf_counter()
            self.tally.sent += 1
            connection.send(self._requests[number])

        def answered(connection: Connection, status: int, body: bytes) -> None:
            number, began = asked.pop(connection)
            self.tally.statuses[status] += 1
            self.tally.seconds[status].append(perf_counter() - began)
            if fault := self._judge(number, status, json.loads(body) if body else None):
                self.tally.faults.append(fault)
            if status and not self._ending.is_set():
                send(connection)
            elif not asked:
                finished.set()

        pool = await connect(self._port, self._connections, answered)
        for connection in pool:
            send(connection)
        await finished.wait()
        for connection in pool:
            connection.close()
