"""A service of a new release on the store of the last release, whose models it cannot load."""

from pathlib import Path
from typing import Any

import pytest
from httpx import AsyncClient

from app.registry import DEFAULT_STORE, AliasTarget, Store
from tests.http.test_problems import problem
from tests.registry.small_artifacts import (
    copy,
    description,
    make_outdated,
    publish_as,
    state,
    state_replaced,
)
from tests.services import serve

PARENT = {"parent": {"name": "old", "version": "3.5.0"}}
OBJECTS = {"objects": ["bed", "lamp"]}


@pytest.fixture
def volume(tmp_path: Path) -> Store:
    """Shipped models of the last release, an adapted home (default) and an own model."""
    store = Store(tmp_path / "volume")
    store.publish(description("old", "3.5.0"), state(seed=1))
    publish_as(store, "default", description("home", training=PARENT), state(seed=2))
    publish_as(store, "mine", description("lab"), state(seed=3))
    for name in store.names():
        make_outdated(store, name, *store.versions(name))
    return store


@pytest.fixture
def release(tmp_path: Path, volume: Store, monkeypatch: pytest.MonkeyPatch) -> Store:
    """The shipped store of the new release, where the service looks for it."""
    store = Store(tmp_path / DEFAULT_STORE)
    publish_as(store, "default", description("new", "4.0.0"), state())
    state_replaced(store, volume, {"old": "new"})
    monkeypatch.chdir(tmp_path)
    return store


async def answering(client: AsyncClient, **fields: Any) -> str:
    response = await client.post("/missing", json=OBJECTS | fields)
    assert response.status_code == 200, response.text
    model = response.json()["model"]
    return f"{model['name']}@{model['version']}"


@pytest.mark.parametrize("is_copied", [True, False], ids=["volume", "own folder"])
async def test_the_shipped_default_answers(volume: Store, release: Store, is_copied: bool) -> None:
    if is_copied:
        assert copy(release, volume) == 0
    assert str(volume.aliases()["default"]) == "home@1.0.0", "an own model keeps the alias"
    async with serve(volume.root, store_poll=0) as client:
        ready = await client.get("/health/ready")
        assert ready.status_code == 200
        failures = {entry["subject"]: entry for entry in ready.json()["failures"]}
        assert list(failures)[:2] == ["default", "mine"], "the first failures name the aliases"
        for alias, own, again in (("default", "home", "adapt"), ("mine", "lab", "train")):
            assert await answering(client, model=alias) == "new@4.0.0"
            assert failures[alias]["reason"] == "outdated_format"
            assert f"{own}@1.0.0: manifest.json has format" in failures[alias]["detail"]
            assert f"(python -m training {again})" in failures[alias]["detail"]
            assert failures[alias]["detail"].endswith("; new@4.0.0 answers instead")
            response = await client.post("/missing", json=OBJECTS | {"model": own})
            detail = problem(response, 503, "model-unavailable")["detail"]
            assert f"python -m training {again}" in detail
        listing = (await client.get("/models")).json()
        assert listing["failures"][:4] == ready.json()["failures"][:4]
        (shipped,) = [model for model in listing["models"] if model["name"] == "new"]
        assert shipped["versions"][0]["aliases"] == ["default", "mine"]


async def test_a_damaged_own_model_is_not_replaced(volume: Store, release: Store) -> None:
    volume.publish(description("home", "1.1.0"), state(seed=5))
    volume.set_alias("default", AliasTarget.of("home@1.1.0"))
    (volume.root / "home" / "1.1.0" / "model.safetensors").write_bytes(b"")
    async with serve(volume.root) as client:
        problem(await client.get("/health/ready"), 503, "not-ready")


@pytest.mark.parametrize("store", ["volume", "release"])
async def test_replaced_names(store: str, request: pytest.FixtureRequest, release: Store) -> None:
    async with serve(request.getfixturevalue(store).root) as client:
        for name in ("old", "old@3.5.0"):
            body = OBJECTS | {"model": name}
            document = problem(await client.post("/missing", json=body), 404, "model-replaced")
            assert document["detail"].startswith("The model new replaces the model old.")
            (error,) = document["errors"]
            assert (error["pointer"], error["suggestions"]) == ("#/model", ["new"])
            batch = {"scenes": [OBJECTS, body]}
            answer, refused = (await client.post("/missing/batch", json=batch)).json()["results"]
            assert answer["result"]["model"]["name"] == "new"
            assert refused["problem"]["type"] == document["type"]
            assert refused["problem"]["errors"][0]["pointer"] == "#/scenes/1/model"
            path = f"/models/{name}/vocabulary"
            assert "errors" not in problem(await client.get(path), 404, "model-replaced")
        problem(await client.get("/models/older/vocabulary"), 404, "model-not-found")
