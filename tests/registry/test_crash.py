"""Publishers that die at any moment, and publishers that meet."""

import json
import multiprocessing
import os
import shutil
import sys
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import pytest

from app.registry import AliasTarget, ModelSet, Store, StoreError, load_model_set
from tests.registry import small_artifacts
from tests.registry.small_artifacts import description, publish_as, state
from tests.services import PATIENCE

pytestmark = pytest.mark.system

KILLED, WEIGHTS = 9, state()
# A process forks the publishers, which then have their imports done. The process of the tests has
# threads, so it must not fork.
PUBLISHERS = multiprocessing.get_context("forkserver")
PUBLISHERS.set_forkserver_preload([__name__])


def publish(root: Path) -> None:
    publish_as(Store(root), "default", description(version="2.0.0"), WEIGHTS)


def copy(root: Path) -> None:
    assert small_artifacts.copy(Store(root.parent / "newer"), Store(root)) == 0


def run_until(write: Callable[[Path], None], root: Path, steps: int) -> None:
    """Write to a store, but die before the given step that touches the file system."""
    left = steps
    writing = os.O_WRONLY | os.O_RDWR | os.O_CREAT
    changing = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "fcntl.flock", "os.scandir"}
    fsync = os.fsync

    def step() -> None:
        nonlocal left
        if left == 0:
            os._exit(KILLED)
        left -= 1

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event in changing or (event == "open" and arguments[2] & writing):
            step()

    def watched(descriptor: int) -> None:
        step()
        fsync(descriptor)

    sys.addaudithook(hook)
    os.fsync = watched
    write(root)
    os._exit(0)


def race(root: Path, results: Path, versions: int) -> None:
    """Try to publish 1.0.0, 2.0.0 … beside others, and write down the successes."""
    store, won = Store(root, lock_timeout=PATIENCE), []
    for major in range(1, versions + 1):
        try:
            store.publish(description(version=f"{major}.0.0"), WEIGHTS)
        except StoreError as error:
            if error.code != "version_exists":
                raise
        else:
            won.append(major)
    results.write_text(json.dumps(won))


def start(target: Any, *arguments: Any) -> BaseProcess:
    process = PUBLISHERS.Process(target=target, args=arguments)
    process.start()
    return process


def exit_code(process: BaseProcess) -> int | None:
    process.join(PATIENCE)
    return process.exitcode


def leftovers(root: Path) -> list[Path]:
    return [*root.glob(".publishing-*"), *root.glob("*/.publishing-*")]


def check_survivor(root: Path) -> tuple[str, str, bool]:
    """Check the store, and return newest version, default, and whether a temporary file is left."""
    models, left = load_model_set(Store(root)), bool(leftovers(root))
    assert models.failure is None
    assert not models.failures
    newest, default = models.versions["tiny"][-1], models.resolve("default").manifest.version
    store = Store(root)
    publish_as(store, "default", description(version="3.0.0"), WEIGHTS)
    assert not leftovers(root)
    assert load_model_set(store).resolve("default").manifest.version == "3.0.0"
    return newest, default, left


@pytest.mark.parametrize("write", [publish, copy])
def test_a_writer_may_stop_before_any_step(tmp_path: Path, write: Callable[[Path], None]) -> None:
    publish_as(Store(tmp_path / "newer"), "default", description(version="2.0.0"), WEIGHTS)
    published = tmp_path / "published"
    publish_as(Store(published), "default", description(), WEIGHTS)
    seen, ended = set(), None
    for steps in range(200):
        root = tmp_path / str(steps)
        shutil.copytree(published, root)
        ended = exit_code(start(run_until, write, root, steps))
        seen.add(check_survivor(root))
        if ended != KILLED:
            break
    assert ended == 0, "the last run came to its end"
    assert steps > 15
    assert seen == {
        ("1.0.0", "1.0.0", False),  # before the first file
        ("1.0.0", "1.0.0", True),  # half written
        ("2.0.0", "1.0.0", False),  # renamed
        ("2.0.0", "1.0.0", True),  # the table of aliases half written
        ("2.0.0", "2.0.0", False),  # done
    }


def test_concurrent_publishers_and_readers(tmp_path: Path) -> None:
    root, versions = tmp_path / "store", 12
    Store(root).publish(description(version="0.0.1"), WEIGHTS)
    Store(root).set_alias("default", AliasTarget(name="tiny"))
    results = [tmp_path / f"{n}.json" for n in range(4)]
    publishers = [start(race, root, path, versions) for path in results]
    models, highest, deadline = ModelSet({}, {}), 0, time.monotonic() + PATIENCE
    while any(process.is_alive() for process in publishers):
        assert time.monotonic() < deadline
        models = load_model_set(Store(root), models)
        assert not models.failures
        version = int(models.resolve("default").manifest.version.split(".")[0])
        assert version >= highest
        highest = version
    assert [exit_code(process) for process in publishers] == [0] * 4
    won = sorted(major for path in results for major in json.loads(path.read_text()))
    assert won == list(range(1, versions + 1)), "each version was published once"
    assert not leftovers(root)
    final = load_model_set(Store(root), models)
    assert not final.failures
    assert final.resolve("default").manifest.version == f"{versions}.0.0"
