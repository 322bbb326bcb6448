"""A copy of the repository and a running service, as a new engineer would have them."""

import os
import shutil
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

_LEFT_OUT = shutil.ignore_patterns(
    ".git", ".venv", "build", "dist", "runs", ".hypothesis", ".*_cache"
)


@dataclass(frozen=True)
class Workplace:
    """A copy of the repository, and the address of a service with the shipped models."""

    folder: Path
    address: str

    @property
    def environment(self) -> dict[str, str]:
        """Of a shell there: programs of the environment are on the path."""
        programs = os.pathsep.join([str(self.folder / ".venv" / "bin"), os.environ["PATH"]])
        plain = {name: value for name, value in os.environ.items() if name[:6] != "SCENE_"}
        return plain | {"PATH": programs, "PYTHONPATH": str(self.folder)}


@pytest.fixture(scope="session")
def workplace(repository, shipped, tmp_path_factory, find_tool):
    """The shipped models as a service, and a fresh copy of the repository for the pages' commands.
    All in the copy is as in a checkout but for `.venv`, see `install`."""
    for tool in ("make", "curl", "bash"):
        find_tool(tool)
    folder = tmp_path_factory.mktemp("checkout") / "scene"
    shutil.copytree(repository, folder, ignore=_LEFT_OUT, symlinks=True)
    install(folder)
    return Workplace(folder, f"127.0.0.1:{shipped.port}")


def install(folder: Path) -> None:
    """Give the copy this interpreter's environment for its `.venv`, and programs of its own. With
    the stamps of an installation: installing anew would take minutes and the internet (tests/system
    installs for the image)."""
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
