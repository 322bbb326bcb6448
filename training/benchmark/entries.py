"""The rows of the tables: our machines, baselines tuned on validation, and references."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

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
from training.batches import SceneTensors
from training.calibrate import calibrate
from training.config import Config, ConfigError
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
from training.machines import BoltzmannMachine
from training.pipeline import SplitScenes
from training.runs import RunError, load_run, save_run
from training.trainer import Trainer, TrainingData


@dataclass(frozen=True, eq=False)
class Material:
    """What the rows of a domain learn from.

    Attributes:
        data: tensors of the three parts.
        vocabulary: their classes.
        digest: of the scenes' contents and how they were split; with a row's identity it decides
            whether what a folder holds is gone on with.
    """

    data: TrainingData
    vocabulary: Vocabulary
    digest: str

    @classmethod
    def of(cls, scenes: SplitScenes) -> Material:
        """All of some split scenes.

        Raises:
            ConfigError: a part of them is empty.
        """
        for part, some in scenes.parts.items():
            if not some:
                raise ConfigError(
                    f"no scene is in the {part} part: take more scenes, or of more groups"
                )
        return cls(scenes.training_data(), scenes.vocabulary, scenes.digest)

    @property
    def related(self) -> bool:
        """Relations are there to be learnt, and to tune on."""
        return has_relations(self.data.train) and has_relations(self.data.validation)


RELATION_TASKS = ("T1a relations", "T1 pairs")
"""What a baseline of `RELATIONS` answers with nothing else fitted."""

OBJECT_TASKS = ("T2 missing", "T2 partial", "T3 signature")
"""The same for one of `OBJECTS`."""

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
        identity: of everything that decides the figures but the scenes, which `Material.digest`
            stands for; reports of another identity are not gone on with.
        make: trains it, or reads back what was trained, in a folder of its own.
    """

    name: str
    seed: int
    identity: str
    make: Maker


def baseline_entries(
    seed: int, names: Sequence[str] | None = None, *, related: bool = True
) -> Iterator[Entry]:
    """Every baseline of the registries, or those named.

    Where the seed changes nothing, there is an entry for seed 0 alone.

    Args:
        related: there are relations to learn from; otherwise those that need them are left out.

    Raises:
        ValueError: an unknown name.
    """
    makers: dict[str, tuple[Maker, bool]] = {}
    needy: set[str] = set()
    for objects in OBJECTS:
        makers[objects.name] = partial(_objects, objects, seed), objects.stochastic
    for relations in RELATIONS:
        makers[relations.name] = partial(_relations, relations, seed), relations.stochastic
        needy.add(relations.name)
    for completion in COMPLETIONS:
        name = f"{completion.name}, completing"
        makers[name] = partial(_completion, completion, seed), completion.stochastic
        needy.add(name)
    for placed in PLACED:
        makers[placed.name] = partial(_placed, placed, seed), placed.stochastic
        needy.add(placed.name)
    for density in DENSITIES:
        makers[density.name] = partial(_density, density, seed), density.stochastic
    if unknown := sorted(set(names or ()) - set(makers)):
        raise ValueError(f"unknown baselines {unknown}, must be of {list(makers)}")
    for name, (make, stochastic) in makers.items():
        wanted = (names is None or name in names) and (related or name not in needy)
        if wanted and (stochastic or seed == 0):
            yield Entry(name, seed, f"{name}, seed {seed}", make)


def plain_baseline_entries(seed: int, task: str) -> Iterator[Entry]:
    """Every baseline of a task that asks for objects or relations alone, fitted for no other.

    Raises:
        ValueError: another task.
    """
    if task in OBJECT_TASKS:
        for objects in OBJECTS:
            identity = f"{objects.name}, seed {seed}"
            yield Entry(objects.name, seed, identity, partial(_objects_alone, objects, seed))
    elif task in RELATION_TASKS:
        for relations in RELATIONS:
            identity = f"{relations.name}, seed {seed}"
            yield Entry(relations.name, seed, identity, partial(_relations, relations, seed))
    else:
        raise ValueError(f"{task!r} is none of {(*RELATION_TASKS, *OBJECT_TASKS)}")


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
    if not material.related:
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
        calibration = calibrate(draft, material.data.validation, material.data.train, seed)
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
    """Fit, and write down every trial; those of an earlier, interrupted fit give way to them."""
    fitted = baseline.fit(data.train, data.validation, data.structure, seed=seed, progress=say)
    trials = folder / "trials.jsonl"
    trials.parent.mkdir(parents=True, exist_ok=True)
    before = trials.read_text(encoding="utf-8").splitlines() if trials.exists() else []
    lines = [line for line in before if json.loads(line)["model"] != fitted.name]
    lines += [json.dumps({"model": fitted.name, **asdict(trial)}) for trial in fitted.trials]
    draft = trials.with_name(trials.name + ".part")
    draft.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    draft.replace(trials)
    return fitted


def has_relations(scenes: SceneTensors) -> bool:
    """Any scene is annotated with a relation."""
    return any(scene.evidence.holds.any() for scene in scenes.scenes)
