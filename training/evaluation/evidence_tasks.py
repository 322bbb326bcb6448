"""Measure how additional evidence changes the answers: the room type, relations or poses.

Each question is asked twice about the same scene: with the object labels only, and with labels and
one kind of evidence. The result is the paired change of a metric, with an interval over scenes.

    T2   (missing objects) One class is removed with all its instances. The evidence is the room
         type. Metric: change of the mean reciprocal rank (MRR) of the removed class among absent
         classes
    T1   (relations) The evidence is the relations or poses between the instances of half of the
         classes. Metric: change of R-precision on all other ordered pairs. The number of
         predictions is the number of listed relations. An unlisted relation counts as wrong

Relations and poses are no evidence for objects in these machines. Poses also show which relations
do not hold. Only data sources with positions have poses. The evidence never contains the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from app.registry import Artifact
from app.scene import PoseRelations, Scene
from training.datasets.array_types import Flags
from training.datasets.batches import SceneTensors
from training.datasets.cases import scene_of, scene_rng
from training.evaluation.asking import (
    ask_every,
    missing_probabilities,
    relation_probabilities,
    thing_instances,
)
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.relation_tasks import expected_hits
from training.evaluation.setting import Outcome, Setting

OF_RELATIONS = ("relations", "poses")
OF_OBJECTS = ("room type",)
"""Kinds of evidence for relations (T1) and for objects (T2)."""

# Number of questions per scene in T2, each with another removed class. With one question per scene,
# the random choice of the class changes the result of a small data source by about 0.01.
_REMOVALS = 2


class Case(NamedTuple):
    """One question about a scene, asked with labels only and with additional evidence.

    Attributes:
        scene_index: index of the scene in its set.
        scene: the scene with the evidence.
        asked: index of the removed class in T2. In T1, the queried relations and those that hold,
            both (relations, objects, objects) bool.
        items: number of relations to find in T1; 1 in T2.
    """

    scene_index: int
    scene: Scene
    asked: Any
    items: int = 1


def removals(scenes: SceneTensors, structure: Flags, seed: int = 0) -> Iterator[Case]:
    """Generate the T2 questions: up to two questions per scene, each with one removed class."""
    for index, encoded in enumerate(scenes.scenes):
        classes = encoded.evidence.classes
        removable = classes[~structure[classes]]
        if len(removable) < 2 or encoded.room_type < 0:
            continue
        for target in scene_rng(encoded, seed).permutation(removable)[:_REMOVALS].tolist():
            kept = thing_instances(encoded, structure, {target})
            yield Case(index, scene_of(encoded, kept, ()), target)


def halves(scenes: SceneTensors, structure: Flags, kind: str, seed: int = 0) -> Iterator[Case]:
    """Generate the T1 questions: evidence about half of the classes, all other pairs queried."""
    for index, encoded in enumerate(scenes.scenes):
        instances, classes = encoded.instance_classes, encoded.evidence.classes
        things = classes[~structure[classes]]
        if len(things) < 3 or (kind == "poses" and encoded.instance_positions is None):
            continue
        half = scene_rng(encoded, seed).permutation(things)[: max(2, len(things) // 2)]
        in_half, is_thing = np.isin(instances, half), ~structure[instances]
        between = in_half[:, None] & in_half
        pair = is_thing[:, None] & is_thing & ~between & ~np.eye(len(instances), dtype=np.bool_)
        queried = np.broadcast_to(pair, encoded.instance_holds.shape)
        truth, given = encoded.instance_holds & queried, encoded.instance_holds & between
        if not truth.any() or not given.any():
            continue
        triples = [(int(a), int(i), int(j)) for a, i, j in np.argwhere(given)]
        scene = replace(scene_of(encoded, range(len(instances)), triples), room_type=None)
        if kind == "poses":
            scene = replace(scene, poses=PoseRelations(given, encoded.instance_observed & between))
        yield Case(index, scene, (queried, truth), int(truth.sum()))


def reciprocal_rank(artifact: Artifact, scene: Scene, target: int) -> float:
    """Return the reciprocal rank of a removed class among absent classes, expected over ties."""
    p = missing_probabilities(artifact, scene)
    above, ties = int((p > p[target]).sum()), int((p == p[target]).sum())
    return float((1.0 / np.arange(above + 1, above + ties + 1)).mean())


def missing_evidence_task(artifact: Artifact, setting: Setting) -> Outcome | None:
    """Measure T2 (missing objects) with labels only and with additional evidence."""

    def cases(scenes: SceneTensors, _: str) -> Iterator[Case]:
        return removals(scenes, setting.structure.numpy(), setting.seed)

    def value(scene: Scene, target: int) -> float:
        return reciprocal_rank(artifact, scene, target)

    return _changes("MRR", setting, cases, value, OF_OBJECTS)


def relations_evidence_task(artifact: Artifact, setting: Setting) -> Outcome | None:
    """Measure T1 (relations) with labels only and with additional evidence."""

    def cases(scenes: SceneTensors, kind: str) -> Iterator[Case]:
        return halves(scenes, setting.structure.numpy(), kind, setting.seed)

    def value(scene: Scene, asked: tuple[Flags, Flags]) -> float:
        queried, truth = asked
        p = relation_probabilities(artifact, scene)[queried]
        return expected_hits(p, truth[queried], int(truth.sum()))

    return _changes("R-precision", setting, cases, value, OF_RELATIONS)


def _changes(
    metric: str,
    setting: Setting,
    cases_of: Callable[[SceneTensors, str], Iterator[Case]],
    value: Callable[[Scene, Any], float],
    kinds: tuple[str, ...],
) -> Outcome | None:
    """Return the metric without and with each kind of evidence, and the change of the metric.

    Args:
        cases_of: function that yields the questions about scenes for a kind of evidence.
        value: function of a scene with or without evidence, and `Case.asked`. It returns the
            metric of the answer, summed over the items of the question.
    """
    scenes = setting.some(related=kinds == OF_RELATIONS)
    metrics: dict[str, Metric] = {}
    skipped: list[int] = []

    def ask(case: Case) -> np.ndarray:
        bare = replace(case.scene, room_type=None, relations=None, poses=None)
        return np.array([value(scene, case.asked) for scene in (bare, case.scene)])

    for kind in kinds:
        cases = list(cases_of(scenes, kind))
        if not cases:
            continue
        index = [case.scene_index for case in cases]
        without, informed, items = (
            np.bincount(index, weights=column, minlength=len(scenes)).astype(np.float64)
            for column in (*np.array(ask_every(ask, cases)).T, [case.items for case in cases])
        )
        metrics |= {
            f"change of {metric}, {kind}": Ratio(informed - without, items),
            f"{metric}, {kind}": Ratio(informed, items),
            f"{metric}, {kind} withheld": Ratio(without, items),
        }
        skipped.append(int((items == 0).sum()))
    return Outcome.over(scenes, metrics, skipped[0] if skipped else 0)
