"""Costly questions: health and other models answer meanwhile, and unwanted work ends."""

from __future__ import annotations

import asyncio
import os
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
from pydantic import ValidationError

from app.settings import Settings
from tests.http.stores import VOCABULARY
from tests.services import Hold, launch, serve

LABELS = [entry.label for entry in VOCABULARY.objects if not entry.structure]
DEEP = {"objects": LABELS[:4], "model": "deep"}
HOME = {"objects": LABELS[:4]}


def related(objects: int) -> dict[str, Any]:
    """A scene in which every two objects are related."""
    names = LABELS[:objects]
    relations = [
        {"subject": one, "relation": "left", "object": other}
        for place, one in enumerate(names)
        for other in names[:place]
    ]
    return {"objects": names, "relations": relations, "model": "deep"}


@pytest.mark.parametrize("cheap", [DEEP, {**DEEP, "objects": [LABELS[0]] * 14}])
async def test_health_answers_beside_a_first_question(
    shared_store: Path, hold: Hold, cheap: dict[str, Any]
) -> None:
    """Neither a cheap question of the same size nor many of them make it look cheap."""
    async with serve(shared_store) as client:
        for _ in range(20):
            assert (await client.post("/outliers", json=cheap)).is_success
        release = hold("outliers").release
        costly = asyncio.ensure_future(client.post("/outliers", json=related(14)))
        began = time.monotonic()
        while not costly.done() and time.monotonic() - began < 0.5:
            asked = time.monotonic()
            assert (await client.get("/health/live")).is_success
            assert time.monotonic() - asked < 0.4
            await asyncio.sleep(0.01)
        assert not costly.done()
        release.set()
        assert (await costly).is_success


async def test_no_model_waits_for_another(shared_store: Path, hold: Hold) -> None:
    async with serve(shared_store) as client:
        release = hold("outliers").release
        batch = {"scenes": [related(count) for count in (3, 6, 9, 14)]}
        costly = [
            asyncio.ensure_future(client.post("/outliers/batch", json=batch)) for _ in range(8)
        ]
        await asyncio.sleep(0.1)
        for size in range(1, 14):
            # Unmeasured: all of these need a thread.
            body = {"objects": LABELS[:size]}
            assert (await client.post("/missing", json=body)).is_success
            assert (await client.post("/relations", json=body)).is_success
        assert not any(job.done() for job in costly)
        release.set()
        assert all(answer.is_success for answer in await asyncio.gather(*costly))


def test_the_longest_deadline_is_no_shorter_than_the_default(shared_store: Path) -> None:
    with pytest.raises(ValidationError, match="SCENE_MAX_REQUEST_TIMEOUT_MS"):
        Settings(store=shared_store, request_timeout_ms=2_000, max_request_timeout_ms=1_000)


@pytest.mark.slow
def test_work_of_a_departed_client_ends(shared_store: Path, tmp_path: Path) -> None:
    with launch(shared_store, tmp_path / "log") as service:
        body = {**DEEP, "count": 64, "steps": 2000}

        def ask(patience: float) -> None:
            with suppress(httpx.TimeoutException):
                service.client.post("/generate", json=body, timeout=patience)

        costs = []
        for patience in (60, 0.1):
            before = used(service.process.pid)
            with ThreadPoolExecutor() as pool:
                list(pool.map(ask, [patience] * 4))
            if patience < 1:
                time.sleep(5)  # more than the four questions take
            costs.append(used(service.process.pid) - before)
        whole, begun = costs
        # The service looks every quarter of a second whether the client is there, and ends the
        # question between two scenes.
        assert begun < 0.6 * whole
        assert service.client.post("/outliers", json=HOME).is_success


def used(pid: int) -> float:
    """Processor seconds that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
