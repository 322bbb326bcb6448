"""Displays of a training run: the progress bar, and the summary at the end."""

from __future__ import annotations

import math
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from training.fit.curve import SCORES, CurvePoint, TrainingResult
from training.fit.trainer import Trainer


class Display(Progress):
    """A progress bar with phase, scores and remaining time."""

    def __init__(self, trainer: Trainer, console: Console) -> None:
        super().__init__(
            "[progress.description]{task.description}",
            BarColumn(bar_width=12),
            TextColumn("{task.fields[note]}"),
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


def score_of(point: CurvePoint) -> str:
    """Return the validation score of a point of the curve as text, or its loss without a score."""
    if math.isnan(point.score):
        return f"loss {point.loss:.3f}"
    return f"{SCORES[point.phase]} {point.score:.3f}"


def summarise(result: TrainingResult, folder: Path, console: Console) -> None:
    """Print the last score of each phase, and the duration of a run."""
    last = {point.phase: point for point in result.curve}
    scores = ", ".join(f"{phase}: {score_of(point)}" for phase, point in last.items())
    seconds = f"trained in {result.seconds:.0f} s"
    console.print(f"{seconds}; {scores}; curve in {folder / 'curve.png'}", soft_wrap=True)


def next_steps(folder: Path, console: Console) -> None:
    """Print the commands that compare a run and publish it."""
    console.print(
        f"next: python -m training compare {folder} --store my-store\n"
        f"      python -m training publish {folder} 1.0.0 --store my-store --promote",
        soft_wrap=True,
        highlight=False,
    )
