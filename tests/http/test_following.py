"""A replica follows its store by itself: what others publish, promote and remove is served."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.http.stores import corrupt, publish
from tests.services import serve

pytestmark = pytest.mark.anyio

POLL = 0.05


async def listed(client: httpx.AsyncClient) -> dict[str, Any]:
    answer: dict[str, Any] = (await client.get("/models")).json()
    return answer


async def default(client: httpx.AsyncClient) -> str:
    model = (await client.post("/missing", json={"objects": ["bed"]})).json()["model"]
    return f"{model['name']}@{model['version']}"


async def until(is_so: Callable[[], Awaitable[bool]]) -> None:
    async with asyncio.timeout(60):
        while not await is_so():  # noqa: ASYNC110 - it is asked for, and tells nobody
            await asyncio.sleep(POLL)


async def reloads(client: httpx.AsyncClient, outcome: str) -> float:
    text = (await client.get("/metrics")).text
    name = f'scene_reloads_total{{change="poll",outcome="{outcome}"}}'
    (line,) = (line for line in text.splitlines() if line.startswith(name))
    return float(line.split()[-1])


async def test_replicas_converge_on_what_is_published(store: Path, admin: dict[str, str]) -> None:
    async with serve(store, store_poll=POLL) as one, serve(store, store_poll=POLL) as other:
        before = (await listed(one))["generation"]
        assert (await listed(other))["generation"] == before
        publish(store, "home", "2.0.0", seed=2, alias="default")
        shutil.rmtree(store / "deep")
        for client in (one, other):

            async def follows(client: httpx.AsyncClient = client) -> bool:
                return await default(client) == "home@2.0.0"

            await until(follows)
            assert (await client.get("/models/deep")).status_code == 404
        after = (await listed(one))["generation"]
        assert (await listed(other))["generation"] == after != before

        # An alias that one of them moves reaches the other.
        response = await one.put(
            "/models/aliases/default", json={"model": "home@1.0.0"}, headers=admin
        )
        assert response.status_code == 200
        assert await default(one) == "home@1.0.0"

        async def rolls_back() -> bool:
            return await default(other) == "home@1.0.0"

        await until(rolls_back)
        assert (await listed(other))["generation"] == (await listed(one))["generation"]


async def test_a_broken_new_version_keeps_nothing_else_back(store: Path) -> None:
    async with serve(store, store_poll=POLL) as client:
        publish(store, "plain", "2.0.0", seed=3)
        corrupt(store, "plain", "2.0.0")
        publish(store, "home", "2.0.0", seed=2, alias="default")

        async def follows() -> bool:
            return await default(client) == "home@2.0.0"

        await until(follows)
        failures = {entry["subject"] for entry in (await listed(client))["failures"]}
        assert failures == {"plain@2.0.0"}
        answer = await client.post("/missing", json={"objects": ["bed"], "model": "plain"})
        assert answer.json()["model"]["version"] == "1.0.0"


async def test_an_unreadable_alias_file_changes_nothing(store: Path) -> None:
    async with serve(store, store_poll=POLL) as client:
        before = await listed(client)
        (store / "aliases.json").write_text("{")

        async def refuses() -> bool:
            return await reloads(client, "refused") > 0

        await until(refuses)
        assert await listed(client) == before
        assert await default(client) == "home@1.0.0"
        assert (await client.get("/health/ready")).status_code == 200


async def test_a_service_without_a_usable_default_becomes_ready(store: Path) -> None:
    aliases = (store / "aliases.json").read_bytes()
    (store / "aliases.json").write_text("{")
    async with serve(store, store_poll=POLL) as client:
        assert (await client.get("/health/ready")).status_code == 503
        (store / "aliases.json").write_bytes(aliases)

        async def is_ready() -> bool:
            return (await client.get("/health/ready")).status_code == 200

        await until(is_ready)


async def test_without_polling_nothing_is_followed(store: Path, admin: dict[str, str]) -> None:
    async with serve(store, store_poll=0) as client:
        publish(store, "home", "2.0.0", seed=2, alias="default")
        await asyncio.sleep(5 * POLL)
        assert await default(client) == "home@1.0.0"
        assert (await client.post("/models/refresh", headers=admin)).status_code == 200
        assert await default(client) == "home@2.0.0"
