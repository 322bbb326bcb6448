"""The folder of a training run. It contains these files:

config.json        the validated configuration
checkpoint.pt      training state after the last finished epoch, to resume an interrupted run
model.safetensors  weights of the best epoch; the header contains the sizes of the machine
curve.csv, .png    reconstruction error of each epoch
result.json        best epoch, duration in seconds, data folder and digest of the scenes
"""

from __future__ import annotations

import csv
import json
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from training.config import Config
from training.machines import BoltzmannMachine, MachineSpec, build


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


@dataclass(frozen=True)
class FinishedRun:
    """A finished training run, loaded from its folder.

    Attributes:
        data: folder of the scenes on the computer that trained the run.
        scenes: digest of the scenes, their vocabulary and split. An empty text means that the run
            has no digest.
    """

    config: Config
    machine: BoltzmannMachine
    best_epoch: int
    epochs: int
    seconds: float
    data: str = ""
    scenes: str = ""

    def require(self, scenes: str) -> None:
        """Check that the run was trained on given scenes.

        Raises:
            RunError: the run was trained on other scenes.
        """
        if self.scenes and self.scenes != scenes:
            raise RunError(
                "the scenes, vocabulary or split have changed since the training of "
                f"{self.config.name}: train this configuration again with --fresh"
            )


def save_run(
    folder: Path,
    config: Config,
    result: TrainingResult,
    *,
    data: Path | None = None,
    scenes: str = "",
) -> None:
    """Write the weights, and then `result.json`, which marks the run as finished."""
    machine = result.machine
    state = {name: tensor.contiguous() for name, tensor in machine.state_dict().items()}
    spec = json.dumps(machine.spec.to_dict())
    save_file(state, folder / "model.safetensors", metadata={"spec": spec})
    (folder / "config.json").write_text(config.model_dump_json(indent=1), encoding="utf-8")
    outcome = {
        "best_epoch": result.best_epoch,
        "epochs": len(result.epochs),
        "seconds": round(result.seconds, 1),
        "data": "" if data is None else str(data.resolve()),
        "scenes": scenes,
    }
    (folder / "result.json").write_text(json.dumps(outcome), encoding="utf-8")


def load_run(folder: Path) -> FinishedRun:
    """Read a finished run.

    Raises:
        RunError: a file is missing or cannot be read.
    """
    for name in ("config.json", "model.safetensors", "result.json"):
        if not (folder / name).is_file():
            runs = ", ".join(str(path.parent) for path in sorted(folder.glob("*/result.json")))
            advice = f"name a folder of a run: {runs}" if runs else "finish the training first"
            raise RunError(
                f"{folder} contains no finished run: the file {name} is missing; {advice}"
            )
    try:
        config = Config.model_validate_json((folder / "config.json").read_text(encoding="utf-8"))
        outcome = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    except ValueError as error:
        raise RunError(
            f"{folder} contains a training run that this release cannot read: {error}"
        ) from error
    with safe_open(folder / "model.safetensors", "pt") as file:
        spec = MachineSpec.from_dict(json.loads(file.metadata()["spec"]))
        state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    machine = build(spec)
    machine.load_state_dict(state)
    machine.requires_grad_(False).eval()
    return FinishedRun(config, machine, **outcome)


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint atomically. After a crash, the previous checkpoint remains."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def load_checkpoint(path: Path, digest: str) -> dict[str, Any]:
    """Read a checkpoint.

    Raises:
        RunError: the file cannot be read, or belongs to another configuration or other scenes.
    """
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
    """Write the figures of each epoch to a CSV file, one row for each epoch."""
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
