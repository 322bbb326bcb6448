"""Constant load on the service during a test."""

from __future__ import annotations

import asyncio
import json
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import httpx

from benchmarks.load.connections import Connection, connect, prepared
from tests.services import PATIENCE


class ConstantLoad:
    """Connections that always have a request in progress, in a thread of their own.

    The end of the context checks that each request has an answer without a complaint.

    Args:
        port: port of the service.
        requests: sent in turn.
        judge: called with (number of the request, status, answer); returns a complaint or None.

    Attributes:
        sent: number of requests.
        statuses: statuses of the answers; 0 stands for a connection that broke.
        faults: the complaints of the judge.
    """

    def __init__(
        self,
        port: int,
        requests: Sequence[bytes],
        judge: Callable[[int, int, Any], str | None],
        connections: int = 8,
    ) -> None:
        self.sent = 0
        self.statuses = Counter[int]()
        self.faults: list[str] = []
        self._arguments = port, requests, judge, connections
        self._ending = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run(*self._arguments)))

    def __enter__(self) -> ConstantLoad:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._ending.set()
        self._thread.join(timeout=PATIENCE)
        if kind is None:
            assert not self._thread.is_alive(), "an answer is lost"
            assert self.faults == [], self.faults[:3]
            assert self.statuses.total() == self.sent

    async def _run(self, port: int, requests: Any, judge: Any, connections: int) -> None:
        pending: dict[Connection, int] = {}
        finished = asyncio.Event()

        def send(connection: Connection) -> None:
            pending[connection] = number = self.sent % len(requests)
            self.sent += 1
            connection.send(requests[number])

        def answered(connection: Connection, status: int, body: bytes) -> None:
            number = pending.pop(connection)
            self.statuses[status] += 1
            if fault := judge(number, status, json.loads(body) if body else None):
                self.faults.append(fault)
            if status and not self._ending.is_set():
                send(connection)
            elif not pending:
                finished.set()

        pool = await connect(port, connections, answered)
        for connection in pool:
            send(connection)
        await finished.wait()
        for connection in pool:
            connection.close()


SCENES: list[dict[str, Any]] = [
    {"objects": ["bed", "lamp"], "top_k": 4},
    {"objects": ["desk", "chair", "keyboard"], "top_k": 4},
    {"objects": ["sink", {"label": "toilet", "confidence": 0.5}], "top_k": 4},
    {"objects": ["sofa", "television"], "room_type": "office", "top_k": 4},
]
REQUESTS = [prepared("/missing", body) for body in SCENES]


class Judge:
    """Compares each answer with that of the version that it names, asked before the load.

    Attributes:
        expected: the answers of each version by its digest.
    """

    def __init__(self, client: httpx.Client, versions: Iterable[str]) -> None:
        self.expected: dict[str, list[Any]] = {}
        for version in versions:
            for scene in SCENES:
                answer = client.post("/missing", json=scene | {"model": f"home@{version}"}).json()
                assert answer["model"]["version"] == version
                self.expected.setdefault(answer["model"]["digest"], []).append(answer["missing"])

    def __call__(self, number: int, status: int, answer: Any) -> str | None:
        if status != 200:
            return f"status {status}: {answer}"
        missing, expected = answer["missing"], self.expected[answer["model"]["digest"]][number]
        return None if missing == expected else f"{answer['model']}: {missing}, not {expected}"
