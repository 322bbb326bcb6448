"""The two candidates of a comparison of models, and the scenes held out from both.

A candidate is the model of a finished run, a published model, or a set of baselines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from app.model import SceneModel
from app.registry import DataSource, Store, StoreError
from app.scene import Vocabulary
from training.datasets import AnnotatedScene, split
from training.datasets.batches import TrainingData, has_relations
from training.datasets.records import digest_of
from training.datasets.splits import stable_part
from training.domain.translation import Translation, same_classes
from training.evaluation.asking import artifact_model
from training.evaluation.baselines import EASE, FREQUENCY_TABLE, PLACED, placed_product
from training.evaluation.report import Progress
from training.evaluation.selection import Baseline
from training.evaluation.setting import Model
from training.fit.configuration import Config, ConfigError, source_name
from training.runs.folder import FinishedRun, RunError, load_run
from training.runs.pipeline import SplitScenes, prepare
from training.runs.publish import calibrated_draft, data_sources, terms

BASELINES = "baselines"
"""Name of the baselines as a candidate: EASE for objects, a frequency table for relations, and
the product of EASE and a frequency table of places for objects at a place."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One of the two compared models."""

    title: str  # name of the model in tables
    config: Config | None
    sources: tuple[DataSource, ...]  # data of the training
    scene_model: SceneModel | None  # None for the baselines
    data: Path | None = None  # folder with the scene files of a run
    tasks: frozenset[str] = frozenset()  # tasks of the figures on the card of a published model
    terms: str = ""  # of the weights

    @property
    def learnt(self) -> dict[str, str]:
        """Digest of each data source of the training, by source name."""
        return {source.source: source.digest for source in self.sources}

    @property
    def vocabulary(self) -> Vocabulary | None:
        """Classes of the model. None for the baselines, which use those of the other candidate."""
        return None if self.scene_model is None else self.scene_model.vocabulary

    def model(self, scenes: Vocabulary, data: TrainingData, say: Progress) -> Model:
        """Return the scores of this candidate in the classes of the test scenes, `scenes`.

        Baselines are fitted to `data`, which has the same classes, so they need no translation.
        """
        if self.scene_model is None:
            return _baselines(data, say)
        model = artifact_model(self.scene_model)
        if same_classes(scenes, self.scene_model.vocabulary):
            return model
        return Translation.between(scenes, self.scene_model.vocabulary).translate(model)


def run_candidate(folder: Path, data: Path | None, say: Progress) -> Candidate:
    """Load a finished run and the scenes in `data` or its own folder, and calibrate its model."""
    run = load_run(folder)
    root = data or run.data_folder
    say("reading scenes")
    scenes = prepare(run.config, root)
    run.require(scenes.digest)
    say(f"calibrating {folder}")
    return of_run(str(folder), run, scenes, calibrated_draft(run, scenes), root)


def of_run(
    title: str, run: FinishedRun, scenes: SplitScenes, model: SceneModel, root: Path
) -> Candidate:
    """Return the calibrated model of a run as a candidate."""
    sources = data_sources(scenes)
    return Candidate(title, run.config, sources, model, root, terms=terms(sources))


def stored_candidate(reference: str, store: Store) -> Candidate:
    """Load a published model as a candidate."""
    name, version = store.resolve(reference)
    artifact = store.load(name, version)
    try:
        config = Config.model_validate(artifact.manifest.training.get("config"))
    except ValidationError:
        config = None
    manifest = artifact.manifest
    return Candidate(
        f"{name}@{version}", config, manifest.data, artifact.model,
        tasks=frozenset(metric.task for metric in manifest.metrics), terms=manifest.terms,
    )  # fmt: skip


def find(reference: str, store: Store, data: Path | None, say: Progress) -> Candidate:
    """Return the candidate that a reference names: a folder of a run, `BASELINES`, or a model."""
    if reference == BASELINES:
        # The baselines are fitted later, on the training scenes of the other candidate.
        return Candidate(BASELINES, None, (), None)
    folder = Path(reference)
    if (folder / "config.json").is_file():
        return run_candidate(folder, data, say)
    try:
        return stored_candidate(reference, store)
    except StoreError as error:
        if folder.is_dir():
            raise RunError(f"the folder {reference} contains no finished run") from error
        raise ConfigError(
            f"{reference!r} names neither the folder of a finished run nor a model in "
            f"{store.root}: {error.reason}"
        ) from error


