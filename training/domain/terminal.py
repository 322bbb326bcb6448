"""What the commands of training share: the console, errors, lists and the option of the store."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Final, NoReturn

import typer
from rich.console import Console
from rich.markup import escape

from app.registry import RegistryError
from training.datasets.records import InvalidLinesError

ROWS: Final = 12  # maximum number of entries of a printed list

StorePath = Annotated[
    str, typer.Option("--store", envvar="SCENE_STORE", help="folder of the model store")
]

console = Console()


def print_lines(*lines: str) -> None:
    """Print lines as they are: without markup, colours and line breaks."""
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def listing(title: str, entries: Sequence[str]) -> list[str]:
    """Return a title and at most `ROWS` indented entries; nothing without entries."""
    more = [f"and {len(entries) - ROWS} more"] if len(entries) > ROWS else []
    return [title, *(f"  {entry}" for entry in [*entries[:ROWS], *more])] if entries else []


def fail(error: Exception) -> NoReturn:
    """Print the error, without the code of a registry error, and exit with code 1."""
    reason = error.reason if isinstance(error, RegistryError) else str(error)
    further: list[str] = []
    if isinstance(error, InvalidLinesError):
        reason = f"{error.path.name} has {error.count} errors; nothing was written"
        further = [f"  {error.path.name}, {one.where}: {one.problem}" for one in error.errors]
        more = error.count - len(error.errors)
        further += [f"  and {more} more"] if more else []
    console.print(f"[red]error:[/red] {escape(reason)}", soft_wrap=True)
    print_lines(*further)
    raise typer.Exit(1) from None
