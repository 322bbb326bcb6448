"""The folder of a training run. It contains these files:

config.json        the validated configuration
model.safetensors  trained weights; the header contains the sizes of the machine
curve.csv, .png    loss and validation score of both phases of the training
result.json        duration in seconds, data folder and digest of the scenes
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory

from safetensors import safe_open
from safetensors.torch import save_file

from training.datasets.files import DATA
from training.fit.configuration import Config
from training.fit.trainer import SCORES, CurvePoint, TrainingResult
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
    """Write the files of a run. `data` is the folder of its scenes, and `scenes` their digest."""
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


def write_csv(path: Path, curve: Sequence[CurvePoint]) -> None:
    """Write a CSV file with one row for each point of a curve."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([field.name for field in fields(CurvePoint)])
        writer.writerows(map(astuple, curve))


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


def load_run(folder: Path) -> FinishedRun:
    """Load a finished run. Raise RunError if files are missing, or of another release."""
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
