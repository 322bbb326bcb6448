"""A replica of a remote store: it follows the store, and serves its copy without it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest

from app.registry import AliasTarget, Store, open_store
from app.registry.index import Signer
from app.registry.remote import RemoteStore
from tests.http.stores import make_store
from tests.http.test_following import POLL, default, until
from tests.registry.object_storage import ObjectStorage, running, use
from tests.services import serve

pytestmark = pytest.mark.anyio


@pytest.fixture(scope="module")
def storage() -> Iterator[ObjectStorage]:
    with running() as storage:
        yield storage


@pytest.fixture
def url(storage: ObjectStorage, monkeypatch: pytest.MonkeyPatch) -> str:
    use(storage, monkeypatch)
    return storage.create_bucket(f"b{uuid4().hex}")


@pytest.fixture
def publisher(url: str, tmp_path: Path) -> RemoteStore:
    """A publisher that has copied the versions of `make_store` into a new bucket."""
    Signer.create(tmp_path / "key.pem")
    cache = tmp_path / "publisher"
    remote = open_store(url, signing_key=tmp_path / "key.pem", cache=cache)
    assert isinstance(remote, RemoteStore)
    local = Store(make_store(tmp_path / "local"))
    for version in local.versions("home"):
        remote.upload(local.load("home", version))
    remote.set_alias("default", AliasTarget(name="home", version="1.0.0"))
    return remote


@pytest.fixture
def settings(url: str, publisher: RemoteStore, tmp_path: Path) -> dict[str, object]:
    key = Signer.read(tmp_path / "key.pem").public
    return {
        "store": url,
        "trusted_keys": [key],
        "store_cache": tmp_path / "cache",
        "store_poll": POLL,
    }


async def test_a_replica_follows_the_store(
    publisher: RemoteStore, settings: dict[str, object]
) -> None:
    async with serve(**settings) as client:  # type: ignore[arg-type]
        assert await default(client) == "home@1.0.0"
        for version in ("1.1.0", "1.0.0"):
            publisher.set_alias("default", AliasTarget(name="home", version=version))

            async def follows(wanted: str = f"home@{version}") -> bool:
                return await default(client) == wanted

            await until(follows)
        health = (await client.get("/health/ready")).json()
        assert health["status"] == "ready"
        assert set(health["store"]) == {"age_s"}


async def test_a_replica_stays_ready_without_the_store(
    storage: ObjectStorage, settings: dict[str, object]
) -> None:
    async with serve(**settings) as client:  # type: ignore[arg-type]
        await default(client)
    storage.stop()
    try:
        async with serve(**settings) as client:  # type: ignore[arg-type]
            assert await default(client) == "home@1.0.0"
            health = (await client.get("/health/ready")).json()
            assert health["status"] == "ready"
            assert health["store"]["reason"] == "unreachable"
        async with serve(**settings, store_max_age=0.001) as client:  # type: ignore[arg-type]
            assert (await client.get("/health/ready")).status_code == 503
    finally:
        storage.start()


async def test_a_revoked_version_leaves_the_service(
    publisher: RemoteStore, settings: dict[str, object]
) -> None:
    async with serve(**settings) as client:  # type: ignore[arg-type]

        async def status() -> int:
            body = {"objects": ["bed"], "model": "home@1.1.0"}
            answer = await client.post("/missing", json=body)
            return answer.status_code

        async def is_refused() -> bool:
            return await status() == 503

        assert await status() == 200
        publisher.revoke("home", "1.1.0", "wrong labels")
        await until(is_refused)
        assert await default(client) == "home@1.0.0"


async def test_a_replica_without_a_signing_key_moves_no_alias(
    settings: dict[str, object], admin: dict[str, str]
) -> None:
    async with serve(**settings) as client:  # type: ignore[arg-type]
        body = {"model": "home@1.1.0"}
        answer = await client.put("/models/aliases/default", json=body, headers=admin)
        assert answer.json()["type"].endswith("store-not-writable")
