"""Every code block of the documentation does what it says, in the order of its page.

`sh` blocks run through bash in a copy of the repository beside a live service, which stands where
the pages say 127.0.0.1:8000 or nothing; `python` blocks run one after the other in one namespace,
held to the house's lint; `json`, `yaml` and `toml` are read. See `tests.docs.blocks` for how a page
says what is output and what is only shown.
"""

import contextlib
import importlib.util
import io
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer.main
import yaml
from markdown_it import MarkdownIt
from pytest_examples import CodeExample, EvalExample

from app.settings import Settings
from tests.conftest import REPOSITORY
from tests.docs.blocks import EXECUTED, Block, blocks, check_output
from tests.docs.conftest import Workplace
from training.cli import app as training

PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
BLOCKS = {page.relative_to(REPOSITORY).as_posix(): list(blocks(page)) for page in PAGES}
EVERY = [block for found in BLOCKS.values() for block in found]
RUN_BY = {"docs/training.md": "scripts/walk.py"}
"""Pages whose code takes minutes, or a place of its own, and the tests that run it there."""
WITH_CODE = [
    name
    for name, found in BLOCKS.items()
    if name not in RUN_BY and any(b.language in EXECUTED for b in found)
]
READERS = {"json": json.loads, "toml": tomllib.loads, "yaml": yaml.safe_load}
SHOWN = {"text", "cpp", "cmake", "xml", "html", "javascript", "http"}
ADDRESS = re.compile(r"\b(127\.0\.0\.1|localhost):8000\b")
DEADLINE = re.compile(r"\btimeout=[\d.]+")


@pytest.mark.parametrize("block", EVERY, ids=str)
def test_every_block_says_what_it_is_and_its_data_can_be_read(block: Block) -> None:
    assert block.language in EXECUTED | READERS.keys() | SHOWN, f"{block}: {block.language!r}"
    if block.mark == "not run":
        assert len(block.reason) > 10, f"{block} is not run: say why"
    if block.mark == "keeps running":
        assert block.source.strip() == "make run", f"{block}: only `make run` is kept running"
    for data in (block, block.output):
        if data is not None and data.language in READERS:
            READERS[data.language](data.source)


@pytest.mark.parametrize("page", sorted(RUN_BY.keys() & BLOCKS.keys()))
def test_pages_run_by_scripts_are_named_there(page: str) -> None:
    assert page in (REPOSITORY / RUN_BY[page]).read_text(encoding="utf-8")


@pytest.mark.system
@pytest.mark.parametrize("page", WITH_CODE)
def test_the_code_of_a_page_runs(workplace, page, eval_example, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])  # a page may add to it
    # The house's rules, but that pages print, and bind names in one block for the next.
    eval_example.set_config(
        target_version="py310", ruff_line_length=100, ruff_ignore=["D", "F401", "F821", "S", "T20"]
    )
    names: dict[str, object] = {}
    for block in BLOCKS[page]:
        if block.mark or block.language not in EXECUTED:
            continue
        if block.language == "python":
            printed = run_python(block, workplace, eval_example, names)
        else:
            printed = run_shell(block, workplace)
        check_output(block, printed)


def run_shell(block: Block, workplace: Workplace) -> str:
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", ADDRESS.sub(workplace.address, block.source)],
        cwd=workplace.folder,
        env=workplace.environment | {"SCENE_URL": f"http://{workplace.address}"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, f"{block} ends with {done.returncode}\n{done.stdout}{done.stderr}"
    return done.stdout.replace(workplace.address, "127.0.0.1:8000")


def run_python(
    block: Block, workplace: Workplace, eval_example: EvalExample, names: dict[str, object]
) -> str:
    """What it prints; names that it binds are there for the page's next block."""
    # Deadlines are a robot's; the machine is shared with other tests.
    source = DEADLINE.sub("timeout=60", ADDRESS.sub(workplace.address, block.source))
    example = CodeExample.create(source, path=block.page, start_line=block.line - 1, prefix="py")
    eval_example.lint_ruff(example)
    if "#>" in source:
        names |= eval_example.run_print_check(example, module_globals=names)
        return ""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.chdir(workplace.folder):
        names |= eval_example.run(example, module_globals=names)
    return printed.getvalue().replace(workplace.address, "127.0.0.1:8000")


# docs/upgrading.md names removed settings and commands.
CURRENT = [page for page in PAGES if page.stem != "upgrading"]
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


@pytest.mark.parametrize("page", CURRENT, ids=lambda page: page.stem)
def test_commands_exist(page: Path) -> None:
    for line in mentioned(page):
        for target in re.findall(r"(?:^|\s)make ([a-z]+)\b", line):
            assert target in TARGETS, line
        # setuptools warns about the search for pip.
        for module in set(re.findall(r"\bpython3? -m ([\w.]+)", line)) - {"pip"}:
            assert importlib.util.find_spec(module) is not None, line
        for command, rest in re.findall(r"\bpython -m training ([a-z]+)(.*)", line):
            assert command in COMMANDS, line
            known = {option for param in COMMANDS[command].params for option in param.opts}
            assert set(re.findall(r"(?<!\S)--[a-z-]+", rest)) <= known, line


@pytest.mark.parametrize("page", CURRENT, ids=lambda page: page.stem)
def test_settings_exist(page: Path) -> None:
    known = {f"SCENE_{name.upper()}" for name in Settings.model_fields}
    clients, registry = REPOSITORY / "clients/python/scene_client", REPOSITORY / "app/registry"
    for module in (*clients.glob("*.py"), *registry.glob("*.py")):
        known |= set(re.findall(r"\"(SCENE_[A-Z_]+)\"", module.read_text(encoding="utf-8")))
    assert set(re.findall(r"\bSCENE_[A-Z_]+\b", page.read_text(encoding="utf-8"))) <= known
