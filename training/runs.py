"""What a finished training run leaves in its folder, and how it is read back.

config.json        the validated configuration
checkpoint.pt      training state, for resuming
model.safetensors  the best weights, with the shape in the header
curve.csv, .png    reconstruction error per epoch
result.json        best epoch, seconds, what it learnt from
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from safetensors import safe_open
from safetensors.torch import save_file

from training.config import Config
from training.machines import BoltzmannMachine, MachineSpec, build
from training.trainer import TrainingResult


class RunError(RuntimeError):
    """A folder that holds no finished run; says what is missing."""


@dataclass(frozen=True)
class FinishedRun:
    """A run as it is read back.

    Attributes:
        data: the folder that its scenes were read from, on the machine that it ran on.
        scenes: digest of the scenes, their vocabulary and split; "" where the run does not say.
    """

    config: Config
    machine: BoltzmannMachine
    best_epoch: int
    epochs: int
    seconds: float
    data: str = ""
    scenes: str = ""

    def require(self, scenes: str) -> None:
        """The run learnt from these scenes.

        Raises:
            RunError: it learnt from others.
        """
        if self.scenes and self.scenes != scenes:
            raise RunError(
                f"{self.config.name} learnt from other scenes than there are now, or with another "
                "vocabulary or split: train it again (--fresh)"
            )


def save_run(
    folder: Path,
    config: Config,
    result: TrainingResult,
    *,
    data: Path | None = None,
    scenes: str = "",
) -> None:
    """Write the weights and the result; `result.json` last, since it marks the run as finished.

    Args:
        data, scenes: see `FinishedRun`.
    """
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
        RunError: a file is missing or unreadable.
    """
    for name in ("config.json", "model.safetensors", "result.json"):
        if not (folder / name).is_file():
            raise RunError(f"{folder} holds no finished run: {name} is missing")
    try:
        config = Config.model_validate_json((folder / "config.json").read_text(encoding="utf-8"))
        outcome = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    except ValueError as error:
        raise RunError(f"{folder} holds a run that this release cannot read: {error}") from error
    with safe_open(folder / "model.safetensors", "pt") as file:
        spec = MachineSpec.from_dict(json.loads(file.metadata()["spec"]))
        state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    machine = build(spec)
    machine.load_state_dict(state)
    machine.requires_grad_(False).eval()
    return FinishedRun(config, machine, **outcome)
