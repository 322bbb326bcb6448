"""The perf analyser: what it sends, and what it says of servers whose behaviour is known."""

from __future__ import annotations

import httpx
import pytest

from benchmarks.load import plain
from benchmarks.load.questions import KINDS, bodies

LABELS = [f"thing {number}" for number in range(40)]


@pytest.mark.parametrize("kind", KINDS)
async def test_the_yardstick_validates_and_sends_the_prepared_answer(kind: str) -> None:
    transport = httpx.ASGITransport(plain.app)
    async with httpx.AsyncClient(transport=transport, base_url="http://plain") as client:
        scene = bodies(kind, LABELS)[0]
        for question in ("missing", "relations", "outliers", "rooms"):
            answer = f'{{"{question}":[]}}'.encode()
            await client.put(f"/answers/{question}", content=answer)
            found = await client.post(f"/{question}", json=scene)
            assert (found.status_code, found.content) == (200, answer)
            refused = await client.post(f"/{question}", json={"objects": 1})
            assert refused.status_code == 422
