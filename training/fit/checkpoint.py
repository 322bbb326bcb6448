"""Checkpoints and curves of a training run."""

from __future__ import annotations

import csv
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch

from training.machines import BoltzmannMachine


class RunError(RuntimeError):
    """A folder contains no finished run, or a run cannot be resumed from its checkpoint."""


@dataclass(frozen=True)
class Epoch:
    """Loss, errors and scores of one epoch. `evaluation.reconstruction` defines the errors."""

    epoch: int
    loss: float
    object_error_train: float
    relation_error_train: float
    object_error_validation: float
    relation_error_validation: float
    mrr_validation: float
    r_precision_validation: float
    seconds: float


@dataclass(frozen=True)
class TrainingResult:
    """The result of training: the machine with its best weights, and figures of each epoch."""

    machine: BoltzmannMachine
    epochs: list[Epoch]
    best_epoch: int
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


def write_csv(path: Path, epochs: list[Epoch]) -> None:
    """Write a CSV file with one row for each epoch."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Epoch)])
        writer.writeheader()
        writer.writerows(asdict(epoch) for epoch in epochs)


def write_plot(path: Path, epochs: list[Epoch], title: str) -> None:
    """Plot the reconstruction errors of objects and of relations against the epoch."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.2), layout="constrained")
    x = [epoch.epoch for epoch in epochs]
    for axis, unit in zip(figure.subplots(1, 2), ("object", "relation"), strict=True):
        for part in ("train", "validation"):
            axis.plot(x, [getattr(e, f"{unit}_error_{part}") for e in epochs], label=part)
        axis.set(xlabel="epoch", ylabel="mean absolute error", title=f"{unit}s")
        axis.legend()
    figure.suptitle(f"Reconstruction error, {title}")
    figure.savefig(path, dpi=120)
