"""``python -m benchmarks.gate COMMIT``: compare the throughput with that of an earlier commit.

Both services run in the same run, on the same core, each with its own `model_store`, and answer the
same requests in turn. The exit status is 1 if a question has less than 90 % of the earlier rate.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Final

import typer

from benchmarks.load import servers
from benchmarks.load.measure import compare, concurrency
from benchmarks.load.questions import ROUTES, labels_of, requests

_KIND: Final = "12 labels"
_CONNECTIONS: Final = 32
_LEAST: Final = 0.9


def main(
    commit: Annotated[str, typer.Argument(help="commit of the last release")],
    seconds: Annotated[float, typer.Option(min=0.1, help="seconds per measurement")] = 1.5,
) -> None:
    """Print the rate of each question, divided by its rate in an earlier commit."""
    slower = []
    with ExitStack() as stack:
        stack.callback(os.sched_setaffinity, 0, os.sched_getaffinity(0))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "earlier"
        git("worktree", "add", "--quiet", "--detach", str(folder), commit)
        stack.callback(git, "worktree", "remove", "--force", str(folder))
        ports = tuple(
            stack.enter_context(servers.service(root / "model_store", root=root)).port
            for root in (servers.ROOT, folder)
        )
        os.sched_setaffinity(0, servers.cores()[1])
        for route in ROUTES:
            bodies = requests(_KIND, route, labels_of(ports[1]))
            names = _KIND, route, f"{_CONNECTIONS} connections"
            load = concurrency(_CONNECTIONS)
            result = compare((ports[0], ports[1]), bodies, load, names, seconds=seconds)
            print(f"{route}: {result.rate_ratio:.2f} of the rate of {commit}", flush=True)
            if result.rate_ratio < _LEAST:
                slower.append(route)
    if slower:
        sys.exit(f"slower than {commit}: {', '.join(slower)}")


def git(*arguments: str) -> None:
    """Run git in the root of the repository."""
    subprocess.run(("git", *arguments), cwd=servers.ROOT, check=True)


if __name__ == "__main__":
    typer.run(main)
