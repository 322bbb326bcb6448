"""The stream's benchmark: what it sends, and that it counts every update once."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.load import servers
from benchmarks.stream import PING, REQUESTS, STREAM, measure, moves, room
from tests.http.stores import make_store

pytestmark = pytest.mark.system


def test_one_thing_moves_at_a_time() -> None:
    things = room([f"label {k}" for k in range(20)], 5)
    assert len({thing["label"] for thing in things}) == 5
    moved = moves(things, 12)
    assert [thing["id"] for thing in moved] == [f"object_{k % 5}" for k in range(12)]
    assert len({str(thing["position"]) for thing in moved}) == 12
    assert moves(things, 12) == moved


@pytest.mark.slow
@pytest.mark.anyio
async def test_every_update_ping_and_request_is_counted_once(tmp_path: Path) -> None:
    with servers.service(make_store(tmp_path / "store"), access_log="false") as service:
        found = await measure(service.port, updates=30, rate=200, objects=8)
    assert {name: len(seconds) for name, seconds in found.seconds.items()} == {
        STREAM: 30,
        PING: 30,
        REQUESTS: 30,
    }
    assert min(map(min, found.seconds.values())) > 0
    assert found.answers + found.superseded == 30
    assert min(found.bytes.values()) > 0
    assert found.quantile(STREAM, 0.5) <= found.quantile(STREAM, 0.99)