def _baselines(data: TrainingData, say: Progress) -> Model:
    """Fit the baselines; without annotated relations, only the baseline for objects."""

    def fit(baseline: Baseline) -> Model:
        say(f"fitting {baseline.name}")
        return baseline.fit(data.train, data.validation, data.structure, progress=say)

    objects = fit(EASE)
    if not has_relations(data.validation):
        return Model(missing=objects.missing)
    relations = fit(FREQUENCY_TABLE).relations
    placed = fit(placed_product(EASE.name, objects, fit(PLACED)))
    return Model(
        missing=objects.missing,
        at_place=placed.at_place,
        relations=relations,
        completion=relations,
        false_relations=relations,
    )


Sources = Mapping[str, Sequence[AnnotatedScene]]  # scenes of a configuration, by source name
HeldOut = tuple[list[AnnotatedScene], tuple[str, ...]]
"""Scenes held out from models, and remarks on their choice."""


def held_out(a: Candidate, b: Candidate, sources: Sources) -> HeldOut:
    """Return the first model's test scenes without scenes that the second model learnt from."""
    if a.config is None:
        raise ConfigError(
            f"{a.title} does not record the split of its scenes, so its test scenes are unknown"
        )
    all_scenes = [scene for scenes in sources.values() for scene in scenes]
    data = a.config.data
    test_scenes = split(all_scenes, seed=data.split_seed, protocol=data.split)["test"]
    if not test_scenes:
        if data.split == "final":
            raise ConfigError(
                f"{a.title} learnt from all of its scenes, because it was trained with --final; "
                "compare the run without --final"
            )
        raise ConfigError("the test part contains no scenes: provide more scenes or more groups")
    first, notes = _drop_learnt(a, test_scenes, sources)
    unlearnt, more = _drop_learnt(b, first, sources)
    if not unlearnt:
        raise ConfigError(
            f"no scene is held out from both models: {b.title} has learnt from all test scenes of "
            f"{a.title}"
        )
    if dropped := len(test_scenes) - len(unlearnt):
        more += (
            f"{dropped} of {len(test_scenes)} test scenes of {a.title} are left out: {b.title} has "
            "learnt from these scenes or from near-duplicates (same group)",
        )
    return unlearnt, notes + more


def _drop_learnt(candidate: Candidate, scenes: list[AnnotatedScene], sources: Sources) -> HeldOut:
    """Leave out the scenes that a candidate learnt from."""
    if candidate.scene_model is None:
        return scenes, ()  # baselines are fitted on the training scenes of the first model
    digests = {name: digest_of(source) for name, source in sources.items()}
    shared = {
        name
        for name, digest in digests.items()
        if name in candidate.learnt or digest in candidate.learnt.values()
    }
    if not shared:
        origin = ", ".join(candidate.learnt) or "unknown"
        return scenes, (f"{candidate.title} learnt from other data sources ({origin})",)
    data = None if candidate.config is None else candidate.config.data
    if data is not None and data.split == "stable":
        seed = data.split_seed
        return [s for s in scenes if s.source not in shared or stable_part(s, seed) == "test"], ()
    names = [] if data is None else list(map(source_name, data.sources))
    if data is None or any(candidate.learnt.get(x) != digests.get(x, "") for x in names):
        note = (
            f"{candidate.title} may have learnt from these scenes: its split cannot be reproduced, "
            f"because it learnt from other versions of {', '.join(sorted(shared))}, or from more "
            "data sources. Use the stable split to avoid this"
        )
        return scenes, (note,)
    all_scenes = [scene for name in names for scene in sources[name]]
    parts = split(all_scenes, seed=data.split_seed, protocol=data.split)
    # Filter by group for all protocols: scenes of one group are near-duplicates.
    groups = {scene.group for part in ("train", "validation") for scene in parts[part]}
    return [scene for scene in scenes if scene.group not in groups], ()
