"""Checkpoints and curves of a training run."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import torch

from training.machines import BoltzmannMachine


class RunError(RuntimeError):
    """A folder contains no finished run, or a run cannot be resumed from its checkpoint."""


@dataclass(frozen=True)
class CurvePoint:
    """One point of the training curve.

    Attributes:
        phase: "objects" or "relations".
        done: finished share of the phase, from 0 to 1.
        loss: mean loss since the previous point of the phase.
        score: score on validation scenes. NaN means that no scene can be scored.
        seconds: duration since the previous point.
    """

    phase: str
    done: float
    loss: float
    score: float
    seconds: float


@dataclass(frozen=True)
class TrainingResult:
    """The trained machine, the training curve and the duration in seconds."""

    machine: BoltzmannMachine
    curve: list[CurvePoint]
    seconds: float


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint atomically. After a crash, the previous checkpoint remains."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def load_checkpoint(path: Path, digest: str) -> dict[str, Any] | None:
    """Read a checkpoint. Return None if the file does not exist.

    Raises:
        RunError: the file cannot be read, or belongs to another configuration or other scenes.
    """
    if not path.exists():
        return None
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise RunError(f"{path.name} cannot be read: {error}") from error
    if state.get("digest") != digest:
        raise RunError(
            f"{path.name} belongs to another configuration or other scenes: use --fresh to start "
            "over"
        )
    return state


def write_csv(path: Path, curve: Sequence[CurvePoint]) -> None:
    """Write a CSV file with one row for each point of a curve."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([field.name for field in fields(CurvePoint)])
        writer.writerows(map(astuple, curve))


def write_plot(path: Path, curve: Sequence[CurvePoint], title: str) -> None:
    """Plot loss and validation score of both phases."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    scores = {"objects": "MRR of hidden classes", "relations": "R-precision of relations"}
    for phase, score in scores.items():
        points = [point for point in curve if point.phase == phase]
        done = [point.done for point in points]
        left.plot(done, [point.loss for point in points], marker=".", label=phase)
        right.plot(done, [point.score for point in points], marker=".", label=score)
    for axis, title in ((left, "loss"), (right, "validation score")):
        axis.set(xlabel="finished share of the phase", title=title)
        axis.legend()
    figure.suptitle(title)
    figure.savefig(path, dpi=120)
