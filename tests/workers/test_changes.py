"""What several workers serve: the same, before and after a change, and during one that fails."""

from __future__ import annotations

import asyncio
import json
import shutil
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.workers.agreement import RefusedError
from tests.http.conftest import ADMIN_KEY
from tests.http.stores import corrupt, publish
from tests.http.test_problems import problem
from tests.workers.conftest import fleet

pytestmark = pytest.mark.anyio

PATHS = ("/models", "/models/home", "/models/default/contexts", "/v2/models/default")


async def served(client: httpx.AsyncClient) -> list[bytes]:
    """Everything a worker says about models, and an answer of its default."""
    headers = {"X-Request-Id": "same"}
    answers = [await client.get(path, headers=headers) for path in PATHS]
    body = {"objects": ["bed", "lamp"], "seed": 1}
    answers.append(await client.post("/generate", json=body, headers=headers))
    return [answer.content for answer in answers]


async def default(client: httpx.AsyncClient) -> str:
    model = (await client.post("/missing", json={"objects": ["bed"]})).json()["model"]
    return f"{model['name']}@{model['version']}"


async def put(client: httpx.AsyncClient, alias: str, **body: Any) -> httpx.Response:
    headers = {"X-Admin-Key": ADMIN_KEY}
    return await client.put(f"/models/aliases/{alias}", json=body, headers=headers)


def stored(store: Path) -> dict[str, Any]:
    aliases: dict[str, Any] = json.loads((store / "aliases.json").read_text())
    return aliases


async def test_a_refresh_reaches_every_worker(store: Path, admin: dict[str, str]) -> None:
    async with fleet(store) as workers:
        one, two, three = [await workers.add() for _ in range(3)]
        publish(store, "home", "2.0.0", seed=2, alias="default")
        shutil.rmtree(store / "deep")
        assert [await default(c) for c in (one, two, three)] == ["home@1.0.0"] * 3
        answer = (await two.post("/models/refresh", headers=admin)).json()
        assert answer["added"] == ["home@2.0.0"]
        assert answer["removed"] == ["deep@0.1.0"]
        assert [await default(c) for c in (one, two, three)] == ["home@2.0.0"] * 3
        assert await served(one) == await served(two) == await served(three)


async def test_an_alias_reaches_every_worker(store: Path) -> None:
    async with fleet(store) as workers:
        one, two = await workers.add(), await workers.add()
        assert (await put(one, "default", model="home@1.1.0")).status_code == 200
        assert [await default(one), await default(two)] == ["home@1.1.0"] * 2
        assert (await put(two, "another", model="plain")).status_code == 200
        assert (await put(one, "default", model="home@1.0.0")).json()["previous"] == "home@1.1.0"
        assert await served(one) == await served(two)


async def test_an_alias_that_is_refused_moves_nowhere(store: Path) -> None:
    async with fleet(store) as workers:
        one, two = await workers.add(), await workers.add()
        before = await served(one)
        response = await put(one, "default", model="plain@1.0.0", expected="home@1.1.0")
        problem(response, 409, "alias-conflict")
        problem(await put(one, "Not A Name", model="plain@1.0.0"), 422, "invalid-request")
        problem(await put(two, "plain", model="home@1.0.0"), 409, "alias-conflict")
        assert await served(one) == await served(two) == before
        # The change that failed has left nothing behind that the next one trips over.
        assert (await put(two, "default", model="home@1.1.0")).status_code == 200
        assert await served(one) == await served(two) != before


async def test_a_broken_version_changes_no_worker(store: Path, admin: dict[str, str]) -> None:
    async with fleet(store) as workers:
        one, two = await workers.add(), await workers.add()
        before = await served(one)
        publish(store, "home", "2.0.0", seed=2, alias="default")
        corrupt(store, "home", "2.0.0")
        for client in (one, two):
            response = await client.post("/models/refresh", headers=admin)
            document = problem(response, 409, "refresh-refused")
            reasons = {failure["subject"]: failure["reason"] for failure in document["failures"]}
            assert reasons == {"home@2.0.0": "checksum_mismatch", "default": "checksum_mismatch"}
            assert await served(one) == await served(two) == before


