"""The rows of an experiment: machines, baselines tuned on validation scenes, and references."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
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
from training.evaluation.alarms import fitted_alarm
from training.evaluation.contenders import Contender, artifact_contender
from training.evaluation.setting import Setting
from training.evaluation.tasks import floor_contender, independent_contender
from training.machines import BoltzmannMachine
from training.pipeline import SplitScenes
from training.publish import as_stored, draft_artifact
from training.runs import RunError, load_run, save_run
from training.trainer import Trainer, TrainingData

CALIBRATION = "calibration.json"
"""A machine's calibration, beside its run."""

# Registry, end of the row's name, the tasks' scores that it gives, whether it learns relations.
_KINDS: tuple[tuple[Sequence[Baseline[Any]], str, tuple[str, ...], bool], ...] = (
    (OBJECTS, "", ("objects",), False),
    (RELATIONS, "", ("relations", "placement"), True),
    (COMPLETIONS, ", completing", ("completion",), True),
    (PLACED, "", ("placed",), True),
    (DENSITIES, "", ("density",), False),
)

Say = Callable[[str], None]
# What answers for a row before some scenes: the same before all of them if it was trained.
Rival = Callable[[Setting], Contender]


@dataclass(frozen=True, eq=False)
class Material:
    """The scenes that the rows learn from.

    Attributes:
        data: tensors of the three parts.
        vocabulary: their classes.
        digest: of the scenes' contents and split; with a row's identity it decides whether a
            folder's reports are kept.
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
        """Training and validation scenes are annotated with relations."""
        return has_relations(self.data.train) and has_relations(self.data.validation)


Maker = Callable[[Material, Path, Say], Rival]


@dataclass(frozen=True, eq=False)
class Row:
    """One row, for one training seed.

    Attributes:
        name: of the row; rows of one name differ by their seed.
        seed: of the training.
        identity: of everything but the scenes that decides the figures; reports of another
            identity are refused.
        make: trains it, or reads back what was trained, in a folder of its own.
    """

    name: str
    seed: int
    identity: str
    make: Maker


def baseline_rows(
    seed: int, names: Sequence[str] | None = None, *, related: bool = True
) -> Iterator[Row]:
    """Every baseline of the registries, or those named, where the seed changes anything.

    Args:
        related: there are relations to learn from; otherwise baselines of relations are left out.

    Raises:
        ValueError: an unknown name.
    """
    every = [
        (f"{baseline.name}{end}", baseline, scores, needy)
        for registry, end, scores, needy in _KINDS
        for baseline in registry
    ]
    known = [name for name, *_ in every]
    if unknown := sorted(set(names or ()) - set(known)):
        raise ValueError(f"unknown baselines {unknown}, must be of {known}")
    for name, baseline, scores, needy in every:
        wanted = (names is None or name in names) and (related or not needy)
        if wanted and (baseline.stochastic or seed == 0):
            make = partial(_fitted, baseline, scores, seed, True)
            yield Row(name, seed, f"{name}, seed {seed}", make)


def plain_rows(baselines: Iterable[Baseline[Any]], *scores: str) -> Iterator[Row]:
    """Baselines with seed 0 and only the given scores of `Contender`: no alarm, no places."""
    for baseline in baselines:
        make = partial(_fitted, baseline, scores, 0, False)
        yield Row(baseline.name, 0, f"{baseline.name}, seed 0", make)


def reference_rows() -> Iterator[Row]:
    """References for drawn scenes and densities; nothing is trained."""
    for name, rival in (
        ("independent classes", independent_contender),
        ("held-out scenes (floor)", floor_contender),
    ):
        yield Row(name, 0, name, partial(_reference, rival))


def machine_row(config: Config, *, calibrated: bool = True) -> Row:
    """A machine trained by a configuration; its run lies in the row's folder and is resumed.

    Args:
        calibrated: as publishing does; without it, as it was trained.
    """
    if calibrated:
        identity, make = f"{config.digest}, calibrated", partial(_calibrated, config)
    else:
        identity, make = config.digest, partial(_bare, config)
    return Row(config.name, config.training.seed, identity, make)


def _reference(rival: Rival, material: Material, folder: Path, say: Say) -> Rival:  # noqa: ARG001
    return rival


def _fitted(
    baseline: Baseline[Any],
    scores: tuple[str, ...],
    seed: int,
    whole: bool,
    material: Material,
    folder: Path,
    say: Say,
) -> Rival:
    """A score of objects also answers T2-at, by the product with the frequency table."""
    data = material.data
    fitted = _fit(baseline, data, seed, folder, say)
    score = fitted.score
    values: dict[str, Any] = dict.fromkeys(scores, score)
    if "density" in scores:
        values["density"] = lambda: score
    if "objects" in scores:
        values["parameters"] = parameter_count(score)
        if whole:
            values["alarm"] = fitted_alarm(score, data.validation, data.structure, seed)
        if whole and material.related:
            table = _fit(PLACED[0], data, seed, folder, say)
            product = placed_product(fitted, table.score)
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
        partial_file = place.with_suffix(".part")
        partial_file.write_text(calibration.model_dump_json(indent=1), encoding="utf-8")
        partial_file.replace(place)
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
    """The same contender before all scenes."""
    return lambda _: contender


def _fit(
    baseline: Baseline[Any], data: TrainingData, seed: int, folder: Path, say: Say
) -> Fitted[Any]:
    """Fit, and write down every trial; those of an interrupted fit are replaced."""
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
