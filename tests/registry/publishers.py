"""A process that forks publishers on demand, so that each is born with its imports done.

Run as a module. It reads one JSON request a line from standard input and answers each with a line:

    {"task": "...", "root": "...", ...}     the process id of a new publisher
    {"wait": pid}                           how it ended: {"code": int | null, "signal": int | null}
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import traceback
from pathlib import Path
from typing import Any

from app.registry import Store, StoreError
from tests.registry.small_artifacts import description, state

WEIGHTS = state()
KILLED = 9


def publish_until(root: str, steps: int) -> None:
    """Publish one version, but die before the given step that touches the file system."""
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

    store = Store(root)
    sys.addaudithook(hook)
    os.fsync = watched
    store.publish(description(version="2.0.0"), WEIGHTS, alias="default")


def race(root: str, results: str, versions: int) -> None:
    """Try to publish 1.0.0, 2.0.0 … against others; write down which were won."""
    store = Store(root)
    won = []
    for major in range(1, versions + 1):
        try:
            store.publish(description(version=f"{major}.0.0"), WEIGHTS, alias="default")
        except StoreError as error:
            if error.code != "version_exists":
                raise
        else:
            won.append(major)
    Path(results).write_text(json.dumps(won))


TASKS = {"publish_until": publish_until, "race": race}


def _fork(request: dict[str, Any]) -> int:
    if child := os.fork():
        return child
    code = 1
    try:
        TASKS[request.pop("task")](**request)
        code = 0
    finally:
        if code:
            traceback.print_exc()
        os._exit(code)  # past the parent's own loop and handlers


def _wait(child: int) -> dict[str, int | None]:
    status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status):
        return {"code": None, "signal": os.WTERMSIG(status)}
    return {"code": os.WEXITSTATUS(status), "signal": None}


def main() -> None:
    with tempfile.TemporaryDirectory() as root:  # whatever the first publication imports
        Store(root).publish(description(), WEIGHTS)
    for line in sys.stdin:
        request = json.loads(line)
        answer = _wait(request["wait"]) if "wait" in request else _fork(request)
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
