"""The rows of a result table: machines, baselines with tuned settings, and untrained references."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from app.registry import Calibration
from app.scene import Vocabulary
from training.datasets.batches import TrainingData, has_relations
from training.evaluation.baselines import PLACED, placed_product
from training.evaluation.baselines.fitting import Baseline, Fitted
from training.evaluation.contenders import (
    artifact_contender,
    floor_contender,
    independent_contender,
)
from training.evaluation.model import Contender
from training.evaluation.outlier_tasks import fitted_alarm
from training.evaluation.report import write_whole
from training.evaluation.setting import Setting
from training.fit.calibrate import calibrate
from training.fit.checkpoint import RunError
from training.fit.settings import Config, ConfigError
from training.fit.trainer import Trainer
from training.machines import BoltzmannMachine
from training.research.baselines import BASELINES
from training.runs.folder import load_run, save_run
from training.runs.pipeline import SplitScenes
from training.runs.publish import as_stored, draft_artifact

CALIBRATION = "calibration.json"
"""File name of a machine's calibration, in the folder of its run."""

Say = Callable[[str], None]
# Function that takes the evaluation setting and returns the scores of a row. Only the references
# depend on the setting.
Rival = Callable[[Setting], Contender]


@dataclass(frozen=True, eq=False)
class Material:
    """The scenes of an experiment.

    Attributes:
        data: tensors of the training, validation and test scenes.
        vocabulary: object classes and room types of the scenes.
        digest: digest of the scenes and their split. A report on disk is reused only if this
            digest and the identity of its row are unchanged.
    """

    data: TrainingData
    vocabulary: Vocabulary
    digest: str

    @classmethod
    def of(cls, scenes: SplitScenes) -> Material:
        """Create the tensors of split scenes.

        Raises:
            ConfigError: the training, validation or test part contains no scenes.
        """
        for part, some in scenes.parts.items():
            if not some:
                raise ConfigError(
                    f"the {part} part contains no scenes: provide more scenes or more groups"
                )
        return cls(scenes.training_data(), scenes.vocabulary, scenes.digest)

    @property
    def related(self) -> bool:
        """True if training and validation scenes contain annotated relations."""
        return has_relations(self.data.train) and has_relations(self.data.validation)


Maker = Callable[[Material, Path, Say], Rival]


@dataclass(frozen=True, eq=False)
class Row:
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
    make: Maker


def baseline_rows(
    seed: int,
    names: Sequence[str] | None = None,
    *,
    related: bool = True,
    whole: bool = True,
) -> Iterator[Row]:
    """Generate the rows of the selected baselines.

    Deterministic baselines have a row for seed 0 only.

    Args:
        names: names of the baselines. None means all baselines.
        related: True if the scenes contain relations. False leaves out relation baselines.
        whole: True adds an outlier alarm and place scores to object baselines.

    Raises:
        ValueError: a name is not in `BASELINES`.
    """
    if unknown := sorted(set(names or ()) - set(BASELINES)):
        raise ValueError(f"unknown baselines {unknown}: choose from {list(BASELINES)}")
    for name, baseline in BASELINES.items():
        wanted = (names is None or name in names) and (related or not baseline.learns_relations)
        if wanted and (baseline.stochastic or seed == 0):
            make = partial(_fitted, baseline, seed, whole)
            yield Row(name, seed, f"{name}, seed {seed}", make)


def reference_rows() -> Iterator[Row]:
    """Generate the untrained references for the evaluation of generated scenes and densities."""
    references: dict[str, Rival] = {
        "independent classes": independent_contender,
        "held-out scenes (floor)": floor_contender,
    }
    for name, rival in references.items():
        yield Row(name, 0, name, partial(_reference, rival))


def _reference(rival: Rival, material: Material, folder: Path, say: Say) -> Rival:  # noqa: ARG001
    return rival


def machine_row(config: Config, *, calibrated: bool = True) -> Row:
    """Return the row of a machine. An interrupted training resumes from the row's folder.

    Args:
        calibrated: True calibrates the machine as for publication.
    """
    if calibrated:
        identity, make = f"{config.digest}, calibrated", partial(_calibrated, config)
    else:
        identity, make = config.digest, partial(_bare, config)
    return Row(config.name, config.training.seed, identity, make)


def _fitted(
    baseline: Baseline[Any], seed: int, whole: bool, material: Material, folder: Path, say: Say
) -> Rival:
    """Fit a baseline, and return its scores for the tasks that it supports.

    An object baseline also supports T2-at (missing object at a place): its score is multiplied by a
    frequency table of places.
    """
    data = material.data
    score = _fit(baseline, data, seed, folder, say).score
    values: dict[str, Any] = dict.fromkeys(baseline.scores, score)
    if "density" in values:
        values["density"] = lambda: score
    if "objects" in values:
        values["parameters"] = getattr(score, "parameter_count", None)
        if whole:
            values["alarm"] = fitted_alarm(score, data.validation, data.structure, seed)
        if whole and material.related:
            table = _fit(PLACED, data, seed, folder, say).score
            product = placed_product(baseline.name, score, table)
            values["placed"] = _fit(product, data, seed, folder, say).score
    return always(Contender(**values))


def _calibrated(config: Config, material: Material, folder: Path, say: Say) -> Rival:
    machine = as_stored(_trained(config, material.data, folder / "run", say))
    draft = draft_artifact(machine, material.vocabulary)
    place, seed = folder / "run" / CALIBRATION, config.training.seed
    if place.exists():
        calibration = Calibration.model_validate_json(place.read_text(encoding="utf-8"))
    else:
        say("calibrating")
        calibration = calibrate(draft, material.data.validation, material.data.train, seed)
        write_whole(place, calibration.model_dump_json(indent=1))
    artifact = draft_artifact(machine, material.vocabulary, calibration)
    return always(artifact_contender(artifact, material.data.train, seed=seed))


def _bare(config: Config, material: Material, folder: Path, say: Say) -> Rival:
    machine = _trained(config, material.data, folder / "run", say).requires_grad_(False)
    draft, seed = draft_artifact(machine, material.vocabulary), config.training.seed
    return always(artifact_contender(draft, material.data.train, seed=seed, calibrated=False))


def _trained(config: Config, data: TrainingData, run: Path, say: Say) -> BoltzmannMachine:
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


def always(contender: Contender) -> Rival:
    """Return a function that returns the same contender for every evaluation setting."""
    return lambda _: contender


def _fit(
    baseline: Baseline[Any], data: TrainingData, seed: int, folder: Path, say: Say
) -> Fitted[Any]:
    """Fit a baseline, and write its trials into trials.jsonl in place of its earlier trials."""
    fitted = baseline.fit(data.train, data.validation, data.structure, seed=seed, progress=say)
    trials = folder / "trials.jsonl"
    before = trials.read_text(encoding="utf-8").splitlines() if trials.exists() else []
    lines = [line for line in before if json.loads(line)["model"] != baseline.name]
    lines += [json.dumps({"model": baseline.name, **asdict(trial)}) for trial in fitted.trials]
    write_whole(trials, "".join(f"{line}\n" for line in lines))
    return fitted
