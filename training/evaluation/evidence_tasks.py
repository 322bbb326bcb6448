"""Measure how additional evidence changes the answers: the room type, relations or poses.

Each question is asked twice about the same scene: with the object labels only, and with labels and
one kind of evidence. The result is the paired change of a metric, with an interval over scenes.

    T2   (missing objects) One class is removed with all its instances. The evidence is the room
         type. Metric: change of the mean reciprocal rank (MRR) of the removed class among absent
         classes
    T3   (outliers) A uniformly drawn absent class is added as an intruder. The evidence is the room
         type. Metric: change of the share of scenes whose intruder ranks first
    T1   (relations) The evidence is the relations or poses between the instances of half of the
         classes. Metric: change of R-precision on all other ordered pairs. The number of
         predictions is the number of listed relations. An unlisted relation counts as wrong

Relations and poses are no evidence for objects in these machines. Poses also show which relations
do not hold. Only data sources with positions have poses. The evidence never contains the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from app.registry import Artifact
from app.scene import PoseRelations, Scene
from training.datasets import EncodedScene
from training.datasets.array_types import Flags, Ints
from training.datasets.batches import SceneTensors
from training.datasets.cases import scene_of, scene_rng
from training.evaluation.asking import (
    ask_every,
    judge,
    missing_probabilities,
    relation_probabilities,
    thing_instances,
    with_intruder,
)
from training.evaluation.intruders import draw_intruders
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.relation_tasks import expected_hits
from training.evaluation.setting import Outcome, Setting

OF_RELATIONS = ("relations", "poses")
OF_OBJECTS = ("room type",)
"""Kinds of evidence for relations and for objects."""

# Number of questions per scene in T2, each with another removed class. With one question per scene,
# the random choice of the class changes the result of a small data source by about 0.01.
_REMOVALS = 2


@dataclass(frozen=True, eq=False)
class Case:
    """One question about a scene, asked with labels only and with additional evidence.

    Attributes:
        scene_index: index of the scene in its set.
        scenes: the scene with labels only, and the scene with evidence.
        target: index of the removed class in T2, or of the intruding object in T3.
        truth: (relations, objects, objects) bool, the relations that hold. Empty in T2 and T3.
        queried: (relations, objects, objects) bool, the queried relations. Empty in T2 and T3.
        items: number of relations to find in T1; 1 in T2 and T3.
    """

    scene_index: int
    scenes: tuple[Scene, Scene]
    target: int = -1
    truth: Flags = field(default_factory=lambda: np.zeros((0, 0, 0), dtype=np.bool_))
    queried: Flags = field(default_factory=lambda: np.zeros((0, 0, 0), dtype=np.bool_))
    items: int = 1


def with_relations(encoded: EncodedScene, kind: str, between: Flags) -> tuple[Scene, Scene] | None:
    """Return a scene with labels only, and with evidence about the pairs `between`, (n, n).

    Return None if the scene lacks this evidence.
    """
    bare = replace(scene_of(encoded, range(len(between)), ()), room_type=None)
    holds = encoded.instance_holds & between
    triples = tuple((int(a), int(i), int(j)) for a, i, j in np.argwhere(holds))
    if not triples or (kind == "poses" and encoded.instance_positions is None):
        return None
    poses = PoseRelations(holds, encoded.instance_observed & between)
    return bare, replace(bare, relations=triples, poses=poses if kind == "poses" else None)


def with_room(encoded: EncodedScene, kept: list[int]) -> tuple[Scene, Scene] | None:
    """Return a scene with labels only, and with its room type; None if this is unknown."""
    scene = scene_of(encoded, kept, ())
    return None if scene.room_type is None else (replace(scene, room_type=None), scene)


def removals(scenes: SceneTensors, structure: Flags, seed: int = 0) -> Iterator[Case]:
    """Generate the T2 questions: up to two questions per scene, each with one removed class."""
    for index, encoded in enumerate(scenes.scenes):
        classes = encoded.evidence.classes
        removable = classes[~structure[classes]]
        if len(removable) < 2:
            continue
        for target in scene_rng(encoded, seed).permutation(removable)[:_REMOVALS]:
            kept = thing_instances(encoded, structure, {int(target)})
            if (pair := with_room(encoded, kept)) is not None:
                yield Case(index, pair, int(target))


def intrusions(
    artifact: Artifact, scenes: SceneTensors, structure: Flags, intruders: Ints
) -> Iterator[Case]:
    """Generate the T3 questions: each scene with its intruder, (scenes,); -1 skips the scene."""
    for index, (encoded, intruder) in enumerate(zip(scenes.scenes, intruders, strict=True)):
        pair = with_room(encoded, thing_instances(encoded, structure))
        if intruder < 0 or pair is None:
            continue
        bare, informed = (with_intruder(artifact, scene, int(intruder)) for scene in pair)
        yield Case(index, (bare, informed), len(bare.objects) - 1)


def halves(scenes: SceneTensors, structure: Flags, kind: str, seed: int = 0) -> Iterator[Case]:
    """Generate the T1 questions: evidence about half of the classes, all other pairs queried."""
    for index, encoded in enumerate(scenes.scenes):
        instances, classes = encoded.instance_classes, encoded.evidence.classes
        things = classes[~structure[classes]]
        if len(things) < 3:
            continue
        half = scene_rng(encoded, seed).permutation(things)[: max(2, len(things) // 2)]
        in_half, is_thing = np.isin(instances, half), ~structure[instances]
        between = in_half[:, None] & in_half
        scene_pair = with_relations(encoded, kind, between)
        pair = is_thing[:, None] & is_thing & ~between & ~np.eye(len(instances), dtype=np.bool_)
        queried = np.broadcast_to(pair, encoded.instance_holds.shape)
        truth = encoded.instance_holds & queried
        if scene_pair is not None and truth.any():
            yield Case(index, scene_pair, truth=truth, queried=queried, items=int(truth.sum()))


def reciprocal_rank(artifact: Artifact, scene: Scene, target: int) -> float:
    """Return the reciprocal rank of a removed class among absent classes, expected over ties."""
    p = missing_probabilities(artifact, scene)
    above, ties = int((p > p[target]).sum()), int((p == p[target]).sum())
    return float((1.0 / np.arange(above + 1, above + ties + 1)).mean())


def missing_evidence_task(artifact: Artifact, setting: Setting) -> Outcome | None:
    """Measure T2 (missing objects) with labels only and with additional evidence."""
    structure = setting.structure.numpy()
    return _changes(
        "MRR",
        setting,
        lambda scenes, _: removals(scenes, structure, setting.seed),
        lambda scene, case: reciprocal_rank(artifact, scene, case.target),
        OF_OBJECTS,
    )


def outliers_evidence_task(artifact: Artifact, setting: Setting) -> Outcome | None:
    """Measure T3 (outliers) with labels only and with additional evidence."""

    def cases(scenes: SceneTensors, _: str) -> Iterator[Case]:
        intruders = draw_intruders(scenes, setting.structure, seed=setting.seed).numpy()
        return intrusions(artifact, scenes, setting.structure.numpy(), intruders)

    def value(scene: Scene, case: Case) -> float:
        p = judge(artifact, scene)[:, 0]
        return expected_hits(p, np.arange(len(p)) == case.target, 1)

    return _changes("hit@1", setting, cases, value, OF_OBJECTS)


def relations_evidence_task(artifact: Artifact, setting: Setting) -> Outcome | None:
    """Measure T1 (relations) with labels only and with additional evidence."""

    def cases(scenes: SceneTensors, kind: str) -> Iterator[Case]:
        return halves(scenes, setting.structure.numpy(), kind, setting.seed)

    def value(scene: Scene, case: Case) -> float:
        p, truth = relation_probabilities(artifact, scene)[case.queried], case.truth[case.queried]
        return expected_hits(p, truth, case.items)

    return _changes("R-precision", setting, cases, value, OF_RELATIONS)


def _changes(
    metric: str,
    setting: Setting,
    cases_of: Callable[[SceneTensors, str], Iterator[Case]],
    value: Callable[[Scene, Case], float],
    kinds: tuple[str, ...],
) -> Outcome | None:
    """Return the metric without and with each kind of evidence, and the change of the metric.

    Args:
        cases_of: function that yields the questions about scenes for a kind of evidence.
        value: function of one of the two scenes of a question, and the question. It returns the
            metric of the answer, summed over the items of the question.
    """
    scenes = setting.some(related=kinds == OF_RELATIONS)
    metrics: dict[str, Metric] = {}
    skipped: list[int] = []
    for kind in kinds:
        cases = list(cases_of(scenes, kind))
        if not cases:
            continue
        values = ask_every(lambda case: np.array([value(s, case) for s in case.scenes]), cases)
        index = [case.scene_index for case in cases]
        without, informed, items = (
            np.bincount(index, weights=column, minlength=len(scenes)).astype(np.float64)
            for column in (*np.array(values).T, [case.items for case in cases])
        )
        metrics |= {
            f"change of {metric}, {kind}": Ratio(informed - without, items),
            f"{metric}, {kind}": Ratio(informed, items),
            f"{metric}, {kind} withheld": Ratio(without, items),
        }
        skipped.append(int((items == 0).sum()))
    return Outcome.over(scenes, metrics, skipped[0] if skipped else 0)
