"""Displays of a training run: progress bar, final curve and TensorBoard log."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from training.fit.checkpoint import Epoch, TrainingResult
from training.fit.configuration import Config
from training.fit.trainer import Trainer

_LEVELS = "▁▂▃▄▅▆▇█"
_WIDTH = 21
# Curves of the final summary. Each entry is the title and the attribute of `Epoch`.
_CURVES = (
    ("objective", "loss"),
    ("missing objects, MRR", "mrr_validation"),
    ("relations, R-precision", "r_precision_validation"),
)


class Display(Progress):
    """A progress bar with epoch, scores and remaining time. `logs` is a TensorBoard folder."""

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
        self._task = self.add_task(
            trainer.config.name,
            total=trainer.config.training.epochs,
            completed=len(trainer.epochs),
            note="",
        )
        self._log = None if logs is None else tensorboard(logs, trainer.config)

    def progress(self, epoch: int, done: float, loss: float) -> None:
        """Show the progress after an update of the weights."""
        trainer = self._trainer
        total = trainer.config.training.epochs
        state = scores(trainer.epochs[-1]) if trainer.epochs else f"objective {loss:.3f}"
        note = f"epoch {epoch + 1}/{total}, {state}"
        self.update(self._task, completed=epoch + done, note=note)

    def objects(self, done: float) -> None:
        """Show the progress of the first training phase, which trains only objects."""
        self.update(self._task, completed=0, note=f"objects, {done:.0%}")

    def ended(self, epoch: Epoch) -> None:
        """Write a finished epoch to the TensorBoard log."""
        if self._log is not None:
            self._log(epoch, self._trainer.updates)


def scores(epoch: Epoch) -> str:
    """Return the validation scores of an epoch as text."""
    text = f"MRR {epoch.mrr_validation:.3f}"
    if not math.isnan(epoch.r_precision_validation):
        text += f", R-precision {epoch.r_precision_validation:.3f}"
    return text


def tensorboard(folder: Path, config: Config) -> Callable[[Epoch, int], None]:
    """Return a function of an epoch and the number of updates that writes to TensorBoard."""
    # TensorBoard is imported only when needed, because the import takes longer than a small run.
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(str(folder / config.name / f"seed-{config.training.seed}"))
    names = {
        "objective/train": "loss",
        "validation/MRR": "mrr_validation",
        "validation/R-precision": "r_precision_validation",
        "error of objects/train": "object_error_train",
        "error of objects/validation": "object_error_validation",
        "error of relations/train": "relation_error_train",
        "error of relations/validation": "relation_error_validation",
        "seconds": "seconds",
    }

    def log(epoch: Epoch, updates: int) -> None:
        for name, attribute in names.items():
            if not math.isnan(value := getattr(epoch, attribute)):
                writer.add_scalar(name, value, updates)
        # Flush after each epoch, so that the log of an interrupted run is complete.
        writer.flush()

    return log


def sparkline(values: Sequence[float], width: int = _WIDTH) -> str:
    """Return the values, or means of several, as at most `width` blocks of different heights."""
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return ""
    size = max(1, math.ceil(len(finite) / width))
    means = [
        sum(part) / len(part)
        for part in (finite[start : start + size] for start in range(0, len(finite), size))
    ]
    low, high = min(means), max(means)
    step = (high - low) / (len(_LEVELS) - 1)
    return "".join(_LEVELS[round((value - low) / step) if step else 0] for value in means)


def summarise(result: TrainingResult, trainer: Trainer, folder: Path, console: Console) -> None:
    """Print the validation curve, best epoch and duration of a run."""
    best_epoch = result.epochs[result.best_epoch]
    table = Table("curve", "", "first", "best epoch", "last", title_justify="left")
    table.title = f"{trainer.config.name}, seed {trainer.config.training.seed}"
    for title, name in _CURVES:
        values = [getattr(epoch, name) for epoch in result.epochs]
        if math.isnan(values[-1]):
            continue
        ends = (values[0], values[result.best_epoch], values[-1])
        table.add_row(title, sparkline(values), *(f"{value:.3f}" for value in ends))
    console.print(table)
    updates = (result.best_epoch + 1) * trainer.steps_per_epoch
    stopped_early = len(result.epochs) < trainer.config.training.epochs
    idle = len(result.epochs) - 1 - result.best_epoch
    console.print(
        f"best epoch {result.best_epoch + 1} of {len(result.epochs)} (update {updates:,}) in "
        f"{result.seconds:.0f} s: {scores(best_epoch)}; curve in {folder / 'curve.png'}",
        soft_wrap=True,
    )
    if stopped_early:
        console.print(f"stopped early: {idle} epochs without a better score on validation scenes")
    elif advice := _advice(result):
        console.print(advice, soft_wrap=True)


def next_steps(folder: Path, console: Console) -> None:
    """Print the commands that compare a run and publish it."""
    console.print(
        f"next: python -m training compare {folder} --store my-store\n"
        f"      python -m training publish {folder} 1.0.0 --store my-store --promote",
        soft_wrap=True,
        highlight=False,
    )


def _advice(result: TrainingResult) -> str:
    """Return advice on the settings that follows from the position of the best epoch."""
    total, best = len(result.epochs), result.best_epoch + 1
    if total >= 10 and best == total:
        return "the last epoch was the best: more epochs may help (training.epochs)"
    if total >= 10 and best <= total // 2:
        return (
            "the best epoch came early and later epochs overfitted: fewer epochs, fewer hidden "
            "units (machine.H1) or more decay (training.weight_decay) may help"
        )
    return ""
