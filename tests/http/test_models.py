"""Listing, refreshing and promoting models."""

from __future__ import annotations

import asyncio
import errno
import gc
import json
import math
import os
import shutil
import threading
import weakref
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx
import pytest

from app.registry import Store, StoreError
from app.scene.relations import CANONICAL, opposite
from tests.http.stores import PROFILES, VOCABULARY, corrupt, publish
from tests.http.test_problems import problem
from tests.services import ADMIN_KEY, PATIENCE, Hold, Replace, defect, serve


async def default(client: httpx.AsyncClient) -> str:
    response = await client.post("/relations", json={"objects": ["bed", "lamp"]})
    assert response.status_code == 200, response.text
    model = response.json()["model"]
    return f"{model['name']}@{model['version']}"


# ----------------------------------------------------------------------------------- reading


async def test_models_versions_and_aliases_are_listed(client: httpx.AsyncClient) -> None:
    listing = (await client.get("/models")).json()
    assert listing["aliases"] == {"candidate": "home@1.1.0", "default": "home@1.0.0"}
    assert listing["failures"] == []
    models = {model["name"]: model["versions"] for model in listing["models"]}
    assert set(models) == {"home", "plain", "deep"}
    assert [version["version"] for version in models["home"]] == ["1.1.0", "1.0.0"]
    assert [version["aliases"] for version in models["home"]] == [["candidate"], ["default"]]
    assert {version["status"] for versions in models.values() for version in versions} == {"ready"}
    assert models["plain"][0]["variant"] == "rbm"
    for name in ("home", "default", "candidate"):
        model = (await client.get(f"/models/{name}")).json()
        assert model == {"name": "home", "versions": models["home"]}


async def test_the_vocabulary_tells_every_word(client: httpx.AsyncClient) -> None:
    words = (await client.get("/models/default/vocabulary")).json()
    assert [entry["label"] for entry in words["objects"]] == list(VOCABULARY.labels)
    for entry, known in zip(words["objects"], VOCABULARY.objects, strict=True):
        assert (entry["parent"], entry["anywhere"]) == (known.parent, known.anywhere)
        assert (entry["aliases"], entry["structure"]) == ([*known.aliases], known.structure)
        size = entry["size"]
        assert (size and tuple(size[axis] for axis in "xyz")) == known.size
    assert words["room_types"] == list(VOCABULARY.room_types)
    assert words["profiles"] == list(PROFILES)
    assert set(words["relations"]) == {*CANONICAL, *map(opposite, CANONICAL)}
    assert words["model"]["version"] == "1.0.0"
    (example,) = words["examples"]
    assert example["name"] == "A bedroom"
    assert (await client.post("/missing", json=example["scene"])).status_code == 200


@pytest.mark.parametrize(
    ("word", "label", "rule", "certain"),
    [
        ("desk", "desk", "label", True),
        ("Bedside_Tables", "nightstand", "alias", True),
        ("pile of books", "book", "phrase", True),
        ("divan/couch", "sofa", "alternative", True),
        ("bed_2", "bed", "instance", True),
        ("keybaord", "keyboard", "spelling", False),
        ("office lamp", "lamp", "head", False),
    ],
)
async def test_a_word_becomes_a_class(
    client: httpx.AsyncClient, word: str, label: str, rule: str, certain: bool
) -> None:
    answer = (await client.get(f"/models/default/vocabulary/{quote(word)}")).json()
    assert (answer["word"], answer["class"]["label"]) == (word, label)
    assert (answer["rule"], answer["certain"]) == (rule, certain)
    assert (answer["class"].get("parent") == "table") == (label == "desk")
    # A request accepts the label by the same rule.
    body = {"objects": [word], "unknown_labels": "error" if certain else "nearest"}
    mapped = (await client.post("/missing", json=body)).json()["mapped"]
    expected = [] if rule in ("label", "alias", "phrase") else [(label, rule)]
    assert [(entry["class"], entry["rule"]) for entry in mapped] == expected


@pytest.mark.parametrize(
    "path",
    [
        *("nobody", "nobody/versions/1.0.0", "home/versions/9.9.9", "home/versions/nonsense"),
        *("nobody/vocabulary", "nobody/vocabulary/bed", "home@9.9.9/contexts"),
        *("../v2/models/nobody", "../v2/models/nobody/ready"),
    ],
)
async def test_unknown_models_are_not_found(client: httpx.AsyncClient, path: str) -> None:
    problem(await client.get(f"/models/{path}"), 404, "model-not-found")


