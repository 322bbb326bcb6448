"""``python -m benchmarks.stream``: updates over a stream, compared with requests of whole scenes.

At each tick, one object of a room moves, and the client asks three questions about the new scene.
Over the stream, the client sends one update per tick. Without the stream, the client sends three
requests per tick on a keep-alive connection. Blocks of ticks with and without the stream alternate,
so that both run under the same conditions. A ping between two updates measures the round-trip time.
Latency runs from the scheduled time of a tick, so it includes delays of the client.
"""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, Final

import httpx
import numpy as np
import typer
import uvloop
from rich.console import Console
from rich.table import Table
from websockets.asyncio.client import ClientConnection, connect

from benchmarks.load import servers
from benchmarks.report import describe_machine

ASK: Final = {"missing": {"top_k": 10}, "outliers": {}, "relations": {"top_k": 20}}
STREAM, PING, REQUESTS = "update, answered", "ping, answered", "three requests, answered"
AIM: Final = 0.020
"""Target for the 99th percentile of the latency of an update, in seconds."""

_BLOCK: Final = 100
_QUANTILES: Final = (0.5, 0.9, 0.99)


@dataclass
class Measured:
    """Results of one run.

    Attributes:
        seconds: seconds from the scheduled time of each tick to its answer, by kind of message.
        answers: number of answers over the stream.
        superseded: number of updates without an own answer, because a newer update was answered.
        bytes: total size of the answers over the stream, and of the responses to requests.
    """

    seconds: dict[str, list[float]] = field(
        default_factory=lambda: {STREAM: [], PING: [], REQUESTS: []}
    )
    answers: int = 0
    superseded: int = 0
    bytes: dict[str, int] = field(default_factory=lambda: {STREAM: 0, REQUESTS: 0})

    def quantile(self, name: str, q: float) -> float:
        """Return a quantile of the latency of one kind of message, in seconds."""
        return float(np.quantile(self.seconds[name], q))


def room(labels: list[str], objects: int, seed: int = 0) -> list[dict[str, Any]]:
    """Return objects with random positions in a cube of three metres."""
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(labels), objects, replace=False)
    return [
        {
            "id": f"object_{k}",
            "label": labels[label],
            "position": dict(zip("xyz", rng.uniform(0, 3, 3).round(3).tolist(), strict=True)),
            "size": {"x": 0.5, "y": 0.5, "z": 0.5},
        }
        for k, label in enumerate(chosen)
    ]


