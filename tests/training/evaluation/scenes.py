"""Tiny scenes for the evaluation's tests."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import count

import numpy as np
import torch

from app.scene import CANONICAL, ObjectClass, Vocabulary
from app.scene.stands import UNKNOWN
from training.datasets import EncodedScene
from training.datasets.batches import SceneTensors, scene_tensors
from training.datasets.encoding import pool_instances

V = 5
NO_STRUCTURE = torch.zeros(V, dtype=torch.bool)
FLOOR = torch.arange(V) == 1
# Enough classes for many scenes that differ in them.
WIDE = 12
WIDE_STRUCTURE = torch.zeros(WIDE, dtype=torch.bool)

_names = count()


def scene(
    classes: Sequence[int],
    triples: Sequence[tuple[int, int, int]] = (),
    *,
    source: str = "toy",
    unknown: tuple[str, ...] = (),
    room: int = -1,
    group: str | None = None,
    name: str | None = None,
    relations: int = len(CANONICAL),
    annotated: bool = True,
) -> EncodedScene:
    """One instance of each entry of `classes`; triples (a, i, j) name classes, first instances."""
    n = len(classes)
    holds = np.zeros((len(CANONICAL), n, n), dtype=np.bool_)
    for a, i, j in triples:
        holds[a, classes.index(i), classes.index(j)] = True
    labels = np.array(classes, dtype=np.int64)
    observed = np.broadcast_to(~np.eye(n, dtype=np.bool_) & annotated, holds.shape).copy()
    evidence = pool_instances(labels, holds, observed)
    cut = {"holds": evidence.holds[:relations], "observed": evidence.observed[:relations]}
    scene_id = name or f"scene {next(_names)}"
    return EncodedScene(
        scene_id=scene_id,
        source=source,
        group=group or scene_id,
        room_type=room,
        evidence=replace(evidence, **cut),
        instance_classes=labels,
        instance_holds=holds[:relations],
        instance_observed=observed[:relations],
        instance_stands=np.full(n, UNKNOWN),
        unknown=unknown,
    )


def toy(*args: object, **options: object) -> EncodedScene:
    """A scene of two relations, for the toy machines."""
    return scene(*args, relations=2, **options)


def tensors(scenes: Sequence[EncodedScene], classes: int = V) -> SceneTensors:
    sources = {entry.source for entry in scenes}
    annotated = {source: np.ones(classes, dtype=np.bool_) for source in sources}
    vocabulary = Vocabulary([ObjectClass(str(index)) for index in range(classes)])
    return scene_tensors(scenes, annotated, vocabulary)


def random_scenes(
    number: int, classes: int = WIDE, relations: int = len(CANONICAL), seed: int = 0
) -> list[EncodedScene]:
    """Scenes of three to five classes with random triples; no two have the same classes."""
    rng = np.random.default_rng(seed)
    every: dict[tuple[int, ...], EncodedScene] = {}
    while len(every) < number:
        k = len(every)
        chosen = sorted(rng.choice(classes, rng.integers(3, 6), replace=False).tolist())
        triples = [
            (a, *((i, j) if rng.random() < 0.5 else (j, i)))
            for a in range(relations)
            for i in chosen
            for j in chosen
            if i < j and rng.random() < 0.4
        ]
        every[tuple(chosen)] = scene(
            chosen,
            triples,
            room=int(rng.integers(2)),
            group=f"group {seed} {k}",
            name=f"random {seed} {k}",
            relations=relations,
        )
    return list(every.values())


def knowing(scenes: SceneTensors):
    """A relation score that knows which triples of the scenes hold, by their classes."""
    truth = {}
    for entry in scenes.scenes:
        evidence = entry.evidence
        triples = {
            (int(a), int(evidence.classes[x]), int(evidence.classes[y]))
            for a, x, y in np.argwhere(evidence.holds)
        }
        truth[tuple(evidence.classes.tolist())] = triples

    def score(batch):
        values = torch.zeros(batch.holds.shape)
        for row in range(len(batch)):
            classes = [int(c) for c in batch.classes[row] if c >= 0]
            for a, i, j in truth[tuple(classes)]:
                values[row, a, classes.index(i), classes.index(j)] = 1.0
        return values

    return score


def values_of(outcome):
    """The values of the metrics of an outcome, by name."""
    return {name: metric.value for name, metric in outcome.metrics.items()}


def in_order(v):
    """A score of objects: class 0 before 1 before 2, ..."""
    return torch.tensor([5.0, 4, 3, 2, 1]).expand_as(v)


def flat(batch):
    """A relation score that knows nothing."""
    return torch.zeros(batch.holds.shape)
