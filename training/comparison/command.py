"""`python -m training compare`: where a new version is better, where it is worse."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from app.registry import RegistryError, Store
from training.comparison.compare import Comparison, compare
from training.comparison.sides import BASELINES, Say, Side, find
from training.config import DATA, ConfigError
from training.datasets import DatasetError
from training.runs import RunError

console = Console()

_COLOURS = {"better": "green", "worse": "red"}


def compare_command(
    new: Annotated[str, typer.Argument(help="a finished run's folder, or a model of the store")],
    old: Annotated[
        str | None,
        typer.Argument(
            help=f"another one, or {BASELINES}; by default what `default` serves, and {BASELINES} "
            "where nothing is"
        ),
    ] = None,
    data: Annotated[
        Path | None, typer.Option("--data", help="folder with the first one's scenes")
    ] = None,
    store: Annotated[Path, typer.Option("--store", help="the model store")] = Path("model_store"),
    limit: Annotated[int, typer.Option(min=2, help="scenes that are asked about")] = 300,
    examples: Annotated[int, typer.Option(min=0, help="changed answers that are shown")] = 3,
    output: Annotated[Path | None, typer.Option("--json", help="write everything here")] = None,
) -> None:
    """Compare two models on scenes that neither has learnt from.

    The scenes are the test part of the first one's configuration; those that the second has learnt
    from are left out. Intervals are of 95 %, paired, over groups of scenes.
    """
    try:
        with console.status("reading") as status:
            say: Say = status.update
            a = find(new, Store(store), data, say)
            b = find(old or _served(store), Store(store), data, say)
            comparison = compare(a, b, _root(data, a, b), limit=limit, examples=examples, say=say)
    except (ConfigError, DatasetError, RegistryError, RunError) as error:
        console.print(f"[red]error:[/red] {error}", soft_wrap=True)
        raise typer.Exit(1) from None
    if output is not None:
        text = json.dumps(comparison.to_dict(), indent=1, ensure_ascii=False)
        output.write_text(text + "\n", encoding="utf-8")
    show(comparison, console)


def _served(store: Path) -> str:
    """The alias `default`, where the store has one."""
    return "default" if "default" in Store(store).aliases() else BASELINES


def _root(given: Path | None, *sides: Side) -> Path:
    known = (side.data for side in sides)
    return given or next((path for path in known if path is not None), DATA)


def show(comparison: Comparison, console: Console) -> None:
    """Print the table, the notes and the examples."""
    title = f"{comparison.scenes} held-out scenes of {comparison.groups} groups"
    table = Table(title=title, title_justify="left")
    for name in ("task", "metric", comparison.a, comparison.b, "difference", ""):
        table.add_column(name, overflow="fold")
    for row in comparison.differences:
        colour = _COLOURS.get(row.verdict, "dim")
        metric = row.metric if row.primary else f"  {row.metric}"
        table.add_row(
            row.task if row.primary else "",
            metric,
            f"{row.a:.3f}",
            f"{row.b:.3f}",
            f"{row.difference.value:+.3f} [{row.difference.low:+.3f}, {row.difference.high:+.3f}]",
            f"[{colour}]{row.verdict}[/{colour}]",
        )
    console.print(table)
    notes = list(comparison.notes)
    if comparison.unmeasured:
        names = ", ".join(comparison.unmeasured)
        notes.append(f"nothing here shows how {comparison.a} does at {names}")
    for note in notes:
        console.print(f"note: {note}", markup=False, soft_wrap=True)
    if not comparison.examples:
        return
    console.print("Answers that differ most, each with one thing taken out of a scene:")
    for example in comparison.examples:
        room = f" ({example.room_type})" if example.room_type else ""
        lines = [f"  {example.scene}{room}: {', '.join(example.shown)}"]
        lines.append(f"    taken out: {example.removed}")
        for name, rank, answers in zip(
            (comparison.a, comparison.b), example.ranks, example.answers, strict=True
        ):
            lines.append(f"    {name} has it in place {rank}: {', '.join(answers)}, …")
        console.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)
