"""The command `fetch`: where the public data sets are to be had, and which of them one has."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from training.config import DATA, ConfigError, load_config, shipped_configs
from training.datasets import DatasetError
from training.datasets.origins import ORIGINS, WORDS, count_entries, file_of
from training.datasets.sources import SOURCES
from training.domain.command import fail

console = Console()


def fetch(
    names: Annotated[
        list[str] | None,
        typer.Argument(help="sources, or shipped configurations; default: all sources"),
    ] = None,
    data: Annotated[
        Path | None, typer.Option("--data", help="check the files in this folder instead")
    ] = None,
) -> None:
    """Say where each public data set is to be had, and where its file belongs.

    The command downloads nothing. With --data, it reads the files in a folder, and prints which of
    them are found, missing or unreadable. The exit code is 1 if a file is missing or unreadable.
    """
    try:
        chosen = _sources(names or ())
        if data is not None and not data.is_dir():
            raise ConfigError(f"{data}: the folder does not exist")
    except ConfigError as error:
        fail(error)
    command = " ".join(["python -m training fetch", *(names or ())])
    if data is None:
        for name in chosen:
            _describe(name)
        _explain(command)
    elif not _check(chosen, data):
        console.print(f"`{command}` says where each file is to be had", soft_wrap=True)
        raise typer.Exit(1)


def _sources(names: Sequence[str]) -> list[str]:
    """Return the sources that names of sources and of configurations mean, without repetition.

    Raises:
        ConfigError: a name is neither a source nor a configuration.
    """
    found: dict[str, None] = {}
    for name in names or tuple(ORIGINS):
        if name in ORIGINS:
            found[name] = None
        elif name in shipped_configs():
            config = load_config(name)
            words = [WORDS] if config.data.words else []
            found |= dict.fromkeys([*config.data.sources, *words])
        else:
            raise ConfigError(
                f"{name!r} is neither a source nor a shipped configuration. Sources: "
                f"{', '.join(ORIGINS)}. Configurations: {', '.join(shipped_configs())}"
            )
    return list(found)


def _describe(name: str) -> None:
    origin = ORIGINS[name]
    lines = Table.grid(padding=(0, 2))
    lines.add_column(no_wrap=True)
    lines.add_column(overflow="fold")
    for head, text in (
        ("origin", origin.terms or SOURCES[name].terms),
        ("home page", origin.home),
        ("needed", origin.files),
        ("to do", origin.steps),
        ("belongs at", f"FOLDER/{origin.place}"),
    ):
        lines.add_row(f"  {head}", text)
    console.print(f"[bold]{name}[/bold]")
    console.print(lines, highlight=False, markup=False)


def _explain(command: str) -> None:
    console.print(
        "\nThis command downloads nothing: the terms of each data set are between you and\n"
        "its owner. FOLDER is your data folder. Without --data, training reads\n"
        f"{DATA}.\n\n"
        "docs/training.md describes the format of the scenes (JSON lines). Readers exist\n"
        "for some official files. So Python converts 3DSSG:\n\n"
        "    from pathlib import Path\n"
        "    from training.datasets.jsonl import write_jsonl\n"
        "    from training.datasets.readers import READERS\n"
        '    scenes = READERS["3dssg"](Path("relationships.json"))\n'
        '    write_jsonl(scenes, Path("FOLDER/3dssg.jsonl.gz"))\n\n'
        f"Check your files: {command} --data FOLDER",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )


def _check(chosen: Sequence[str], root: Path) -> bool:
    """Print the state of each file. Return True if all files are found."""
    table = Table("source", "file", "state", "entries", box=box.SIMPLE_HEAD)
    table.columns[3].justify = "right"
    complete, problems = True, []
    for name in chosen:
        path, count, state = file_of(name, root), "", "missing"
        try:
            with console.status(f"reading {path.name}"):
                if path.is_file():
                    count, state = f"{count_entries(name, root):,}", "found"
        except DatasetError as error:
            state = "unreadable"
            problems.append(str(error))
        complete &= state == "found"
        table.add_row(name, path.relative_to(root).as_posix(), state, count)
    console.print(f"folder: {root}", soft_wrap=True, highlight=False)
    console.print(table)
    for problem in problems:
        console.print(problem, soft_wrap=True, highlight=False, markup=False)
    return complete