def moves(things: list[dict[str, Any]], count: int, seed: int = 1) -> list[dict[str, Any]]:
    """Return ``count`` updates. Each update is one object of the room at a new position."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(count):
        place = dict(zip("xyz", rng.uniform(0, 3, 3).round(3).tolist(), strict=True))
        found.append({**things[number % len(things)], "position": place})
    return found


async def measure(port: int, *, updates: int, rate: float, objects: int) -> Measured:
    """Send updates over the stream at a fixed rate, and send the same scenes as requests.

    Args:
        port: port of a service on this machine.
        updates: number of measured updates. Additional warm-up updates are not measured.
        rate: updates per second.
        objects: number of objects in the room.
    """
    base = f"http://127.0.0.1:{port}"
    async with (
        httpx.AsyncClient(base_url=base) as client,
        connect(f"ws://127.0.0.1:{port}/stream", compression=None, proxy=None) as socket,
    ):
        entries = (await client.get("/models/default/vocabulary")).json()["objects"]
        things = room([entry["label"] for entry in entries if not entry["structure"]], objects)
        await socket.send(json.dumps({"type": "open", "ask": ASK, "objects": things}))
        await socket.recv()
        await socket.recv()
        run = _Run(client, socket, {thing["id"]: thing for thing in things}, 1 / rate)
        await run.block(moves(things, min(_BLOCK, updates), seed=2))
        run.found = Measured()
        every = moves(things, updates)
        for begin in range(0, updates, _BLOCK):
            await run.block(every[begin : begin + _BLOCK])
        return run.found


class _Run:
    """One run of the benchmark. It alternates between the stream and requests of whole scenes."""

    def __init__(
        self,
        client: httpx.AsyncClient,
        socket: ClientConnection,
        scene: dict[str, dict[str, Any]],
        tick: float,
    ) -> None:
        self.found = Measured()
        self._client = client
        self._socket = socket
        self._scene = scene
        self._tick = tick
        self._seq = 0

    async def block(self, moved: list[dict[str, Any]]) -> None:
        before = dict(self._scene)
        await self._over_the_stream(moved)
        self._scene = before
        await self._as_requests(moved)

    async def _over_the_stream(self, moved: list[dict[str, Any]]) -> None:
        due: dict[int, float] = {}
        pings: list[float] = []
        last = self._seq + len(moved)
        listening = asyncio.create_task(self._listen(due, pings, last, len(moved)))
        began = perf_counter()
        for number, thing in enumerate(moved):
            at = began + number * self._tick
            await _until(at)
            self._seq += 1
            due[self._seq] = at
            update = {"type": "update", "seq": self._seq, "objects": [thing]}
            await self._socket.send(json.dumps(update))
            await _until(at + self._tick / 2)
            pings.append(at + self._tick / 2)
            await self._socket.send('{"type": "ping"}')
        await listening

    async def _listen(
        self, due: dict[int, float], pings: list[float], last: int, count: int
    ) -> None:
        found, answered, ponged = self.found, 0, 0
        while answered < last or ponged < count:
            text = await self._socket.recv(decode=False)
            now = perf_counter()
            message = json.loads(text)
            if message["type"] == "pong":
                found.seconds[PING].append(now - pings[ponged])
                ponged += 1
                continue
            found.answers += 1
            found.superseded += message["superseded"]
            found.bytes[STREAM] += len(text)
            answered = message["seq"]
            for seq in [seq for seq in due if seq <= answered]:
                found.seconds[STREAM].append(now - due.pop(seq))

    async def _as_requests(self, moved: list[dict[str, Any]]) -> None:
        async def ask(thing: dict[str, Any]) -> None:
            self._scene[thing["id"]] = thing
            for question, options in ASK.items():
                scene = {"objects": list(self._scene.values()), **options}
                response = (await self._client.post(f"/{question}", json=scene)).raise_for_status()
                self.found.bytes[REQUESTS] += len(response.content)

        began = perf_counter()
        for number, thing in enumerate(moved):
            at = began + number * self._tick
            await _until(at)
            await _timed(ask, thing, at, self.found.seconds[REQUESTS])


async def _until(at: float) -> None:
    if (left := at - perf_counter()) > 0:
        await asyncio.sleep(left)


async def _timed(
    ask: Callable[[dict[str, Any]], Awaitable[None]],
    thing: dict[str, Any],
    due: float,
    seconds: list[float],
) -> None:
    await ask(thing)
    seconds.append(perf_counter() - due)


def main(
    store: Annotated[Path, typer.Option(help="the model store to serve")] = Path("model_store"),
    updates: Annotated[int, typer.Option(min=1, help="number of updates")] = 1000,
    rate: Annotated[float, typer.Option(min=1, help="updates per second")] = 50.0,
    objects: Annotated[int, typer.Option(min=1, max=256, help="objects in the room")] = 12,
) -> None:
    """Measure the latency of updates over a stream, and of the same questions as requests."""
    console = Console(width=120)
    for key, value in describe_machine().items():
        console.print(f"{key}: {value}", highlight=False)
    with ExitStack() as stack:
        stack.callback(os.sched_setaffinity, 0, os.sched_getaffinity(0))
        service = stack.enter_context(servers.service(store, access_log="false"))
        os.sched_setaffinity(0, servers.cores()[1])
        found = uvloop.run(measure(service.port, updates=updates, rate=rate, objects=objects))
    table = Table(title=f"{updates} updates at {rate:g} a second, {objects} objects (milliseconds)")
    for column in ("", *(f"p{100 * q:g}" for q in _QUANTILES), "p99 relative to the stream"):
        table.add_column(column, justify="left" if not column else "right")
    own = found.quantile(STREAM, 0.99)
    for name in (STREAM, PING, REQUESTS):
        values = [found.quantile(name, q) for q in _QUANTILES]
        beside = "" if name == STREAM else f"{values[-1] / own:.2f}"
        table.add_row(name, *(f"{1e3 * value:.2f}" for value in values), beside)
    console.print(table)
    share = found.bytes[STREAM] / found.bytes[REQUESTS]
    each = found.bytes[STREAM] / found.answers
    console.print(f"answers: {found.answers}; they also answer {found.superseded} older updates")
    console.print(f"bytes: {each:.0f} per answer; {share:.2f} of the bytes of the requests")
    verdict = "met" if own < AIM else "MISSED"
    console.print(f"p99 of an update: {1e3 * own:.2f} ms; below {1e3 * AIM:.0f} ms: {verdict}")


if __name__ == "__main__":
    typer.run(main)
