"""The effect of additional evidence (relations, poses, room type) compared with labels only.

Each question is asked twice about the same scene: with labels only, and with one additional kind of
evidence. The result is the paired change of a metric, with a confidence interval over scenes.

    T2   one class is removed with all its instances. The evidence is the relations (or poses) of
         the remaining instances, or the room type. Metric: change of MRR over absent classes
    T3   a uniformly drawn intruder is added; its relations are unknown. Metric: change of hit@1
    T1   the evidence is the relations (or poses) between the instances of half of the classes.
         Metric: change of R-precision on all other ordered pairs, with as many predictions as
         listed relations; an unlisted relation counts as wrong

Poses also show which relations do not hold; only sources with positions have poses. Scenes without
a relation among the remaining instances are left out. The answer is never part of the evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from app.registry import Artifact
from app.scene import PoseRelations, Scene
from training.batches import SceneTensors
from training.cases import scene_of, scene_rng
from training.datasets import EncodedScene
from training.evaluation.asking import (
    Flags,
    ask_every,
    judge,
    missing_probabilities,
    relation_probabilities,
    things,
    with_intruder,
)
from training.evaluation.intruders import draw_intruders
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.outliers import share_of_first
from training.evaluation.relations import expected_hits
from training.evaluation.setting import Contender, Outcome, Setting

KINDS = ("relations", "poses", "room type")

# Number of removed classes per scene. With one class, chance varies the change of a small source by
# .01.
_REMOVALS = 2


@dataclass(frozen=True, eq=False)
class Case:
    """One question, asked with and without additional evidence.

    Attributes:
        place: index of the scene.
        scenes: the scene with labels only, and with evidence.
        target: the removed class in T2, the object index of the intruder in T3.
        truth, asked: (A, n, n) bool in T1: relations that hold, and queried relations. Empty in T2
            and T3.
        items: number of listed relations in T1; 1 in T2 and T3.
    """

    place: int
    scenes: tuple[Scene, Scene]
    target: int = -1
    truth: Flags = field(default_factory=lambda: np.zeros((0, 0, 0), dtype=np.bool_))
    asked: Flags = field(default_factory=lambda: np.zeros((0, 0, 0), dtype=np.bool_))
    items: int = 1


def told(
    encoded: EncodedScene, kept: list[int], kind: str, between: Flags | None = None
) -> tuple[Scene, Scene] | None:
    """Return a scene twice: with labels only, and with evidence of one of `KINDS`.

    The result is None if the scene lacks such evidence.

    Args:
        kept: indices of the remaining instances.
        between: (n, n) mask of the pairs with evidence; all pairs by default.
    """
    bare = replace(scene_of(encoded, kept, ()), room_type=None)
    if kind == "room type":
        known = scene_of(encoded, kept, ())
        return None if known.room_type is None else (bare, known)
    mask = np.ones((len(kept),) * 2, dtype=np.bool_) if between is None else between
    holds = encoded.instance_holds[:, kept][:, :, kept] & mask
    triples = tuple((int(a), int(i), int(j)) for a, i, j in np.argwhere(holds))
    if not triples or (kind == "poses" and encoded.instance_positions is None):
        return None
    poses = None
    if kind == "poses":
        poses = PoseRelations(holds, encoded.instance_observed[:, kept][:, :, kept] & mask)
    return bare, replace(bare, relations=triples, poses=poses)


def removals(
    scenes: SceneTensors, structure: NDArray[np.bool_], kind: str, seed: int = 0
) -> Iterator[Case]:
    """Generate T2 cases: up to two classes of every scene are removed, one at a time."""
    for place, encoded in enumerate(scenes.scenes):
        classes = encoded.evidence.classes
        removable = classes[~structure[classes]]
        if len(removable) < 2:
            continue
        for target in scene_rng(encoded, seed).permutation(removable)[:_REMOVALS]:
            kept = np.flatnonzero(encoded.instance_classes != target).tolist()
            if (both := told(encoded, kept, kind)) is not None:
                yield Case(place, both, int(target))


def intrusions(
    artifact: Artifact,
    scenes: SceneTensors,
    intruders: NDArray[np.int64],
    kind: str,
) -> Iterator[Case]:
    """Generate T3 cases: every scene with its intruder.

    Args:
        intruders: (N,) class of the intruder of each scene; -1 skips the scene.
    """
    for place, (encoded, intruder) in enumerate(zip(scenes.scenes, intruders, strict=True)):
        both = told(encoded, list(range(len(encoded.instance_classes))), kind)
        if intruder < 0 or both is None:
            continue
        bare, more = (_intruded(artifact, scene, int(intruder)) for scene in both)
        yield Case(place, (bare, more), len(bare.objects) - 1)


def _intruded(artifact: Artifact, scene: Scene, intruder: int) -> Scene:
    """Return the scene with one more object; only the label of the object is known."""
    if scene.poses is not None:
        pad = ((0, 0), (0, 1), (0, 1))
        poses = PoseRelations(np.pad(scene.poses.holds, pad), np.pad(scene.poses.observed, pad))
        larger = with_intruder(artifact, replace(scene, poses=None), intruder)
        return replace(larger, poses=poses)
    return with_intruder(artifact, scene, intruder)


def halves(
    scenes: SceneTensors, structure: NDArray[np.bool_], kind: str, seed: int = 0
) -> Iterator[Case]:
    """Generate T1 cases: half of the classes (at least two) have evidence; others are queried."""
    for place, encoded in enumerate(scenes.scenes):
        own, classes = encoded.instance_classes, encoded.evidence.classes
        usable = classes[~structure[classes]]
        if len(usable) < 3:
            continue
        half = scene_rng(encoded, seed).permutation(usable)[: max(2, len(usable) // 2)]
        known, plain = np.isin(own, half), ~structure[own]
        between = known[:, None] & known
        both = told(encoded, list(range(len(own))), kind, between)
        pair = plain[:, None] & plain & ~between & ~np.eye(len(own), dtype=np.bool_)
        asked = np.broadcast_to(pair, encoded.instance_holds.shape)
        truth = encoded.instance_holds & asked
        if both is not None and truth.any():
            yield Case(place, both, truth=truth, asked=asked, items=int(truth.sum()))


def reciprocal_rank(artifact: Artifact, scene: Scene, target: int) -> float:
    """Return the reciprocal rank of a removed class among absent ones; expectation over ties."""
    p = missing_probabilities(artifact, scene)
    above, ties = int((p > p[target]).sum()), int((p == p[target]).sum())
    return float((1.0 / np.arange(above + 1, above + ties + 1)).mean())


def missing_evidence_task(contender: Contender, setting: Setting) -> Outcome | None:
    """Measure T2 with additional evidence."""

    def value(artifact: Artifact, scene: Scene, case: Case) -> float:
        return reciprocal_rank(artifact, scene, case.target)

    return _changes(
        "MRR",
        contender,
        setting,
        lambda _, scenes, kind: removals(scenes, setting.structure.numpy(), kind, setting.seed),
        value,
    )


def outliers_evidence_task(contender: Contender, setting: Setting) -> Outcome | None:
    """Measure T3 with additional evidence."""
    structure = setting.structure.numpy()

    def cases(artifact: Artifact, scenes: SceneTensors, kind: str) -> Iterator[Case]:
        intruders = draw_intruders(scenes, setting.structure, seed=setting.seed).numpy()
        return intrusions(artifact, scenes, intruders, kind)

    def value(artifact: Artifact, scene: Scene, case: Case) -> float:
        p = np.where(things(scene, structure), judge(artifact, scene).probability, -np.inf)
        return share_of_first(p, case.target)

    return _changes("hit@1", contender, setting, cases, value)


def relations_evidence_task(contender: Contender, setting: Setting) -> Outcome | None:
    """Measure T1 with additional evidence."""

    def value(artifact: Artifact, scene: Scene, case: Case) -> float:
        p, truth = relation_probabilities(artifact, scene)[case.asked], case.truth[case.asked]
        return expected_hits(p, truth, case.items)

    return _changes(
        "R-precision",
        contender,
        setting,
        lambda _, scenes, kind: halves(scenes, setting.structure.numpy(), kind, setting.seed),
        value,
        KINDS[:2],
    )


def _changes(
    metric: str,
    contender: Contender,
    setting: Setting,
    cases_of: Callable[[Artifact, SceneTensors, str], Iterator[Case]],
    value: Callable[[Artifact, Scene, Case], float],
    kinds: tuple[str, ...] = KINDS,
) -> Outcome | None:
    """Return the metric with and without each kind of evidence, and its change, over all items.

    Args:
        cases_of: function of the artifact, scenes and a kind of evidence; yields the cases.
        value: function that returns the metric of one scene of a case, summed over its items.
    """
    artifact = contender.artifact
    if artifact is None:
        return None
    scenes = setting.some(related=True)
    metrics: dict[str, Metric] = {}
    skipped: list[int] = []
    for kind in kinds:
        cases = list(cases_of(artifact, scenes, kind))
        if not cases:
            continue
        values = np.array(
            ask_every(lambda case: np.array([value(artifact, s, case) for s in case.scenes]), cases)
        )
        place = [case.place for case in cases]
        without, given, below = (
            np.bincount(place, weights=column, minlength=len(scenes)).astype(np.float64)
            for column in (*values.T, [case.items for case in cases])
        )
        metrics |= {
            f"change of {metric}, {kind}": Ratio(given - without, below),
            f"{metric}, {kind}": Ratio(given, below),
            f"{metric}, {kind} withheld": Ratio(without, below),
        }
        skipped.append(int((below == 0).sum()))
    return Outcome(metrics, len(scenes), skipped[0]) if metrics else None
