"""A store with one hostile version: it is refused, the others serve, and memory stays bounded."""

import json
import os
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import pytest

from app.registry import Store, StoreError, load_model_set
from app.registry.artifact import MAX_MANIFEST_BYTES
from app.registry.tensors import MAX_HEADER_BYTES
from tests.registry.small_artifacts import (
    description,
    publish_as,
    replace_file,
    resign,
    rewrite_manifest,
    state,
)
from tests.services import load_changes, serve

TERABYTE = 2**40


@contextmanager
def at_most(megabytes: int) -> Iterator[None]:
    """Python's own allocations inside stay below this."""
    tracemalloc.start()
    try:
        yield
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < megabytes * 2**20, f"{peak / 2**20:.0f} MB"


@pytest.fixture
def published(tmp_path: Path) -> Path:
    """A store whose default is healthy, and a second version of another name to be spoilt."""
    store = Store(tmp_path / "store")
    publish_as(store, "default", description("healthy"), state())
    store.publish(description("hostile"), state())
    return tmp_path / "store"


def hostile(root: Path) -> Path:
    return root / "hostile" / "1.0.0"


def as_pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def enlarge(folder: Path, name: str) -> None:
    """Make a sparse file of a terabyte, whose size the manifest confirms."""
    os.truncate(folder / name, TERABYTE)
    rewrite_manifest(folder, lambda members: members["files"][name].update(bytes=TERABYTE))


def many_tensors(root: Path) -> None:
    header = b'{"a":{"dtype":"F32","shape":[0],"data_offsets":[0,0]}' + b" " * MAX_HEADER_BYTES
    header += b"}"
    replace_file(hostile(root), "model.safetensors", len(header).to_bytes(8, "little") + header)


def large_examples(root: Path) -> None:
    scene = {"objects": [{"label": "bed", "id": f"{k:099}"} for k in range(64)]}
    examples = [{"name": "a", "scene": scene}] * 8
    rewrite_manifest(hostile(root), lambda members: members.update(examples=examples))


SPOILED = [
    (lambda root: as_pipe(hostile(root) / "manifest.json"), "unreadable"),
    (lambda root: enlarge(hostile(root), "card.md"), "too_large"),
    (lambda root: enlarge(hostile(root), "model.safetensors"), "too_large"),
    (lambda root: os.truncate(hostile(root) / "manifest.json", TERABYTE), "too_large"),
    (many_tensors, "too_large"),
    (large_examples, "invalid_manifest"),
]


@pytest.mark.parametrize(("spoil", "code"), SPOILED)
def test_hostile_versions(published: Path, spoil: Callable[[Path], None], code: str) -> None:
    spoil(published)
    with at_most(32):
        models = load_model_set(Store(published))
    failures = {key: failure.code for key, failure in models.failures.items()}
    assert failures == {("hostile", "1.0.0"): code}
    models.resolve("default")


async def test_a_loaded_version_stays_usable(published: Path) -> None:
    async with serve(published, store_poll=0) as client:
        enlarge(hostile(published), "card.md")
        await load_changes(client)
        body = {"objects": ["bed"], "model": "hostile"}
        assert (await client.post("/relations", json=body)).status_code == 200
        assert (await client.get("/models")).json()["failures"] == []
    async with serve(published, store_poll=0) as client:
        assert len((await client.get("/models")).json()["failures"]) == 1


@pytest.mark.parametrize("error", [OverflowError, MemoryError, RecursionError, KeyError])
def test_an_error_refuses_one_version(published, monkeypatch, error):
    load = Store.load

    def fail(self: Store, name: str, *rest: object) -> object:
        if name == "hostile":
            raise error
        return load(self, name, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(Store, "load", fail)
    models = load_model_set(Store(published))
    models.resolve("default")
    failures = {key: failure.code for key, failure in models.failures.items()}
    assert failures == {("hostile", "1.0.0"): "unexpected_error"}
    assert error.__name__ in models.failures["hostile", "1.0.0"].reason


def test_the_operator_limits_the_weights(published: Path) -> None:
    models = load_model_set(Store(published, max_weights_bytes=100))
    assert {failure.code for failure in models.failures.values()} == {"too_large"}


def test_loads_are_linear_in_versions(published: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = Counter[str]()

    def counted(name: str) -> None:
        function = getattr(os, name)

        def call(*args: Any, **keywords: Any) -> Any:
            calls[name] += 1
            return function(*args, **keywords)

        monkeypatch.setattr(os, name, call)

    for name in ("stat", "lstat", "open", "listdir", "scandir"):
        counted(name)
    store, totals = Store(published), []
    for size in (50, 100):
        for number in range(size):
            junk = published / "hostile" / f"9.9.{number}"
            junk.mkdir(parents=True, exist_ok=True)
            (junk / "manifest.json").write_bytes(b"{}")
        calls.clear()
        store.state()
        assert len(load_model_set(store).failures) == size
        totals.append(calls.total())
    assert 0 < totals[1] <= 2 * totals[0]


@pytest.mark.parametrize("spoil", [lambda path: os.truncate(path, TERABYTE), as_pipe])
def test_hostile_alias_tables_are_refused(published: Path, spoil: Callable[[Path], None]) -> None:
    spoil(published / "aliases.json")
    with at_most(4), pytest.raises(StoreError) as refused:
        Store(published).aliases()
    assert refused.value.code == "invalid_aliases"


@pytest.mark.slow
@pytest.mark.parametrize("place", ["metrics", "vocabulary.objects", "training.x"])
def test_a_manifest_of_a_million_objects(published: Path, place: str) -> None:
    folder, (*path, last) = hostile(published), place.split(".")
    rewrite_manifest(folder, lambda members: reduce(getitem, path, members).update({last: "@"}))
    body = json.loads((folder / "manifest.json").read_bytes())
    del body["checksum"]
    many = "[" + ",".join(["{}"] * (MAX_MANIFEST_BYTES // 3 - 100_000)) + "]"
    data = resign(json.dumps(body).replace('"@"', many).encode())
    assert len(data) < MAX_MANIFEST_BYTES
    (folder / "manifest.json").write_bytes(data)
    with at_most(400):
        models = load_model_set(Store(published))
    models.resolve("default")
    # Free JSON of the trainer may hold anything.
    assert bool(models.failures) == (place != "training.x")
