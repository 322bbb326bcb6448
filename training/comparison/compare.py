"""One model against another on scenes that neither has learnt from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from app.scene import Vocabulary
from training.batches import SceneTensors, scene_tensors
from training.comparison.differences import RELATIONAL, Difference, differences
from training.comparison.examples import Example, changed_most
from training.comparison.heldout import HeldOut, held_out
from training.comparison.sides import Say, Side
from training.comparison.translation import Translation, same_classes
from training.config import ConfigError
from training.datasets import AnnotatedScene, annotated_classes, encode
from training.evaluation.cases import some_scenes
from training.pipeline import read_sources, split_and_encode
from training.trainer import TrainingData

# A bootstrap over fewer than these tells little of what other groups would have said.
_ENOUGH_GROUPS = 15


@dataclass(frozen=True)
class Comparison:
    """What was found.

    Attributes:
        a, b: the titles.
        scenes, groups: how many were asked about.
        certain: nothing speaks for either having learnt from any of them.
        notes: what has to be said beside the figures.
        differences: a minus b, by task and metric.
        examples: questions whose answers differ most.
        unmeasured: tasks about relations at which the second was measured when it was published,
            where the scenes ask about none.
    """

    a: str
    b: str
    scenes: int
    groups: int
    certain: bool
    notes: tuple[str, ...]
    differences: tuple[Difference, ...]
    examples: tuple[Example, ...]
    unmeasured: tuple[str, ...] = ()

    def worse_by(self, margin: float) -> list[Difference]:
        """The primary metrics in which the first is worse by more than a margin, surely."""
        return [row for row in self.differences if row.primary and row.difference.high < -margin]

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        values = asdict(self)
        for row, found in zip(values["differences"], self.differences, strict=True):
            row["verdict"] = found.verdict
        return values


def compare(
    a: Side, b: Side, root: Path, *, limit: int | None, examples: int, say: Say
) -> Comparison:
    """Ask both the questions of `COMPARED`, in the classes of the first.

    Args:
        root: the folder with the scenes of the first one's configuration.
        limit: at most so many scenes.

    Raises:
        ConfigError: the first does not say how it was trained; its scenes cannot be found; none is
            held out for both, or too few are.
        DatasetError: the scenes cannot be read.
    """
    if a.config is None or a.vocabulary is None:
        raise ConfigError(
            f"{a.title} does not say which scenes were held out from it: name a model or a "
            "run that was trained here first"
        )
    say("reading scenes")
    sources = read_sources(a.config.data, root)
    held = held_out(a, b, sources, root)
    data = split_and_encode(a.config.data, sources, a.vocabulary).training_data()
    scenes = some_scenes(_tensors(held.scenes, a.vocabulary), limit)
    rivals = (a.rival(a.vocabulary, data, say), b.rival(a.vocabulary, data, say))
    try:
        rows = differences(*rivals, scenes, data.structure, progress=say)
    except ValueError as error:
        raise ConfigError(f"{a.title} and {b.title} cannot be compared: {error}") from error
    if not rows:
        raise ConfigError(f"none of the {len(scenes)} scenes that are held out can be asked about")
    groups = len({scene.group for scene in scenes.scenes})
    say("looking for examples")
    return Comparison(
        a=a.title,
        b=b.title,
        scenes=len(scenes),
        groups=groups,
        certain=held.certain,
        notes=(
            *held.notes,
            *_classes_note(a, b, held),
            *_limit_note(held, limit),
            *_groups_note(groups),
        ),
        differences=tuple(rows),
        examples=tuple(_examples(rivals, scenes, data, a.vocabulary, examples)),
        unmeasured=unmeasured(rows, b),
    )


def unmeasured(rows: Sequence[Difference], other: Side) -> tuple[str, ...]:
    """The tasks about relations at which a model was measured, where no row is of any."""
    if other.artifact is None or any(row.task in RELATIONAL for row in rows):
        return ()
    measured = {metric.task for metric in other.artifact.manifest.metrics}
    return tuple(task for task in RELATIONAL if task in measured)


def _tensors(scenes: Sequence[AnnotatedScene], vocabulary: Vocabulary) -> SceneTensors:
    encoded = encode(scenes, vocabulary)
    return scene_tensors(encoded, annotated_classes(encoded, vocabulary), len(vocabulary))


def _examples(
    rivals: Sequence[Any],
    scenes: SceneTensors,
    data: TrainingData,
    vocabulary: Vocabulary,
    count: int,
) -> list[Example]:
    first, second = (rival("T2 missing").objects for rival in rivals)
    return changed_most(first, second, scenes, data.structure, vocabulary, count)


def _classes_note(a: Side, b: Side, held: HeldOut) -> list[str]:
    """What the second does not know of the first one's classes."""
    if a.vocabulary is None or b.vocabulary is None or same_classes(a.vocabulary, b.vocabulary):
        return []
    own = Translation.between(a.vocabulary, b.vocabulary).own
    unknown = {label for label, index in zip(a.vocabulary.labels, own, strict=True) if index < 0}
    mentions = [
        a.vocabulary.labels[index]
        for scene in held.scenes
        for thing in scene.objects
        if (index := a.vocabulary.index(thing.label)) is not None
    ]
    lost = sum(label in unknown for label in mentions)
    return [
        f"asked in the {len(a.vocabulary)} classes of {a.title}; {b.title} does not know "
        f"{len(unknown)} of them, {lost / max(len(mentions), 1):.0%} of the mentions here: it is "
        "not shown these, and ranks them last, in no order"
    ]


def _groups_note(groups: int) -> list[str]:
    if groups >= _ENOUGH_GROUPS:
        return []
    return [f"{groups} groups are few: intervals over them are rough, and too narrow"]


def _limit_note(held: HeldOut, limit: int | None) -> list[str]:
    if limit is None or len(held.scenes) <= limit:
        return []
    return [f"{limit} of {len(held.scenes)} held-out scenes, by --limit"]
