"""A replica polls its store: it serves new versions and aliases without a request to refresh."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import httpx

from tests.http.stores import corrupt, publish
from tests.http.test_models import default
from tests.services import serve

POLL = 0.05
Ask = Callable[[httpx.AsyncClient], Awaitable[Any]]


async def listed(client: httpx.AsyncClient) -> dict[str, Any]:
    answer: dict[str, Any] = (await client.get("/models")).json()
    return answer


async def ready(client: httpx.AsyncClient) -> int:
    return (await client.get("/health/ready")).status_code


async def until(client: httpx.AsyncClient, ask: Ask, expected: Any) -> None:
    async with asyncio.timeout(60):
        while await ask(client) != expected:  # noqa: ASYNC110 - a service has no event to wait for
            await asyncio.sleep(POLL)


async def test_replicas_converge_on_what_is_published(store: Path, admin: dict[str, str]) -> None:
    async with serve(store, store_poll=POLL) as one, serve(store, store_poll=POLL) as other:
        before = (await listed(one))["generation"]
        assert (await listed(other))["generation"] == before
        publish(store, "home", "2.0.0", seed=2, alias="default")
        shutil.rmtree(store / "deep")
        for client in (one, other):
            await until(client, default, "home@2.0.0")
            assert (await client.get("/models/deep")).status_code == 404
        after = (await listed(one))["generation"]
        assert (await listed(other))["generation"] == after != before

        # An alias that one of them moves reaches the other.
        response = await one.put(
            "/models/aliases/default", json={"model": "home@1.0.0"}, headers=admin
        )
        assert response.status_code == 200
        assert await default(one) == "home@1.0.0"
        await until(other, default, "home@1.0.0")
        assert (await listed(other))["generation"] == (await listed(one))["generation"]


async def test_a_broken_new_version_keeps_nothing_else_back(store: Path) -> None:
    async with serve(store, store_poll=POLL) as client:
        publish(store, "plain", "2.0.0", seed=3)
        corrupt(store, "plain", "2.0.0")
        publish(store, "home", "2.0.0", seed=2, alias="default")
        await until(client, default, "home@2.0.0")
        failures = {entry["subject"] for entry in (await listed(client))["failures"]}
        assert failures == {"plain@2.0.0"}
        answer = await client.post("/missing", json={"objects": ["bed"], "model": "plain"})
        assert answer.json()["model"]["version"] == "1.0.0"


async def test_without_polling_nothing_is_followed(store: Path, admin: dict[str, str]) -> None:
    async with serve(store, store_poll=0) as client:
        publish(store, "home", "2.0.0", seed=2, alias="default")
        await asyncio.sleep(5 * POLL)
        assert await default(client) == "home@1.0.0"
        assert (await client.post("/models/refresh", headers=admin)).status_code == 200
        assert await default(client) == "home@2.0.0"
