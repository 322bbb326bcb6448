"""The rows of the tables: our machines, baselines tuned on validation, and references."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from app.boltzmann import BoltzmannMachine
from app.registry import Calibration
from app.scene import Vocabulary
from training.baselines import (
    COMPLETIONS,
    DENSITIES,
    OBJECTS,
    PLACED,
    RELATIONS,
    Baseline,
    Fitted,
    placed_product,
)
from training.baselines.size import parameter_count
from training.calibrate import calibrate
from training.config import Config
from training.draft import as_stored, draft_artifact
from training.evaluation.alarms import fitted_alarm
from training.evaluation.contenders import (
    Contender,
    artifact_contender,
    machine_contender,
)
from training.evaluation.density import ObjectDensity
from training.evaluation.missing import ObjectScore
from training.evaluation.placed import PlacedScore
from training.evaluation.relations import RelationScore
from training.evaluation.tasks import Setting, floor_contender, independent_contender
from training.runs import RunError, load_run, save_run
from training.trainer import Trainer, TrainingData


@dataclass(frozen=True, eq=False)
class Material:
    """What the rows of a domain learn from: tensors of the three parts, and their vocabulary."""

    data: TrainingData
    vocabulary: Vocabulary


CALIBRATION = "calibration.json"
"""A machine's calibration, beside its run."""

Progress = Callable[[str], None]
# What stands for a row before some scenes: the same before all of them if it was trained.
Rival = Callable[[Setting], Contender]
Maker = Callable[[Material, Path, Progress], Rival]


@dataclass(frozen=True, eq=False)
class Entry:
    """One row of the tables, for one training seed.

    Attributes:
        name: of the row; rows of one name differ by their seed.
        seed: of the training.
        identity: of everything that decides the figures but the scenes; reports of another
            identity are not gone on with.
        make: trains it, or reads back what was trained, in a folder of its own.
    """

    name: str
    seed: int
    identity: str
    make: Maker


def baseline_entries(seed: int, names: Sequence[str] | None = None) -> Iterator[Entry]:
    """Every baseline of the registries, or those named.

    Where the seed changes nothing, there is an entry for seed 0 alone.

    Raises:
        ValueError: an unknown name.
    """
    makers: dict[str, tuple[Maker, bool]] = {}
    for objects in OBJECTS:
        makers[objects.name] = partial(_objects, objects, seed), objects.stochastic
    for relations in RELATIONS:
        makers[relations.name] = partial(_relations, relations, seed), relations.stochastic
    for completion in COMPLETIONS:
        name = f"{completion.name}, completing"
        makers[name] = partial(_completion, completion, seed), completion.stochastic
    for placed in PLACED:
        makers[placed.name] = partial(_placed, placed, seed), placed.stochastic
    for density in DENSITIES:
        makers[density.name] = partial(_density, density, seed), density.stochastic
    if unknown := sorted(set(names or ()) - set(makers)):
        raise ValueError(f"unknown baselines {unknown}, must be of {list(makers)}")
    for name, (make, stochastic) in makers.items():
        if (names is None or name in names) and (stochastic or seed == 0):
            yield Entry(name, seed, f"{name}, seed {seed}", make)


def plain_baseline_entries(seed: int, task: str) -> Iterator[Entry]:
    """Every baseline of one task, T1a or T2, fitted for that task alone.

    Raises:
        ValueError: another task.
    """
    if task == "T2 missing":
        for objects in OBJECTS:
            identity = f"{objects.name}, seed {seed}"
            yield Entry(objects.name, seed, identity, partial(_objects_alone, objects, seed))
    elif task == "T1a relations":
        for relations in RELATIONS:
            identity = f"{relations.name}, seed {seed}"
            yield Entry(relations.name, seed, identity, partial(_relations, relations, seed))
    else:
        raise ValueError(f"{task!r} is neither T1a relations nor T2 missing")


def reference_entries() -> Iterator[Entry]:
    """What drawn scenes and densities are held against; nothing is trained."""
    yield Entry("independent classes", 0, "independent classes", _independent)
    yield Entry("held-out scenes (floor)", 0, "held-out scenes (floor)", _floor)


def machine_entry(config: Config) -> Entry:
    """A machine trained by a configuration and calibrated as publishing does.

    Its run lies in the entry's folder and is resumed.
    """
    identity = f"{config.digest}, calibrated"
    return Entry(config.name, config.training.seed, identity, partial(_calibrated, config))


