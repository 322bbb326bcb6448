"""The result of a training: the machine and its curve."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Final

from training.machines import BoltzmannMachine


@dataclass(frozen=True)
class CurvePoint:
    """One point of the training curve."""

    phase: str  # "objects" or "relations"
    done: float  # finished share of the phase, from 0 to 1
    loss: float  # mean since the previous point of the phase
    score: float  # on validation scenes; NaN means that no scene can be scored
    seconds: float  # since the previous point


@dataclass(frozen=True)
class TrainingResult:
    """The trained machine, the training curve and the duration in seconds."""

    machine: BoltzmannMachine
    curve: list[CurvePoint]
    seconds: float


def write_csv(path: Path, curve: Sequence[CurvePoint]) -> None:
    """Write a CSV file with one row for each point of a curve."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([field.name for field in fields(CurvePoint)])
        writer.writerows(map(astuple, curve))


SCORES: Final = {"objects": "MRR", "relations": "R-precision"}
"""Name of the validation score of each phase."""


def write_plot(path: Path, curve: Sequence[CurvePoint], title: str) -> None:
    """Plot the loss and the score of each phase. A mark shows the score of the kept weights."""
    from matplotlib.figure import Figure

    phases = [phase for phase in SCORES if any(point.phase == phase for point in curve)]
    figure = Figure(figsize=(4.5 * len(phases), 4.8), layout="constrained")
    for (above, below), phase in zip(
        figure.subplots(2, len(phases), squeeze=False, sharex=True).T, phases, strict=True
    ):
        points = [point for point in curve if point.phase == phase]
        done, scores = [point.done for point in points], [point.score for point in points]
        above.plot(done, [point.loss for point in points], marker=".")
        above.set(title=phase, ylabel="training loss")
        below.set(xlabel="finished share of the phase", ylabel=SCORES[phase])
        below.set(xlim=(0, 1.04), ylim=(0, 1.04))
        if math.isnan(scores[-1]):
            below.text(0.5, 0.5, "no validation scenes", ha="center", transform=below.transAxes)
            continue
        below.plot(done, scores, marker=".", color="C1", label="validation score")
        kept = f"kept weights (average): {scores[-1]:.3f}"
        below.plot(done[-1:], scores[-1:], "*", color="C3", markersize=13, label=kept)
        below.legend(loc="best")
    figure.suptitle(f"{title}: fixed length, no score chooses a point")
    figure.savefig(path, dpi=120)
