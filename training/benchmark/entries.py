"""The rows of the tables: baselines tuned on validation, and our machines, by training seed."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from training.baselines import (
    COMPLETIONS,
    OBJECTS,
    PLACED,
    RELATIONS,
    Baseline,
    Fitted,
    placed_product,
)
from training.config import Config
from training.evaluation.contenders import Contender, fitted_alarm, machine_contender
from training.evaluation.missing import ObjectScore
from training.evaluation.outliers import intruder_scores
from training.evaluation.placed import PlacedScore
from training.evaluation.relations import RelationScore
from training.runs import RunError, load_run, save_run
from training.trainer import Trainer, TrainingData

Progress = Callable[[str], None]
Maker = Callable[[Path, Progress], Contender]


@dataclass(frozen=True, eq=False)
class Entry:
    """One row of the tables.

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


def baseline_entries(
    data: TrainingData, seed: int, names: Sequence[str] | None = None
) -> Iterator[Entry]:
    """Every baseline of the registries, or those named.

    Raises:
        ValueError: an unknown name.
    """
    makers: dict[str, Maker] = {}
    for objects in OBJECTS:
        makers[objects.name] = partial(_objects, objects, data, seed)
    for relations in RELATIONS:
        makers[relations.name] = partial(_relations, relations, data, seed)
    for completion in COMPLETIONS:
        makers[f"{completion.name}, completing"] = partial(_completion, completion, data, seed)
    for placed in PLACED:
        makers[placed.name] = partial(_placed, placed, data, seed)
    if unknown := sorted(set(names or ()) - set(makers)):
        raise ValueError(f"unknown baselines {unknown}, must be of {list(makers)}")
    for name, make in makers.items():
        if names is None or name in names:
            yield Entry(name, seed, f"{name}, seed {seed}", make)


def machine_entry(config: Config, data: TrainingData) -> Entry:
    """A machine trained by a configuration; its run lies in the entry's folder and is resumed."""
    return Entry(config.name, config.training.seed, config.digest, partial(_machine, config, data))


def _objects(
    baseline: Baseline[ObjectScore], data: TrainingData, seed: int, folder: Path, say: Progress
) -> Contender:
    """T2 and T3; T2-at by the product with the frequency table."""
    fitted = _fit(baseline, data, seed, folder, say)
    clean = intruder_scores(data.validation, data.structure, fitted.score, seed=seed)
    alarm = fitted_alarm(clean)
    if not _related(data):
        return Contender(objects=fitted.score, alarm=alarm)
    (first, *_) = PLACED
    table = _fit(first, data, seed, folder, say)
    product = _fit(placed_product(fitted, table.score), data, seed, folder, say)
    return Contender(objects=fitted.score, alarm=alarm, placed=product.score)


def _relations(
    baseline: Baseline[RelationScore], data: TrainingData, seed: int, folder: Path, say: Progress
) -> Contender:
    score = _fit(baseline, data, seed, folder, say).score
    return Contender(relations=score, placement=score)


def _completion(
    baseline: Baseline[RelationScore], data: TrainingData, seed: int, folder: Path, say: Progress
) -> Contender:
    return Contender(completion=_fit(baseline, data, seed, folder, say).score)


def _placed(
    baseline: Baseline[PlacedScore], data: TrainingData, seed: int, folder: Path, say: Progress
) -> Contender:
    return Contender(placed=_fit(baseline, data, seed, folder, say).score)


def _machine(config: Config, data: TrainingData, folder: Path, say: Progress) -> Contender:
    run = folder / "run"
    try:
        machine = load_run(run).machine
    except RunError:
        run.mkdir(parents=True, exist_ok=True)
        trainer = Trainer(config, data, run)
        trainer.resume()
        epochs = config.training.epochs
        result = trainer.run(lambda epoch, _, loss: say(f"epoch {epoch + 1}/{epochs}, {loss:.3f}"))
        save_run(run, config, result)
        machine = result.machine
    machine.requires_grad_(False)
    return machine_contender(machine, data.train, seed=config.training.seed)


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
