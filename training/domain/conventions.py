"""The conventions that the boxes of scenes probably follow, judged with written knowledge."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from functools import cache
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from app.questions.conventions import LEAST, Alternative, Evidence, evidence_of
from app.scene import SceneObject, label_key
from training.datasets import AnnotatedScene
from training.datasets.inventories import shipped_things
from training.datasets.written import written_vocabulary

_SHARE: Final = 0.2
"""Minimum share of the scenes with enough boxes that show the same other convention."""


def likely_convention(
    scenes: Iterable[AnnotatedScene],
) -> tuple[Alternative | None, list[AnnotatedScene]]:
    """Return the reading that fits the boxes of most scenes, and these scenes.

    The reading is None, without scenes, if few scenes fit another reading than the declared one.
    """
    found: defaultdict[str, list[AnnotatedScene]] = defaultdict(list)
    readings: dict[str, Alternative] = {}
    judged = 0
    for scene in scenes:
        has_boxes = sum(thing.size is not None for thing in scene.objects) >= LEAST
        evidence = _evidence(scene) if has_boxes else None
        judged += evidence is not None
        if evidence is not None and (reading := evidence.likeliest) is not None:
            found[reading.message].append(scene)
            readings[reading.message] = reading
    if not found:
        return None, []
    message, cases = max(found.items(), key=lambda item: len(item[1]))
    return (readings[message], cases) if len(cases) >= _SHARE * judged else (None, [])


def _evidence(scene: AnnotatedScene) -> Evidence | None:
    vocabulary = written_vocabulary()
    objects = [
        SceneObject(
            thing.id, thing.label, vocabulary.index(thing.label),
            position=thing.position, size=thing.size, yaw=thing.yaw,
        )
        for thing in scene.objects
    ]  # fmt: skip
    return evidence_of(objects, {}, scene.conventions, vocabulary, _stands(), lambda _: objects)


@cache
def _stands() -> Float[NDArray[np.float64], "V 3"]:
    """Return the written shares of the classes: on the floor, hanging, on or in a thing."""
    things = {label_key(thing.label): thing.stands for thing in shipped_things().values()}
    shares = []
    for label in written_vocabulary().labels:
        stands = things.get(label_key(label), {})
        hangs = stands.get("wall", 0.0) + stands.get("ceiling", 0.0)
        floor = stands.get("floor", 0.0)
        shares.append((floor, hangs, 1.0 - floor - hangs))
    return np.array(shares)
