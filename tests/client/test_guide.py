"""The C++ programs of docs/clients.md; tests/docs runs the other blocks."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.client import callers
from tests.conftest import REPOSITORY, run_program

GUIDE = (REPOSITORY / "docs" / "clients.md").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.system
def test_the_cpp_block_compiles_and_runs(
    url: str, tmp_path: Path, require_system_tool: Callable[[str], Path]
) -> None:
    (program,) = re.findall(r"^```cpp\n(.*?)^```$", GUIDE, flags=re.MULTILINE | re.DOTALL)
    source = tmp_path / "block.cpp"
    source.write_text(program)
    block = callers.compiled(require_system_tool, source, tmp_path / "block")
    assert run_program(block, url).stdout.strip().strip('"')
    done = run_program(block, "robot:8000", status=2)
    assert (done.stdout, bool(done.stderr)) == ("", True)


@pytest.mark.slow
@pytest.mark.system
def test_the_cpp_example_is_made_and_asks_all_five_questions(
    url: str,
    tmp_path: Path,
    bridge: Path,
    require_system_tool: Callable[[str], Path],
) -> None:
    # Asking for `bridge` leaves this test out where the libraries are missing.
    folder = shutil.copytree(REPOSITORY / "clients" / "cpp", tmp_path / "cpp")
    make = require_system_tool("make")
    run_program(make, "-C", folder, "CXXFLAGS=-O0")
    example = folder / "example"
    answered = run_program(example, url, "30").stdout
    headings = re.findall(r"^\w.*:$", answered, re.MULTILINE)
    assert headings == [
        *("Missing:", "How they stand:", "Least fitting first:", "Which room it is:"),
        "A scene like it:",
    ]
    for arguments, error in (
        (["http://127.0.0.1:9"], "cannot reach http://127.0.0.1:9: connection refused"),
        (["robot:8000"], "the URL must begin with http://\n"),
        ([url, "soon"], "SECONDS must be a number, not 'soon'\n"),
    ):
        assert run_program(example, *arguments, status=2).stderr.startswith(error)
