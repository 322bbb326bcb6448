"""The entries of a result table: machines, baselines with tuned settings, untrained references."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from app.registry import Calibration
from training.datasets.batches import TrainingData
from training.evaluation.artifact_model import artifact_model, floor_model, independent_model
from training.evaluation.baselines import PLACED, placed_product
from training.evaluation.baselines.fitting import Baseline
from training.evaluation.model import Model
from training.evaluation.outlier_tasks import fitted_alarm
from training.evaluation.report import Progress, write_whole
from training.fit.calibrate import calibrate
from training.fit.checkpoint import RunError
from training.fit.configuration import Config
from training.fit.trainer import Trainer
from training.machines import BoltzmannMachine
from training.research.baselines import BASELINES
from training.runs.folder import load_run, save_run
from training.runs.publish import as_stored, draft_artifact

CALIBRATION = "calibration.json"
"""File name of a machine's calibration, in the folder of its run."""


@dataclass(frozen=True, eq=False)
class Entry:
    """One model of an experiment, with one training seed.

    Attributes:
        name: name of the model. It does not depend on the training seed.
        identity: text with all settings that affect the results. Reports on disk with another
            identity are rejected.
        make: function that trains the model, or reads the trained model from its folder.
    """

    name: str
    seed: int
    identity: str
    make: Callable[[TrainingData, Path, Progress], Model]


def baseline_entries(
    seed: int, names: Sequence[str] | None = None, *, related: bool = True, whole: bool = True
) -> Iterator[Entry]:
    """Generate the entries of the baselines in `names`; None means all baselines.

    Deterministic baselines have an entry for seed 0 only.

    Args:
        related: False leaves out relation baselines.
        whole: True adds an outlier alarm and place scores to object baselines.

    Raises:
        ValueError: a name is not in `BASELINES`.
    """
    if unknown := sorted(set(names or ()) - set(BASELINES)):
        raise ValueError(f"unknown baselines {unknown}: choose from {list(BASELINES)}")
    for name, baseline in BASELINES.items():
        is_usable = related or not baseline.learns_relations
        is_selected = names is None or name in names
        if is_usable and is_selected and (baseline.stochastic or seed == 0):
            make = partial(_baseline_model, baseline, seed, whole)
            yield Entry(name, seed, f"{name}, seed {seed}", make)


def reference_entries() -> Iterator[Entry]:
    """Generate the untrained references for the evaluation of generated scenes and densities."""
    for name in ("independent classes", "held-out scenes (floor)"):
        yield Entry(name, 0, name, partial(_reference_model, name))


def _reference_model(name: str, data: TrainingData, folder: Path, say: Progress) -> Model:  # noqa: ARG001
    classes = data.train.v.shape[1]
    return independent_model(classes) if name == "independent classes" else floor_model()


def machine_entry(config: Config, *, calibrated: bool = True) -> Entry:
    """Return the entry of a machine, calibrated as for publication if `calibrated`."""
    identity = f"{config.digest}, calibrated" if calibrated else config.digest
    make = partial(_machine_model, config, calibrated)
    return Entry(config.name, config.training.seed, identity, make)


def _baseline_model(
    baseline: Baseline, seed: int, whole: bool, data: TrainingData, folder: Path, say: Progress
) -> Model:
    """Fit a baseline.

    An object baseline also supports T2-at (missing object at a place): its score is multiplied by a
    frequency table of places.
    """
    model = _fit(baseline, data, seed, folder, say)
    if not whole or model.missing is None:
        return model
    model = replace(model, alarm=fitted_alarm(model.missing, data.validation, data.structure, seed))
    if not data.related:
        return model
    table = _fit(PLACED, data, seed, folder, say)
    product = _fit(placed_product(baseline.name, model, table), data, seed, folder, say)
    return replace(model, at_place=product.at_place)


def _fit(baseline: Baseline, data: TrainingData, seed: int, folder: Path, say: Progress) -> Model:
    """Fit a baseline, and write its trials into trials.jsonl in place of its earlier trials."""
    model = baseline.fit(data.train, data.validation, data.structure, seed=seed, progress=say)
    trials = folder / "trials.jsonl"
    lines_before = trials.read_text(encoding="utf-8").splitlines() if trials.exists() else []
    lines = [line for line in lines_before if json.loads(line)["model"] != baseline.name]
    lines += [json.dumps({"model": baseline.name, **asdict(trial)}) for trial in model.trials]
    write_whole(trials, "".join(f"{line}\n" for line in lines))
    return model


def _machine_model(
    config: Config, calibrated: bool, data: TrainingData, folder: Path, say: Progress
) -> Model:
    run, seed = folder / "run", config.training.seed
    machine = _train_once(config, data, run, say)
    if not calibrated:
        draft = draft_artifact(machine.requires_grad_(False), data.classes)
        return artifact_model(draft, data.train, seed=seed, calibrated=False)
    machine = as_stored(machine)
    path = run / CALIBRATION
    if path.exists():
        calibration = Calibration.model_validate_json(path.read_text(encoding="utf-8"))
    else:
        say("calibrating")
        draft = draft_artifact(machine, data.classes)
        calibration = calibrate(draft, data.validation, data.train, seed)
        write_whole(path, calibration.model_dump_json(indent=1))
    artifact = draft_artifact(machine, data.classes, calibration)
    return artifact_model(artifact, data.train, seed=seed)


def _train_once(config: Config, data: TrainingData, run: Path, say: Progress) -> BoltzmannMachine:
    try:
        return load_run(run).machine
    except RunError:
        run.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(config, data, run)
    trainer.resume()
    epochs = config.training.epochs
    result = trainer.run(lambda epoch, _, loss: say(f"epoch {epoch + 1}/{epochs}, {loss:.3f}"))
    save_run(run, config, result)
    return result.machine
