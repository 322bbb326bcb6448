"""docs/contributing.md states the order of imports and the files of a request."""

import re
import sys
import tomllib

import pytest

from tests.conftest import REPOSITORY, run_program

PAGE = (REPOSITORY / "docs" / "contributing.md").read_text("utf-8")


def section(title: str) -> str:
    return PAGE.partition(f"## {title}\n")[2].partition("\n## ")[0]


def test_the_order_of_imports_is_that_of_import_linter() -> None:
    settings = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))
    order = []
    for contract in settings["tool"]["importlinter"]["contracts"]:
        if contract["type"] == "layers":
            prefixes = [f"{container}." for container in contract.get("containers", [])] or [""]
            for layer in contract["layers"]:
                order += [{f"{prefix}{name}" for name in layer.split(" | ")} for prefix in prefixes]
    entries = re.findall(r"^- (`.+?`): ", section("The order of imports"), re.MULTILINE)
    assert [set(re.findall(r"`(.+?)`", entry)) for entry in entries] == order


@pytest.mark.system
def test_a_request_passes_through_the_stated_files() -> None:
    listed = run_program(sys.executable, "-m", "scripts.request_path", "/missing").stdout
    called = set(re.findall(r"^(\S+\.py): ", listed, re.MULTILINE))
    stated = re.findall(r"`(app/\S+\.py)`", section("The way of a request"))
    assert len(stated) > 10
    assert set(stated) <= called
