"""A copy of the repository and a running service, as a new engineer would have them."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.services import free_port, is_ready, wait_until

_LEFT_OUT = shutil.ignore_patterns(
    ".git", ".venv", "build", "dist", "runs", ".hypothesis", ".*_cache"
)


@dataclass(frozen=True)
class Workplace:
    """A copy of the repository, and the service that `make run` started."""

    folder: Path
    address: str

    @property
    def environment(self) -> dict[str, str]:
        """Of a shell there: programs of the environment are on the path."""
        programs = os.pathsep.join([str(self.folder / ".venv" / "bin"), os.environ["PATH"]])
        return _without_settings() | {"PATH": programs, "PYTHONPATH": str(self.folder)}


@pytest.fixture(scope="session")
def workplace(
    repository: Path,
    tmp_path_factory: pytest.TempPathFactory,
    require_system_tool: Callable[[str], Path],
) -> Iterator[Workplace]:
    """`make run`, and a fresh copy of the repository for the commands of the pages.

    All in the copy is as in a checkout but for `.venv`, see `install`. The service runs from the
    repository itself: numba's cache belongs to a path, and a copy would compile for a minute.
    """
    for tool in ("make", "curl", "bash"):
        require_system_tool(tool)
    folder = tmp_path_factory.mktemp("checkout") / "scene"
    shutil.copytree(repository, folder, ignore=_LEFT_OUT, symlinks=True)
    install(folder)
    port = free_port()
    place = Workplace(folder, f"127.0.0.1:{port}")
    log = folder.parent / "log"
    with log.open("w") as stream:
        process = subprocess.Popen(
            ["make", "run", f"PORT={port}", f"VENV={folder / '.venv'}"],
            cwd=repository,
            env=place.environment,
            stdout=stream,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    try:
        # Loops that are compiled anew take a minute or two.
        wait_until(lambda: is_ready(port) or process.poll() is not None, log, seconds=400)
        assert process.poll() is None, log.read_text()
        yield place
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(timeout=60)


def install(folder: Path) -> None:
    """Give the copy this interpreter's environment for its `.venv`, and programs of its own.

    With the stamps of an installation: installing anew would take minutes and the internet
    (tests/system installs for the image).
    """
    environment = folder / ".venv"
    programs = environment / "bin"
    programs.mkdir(parents=True)
    for entry in Path(sys.prefix).iterdir():
        if entry.name != "bin" and not entry.name.startswith(".installed"):
            (environment / entry.name).symlink_to(entry)
    project = tomllib.loads((folder / "clients/python/pyproject.toml").read_text())["project"]
    scripts = project["scripts"]
    for entry in (Path(sys.prefix) / "bin").iterdir():
        if entry.name not in scripts:
            (programs / entry.name).symlink_to(entry)
    for name, place in scripts.items():
        module, _, function = place.partition(":")
        script = f"#!/usr/bin/env python\nfrom {module} import {function}\n\n{function}()\n"
        (programs / name).write_text(script)
        (programs / name).chmod(0o755)
    for stamp in ("service", "everything"):
        (environment / f".installed-{stamp}").touch()


def _without_settings() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith("SCENE_")}