def bare_machine_entry(config: Config) -> Entry:
    """A machine as it was trained, as the seed protocol and the shuffled scenes ask it."""
    return Entry(config.name, config.training.seed, config.digest, partial(_bare, config))


def _objects(
    baseline: Baseline[ObjectScore], seed: int, material: Material, folder: Path, say: Progress
) -> Rival:
    """T2 and T3; T2-at by the product with the frequency table."""
    data = material.data
    fitted = _fit(baseline, data, seed, folder, say)
    alarm = fitted_alarm(fitted.score, data.validation, data.structure, seed)
    size = parameter_count(fitted.score)
    if not _related(data):
        return _always(Contender(objects=fitted.score, alarm=alarm, parameters=size))
    (first, *_) = PLACED
    table = _fit(first, data, seed, folder, say)
    product = _fit(placed_product(fitted, table.score), data, seed, folder, say)
    return _always(
        Contender(objects=fitted.score, alarm=alarm, placed=product.score, parameters=size)
    )


def _objects_alone(
    baseline: Baseline[ObjectScore], seed: int, material: Material, folder: Path, say: Progress
) -> Rival:
    """T2 without what the other tasks need of the row."""
    score = _fit(baseline, material.data, seed, folder, say).score
    return _always(Contender(objects=score, parameters=parameter_count(score)))


def _relations(
    baseline: Baseline[RelationScore], seed: int, material: Material, folder: Path, say: Progress
) -> Rival:
    score = _fit(baseline, material.data, seed, folder, say).score
    return _always(Contender(relations=score, placement=score))


def _completion(
    baseline: Baseline[RelationScore], seed: int, material: Material, folder: Path, say: Progress
) -> Rival:
    score = _fit(baseline, material.data, seed, folder, say).score
    return _always(Contender(completion=score))


def _placed(
    baseline: Baseline[PlacedScore], seed: int, material: Material, folder: Path, say: Progress
) -> Rival:
    score = _fit(baseline, material.data, seed, folder, say).score
    return _always(Contender(placed=score))


def _density(
    baseline: Baseline[ObjectDensity], seed: int, material: Material, folder: Path, say: Progress
) -> Rival:
    density = _fit(baseline, material.data, seed, folder, say).score
    return _always(Contender(density=lambda: density))


def _independent(material: Material, folder: Path, say: Progress) -> Rival:  # noqa: ARG001
    return independent_contender


def _floor(material: Material, folder: Path, say: Progress) -> Rival:  # noqa: ARG001
    return floor_contender


def _calibrated(config: Config, material: Material, folder: Path, say: Progress) -> Rival:
    machine = as_stored(_trained(config, material.data, folder / "run", say))
    draft = draft_artifact(machine, material.vocabulary)
    place, seed = folder / "run" / CALIBRATION, config.training.seed
    if place.exists():
        calibration = Calibration.model_validate_json(place.read_text(encoding="utf-8"))
    else:
        say("calibrating")
        calibration = calibrate(draft, material.data.validation, seed)
        partial_file = place.with_suffix(".part")
        partial_file.write_text(calibration.model_dump_json(indent=1), encoding="utf-8")
        partial_file.replace(place)
    artifact = draft_artifact(machine, material.vocabulary, calibration)
    return _always(artifact_contender(artifact, material.data.train, seed=seed))


def _bare(config: Config, material: Material, folder: Path, say: Progress) -> Rival:
    machine = _trained(config, material.data, folder / "run", say).requires_grad_(False)
    return _always(machine_contender(machine, material.data.train, seed=config.training.seed))


def _trained(config: Config, data: TrainingData, run: Path, say: Progress) -> BoltzmannMachine:
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


def _always(contender: Contender) -> Rival:
    return lambda _: contender


def _fit(
    baseline: Baseline[Any], data: TrainingData, seed: int, folder: Path, say: Progress
) -> Fitted[Any]:
    """Fit, and write down every trial."""
    fitted = baseline.fit(data.train, data.validation, data.structure, seed=seed, progress=say)
    trials = folder / "trials.jsonl"
    trials.parent.mkdir(parents=True, exist_ok=True)
    with trials.open("a", encoding="utf-8") as file:
        for trial in fitted.trials:
            file.write(json.dumps({"model": fitted.name, **asdict(trial)}) + "\n")
    return fitted


def _related(data: TrainingData) -> bool:
    return any(scene.evidence.holds.any() for scene in data.validation.scenes)
