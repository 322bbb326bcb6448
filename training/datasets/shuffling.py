"""Scenes whose objects were permuted between scenes: what is learnt from them is popularity alone.

A scene's classes each stand on a slot, which keeps its count and its relations; the classes trade
places. Two slots drawn at random exchange their classes if each class is then still there once in
its scene. That keeps both margins exactly, how many classes a scene has and how many scenes a class
is in, and nothing else: an exchange is as likely as its reversal, so that all tables of these
margins come to be equally likely. What is refused counts as a step, as it must for that.

Source: Gionis, Mannila, Mielikäinen and Tsaparas, "Assessing data mining results via swap
randomization" (ACM TKDD, 2007).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from app.scene import ClassEvidence
from training.datasets.encoding import EncodedScene

# Exchanges that are tried; a mention is in two of them, so each is drawn some twenty times.
_STEPS_PER_MENTION: Final = 10


def shuffle_objects(
    scenes: Sequence[EncodedScene], structure: NDArray[np.bool_], seed: int
) -> list[EncodedScene]:
    """Permute classes between scenes, across all sources, and room types between the scenes.

    Structure classes trade places with structure classes only, so that the relations they do not
    have stay away from them. Counts, confidences and relations stay on their slots and are then of
    other classes. Room types are permuted among the scenes that have one. Names, sources, groups
    and the number of unknown mentions stay.

    Args:
        structure: (V,) bool.

    Raises:
        ValueError: a class of a scene is not among the V.
    """
    for scene in scenes:
        if len(scene.evidence.classes) and scene.evidence.classes[-1] >= len(structure):
            raise ValueError(f"{scene.scene_id} has classes beyond the {len(structure)} given")
    rng = np.random.default_rng(seed)
    sizes = [len(scene.evidence.classes) for scene in scenes]
    owner = np.repeat(np.arange(len(scenes)), sizes)
    nothing = np.zeros(0, dtype=np.int64)
    classes = np.concatenate([nothing, *(scene.evidence.classes for scene in scenes)])
    for group in (structure[classes], ~structure[classes]):
        classes[group] = _exchange(owner[group], classes[group], rng)
    rooms = np.array([scene.room_type for scene in scenes], dtype=np.int64)
    rooms[rooms >= 0] = rng.permutation(rooms[rooms >= 0])
    own = np.split(classes, np.cumsum(sizes)[:-1]) if sizes else []
    return [
        _relabelled(scene, labels, int(room))
        for scene, labels, room in zip(scenes, own, rooms, strict=True)
    ]


def _exchange(
    owner: NDArray[np.int64], classes: NDArray[np.int64], rng: np.random.Generator
) -> NDArray[np.int64]:
    """The classes of n slots, (n,), after a walk of exchanges; owner (n,): the scene of each."""
    if not len(classes):
        return classes
    label, scene = classes.tolist(), owner.tolist()
    there: dict[int, set[int]] = {}
    for s, c in zip(scene, label, strict=True):
        there.setdefault(s, set()).add(c)
    drawn = rng.integers(len(label), size=(2, _STEPS_PER_MENTION * len(label)))
    # One step hangs on those before it: plain lists and sets are fastest at that.
    for i, j in zip(*drawn.tolist(), strict=True):
        c, d = label[i], label[j]
        first, second = there[scene[i]], there[scene[j]]
        if first is not second:
            if d in first or c in second:
                continue
            first.remove(c)
            first.add(d)
            second.remove(d)
            second.add(c)
        label[i], label[j] = d, c
    return np.array(label, dtype=np.int64)


def _relabelled(scene: EncodedScene, labels: NDArray[np.int64], room: int) -> EncodedScene:
    """The scene with other classes on its slots, (n,), which are sorted again."""
    before = scene.evidence
    order = np.argsort(labels)
    evidence = ClassEvidence(
        classes=labels[order],
        counts=before.counts[order],
        confidence=before.confidence[order],
        holds=before.holds[:, order][:, :, order],
        observed=before.observed[:, order][:, :, order],
        room_type=None if room < 0 else room,
    )
    slots = np.searchsorted(before.classes, scene.instance_classes)
    return replace(
        scene, room_type=room, evidence=evidence, instance_classes=labels[slots].astype(np.int64)
    )
