"""Commands and settings that pages only mention exist: what no test runs must not be made up."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest
import typer.main
from markdown_it import MarkdownIt

from app.settings import Settings
from tests.conftest import REPOSITORY
from training.cli import app as training

PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
PAGES.remove(REPOSITORY / "docs/upgrading.md")  # names removed settings and commands
TARGETS = set(re.findall(r"^([a-z]+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE))
COMMANDS = typer.main.get_command(training).commands  # type: ignore[attr-defined]


def mentioned(page: Path) -> list[str]:
    """Lines of code blocks, and pieces of code within prose."""
    found = []
    for token in MarkdownIt().enable("table").parse(page.read_text(encoding="utf-8")):
        if token.type in {"fence", "code_block"} and token.info.split()[:1] != ["python"]:
            found += token.content.replace("\\\n", " ").splitlines()
        found += [child.content for child in token.children or () if child.type == "code_inline"]
    return [line.partition(" #")[0] for line in found]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_exist(page: Path) -> None:
    for line in mentioned(page):
        for target in re.findall(r"(?:^|\s)make ([a-z]+)\b", line):
            assert target in TARGETS, line
        for module in re.findall(r"\bpython3? -m ([\w.]+)", line):
            assert importlib.util.find_spec(module) is not None, line
        for command, rest in re.findall(r"\bpython -m training ([a-z]+)(.*)", line):
            assert command in COMMANDS, line
            known = {option for param in COMMANDS[command].params for option in param.opts}
            assert set(re.findall(r"(?<!\S)--[a-z-]+", rest)) <= known, line


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_settings_exist(page: Path) -> None:
    known = {f"SCENE_{name.upper()}" for name in Settings.model_fields}
    clients, registry = REPOSITORY / "clients/python/scene_client", REPOSITORY / "app/registry"
    for module in (*clients.glob("*.py"), *registry.glob("*.py")):
        known |= set(re.findall(r"\"(SCENE_[A-Z_]+)\"", module.read_text(encoding="utf-8")))
    assert set(re.findall(r"\bSCENE_[A-Z_]+\b", page.read_text(encoding="utf-8"))) <= known