async def test_one_worker_that_cannot_follow_stops_the_change(
    store: Path, admin: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from app.serving import runtime

    async with fleet(store) as workers:
        one, two, three = [await workers.add() for _ in range(3)]
        before = await served(one)
        publish(store, "home", "2.0.0", seed=2, alias="default")
        real = runtime.load_model_set

        def break_afterwards(*args: Any) -> Any:
            found = real(*args)
            corrupt(store, "home", "2.0.0")
            return found

        monkeypatch.setattr(runtime, "load_model_set", break_afterwards)
        response = await one.post("/models/refresh", headers=admin)
        document = problem(response, 409, "refresh-refused")
        # Both others say so; it is told once.
        assert [(f["subject"], f["reason"]) for f in document["failures"]] == [
            ("home@2.0.0", "checksum_mismatch")
        ]
        assert await served(one) == await served(two) == await served(three) == before


async def test_a_version_that_one_worker_cannot_ask_stops_the_change(
    store: Path, admin: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from app.serving import models

    asked = 0
    real = models.warm_up

    def fails_the_second_time(artifact: Any) -> Any:
        nonlocal asked
        if artifact.manifest.version == "2.0.0":
            asked += 1
            if asked == 2:
                raise MemoryError("secret detail")
        return real(artifact)

    async with fleet(store) as workers:
        one, two = await workers.add(), await workers.add()
        before = await served(one)
        publish(store, "home", "2.0.0", seed=2)
        monkeypatch.setattr(models, "warm_up", fails_the_second_time)
        response = await one.post("/models/refresh", headers=admin)
        document = problem(response, 409, "refresh-refused")
        assert [(f["subject"], f["reason"]) for f in document["failures"]] == [
            ("home@2.0.0", "warm_up_failed")
        ]
        assert "secret" not in response.text
        assert await served(one) == await served(two) == before
        assert (await one.post("/models/refresh", headers=admin)).status_code == 200
        assert await served(one) == await served(two) != before


async def test_changes_at_once_follow_each_other(store: Path, admin: dict[str, str]) -> None:
    async with fleet(store) as workers:
        one, two = await workers.add(), await workers.add()
        publish(store, "home", "2.0.0", seed=2)
        responses = await asyncio.gather(
            put(one, "default", model="home@1.1.0"),
            two.post("/models/refresh", headers=admin),
            put(two, "default", model="plain"),
            one.post("/models/refresh", headers=admin),
            put(one, "extra", model="deep"),
        )
        assert [response.status_code for response in responses] == [200] * 5
        assert await served(one) == await served(two)
        listing = (await one.get("/models")).json()
        leads = {alias: str(entry["name"]) for alias, entry in stored(store).items()}
        assert {a: t.partition("@")[0] for a, t in listing["aliases"].items()} == leads


async def test_a_new_worker_serves_what_the_others_do(store: Path, admin: dict[str, str]) -> None:
    async with fleet(store) as workers:
        one = await workers.add()
        publish(store, "home", "2.0.0", seed=2, alias="default")
        publish(store, "plain", "9.0.0", seed=2, variant="rbm")
        corrupt(store, "plain", "9.0.0")
        two = await workers.add()
        assert await default(two) == "home@1.0.0"
        assert await served(one) == await served(two)
        shutil.rmtree(store / "plain" / "9.0.0")
        assert (await two.post("/models/refresh", headers=admin)).status_code == 200
        assert await served(one) == await served(two) == await served(await workers.add())
        assert await default(one) == "home@2.0.0"


async def test_what_was_refused_stays_refused_in_a_new_worker(store: Path) -> None:
    corrupt(store, "home", "1.0.0")
    async with fleet(store) as workers:
        one = await workers.add()
        problem(await one.get("/health/ready"), 503, "not-ready")
        corrupt(store, "home", "1.0.0")  # the same bit again: it is whole now
        two = await workers.add()
        problem(await two.get("/health/ready"), 503, "not-ready")
        assert (await one.get("/models")).content == (await two.get("/models")).content


@pytest.mark.parametrize("how", ["removed", "another"])
async def test_a_new_worker_that_cannot_serve_the_same_stays_out(
    store: Path, admin: dict[str, str], how: str
) -> None:
    async with fleet(store) as workers:
        one = await workers.add()
        shutil.rmtree(store / "deep" / "0.1.0")
        if how == "another":
            publish(store, "deep", "0.1.0", variant="gbm", seed=5)
        with pytest.raises(RefusedError) as refused:
            await workers.add()
        (failure,) = refused.value.failures
        reason = {"removed": "unknown_version", "another": "checksum_mismatch"}[how]
        assert (failure["subject"], failure["reason"]) == ("deep@0.1.0", reason)
        # Once the others have let go of it too, there is something to share again.
        assert (await one.post("/models/refresh", headers=admin)).status_code == 200
        assert await served(await workers.add()) == await served(one)


async def test_a_change_while_a_worker_starts_reaches_it(
    store: Path, admin: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import threading

    from app.serving import runtime

    started, go_on = threading.Event(), threading.Event()
    real = runtime.restore

    def slow(*args: Any) -> Any:
        restored = real(*args)
        if not go_on.is_set():
            started.set()
            assert go_on.wait(60)
        return restored

    async with fleet(store) as workers:
        one = await workers.add()
        monkeypatch.setattr(runtime, "restore", slow)
        coming = asyncio.create_task(workers.add())
        assert await asyncio.to_thread(started.wait, 60)
        publish(store, "home", "2.0.0", seed=2, alias="default")
        # Nobody waits for one that does not serve yet.
        assert (await one.post("/models/refresh", headers=admin)).status_code == 200
        go_on.set()
        two = await coming
        assert await default(two) == "home@2.0.0"
        assert await served(one) == await served(two)


async def test_a_worker_that_takes_too_long_stops_the_change(
    store: Path, admin: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import threading

    from app.serving import runtime

    go_on = threading.Event()
    real = runtime.restore

    def slow(*args: Any) -> Any:
        assert go_on.wait(60)
        return real(*args)

    async with fleet(store) as workers:
        one, two = await workers.add(), await workers.add()
        before = await served(one)
        workers.agreement._patience = 0.5
        monkeypatch.setattr(runtime, "restore", slow)
        response = await put(one, "default", model="home@1.1.0")
        document = problem(response, 409, "refresh-refused")
        assert [(f["subject"], f["reason"]) for f in document["failures"]] == [
            ("worker", "timed_out")
        ]
        assert stored(store)["default"]["version"] == "1.0.0"
        workers.agreement._patience = 60.0
        go_on.set()
        # What it makes ready too late is not what the next change swaps in.
        assert await served(one) == await served(two) == before
        assert (await put(two, "default", model="plain")).status_code == 200
        assert await served(one) == await served(two) != before


async def test_a_worker_that_ends_stops_the_change_and_not_the_next(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from app.serving import runtime

    async with fleet(store) as workers:
        one, _ = await workers.add(), await workers.add()
        ending = workers.members[1]
        real = runtime.restore

        def die(*args: Any) -> Any:
            loop.call_soon_threadsafe(ending.kill)
            return real(*args)

        loop = asyncio.get_running_loop()
        monkeypatch.setattr(runtime, "restore", die)
        response = await put(one, "default", model="home@1.1.0")
        document = problem(response, 409, "refresh-refused")
        assert [f["reason"] for f in document["failures"]] == ["ended"]
        workers.agreement.dismiss(ending)
        monkeypatch.setattr(runtime, "restore", real)
        assert (await put(one, "default", model="home@1.1.0")).status_code == 200
        assert await served(await workers.add()) == await served(one)


async def test_a_worker_that_does_not_swap_is_ended(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with fleet(store) as workers:
        one, two = await workers.add(), await workers.add()
        stuck = workers.members[1]

        def fails() -> None:
            raise RuntimeError("stuck")

        monkeypatch.setattr(two.app.state.runtime, "commit", fails)  # type: ignore[attr-defined]
        workers.agreement._swap_patience = 0.5
        assert (await put(one, "default", model="home@1.1.0")).status_code == 200
        # By the time of the answer nobody is left who serves anything else.
        assert stuck.gone.is_set()
        assert await default(one) == "home@1.1.0"


async def test_a_leader_that_ends_changes_nothing(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from app.registry import Store

    async with fleet(store) as workers:
        one, two = await workers.add(), await workers.add()
        before = await served(two)
        leader = workers.members[0]
        loop = asyncio.get_running_loop()

        def die(*args: Any, **kwargs: Any) -> None:
            loop.call_soon_threadsafe(leader.kill)

        monkeypatch.setattr(Store, "set_alias", die)
        await put(one, "default", model="home@1.1.0")
        workers.agreement.dismiss(leader)
        monkeypatch.undo()
        assert await served(two) == before
        assert (await put(two, "candidate", model="home@1.0.0")).status_code == 200