# ----------------------------------------------------------------------------------- refresh


async def test_a_refresh_takes_over_new_versions(own: httpx.AsyncClient, store: Path) -> None:
    publish(store, "home", "2.0.0", seed=2, alias="default")
    shutil.rmtree(store / "deep")
    assert await default(own) == "home@1.0.0"
    response = await own.post("/models/refresh")
    assert response.status_code == 200
    answer = response.json()
    assert answer["added"] == ["home@2.0.0"]
    assert answer["removed"] == ["deep@0.1.0"]
    assert answer["default"]["version"] == "2.0.0"
    assert answer["request_id"] == response.headers["x-request-id"]
    assert await default(own) == "home@2.0.0"
    problem(await own.get("/models/deep"), 404, "model-not-found")
    again = (await own.post("/models/refresh")).json()
    assert (again["added"], again["removed"]) == ([], [])


@pytest.mark.parametrize("log_odds", [None, math.inf], ids=["raises", "not finite"])
async def test_a_version_that_cannot_answer_is_refused(
    own: httpx.AsyncClient,
    store: Path,
    replace: Replace,
    caplog: pytest.LogCaptureFixture,
    log_odds: float | None,
) -> None:
    def fails(missing: Any, artifact: Any, *args: Any, **parameters: Any) -> Any:
        answer = missing(artifact, *args, **parameters)
        if artifact.manifest.version != "2.0.0":
            return answer
        if log_odds is None:
            return defect()
        return answer | {"missing": [{"log_odds": log_odds}]}

    replace("missing", fails)
    publish(store, "home", "2.0.0", seed=2, alias="default")
    response = await own.post("/models/refresh")
    document = problem(response, 409, "refresh-refused")
    reasons = {failure["subject"]: failure["reason"] for failure in document["failures"]}
    assert reasons == {"home@2.0.0": "warm_up_failed", "default": "warm_up_failed"}
    assert ("not finite" in caplog.text) == (log_odds is not None)
    assert "secret" not in response.text
    assert await default(own) == "home@1.0.0"


