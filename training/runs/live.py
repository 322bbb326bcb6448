"""Displays of a training run: progress bar, final curve and TensorBoard log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from training.fit.checkpoint import CurvePoint, TrainingResult
from training.fit.trainer import Trainer

_LEVELS = "▁▂▃▄▅▆▇█"
_WIDTH = 21
SCORES = {"objects": "MRR", "relations": "R-precision"}
"""Name of the validation score of each phase."""

# Share of the objects in the progress bar. Their phase takes about as long as the relations.
_OF_OBJECTS = 0.5


class Display(Progress):
    """A progress bar with phase, scores and remaining time. `logs` is a TensorBoard folder."""

    def __init__(self, trainer: Trainer, console: Console, logs: Path | None = None) -> None:
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
        self._writer = None
        if logs is not None:
            # Imported only when needed, because the import takes longer than a small run.
            from torch.utils.tensorboard import SummaryWriter

            config = trainer.config
            self._writer = SummaryWriter(str(logs / config.name / f"seed-{config.training.seed}"))

    def progress(self, phase: str, done: float, loss: float) -> None:
        """Show the progress after an update of the weights."""
        points = [point for point in self._trainer.curve if point.phase == phase]
        state = score_of(points[-1]) if points else f"loss {loss:.3f}"
        whole = _OF_OBJECTS * done if phase == "objects" else _OF_OBJECTS + done / 2
        self.update(self._task, completed=whole, note=f"{phase} {done:.0%}, {state}")

    def passed(self, point: CurvePoint) -> None:
        """Write a point of the curve to the TensorBoard log."""
        if self._writer is None:
            return
        step = round(1000 * point.done)
        for name in ("loss", "score", "seconds"):
            if not math.isnan(value := getattr(point, name)):
                self._writer.add_scalar(f"{point.phase}/{name}", value, step)
        # Flush each time, so that the log of an interrupted run is complete.
        self._writer.flush()


def score_of(point: CurvePoint) -> str:
    """Return the validation score of a point of the curve as text."""
    if math.isnan(point.score):
        return f"loss {point.loss:.3f}"
    return f"{SCORES[point.phase]} {point.score:.3f}"


def sparkline(values: Sequence[float], width: int = _WIDTH) -> str:
    """Return the values, or means of several, as at most `width` blocks of different heights."""
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return ""
    size = max(1, math.ceil(len(finite) / width))
    means = [fmean(finite[start : start + size]) for start in range(0, len(finite), size)]
    low, high = min(means), max(means)
    step = (high - low) / (len(_LEVELS) - 1)
    return "".join(_LEVELS[round((value - low) / step) if step else 0] for value in means)


def summarise(result: TrainingResult, trainer: Trainer, folder: Path, console: Console) -> None:
    """Print the curves and the duration of a run."""
    table = Table("curve", "", "first", "last", title_justify="left")
    table.title = f"{trainer.config.name}, seed {trainer.config.training.seed}"
    for phase, score in SCORES.items():
        points = [point for point in result.curve if point.phase == phase]
        for title, name in (("loss", "loss"), (score, "score")):
            values = [getattr(point, name) for point in points]
            if values and not math.isnan(values[-1]):
                ends = (f"{value:.3f}" for value in (values[0], values[-1]))
                table.add_row(f"{phase}, {title}", sparkline(values), *ends)
    console.print(table)
    console.print(
        f"trained in {result.seconds:.0f} s; curve in {folder / 'curve.png'}", soft_wrap=True
    )


def next_steps(folder: Path, console: Console) -> None:
    """Print the commands that compare a run and publish it."""
    console.print(
        f"next: python -m training compare {folder} --store my-store\n"
        f"      python -m training publish {folder} 1.0.0 --store my-store --promote",
        soft_wrap=True,
        highlight=False,
    )
