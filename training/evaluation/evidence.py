"""What more evidence changes: relations, poses and the room type, against labels alone.

Each question is put twice to the same model about the same scenes: with labels alone, and with one
kind of evidence more. The change is paired, with its interval over scenes.

    T2   one class is left out with all its instances; the relations among what stays are stated
         (or shown by poses), or the room type is told: change of MRR over the absent classes
    T3   a uniformly drawn intruder is added, of which no relation is known: change of hit@1
    T1   the relations between the instances of half of the classes are stated (or shown by poses):
         change of R-precision on all other ordered pairs of instances, as many predictions as
         listed relations; an unlisted relation counts as wrong

Poses also show what does not hold; only sources with positions have them. Scenes without a relation
among the instances that stay are left out. What is asked is never stated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from app.registry import Artifact
from app.scene import PoseRelations, Scene
from training.batches import SceneTensors
from training.cases import scene_of
from training.datasets import EncodedScene
from training.evaluation.asking import (
    Floats,
    ask_every,
    judge,
    missing_probabilities,
    relation_probabilities,
    things,
)
from training.evaluation.cases import scene_rng
from training.evaluation.contenders import Contender
from training.evaluation.intervals import Metric
from training.evaluation.metrics import Ratio
from training.evaluation.outliers import draw_intruders
from training.evaluation.relations import expected_hits
from training.evaluation.setting import Outcome, Setting
from training.evaluation.signature import with_intruder

KINDS = ("relations", "poses", "room type")

# Removed classes a scene: of one, chance alone moves the change of a small source by .01.
_REMOVALS = 2

Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Case:
    """One question, asked with and without evidence.

    Attributes:
        place: of the scene; scenes: the labels alone, and with evidence.
        target: the removed class in T2, the place of the intruder in T3.
        truth, asked: (A, n, n) of the relations in T1.
    """

    place: int
    scenes: tuple[Scene, Scene]
    target: int = -1
    truth: Flags | None = None
    asked: Flags | None = None


def told(
    encoded: EncodedScene, kept: list[int], kind: str, between: Flags | None = None
) -> tuple[Scene, Scene] | None:
    """A scene as labels alone and with one of `KINDS`; None where it has no such evidence.

    Args:
        kept: positions of the instances that stay.
        between: (n, n) of these, the pairs of which something is told; all by default.
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
    """T2: up to two classes of every scene, each left out with all its instances."""
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
    """T3: every scene with its intruder, (N,) classes, -1 where there is none."""
    for place, (encoded, intruder) in enumerate(zip(scenes.scenes, intruders, strict=True)):
        both = told(encoded, list(range(len(encoded.instance_classes))), kind)
        if intruder < 0 or both is None:
            continue
        bare, more = (_intruded(artifact, scene, int(intruder)) for scene in both)
        yield Case(place, (bare, more), len(bare.objects) - 1)


def _intruded(artifact: Artifact, scene: Scene, intruder: int) -> Scene:
    """With one more object, of which nothing is known but its label."""
    if scene.poses is not None:
        pad = ((0, 0), (0, 1), (0, 1))
        poses = PoseRelations(np.pad(scene.poses.holds, pad), np.pad(scene.poses.observed, pad))
        larger = with_intruder(artifact, replace(scene, poses=None), intruder)
        return replace(larger, poses=poses)
    return with_intruder(artifact, scene, intruder)


def halves(
    scenes: SceneTensors, structure: NDArray[np.bool_], kind: str, seed: int = 0
) -> Iterator[Case]:
    """T1: half of the classes, at least two, are told about; the other pairs are asked."""
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
            yield Case(place, both, truth=truth, asked=asked)


def reciprocal_rank(artifact: Artifact, scene: Scene, target: int) -> float:
    """Of a removed class among all absent ones; ties in expectation."""
    p = missing_probabilities(artifact, scene)
    above, ties = int((p > p[target]).sum()), int((p == p[target]).sum())
    return float((1.0 / np.arange(above + 1, above + ties + 1)).mean())


