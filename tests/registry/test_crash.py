"""Publishers that die at any moment, and publishers that meet."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from app.registry import ModelSet, Store, load_model_set
from tests.registry.publishers import KILLED
from tests.registry.small_artifacts import description, state

pytestmark = pytest.mark.system


class Publishers:
    """The process of `publishers`, asked for children."""

    def __init__(self, repository: Path) -> None:
        command = [sys.executable, "-m", "tests.registry.publishers"]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, cwd=repository, stdin=pipe, stdout=pipe, text=True)

    def _ask(self, **request: Any) -> Any:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(json.dumps(request), file=self.process.stdin, flush=True)
        return json.loads(self.process.stdout.readline())

    def start(self, task: str, **arguments: Any) -> int:
        return int(self._ask(task=task, **arguments))

    def wait(self, child: int) -> dict[str, int | None]:
        return dict(self._ask(wait=child))

    def close(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.stdout.close()
        self.process.wait(30)


@pytest.fixture(scope="module")
def publishers(repository: Path) -> Iterator[Publishers]:
    running = Publishers(repository)
    yield running
    running.close()


@pytest.fixture
def published(tmp_path: Path) -> Path:
    """A store that holds tiny@1.0.0 as its default."""
    root = tmp_path / "published"
    Store(root).publish(description(), state(), alias="default")
    return root


def leftovers(root: Path) -> list[Path]:
    return [*root.glob(".publishing-*"), *root.glob("*/.publishing-*")]


def check_survivor(root: Path) -> ModelSet:
    """Everything visible verifies, and the alias is at the latest version or the one before."""
    models = load_model_set(Store(root))
    assert models.failure is None
    assert not models.failures
    models.resolve("default")
    default = models.resolve("default").manifest.version
    assert default in models.versions["tiny"][-2:]
    return models


def check_next_publication(root: Path) -> None:
    """The next publication works, and clears up."""
    store = Store(root, lock_timeout=5)
    version = f"{int(store.versions('tiny')[-1].split('.')[0]) + 1}.0.0"
    store.publish(description(version=version), state(), alias="default")
    assert not leftovers(root)
    assert load_model_set(store).resolve("default").manifest.version == version


def test_a_publisher_may_stop_before_any_step(
    publishers: Publishers, published: Path, tmp_path: Path
) -> None:
    seen = set()
    for steps in range(200):
        root = tmp_path / str(steps)
        shutil.copytree(published, root)
        ended = publishers.wait(publishers.start("publish_until", root=str(root), steps=steps))
        models = check_survivor(root)
        latest = models.versions["tiny"][-1]
        seen.add((latest, models.resolve("default").manifest.version, bool(leftovers(root))))
        check_next_publication(root)
        if ended != {"code": KILLED, "signal": None}:
            break
    assert ended == {"code": 0, "signal": None}, "the last run came to its end"
    assert steps > 15
    assert seen == {
        ("1.0.0", "1.0.0", False),  # before the first file
        ("1.0.0", "1.0.0", True),  # half written
        ("2.0.0", "1.0.0", False),  # renamed
        ("2.0.0", "1.0.0", True),  # the table of aliases half written
        ("2.0.0", "2.0.0", False),  # done
    }


def test_concurrent_publishers_and_readers(publishers: Publishers, tmp_path: Path) -> None:
    root, versions = tmp_path / "store", 12
    results = [tmp_path / f"{n}.json" for n in range(4)]
    children = [
        publishers.start("race", root=str(root), results=str(path), versions=versions)
        for path in results
    ]
    models, highest = ModelSet({}, {}), 0
    deadline = time.monotonic() + 60
    while not all(path.exists() for path in results):
        assert time.monotonic() < deadline
        models = load_model_set(Store(root), models)
        assert not models.failures
        if "default" in models.aliases:
            now = int(models.resolve("default").manifest.version.split(".")[0])
            assert now >= highest
            highest = now
    assert [publishers.wait(child) for child in children] == [{"code": 0, "signal": None}] * 4
    won = sorted(major for path in results for major in json.loads(path.read_text()))
    assert won == list(range(1, versions + 1)), "each version was published once"
    assert not leftovers(root)
    final = load_model_set(Store(root), models)
    assert not final.failures
    assert final.resolve("default").manifest.version == f"{versions}.0.0"
