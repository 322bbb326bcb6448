"""Compiled loops on disk: stored once, in a directory that only this user can change."""

import ast
import inspect
import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from app.compiling import KERNELS
from tests.conftest import run_program

PROGRAM = """
import json, logging
import numpy as np
from app import compiling
from app.scene.roles import is_smaller
logging.basicConfig(format="%(message)s", level="INFO")
compiling.check_cache()
with compiling.progress():
    is_smaller(np.ones(3), 2 * np.ones(3))
print(json.dumps([sum(is_smaller.stats.cache_misses.values()), is_smaller.stats.cache_path]))
"""


@pytest.fixture
def package(tmp_path: Path, repository: Path) -> Path:
    for name in ("__init__", "compiling", "scene/__init__", "scene/roles", "scene/footprints"):
        copy = tmp_path / "service" / "app" / f"{name}.py"
        copy.parent.mkdir(parents=True, exist_ok=True)
        text = "" if name.endswith("__init__") else (repository / f"app/{name}.py").read_text()
        copy.write_text(text)
    return tmp_path / "service" / "app"


def start(package: Path, **variables: Any) -> tuple[int, str | None, str]:
    """Return the number of compilations, the directory of the loops, and the log."""
    environment = {name: text for name, text in os.environ.items() if "NUMBA" not in name}
    home = package.parent.parent / "home"
    environment |= {"PYTHONPATH": "", "HOME": str(home), "XDG_CACHE_HOME": str(home / "cache")}
    environment |= {name: str(value) for name, value in variables.items()}
    process = run_program(sys.executable, "-c", PROGRAM, cwd=package.parent, env=environment)
    compilations, folder = json.loads(process.stdout)
    return compilations, folder, process.stderr


def test_a_second_start_compiles_nothing(package: Path) -> None:
    compilations, stored, log = start(package)
    folder = package.parent / ".numba_cache"
    assert compilations == 1
    assert Path(stored).is_relative_to(folder)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert "compiling loop 1 of" in log
    assert start(package)[::2] == (0, "")
    # A change of another file with loops gives another folder, and compiles again.
    other = package / "scene" / "footprints.py"
    other.write_text(other.read_text() + "\n")
    compilations, changed, _ = start(package)
    assert compilations == 1
    assert Path(changed).parent.parent == folder
    assert changed != stored


def test_a_folder_that_others_can_change_is_refused(package: Path, tmp_path: Path) -> None:
    root, folder = tmp_path / "root", tmp_path / "root" / "loops"
    start(package, NUMBA_CACHE_DIR=folder)
    folder.chmod(0o777)
    compilations, stored, log = start(package, NUMBA_CACHE_DIR=folder)
    assert (compilations, stored) == (1, None)
    assert f"other users can write to {folder}" in log
    folder.chmod(0o700)
    root.chmod(0o770)
    assert start(package, NUMBA_CACHE_DIR=folder)[:2] == (1, None)
    root.chmod(0o1777)
    assert start(package, NUMBA_CACHE_DIR=folder)[0] == 0


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder away")
def test_a_folder_of_another_user_is_refused(package: Path, tmp_path: Path) -> None:
    folder = tmp_path / "loops"
    folder.mkdir()
    os.chown(folder, 10001, 10001)
    compilations, stored, log = start(package, NUMBA_CACHE_DIR=folder)
    assert (compilations, stored) == (1, None)
    assert f"{folder} or its parent belongs to another user" in log


def test_loops_depend_on_files_with_loops_only() -> None:
    """The hash in the folder's name covers only these files, and numba notices no other change."""
    import app.main  # noqa: F401 - imports every loop

    with_loops = {kernel.py_func.__module__ for kernel in KERNELS}
    with_loops |= {"app.inference.elementary"}
    for kernel in KERNELS:
        function = kernel.py_func
        tree = ast.parse(inspect.getsource(sys.modules[function.__module__]))
        used = set(function.__code__.co_names)
        for statement in tree.body:
            if isinstance(statement, ast.ImportFrom) and str(statement.module).startswith("app."):
                names = {name.asname or name.name for name in statement.names}
                assert not names & used or statement.module in with_loops, function
