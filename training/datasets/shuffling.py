"""Permute objects between scenes. A model trained on permuted scenes learns only class frequencies.

A slot is the place of one class in one scene. A step exchanges the classes of two random slots,
unless a scene would then contain a class twice. Counts and relations stay with their slots. The
exchange preserves the number of classes of each scene and the number of scenes of each class. An
exchange is as likely as its reversal. All tables with the same two margins therefore become equally
likely, provided that a rejected exchange also counts as a step.

Source: Gionis, Mannila, Mielikäinen and Tsaparas, "Assessing data mining results via swap
randomization" (ACM TKDD, 2007).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from training.datasets.array_types import Flags, Ints, Rng
from training.datasets.encoding import ClassEvidence, EncodedScene

# Number of attempted exchanges, divided by the number of slots. An exchange draws two slots, so
# each slot is drawn about 20 times.
_STEPS_PER_MENTION: Final = 10


def shuffle_objects(
    scenes: Sequence[EncodedScene], structure: Flags, seed: int
) -> list[EncodedScene]:
    """Permute classes between scenes of all data sources, and room types between scenes.

    Structure classes are exchanged only with structure classes, because their relations are
    unobserved. Room types are permuted among the scenes with a room type.
    """
    rng = np.random.default_rng(seed)
    sizes = [len(scene.evidence.classes) for scene in scenes]
    owner = np.repeat(np.arange(len(scenes)), sizes)
    classes = np.concatenate([np.zeros(0, int), *(scene.evidence.classes for scene in scenes)])
    for group in (structure[classes], ~structure[classes]):
        classes[group] = _exchange(owner[group], classes[group], rng)
    rooms = np.array([scene.room_type for scene in scenes], dtype=np.int64)
    rooms[rooms >= 0] = rng.permutation(rooms[rooms >= 0])
    labels_of = np.split(classes, np.cumsum(sizes)[:-1]) if sizes else []
    return [
        _relabel(scene, labels, int(room))
        for scene, labels, room in zip(scenes, labels_of, rooms, strict=True)
    ]


def _exchange(owner: Ints, classes: Ints, rng: Rng) -> Ints:
    """Return the class of each slot, (slots,), after random exchanges."""
    if not len(classes):
        return classes
    label, scene = classes.tolist(), owner.tolist()
    classes_of: defaultdict[int, set[int]] = defaultdict(set)
    for s, c in zip(scene, label, strict=True):
        classes_of[s].add(c)
    pairs = rng.integers(len(label), size=(2, _STEPS_PER_MENTION * len(label)))
    # Each exchange depends on the earlier exchanges, so lists and sets are faster than arrays.
    for i, j in zip(*pairs.tolist(), strict=True):
        c, d = label[i], label[j]
        first, second = classes_of[scene[i]], classes_of[scene[j]]
        if first is not second:
            if d in first or c in second:
                continue
            first ^= {c, d}
            second ^= {c, d}
        label[i], label[j] = d, c
    return np.array(label, dtype=np.int64)


def _relabel(scene: EncodedScene, labels: Ints, room: int) -> EncodedScene:
    """Return the scene with a new class in each slot, sorted by class."""
    before, order = scene.evidence, np.argsort(labels)
    evidence = ClassEvidence(
        classes=labels[order],
        counts=before.counts[order],
        holds=before.holds[:, order][:, :, order],
        observed=before.observed[:, order][:, :, order],
        room_type=None if room < 0 else room,
    )
    classes = labels[np.searchsorted(before.classes, scene.instance_classes)]
    return replace(scene, room_type=room, evidence=evidence, instance_classes=classes)
