"""The folder of a training run. It contains these files:

config.json        the validated configuration
model.safetensors  trained weights; the header contains the sizes of the machine
curve.csv, .png    loss and validation score of both phases of the training
result.json        duration in seconds, data folder and digest of the scenes
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from safetensors import safe_open
from safetensors.torch import save_file

from training.datasets.files import DATA
from training.fit.configuration import Config
from training.fit.curve import TrainingResult, write_csv, write_plot
from training.machines import BoltzmannMachine, MachineSpec, build


class RunError(RuntimeError):
    """A folder contains no finished run, or the scenes of the run have changed."""


@dataclass(frozen=True)
class FinishedRun:
    """A finished training run, loaded from its folder."""

    config: Config
    machine: BoltzmannMachine
    seconds: float
    data: str = ""  # folder of the scenes on the computer that trained the run, if known
    scenes: str = ""  # digest of the scenes, their vocabulary and split, if known

    @property
    def data_folder(self) -> Path:
        """Folder of the scenes. The default is `DATA`."""
        return Path(self.data or DATA)

    def require(self, scenes: str) -> None:
        """Raise RunError if the run was trained on scenes of another digest."""
        if self.scenes and self.scenes != scenes:
            raise RunError(
                "the scenes, vocabulary or split have changed since the training of "
                f"{self.config.name}: train this configuration again"
            )


def save_run(
    folder: Path,
    config: Config,
    result: TrainingResult,
    *,
    data: Path | None = None,
    scenes: str = "",
) -> None:
    """Replace the folder by the files of a finished run. An interruption leaves it as it was."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as beside:
        new, old = Path(beside, "new"), Path(beside, "old")
        new.mkdir()
        _write(new, config, result, data, scenes)
        try:
            if folder.exists():
                folder.rename(old)
            new.rename(folder)
        except BaseException:
            if old.exists() and not folder.exists():
                old.rename(folder)
            raise


def _write(
    folder: Path, config: Config, result: TrainingResult, data: Path | None, scenes: str
) -> None:
    machine = result.machine
    state = {name: tensor.contiguous() for name, tensor in machine.state_dict().items()}
    spec = json.dumps(machine.spec.to_dict())
    save_file(state, folder / "model.safetensors", metadata={"spec": spec})
    (folder / "config.json").write_text(config.model_dump_json(indent=1), encoding="utf-8")
    origin = {"data": "" if data is None else str(data.resolve()), "scenes": scenes}
    outcome = {"seconds": round(result.seconds, 1)} | origin
    (folder / "result.json").write_text(json.dumps(outcome), encoding="utf-8")
    write_csv(folder / "curve.csv", result.curve)
    write_plot(folder / "curve.png", result.curve, config.name)


def load_run(folder: Path) -> FinishedRun:
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
