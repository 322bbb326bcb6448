"""The two that are compared: a finished run, a published model, or the baselines.

And the scenes that neither of them has learnt from.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from app.registry import Artifact, Store, StoreError
from app.scene import Vocabulary
from training.baselines import BASELINES, PLACED, Baseline, placed_product
from training.config import DATA, Config, ConfigError, DataConfig, source_name
from training.datasets import AnnotatedScene, DatasetError, split, stable_part
from training.evaluation.contenders import artifact_contender
from training.evaluation.setting import Contender
from training.experiments.rows import has_relations
from training.experiments.translation import Translation, same_classes
from training.pipeline import digest_of, prepare, read_sources
from training.publish import calibrated_draft
from training.runs import RunError, load_run
from training.trainer import TrainingData

BASELINE_SIDE = "baselines"
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


def run_side(folder: Path, data: Path | None, say: Say) -> Side:
    """A finished run, calibrated as it would be published.

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
    return Side(str(folder), run.config, scenes.digests, artifact, root)


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


def find(reference: str, store: Store, data: Path | None, say: Say) -> Side:
    """Whatever a reference names: a run's folder, the baselines, or a published model.

    Raises:
        ConfigError: none of them; and see `run_side` and `stored_side`.
    """
    if reference == BASELINE_SIDE:
        # Fitted to what the other side learnt from.
        return Side(BASELINE_SIDE, None, {}, None)
    folder = Path(reference)
    if (folder / "config.json").is_file():
        return run_side(folder, data, say)
    try:
        return stored_side(reference, store)
    except StoreError as error:
        if folder.is_dir():
            raise RunError(f"{reference} holds no finished run") from error
        raise ConfigError(
            f"{reference!r} must be a finished run or a model in {store.root}: {error}"
        ) from error


def _baselines(data: TrainingData, say: Say) -> Contender:
    def fit(baseline: Baseline[Any]) -> Any:
        say(f"fitting {baseline.name}")
        return baseline.fit(data.train, data.validation, data.structure, progress=say).score

    objects = fit(BASELINES[_OBJECTS])
    if not has_relations(data.validation):
        return Contender(objects=objects)
    relations = fit(BASELINES[_RELATIONS])
    placed = fit(placed_product(_OBJECTS, objects, fit(PLACED)))
    return Contender(objects, relations, relations, placed, relations)


# --------------------------------------------------------------------------------- held-out scenes

# Whether a model was kept from a scene.
Kept = Callable[[AnnotatedScene], bool]


@dataclass(frozen=True)
class HeldOut:
    """Scenes to compare on.

    Attributes:
        scenes: test scenes of the first that the second has not learnt from either.
        dropped: how many of the first one's test scenes are left out.
        notes: what has to be said beside the figures.
        certain: nothing speaks for either having learnt from any of the scenes.
    """

    scenes: list[AnnotatedScene]
    dropped: int
    notes: tuple[str, ...]
    certain: bool


def held_out(
    a: Side, b: Side, sources: Mapping[str, Sequence[AnnotatedScene]], root: Path
) -> HeldOut:
    """The first one's test scenes, less what the second has learnt from.

    Args:
        sources: the scenes of the first one's configuration, by source, as they are now.
        root: the folder that they, and so perhaps the second one's, were read from.

    Raises:
        ConfigError: the first does not say how it was trained, or nothing is left.
    """
    if a.config is None:
        raise ConfigError(f"{a.title} does not say how its scenes were split")
    everything = [scene for some in sources.values() for scene in some]
    data = a.config.data
    candidates = split(everything, seed=data.split_seed, protocol=data.split)["test"]
    if not candidates:
        raise ConfigError("no scene is in the test part: take more scenes, or of more groups")
    notes: list[str] = []
    certain = True
    kept = candidates
    for side in (a, b):
        judge, note, sure = _kept(side, sources, root)
        if note:
            notes.append(note)
        certain &= sure
        kept = [scene for scene in kept if judge(scene)]
    dropped = len(candidates) - len(kept)
    if not kept:
        raise ConfigError(
            f"{b.title} has learnt from every test scene of {a.title}: nothing is held out for both"
        )
    if dropped:
        notes.append(
            f"{dropped} of {len(candidates)} test scenes of {a.title} are left out: {b.title} has "
            "learnt from them, or from scenes of their groups"
        )
    return HeldOut(kept, dropped, tuple(notes), certain)


def _kept(
    side: Side, sources: Mapping[str, Sequence[AnnotatedScene]], root: Path
) -> tuple[Kept, str, bool]:
    """Whether a side was kept from a scene, what to say of it, and whether that is certain."""
    if side.artifact is None:
        return _all, "", True  # fitted to the first one's own training scenes
    digests = {name: digest_of(some) for name, some in sources.items()}
    shared = {
        name
        for name, digest in digests.items()
        if name in side.learnt or digest in side.learnt.values()
    }
    if not shared:
        names = ", ".join(side.learnt) or "nothing it tells of"
        return _all, f"{side.title} learnt from other sources ({names})", True
    if side.config is None:
        note = f"{side.title} does not say how its scenes were split: it may have learnt from these"
        return _all, note, False
    data = side.config.data
    if data.split == "stable":
        seed = data.split_seed
        return (
            lambda scene: scene.source not in shared or stable_part(scene.group, seed) == "test",
            "",
            True,
        )
    if (own := _scenes_of(data, side.learnt, sources, digests, root)) is None:
        note = (
            f"{side.title} learnt from other versions of {', '.join(sorted(shared))}, and its "
            "split cannot be made again: it may have learnt from these (a split that is stable "
            "avoids this)"
        )
        return _all, note, False
    parts = split(own, seed=data.split_seed, protocol=data.split)
    # By group whatever the protocol: of whom a near-duplicate was learnt has been seen.
    learnt = {scene.group for part in ("train", "validation") for scene in parts[part]}
    return lambda scene: scene.group not in learnt, "", True


def _all(_: AnnotatedScene) -> bool:
    return True


def _scenes_of(
    data: DataConfig,
    learnt: Mapping[str, str],
    sources: Mapping[str, Sequence[AnnotatedScene]],
    digests: Mapping[str, str],
    root: Path,
) -> list[AnnotatedScene] | None:
    """The scenes that a side was split from, if they can be had as they were."""
    found: list[AnnotatedScene] = []
    for source in data.sources:
        name = source_name(source)
        if name in digests and digests[name] == learnt.get(name):
            found += sources[name]
            continue
        try:
            one = data.model_copy(update={"sources": (source,)})
            (read,) = read_sources(one, root).values()
        except (ConfigError, DatasetError):
            return None
        if digest_of(read) != learnt.get(name):
            return None
        found += read
    return found
