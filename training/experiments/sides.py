"""The two that are compared: a finished run, a published model, or the baselines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from app.registry import Artifact, Store, StoreError
from app.scene import Vocabulary
from training.baselines import OBJECTS, PLACED, RELATIONS, Baseline, Fitted, placed_product
from training.config import DATA, Config, ConfigError
from training.evaluation.contenders import Contender, artifact_contender
from training.experiments.translation import Translation, same_classes
from training.pipeline import SplitScenes, prepare
from training.publish import calibrated_draft
from training.runs import RunError, load_run
from training.trainer import TrainingData

BASELINES = "baselines"
"""EASE for objects, the frequency table for relations, their product for places."""

_OBJECTS, _RELATIONS = "EASE", "frequency table"

Say = Callable[[str], None]
# The contender of a model in a task.
Rival = Callable[[str], Contender]


@dataclass(frozen=True, eq=False)
class Side:
    """One of two models.

    Attributes:
        title: what it is called in tables.
        config: what it was trained by; None where it does not say.
        learnt: digest of each source that it learnt from, by name.
        artifact: the model; None for the baselines.
        data: the folder that a run read its scenes from.
    """

    title: str
    config: Config | None
    learnt: dict[str, str]
    artifact: Artifact | None
    data: Path | None = None

    @property
    def vocabulary(self) -> Vocabulary | None:
        """Its classes; those of the other side where it has none of its own."""
        return None if self.artifact is None else self.artifact.vocabulary

    def rival(self, scenes: Vocabulary, data: TrainingData, say: Say) -> Rival:
        """What answers for it about scenes in the classes of a vocabulary.

        Args:
            data: what baselines are fitted to.
        """
        if self.artifact is None:
            fitted = _baselines(data, say)
            return lambda _: fitted
        own = artifact_contender(self.artifact, data.train)
        if same_classes(scenes, self.artifact.vocabulary):
            return lambda _: own
        translation = Translation.between(scenes, self.artifact.vocabulary)
        return lambda task: translation.contender(own, task)


def run_side(folder: Path, data: Path | None, say: Say) -> tuple[Side, SplitScenes]:
    """A finished run, calibrated as it would be published, and its scenes.

    Raises:
        RunError: no finished run, or one that learnt from other scenes.
        ConfigError, DatasetError: its scenes cannot be read.
    """
    run = load_run(folder)
    root = data if data is not None else Path(run.data) if run.data else DATA
    say("reading scenes")
    scenes = prepare(run.config, root)
    run.require(scenes.digest)
    say(f"calibrating {folder}")
    artifact = calibrated_draft(run, scenes.vocabulary, scenes.training_data())
    return Side(str(folder), run.config, scenes.digests, artifact, root), scenes


def stored_side(reference: str, store: Store) -> Side:
    """A published model by alias, name or name@version.

    Raises:
        StoreError, ArtifactError: there is none, or it cannot be used.
    """
    name, version = store.resolve(reference)
    artifact = store.load(name, version)
    manifest = artifact.manifest
    try:
        config = Config.model_validate(manifest.training.get("config"))
    except ValidationError:
        config = None
    learnt = {source.source: source.digest for source in manifest.data}
    return Side(f"{name}@{version}", config, learnt, artifact)


def baseline_side() -> Side:
    """The baselines, fitted to what the other side learnt from."""
    return Side(BASELINES, None, {}, None)


def find(reference: str, store: Store, data: Path | None, say: Say) -> Side:
    """Whatever a reference names: a run's folder, the baselines, or a published model.

    Raises:
        ConfigError: none of them; and see `run_side` and `stored_side`.
    """
    if reference == BASELINES:
        return baseline_side()
    folder = Path(reference)
    if (folder / "config.json").is_file():
        return run_side(folder, data, say)[0]
    try:
        return stored_side(reference, store)
    except StoreError as error:
        if folder.is_dir():
            raise RunError(f"{reference} holds no finished run") from error
        raise ConfigError(
            f"{reference!r} must be a finished run or a model in {store.root}: {error}"
        ) from error


def _baselines(data: TrainingData, say: Say) -> Contender:
    def fit(baseline: Baseline[Any]) -> Fitted[Any]:
        say(f"fitting {baseline.name}")
        return baseline.fit(data.train, data.validation, data.structure, seed=0, progress=say)

    objects = fit(next(entry for entry in OBJECTS if entry.name == _OBJECTS))
    if not any(scene.evidence.holds.any() for scene in data.validation.scenes):
        return Contender(objects=objects.score)
    relations = fit(next(entry for entry in RELATIONS if entry.name == _RELATIONS)).score
    (table, *_) = PLACED
    placed = fit(placed_product(objects, fit(table).score)).score
    return Contender(
        objects=objects.score,
        relations=relations,
        completion=relations,
        placement=relations,
        placed=placed,
    )