def first(artifact: Artifact, scene: Scene, target: int, structure: NDArray[np.bool_]) -> float:
    """Whether an object is the likeliest outlier; ties in expectation."""
    p = np.where(things(scene, structure), judge(artifact, scene).probability, -np.inf)
    best = p == p.max()
    return float(best[target] / best.sum())


def missing_evidence_task(contender: Contender, setting: Setting) -> Outcome | None:
    """T2 with evidence."""
    artifact = contender.artifact
    if artifact is None:
        return None
    scenes, structure = setting.some(related=True), setting.structure.numpy()
    metrics: dict[str, Metric] = {}
    for kind in KINDS:
        cases = list(removals(scenes, structure, kind, setting.seed))
        values = _asked(cases, lambda scene, case: reciprocal_rank(artifact, scene, case.target))
        metrics |= _changes("MRR", kind, cases, values, np.ones(len(cases)), len(scenes))
    return _outcome(metrics, scenes)


def outliers_evidence_task(contender: Contender, setting: Setting) -> Outcome | None:
    """T3 with evidence."""
    artifact = contender.artifact
    if artifact is None:
        return None
    scenes, structure = setting.some(related=True), setting.structure.numpy()
    intruders = draw_intruders(scenes, setting.structure, seed=setting.seed).numpy()
    metrics: dict[str, Metric] = {}
    for kind in KINDS:
        cases = list(intrusions(artifact, scenes, intruders, kind))
        values = _asked(cases, lambda scene, case: first(artifact, scene, case.target, structure))
        metrics |= _changes("hit@1", kind, cases, values, np.ones(len(cases)), len(scenes))
    return _outcome(metrics, scenes)


def relations_evidence_task(contender: Contender, setting: Setting) -> Outcome | None:
    """T1 with evidence."""
    artifact = contender.artifact
    if artifact is None:
        return None
    scenes, structure = setting.some(related=True), setting.structure.numpy()

    def hits(scene: Scene, case: Case) -> float:
        if case.asked is None or case.truth is None:
            return 0.0  # `halves` makes none like this
        p, truth = relation_probabilities(artifact, scene)[case.asked], case.truth[case.asked]
        return expected_hits(p, truth, int(truth.sum()))

    metrics: dict[str, Metric] = {}
    for kind in KINDS[:2]:
        cases = list(halves(scenes, structure, kind, setting.seed))
        listed = np.array([case.truth.sum() for case in cases if case.truth is not None])
        values = _asked(cases, hits)
        metrics |= _changes("R-precision", kind, cases, values, listed, len(scenes))
    return _outcome(metrics, scenes)


def _asked(cases: list[Case], value: Callable[[Scene, Case], float]) -> Floats:
    """(N, 2) of the cases: labels alone, with evidence."""

    def ask(case: Case) -> Floats:
        return np.array([value(scene, case) for scene in case.scenes])

    return np.array(ask_every(ask, cases)).reshape(-1, 2)


def _changes(
    metric: str, kind: str, cases: list[Case], values: Floats, items: Floats, scenes: int
) -> dict[str, Metric]:
    """The change, and the metric on both sides, pooled over items."""
    if not cases:
        return {}
    place = np.array([case.place for case in cases])
    below = np.bincount(place, weights=items, minlength=scenes).astype(np.float64)
    without, given = (
        np.bincount(place, weights=column, minlength=scenes).astype(np.float64)
        for column in values.T
    )
    return {
        f"change of {metric}, {kind}": Ratio(given - without, below),
        f"{metric}, {kind}": Ratio(given, below),
        f"{metric}, {kind} withheld": Ratio(without, below),
    }


def _outcome(metrics: dict[str, Metric], scenes: SceneTensors) -> Outcome | None:
    if not metrics:
        return None
    (below, *_) = [metric.denominators for metric in metrics.values() if isinstance(metric, Ratio)]
    return Outcome(metrics, len(scenes), int((below == 0).sum()))
