"""A store folder that vanishes: only a publication makes a folder, and the service goes on."""

import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from app.main import create_app
from app.registry import AliasTarget, RegistryError, Store, load_model_set
from app.registry.__main__ import main
from app.registry.model_set import with_default
from app.settings import Settings
from tests.registry.small_artifacts import description, publish_as, state
from tests.services import load_changes, serve
from tests.training.commands import invoke

TARGET = AliasTarget(name="healthy")
READERS: list[Callable[[Store], object]] = [
    lambda store: store.names(),
    lambda store: store.versions("healthy"),
    lambda store: (store.aliases(), store.shipped(), store.state()),
    lambda store: store.digest("healthy", "1.0.0"),
    lambda store: store.resolve("default"),
    lambda store: store.load("healthy", "1.0.0"),
    lambda store: store.require_new("healthy", "1.0.1"),
    lambda store: with_default(load_model_set(store), store),
    lambda store: load_model_set(Store("."), release=store),
]
CHANGES: list[Callable[[Store], object]] = [
    lambda store: store.set_alias("robot", TARGET),
    lambda store: store.remove_alias("default"),
    lambda store: store.copy(store, "healthy", "1.0.0"),
]
COMMANDS = [
    ["list", "--store", "STORE"],
    ["alias", "robot", "healthy", "--store", "STORE"],
    ["remove-alias", "default", "--store", "STORE"],
    ["copy", "--from", "STORE", "--to", "OTHER"],
    ["copy", "--from", "OTHER", "--to", "STORE"],
]
TRAINING = [
    ["evaluate", "default", "--store", "STORE"],
    ["compare", "default", "--store", "STORE"],
    ["adapt", "default", "scenes.jsonl", "--store", "STORE"],
    ["publish", "healthy@1.0.0", "1.0.1", "--names", "--store", "STORE"],
]


@pytest.fixture
def published(tmp_path: Path) -> Path:
    publish_as(Store(tmp_path / "store"), "default", description("healthy"), state())
    return tmp_path / "store"


@pytest.mark.parametrize("read", READERS)
def test_readers_write_nothing(published: Path, read: Callable[[Store], object]) -> None:
    before = sorted(published.rglob("*"))
    read(Store(published))
    assert sorted(published.rglob("*")) == before


@pytest.mark.parametrize("ask", [*READERS, *CHANGES])
def test_only_a_publication_makes_the_folder(published, ask):
    store = Store(published)
    shutil.rmtree(published)
    with suppress(RegistryError):
        ask(store)
    assert not published.exists()
    store.publish(description("healthy"), state())
    assert published.is_dir()


@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
def test_commands_make_no_folder(published, tmp_path, arguments, capsys):
    shutil.copytree(published, tmp_path / "other")
    shutil.rmtree(published)
    places = {"STORE": str(published), "OTHER": str(tmp_path / "other")}
    assert main([places.get(one, one) for one in arguments]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert list(tmp_path.iterdir()) == [tmp_path / "other"]


@pytest.mark.parametrize("arguments", TRAINING, ids=" ".join)
def test_training_makes_no_folder(tmp_path: Path, arguments: list[str]) -> None:
    missing = tmp_path / "store"
    output = invoke(*(str(missing) if one == "STORE" else one for one in arguments), code=1)
    assert "store" in output
    assert not missing.exists()


async def test_a_running_service_makes_no_folder(published: Path) -> None:
    async with serve(published, store_poll=0) as client:
        shutil.rmtree(published)
        await load_changes(client)
        await client.app.state.runtime.check_store(always=True)  # type: ignore[attr-defined]
        assert (await client.post("/relations", json={"objects": ["bed"]})).status_code == 200
        assert (await client.get("/health/ready")).status_code == 200
    assert not os.path.lexists(published)  # noqa: ASYNC240


async def test_a_start_makes_no_folder(published: Path) -> None:
    app = create_app(Settings(store=published, store_poll=0))
    shutil.rmtree(published)
    async with app.router.lifespan_context(app):
        assert app.state.runtime.models.store.failure is not None
    assert not os.path.lexists(published)  # noqa: ASYNC240
    with pytest.raises(ValueError, match="SCENE_STORE must be an existing directory"):
        Settings(store=published)
