"""The C++ programs of docs/clients.md; tests/docs runs the other blocks."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.client import callers
from tests.conftest import REPOSITORY

GUIDE = (REPOSITORY / "docs" / "clients.md").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.system
def test_the_cpp_block_compiles_and_runs(
    url: str, tmp_path: Path, require_system_tool: Callable[[str], Path]
) -> None:
    (program,) = re.findall(r"^```cpp\n(.*?)^```$", GUIDE, flags=re.MULTILINE | re.DOTALL)
    source = tmp_path / "block.cpp"
    source.write_text(program)
    found = callers.compiled(
        source, tmp_path / "block", require_system_tool("g++"), require_system_tool("pkg-config")
    )
    done = subprocess.run([found, url], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().strip('"')
    done = subprocess.run([found, "robot:8000"], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr


@pytest.mark.slow
@pytest.mark.system
def test_the_cpp_example_is_made_and_asks_all_four_questions(
    url: str, tmp_path: Path, bridge: Path, require_system_tool: Callable[[str], Path]
) -> None:
    # Asking for `bridge` leaves this test out where the libraries are missing.
    folder = shutil.copytree(REPOSITORY / "clients" / "cpp", tmp_path / "cpp")
    make = require_system_tool("make")
    done = subprocess.run([make, "-C", folder, "CXXFLAGS=-O0"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr

    def run(where: str, seconds: str = "30") -> subprocess.CompletedProcess[str]:
        arguments = [folder / "example", where, seconds]
        return subprocess.run(arguments, capture_output=True, text=True, timeout=60)

    done = run(url)
    assert done.returncode == 0, done.stderr
    for heading in ("Missing:", "How they stand:", "Least fitting first:", "A scene like it:"):
        assert heading in done.stdout
    done = run("http://127.0.0.1:9")
    assert (done.returncode, done.stdout) == (2, "Missing:\n")
    assert done.stderr.startswith("cannot reach http://127.0.0.1:9: connection refused")
    # What was mistyped is said, and ends nothing by force.
    done = run("robot:8000")
    assert (done.returncode, done.stderr) == (2, "the URL must begin with http://\n")
    done = run(url, "soon")
    assert (done.returncode, done.stderr) == (2, "SECONDS must be a number, not 'soon'\n")
