"""Small scenes with a known structure, for fitting baselines in a moment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from app.scene import ClassEvidence
from training.batches import SceneTensors, scene_tensors
from training.datasets import EncodedScene

# 0-3 belong to the kitchen, 4-7 to the bedroom, 8 is anywhere, 9 is structure, 10 never occurs.
KITCHEN, BEDROOM, ANYWHERE, FLOOR, V = (0, 1, 2, 3), (4, 5, 6, 7), 8, 9, 11
STRUCTURE = torch.arange(V) == FLOOR
LEFT, ON_TOP, A = 0, 1, 2


def furnished(count: int, seed: int) -> SceneTensors:
    """Kitchens and bedrooms, each class of the room there with probability .7.

    In both, the first class is on top of the second and left of the third, and the third is left of
    the fourth (so, by transitivity, the first is too).
    """
    rng = np.random.default_rng(seed)
    scenes = []
    while len(scenes) < count:
        room = KITCHEN if rng.random() < 0.5 else BEDROOM
        classes = [c for c in room if rng.random() < 0.7]
        classes += [ANYWHERE] * bool(rng.random() < 0.5) + [FLOOR]
        first, second, third, fourth = room
        triples = [
            (ON_TOP, first, second),
            (LEFT, first, third),
            (LEFT, third, fourth),
            (LEFT, first, fourth),
        ]
        present = [t for t in triples if t[1] in classes and t[2] in classes]
        scenes.append(scene(classes, present, name=f"{seed}-{len(scenes)}"))
    return tensors(scenes)


def scene(
    classes: Sequence[int],
    triples: Sequence[tuple[int, int, int]] = (),
    *,
    counts: Sequence[int] | None = None,
    annotated: bool = True,
    name: str = "scene",
) -> EncodedScene:
    """A scene of classes (ascending) with canonical triples of them."""
    n = len(classes)
    holds = np.zeros((A, n, n), dtype=np.bool_)
    for a, i, j in triples:
        holds[a, classes.index(i), classes.index(j)] = True
    evidence = ClassEvidence(
        classes=np.array(list(classes), dtype=np.int64),
        counts=np.array(counts or [1] * n, dtype=np.int64),
        confidence=np.ones(n),
        holds=holds,
        observed=np.full_like(holds, annotated),
        room_type=None,
    )
    return EncodedScene(
        scene_id=name,
        source="made",
        group=name,
        room_type=-1,
        evidence=evidence,
        instance_classes=evidence.classes,
        instance_holds=holds,
        instance_observed=evidence.observed,
        unknown=(),
    )


def tensors(scenes: Sequence[EncodedScene]) -> SceneTensors:
    """Their tensors over V classes, all of them annotated."""
    return scene_tensors(scenes, {"made": np.ones(V, dtype=np.bool_)}, V)
