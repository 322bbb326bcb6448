"""Measure how additional evidence changes the answers: the room type, relations or poses.

Each question is asked twice about the same scene: with the object labels only, and with labels and
one kind of evidence. The result is the paired change of a metric, with an interval over scenes.

    T2   (missing objects) Two of the classes are removed in turn. The evidence is the room type.
         Metric: change of the mean reciprocal rank (MRR) of the removed class among absent classes
    T1   (relations) The evidence is the relations or poses between the instances of half of the
         classes. Metric: change of R-precision on all other ordered pairs. The number of
         predictions is the number of listed relations. An unlisted relation counts as wrong

Relations and poses are no evidence for objects in these machines. Poses also show which relations
do not hold. Only data sources with positions have poses. The evidence never contains the answer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from app.model import SceneModel
from app.scene import RelationTable, Scene
from training.datasets.batches import SceneTensors
from training.datasets.cases import scene_of, scene_rng
from training.evaluation.asking import ask_every, ask_rows, relation_probabilities, score_missing
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.parts import all_but_one, draw_parts, rank_hidden
from training.evaluation.relation_tasks import expected_hits
from training.evaluation.room_task import with_room_type
from training.evaluation.setting import Outcome, Setting

OF_RELATIONS = ("relations", "poses")  # kinds of evidence for relations (T1)
OF_OBJECTS = ("room type",)  # kinds of evidence for objects (T2)


class Case(NamedTuple):
    """One question of T1."""

    scene_index: int
    scene: Scene  # with the evidence
    queried: Bool[NDArray, "A objects objects"]
    truth: Bool[NDArray, "A objects objects"]  # queried relations that hold


def missing_evidence_task(artifact: SceneModel, setting: Setting) -> Outcome | None:
    """Measure T2 (missing objects) with labels only and with the room type."""
    scenes, structure = with_room_type(setting.some()), setting.structure
    # With one question per scene, chance changes the result of a small data source by about 0.01.
    parts = draw_parts(scenes, structure, all_but_one, (setting.seed, setting.seed + 1))
    if not len(parts.v):
        return None
    score = partial(score_missing, artifact)
    without, informed = (
        rank_hidden(parts, structure, ask_rows(score, *columns)).mrr()
        for columns in ((parts.v,), (parts.v, scenes.room[parts.scene]))
    )
    return Outcome.over(scenes, _changes("MRR", "room type", without, informed), parts.skipped)


def evidence_cases(
    scenes: SceneTensors, structure: Bool[NDArray, " V"], kind: str, seed: int = 0
) -> Iterator[Case]:
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
        truth, evidence = encoded.instance_holds & queried, encoded.instance_holds & between
        if not truth.any() or not evidence.any():
            continue
        triples = [(int(a), int(i), int(j)) for a, i, j in np.argwhere(evidence)]
        scene = replace(scene_of(encoded, range(len(instances)), triples), room_type=None)
        if kind == "poses":
            observed = encoded.instance_observed & between
            table = RelationTable.shown_by_boxes(evidence, observed, np.zeros_like(observed))
            scene = replace(scene, relations=table)
        yield Case(index, scene, queried, truth)


def relations_evidence_task(artifact: SceneModel, setting: Setting) -> Outcome | None:
    """Measure T1 (relations) with labels only, and with relations or poses."""
    scenes, structure = setting.some(related=True), setting.structure.numpy()
    metrics: dict[str, Metric] = {}
    skipped: list[int] = []

    def ask(case: Case) -> Float[NDArray, " 2"]:
        count, truth = int(case.truth.sum()), case.truth[case.queried]
        bare = replace(case.scene, relations=None)
        p = (relation_probabilities(artifact, scene) for scene in (bare, case.scene))
        return np.array([expected_hits(x[case.queried], truth, count) for x in p])

    for kind in OF_RELATIONS:
        cases = list(evidence_cases(scenes, structure, kind, setting.seed))
        if not cases:
            continue
        without, informed, items = np.zeros((3, len(scenes)))
        for case, hits in zip(cases, ask_every(ask, cases), strict=True):
            without[case.scene_index], informed[case.scene_index] = hits
            items[case.scene_index] = case.truth.sum()
        metrics |= _changes("R-precision", kind, Ratio(without, items), Ratio(informed, items))
        skipped.append(int((items == 0).sum()))
    return Outcome.over(scenes, metrics, skipped[0] if skipped else 0)


def _changes(metric: str, kind: str, without: Ratio, informed: Ratio) -> dict[str, Metric]:
    """Return a metric with and without one kind of evidence, and its change, which comes first."""
    return {
        f"change of {metric}, {kind}": informed - without,
        f"{metric}, {kind}": informed,
        f"{metric}, {kind} withheld": without,
    }
