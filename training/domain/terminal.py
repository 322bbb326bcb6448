"""What the commands of training share: errors, lists, progress, option of the store."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final, NoReturn

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

from app.registry import RegistryError
from training.datasets.console import console, print_lines, print_marked
from training.datasets.records import InvalidLinesError
from training.domain.look import Finding
from training.fit.trainer import SCORES, CurvePoint, Trainer

ROWS: Final = 12  # maximum number of entries of a printed list

StorePath = Annotated[
    str, typer.Option("--store", envvar="SCENE_STORE", help="folder of the model store")
]


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
        further = [f"  {error.path.name}, {line.where}: {line.problem}" for line in error.errors]
        more = error.count - len(error.errors)
        further += [f"  and {more} more"] if more else []
    print_marked("error:", "red", reason)
    print_lines(*further)
    raise typer.Exit(1) from None


class Display(Progress):
    """A progress bar with phase, scores and remaining time."""

    def __init__(self, trainer: Trainer) -> None:
        super().__init__(
            TextColumn("{task.description}", style="progress.description", markup=False),
            BarColumn(bar_width=12),
            TextColumn("{task.fields[note]}", markup=False),
            TimeElapsedColumn(),
            "/",
            TimeRemainingColumn(),
            console=console,
        )
        self._trainer = trainer
        self._task = self.add_task(trainer.config.name, total=1.0, note="")

    def progress(self, phase: str, done: float, loss: float) -> None:
        """Show the progress after an update of the weights."""
        points = [point for point in self._trainer.curve if point.phase == phase]
        state = score_of(points[-1]) if points else f"loss {loss:.3f}"
        whole = (done + (phase == "relations")) / 2  # both phases take about as long
        self.update(self._task, completed=whole, note=f"{phase} {done:.0%}, {state}")

    def summarise(self, seconds: float, folder: Path) -> None:
        """Print the last score of each phase, and the duration of a run in its folder."""
        last = {point.phase: point for point in self._trainer.curve}
        scores = ", ".join(f"{phase}: {score_of(point)}" for phase, point in last.items())
        curve = f"curve in {folder / 'curve.png'}"
        console.print(f"trained in {seconds:.0f} s; {scores}; {curve}", soft_wrap=True)


def score_of(point: CurvePoint) -> str:
    """Return the validation score of a point of the curve as text, or its loss without a score."""
    if math.isnan(point.score):
        return f"loss {point.loss:.3f}"
    return f"{SCORES[point.phase]} {point.score:.3f}"


def next_steps(folder: Path) -> None:
    """Print the commands that compare a run and publish it."""
    print_lines(
        f"next: python -m training compare {folder} --store my-store",
        f"      python -m training publish {folder} 1.0.0 --store my-store --promote",
    )


def print_finding(finding: Finding) -> None:
    """Print a property of the scenes that the user should check."""
    console.print(Text.assemble("  ", (str(finding.count), "yellow"), f" × {finding.what}"))
    console.print(f"    {finding.advice}")
    for example in finding.examples:
        print_lines(f"    - {example}")