async def test_requests_are_answered_while_the_store_is_read(
    own: httpx.AsyncClient, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started, go_on, load = threading.Event(), threading.Event(), Store.load

    def slow(*args: Any) -> Any:
        started.set()
        assert go_on.wait(PATIENCE)
        return load(*args)

    monkeypatch.setattr(Store, "load", slow)
    publish(store, "home", "2.0.0", seed=2, alias="default")
    refresh = asyncio.create_task(own.post("/models/refresh"))
    assert await asyncio.to_thread(started.wait, PATIENCE)
    assert await default(own) == "home@1.0.0"
    assert (await own.get("/health/ready")).status_code == 200
    assert not refresh.done()
    go_on.set()
    assert (await refresh).status_code == 200
    assert await default(own) == "home@2.0.0"


async def test_a_request_keeps_the_models_it_started_with(
    own: httpx.AsyncClient, store: Path, hold: Hold
) -> None:
    held = hold("missing", lambda manifest: manifest.version == "1.0.0")
    batch = {"scenes": [{"objects": ["bed"] * 33}] * 3}  # so many are not for the event loop
    asking = asyncio.create_task(own.post("/missing/batch", json=batch))
    assert await asyncio.to_thread(held.started.wait, PATIENCE)
    publish(store, "home", "2.0.0", seed=2, alias="default")
    assert (await own.post("/models/refresh")).status_code == 200
    assert await default(own) == "home@2.0.0"
    held.release.set()
    results = (await asking).json()["results"]
    assert [entry["result"]["model"]["version"] for entry in results] == ["1.0.0"] * 3


async def test_replaced_models_are_freed(
    own: httpx.AsyncClient, store: Path, replace: Replace
) -> None:
    asked: list[weakref.ref[Any]] = []

    def note(missing: Any, artifact: Any, *args: Any, **parameters: Any) -> Any:
        asked.append(weakref.ref(artifact.weights))
        return missing(artifact, *args, **parameters)

    replace("missing", note)
    for model in ("deep", "home"):
        await own.post("/missing", json={"objects": ["bed"], "model": model})
    shutil.rmtree(store / "deep")
    await own.post("/models/refresh")
    await own.post("/models/refresh")
    await own.post("/missing", json={"objects": ["bed"], "model": "home"})
    replaced, kept, again = asked
    assert replaced() is None
    # An unchanged artifact is verified again and not loaded twice.
    assert again() is kept() is not None
    assert gc.get_freeze_count() > 0


# ----------------------------------------------------------------------------------- aliases


async def put(client: httpx.AsyncClient, alias: str, **body: Any) -> httpx.Response:
    headers = {"X-Admin-Key": ADMIN_KEY}
    return await client.put(f"/models/aliases/{alias}", json=body, headers=headers)


def stored(store: Path) -> dict[str, Any]:
    aliases: dict[str, Any] = json.loads((store / "aliases.json").read_text())
    return aliases


async def test_an_alias_is_promoted_and_rolled_back(store: Path) -> None:
    async with serve(store) as client:
        response = await put(client, "default", model="home@1.1.0", expected="home@1.0.0")
        assert response.status_code == 200, response.text
        assert response.json() == {
            "request_id": response.headers["x-request-id"],
            "alias": "default",
            "model": "home@1.1.0",
            "previous": "home@1.0.0",
        }
        assert await default(client) == "home@1.1.0"
        assert stored(store)["default"] == {"name": "home", "version": "1.1.0"}
        await put(client, "default", model="home@1.0.0")
        assert await default(client) == "home@1.0.0"
    async with serve(store) as client:
        assert await default(client) == "home@1.0.0"


@pytest.mark.parametrize(
    ("alias", "body", "status", "slug"),
    [
        *[(alias, {"model": "home"}, 422, "invalid-request")
          for alias in ("UPPER", "-x", "x" * 65, "a b", "a%2e")],
        *[("default", {"model": model}, 404, "model-not-found")
          for model in ("nobody", "home@9.9.9", "HOME")],
        ("default", {}, 422, "invalid-request"),
        ("plain", {"model": "home"}, 409, "alias-conflict"),
    ],
)  # fmt: skip
async def test_invalid_alias_moves_are_refused(
    client: httpx.AsyncClient, alias: str, body: dict[str, str], status: int, slug: str
) -> None:
    problem(await put(client, alias, **body), status, slug)


async def test_a_refused_or_removed_version_takes_no_alias(store: Path) -> None:
    corrupt(store, "plain", "1.0.0")
    async with serve(store) as client:
        problem(await put(client, "default", model="plain"), 409, "model-unusable")
        shutil.rmtree(store / "deep")
        problem(await put(client, "default", model="deep@0.1.0"), 404, "model-not-found")


async def test_a_read_only_or_locked_store_is_refused(
    own: httpx.AsyncClient, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.open

    def read_only(path: Any, flags: int, *args: Any, **keywords: Any) -> int:
        # As a root user the tests could write anywhere; a read-only mount refuses even root.
        if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT) and str(store) in str(path):
            raise OSError(errno.EROFS, "Read-only file system", str(path))
        return real(path, flags, *args, **keywords)

    def busy(*_: Any, **__: Any) -> None:
        raise StoreError("locked", "another process writes")

    monkeypatch.setattr(os, "open", read_only)
    response = await put(own, "default", model="plain@1.0.0")
    problem(response, 409, "store-not-writable")
    assert str(store) not in response.text
    monkeypatch.setattr(Store, "set_alias", busy)
    problem(await put(own, "default", model="plain@1.0.0"), 503, "store-busy")
    assert await default(own) == "home@1.0.0"


# ------------------------------------------------------------------------------------------ polling


POLL = 0.05
Ask = Callable[[httpx.AsyncClient], Awaitable[Any]]


async def listed(client: httpx.AsyncClient) -> dict[str, Any]:
    answer: dict[str, Any] = (await client.get("/models")).json()
    return answer


async def ready(client: httpx.AsyncClient) -> int:
    return (await client.get("/health/ready")).status_code


async def until(client: httpx.AsyncClient, ask: Ask, expected: Any) -> None:
    async with asyncio.timeout(PATIENCE):
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
