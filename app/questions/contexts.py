"""The classes that each hidden unit favours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL

OBJECTS = 8
RELATIONS = 3
ROOM_TYPES = 3
"""How many of each a unit is described by, at most."""

_NAMED = 3
Floats = NDArray[np.float32]
Named = TypeVar("Named")


@dataclass(frozen=True, slots=True)
class ContextUnit:
    """A hidden unit by the classes that it favours.

    Attributes:
        unit: its number in the layer.
        name: for people to read.
        objects: (label, weight) of the objects it favours most.
        relations: ((subject, relation, object), weight) of the relations it favours most, beyond
            the mean over the layer.
        room_types: (room type, weight) of the room types that favour it most.
    """

    unit: int
    name: str
    objects: tuple[tuple[str, float], ...]
    relations: tuple[tuple[tuple[str, str, str], float], ...]
    room_types: tuple[tuple[str, float], ...]


def contexts(artifact: Artifact) -> dict[str, tuple[ContextUnit, ...]]:
    """Layer name to its units, each by what it favours: its largest positive weights.

    For h1 these are the columns of W, and of U for the relations seen in training; for h2, which
    meets objects and relations only through h1, those of W J and U J. Where the machine knows room
    types, the same is done with Q and Q J. Structure is left out.

    A relation's weight counts by how far it is above that relation's mean over the layer: what
    every unit favours (a faucet on a sink) says nothing of any of them.
    """
    weights, vocabulary = artifact.weights, artifact.vocabulary
    named = ~vocabulary.structure
    labels = [vocabulary.labels[index] for index in np.flatnonzero(named).tolist()]
    table = weights["triples"]
    shown = named[table[:, 1:]].all(1)
    relations = [
        (vocabulary.labels[i], CANONICAL[a], vocabulary.labels[j])
        for a, i, j in table[shown].tolist()
    ]
    objects, standing, rooms = weights["W"][named], artifact.context_rows()[shown], weights["Q"]
    layers: dict[str, tuple[Floats, Floats, Floats]] = {"h1": (objects, standing, rooms)}
    if weights.spec.H2:
        J = weights["J"]
        layers["h2"] = (objects @ J, standing @ J, rooms @ J)
    return {
        layer: tuple(
            ContextUnit(unit, _name(unit, things, triples), things, triples, places)
            for unit, (things, triples, places) in enumerate(
                zip(
                    _strongest(to_objects, labels, OBJECTS),
                    _strongest(
                        to_relations - to_relations.mean(1, keepdims=True), relations, RELATIONS
                    ),
                    _strongest(to_rooms, vocabulary.room_types, ROOM_TYPES),
                    strict=True,
                )
            )
        )
        for layer, (to_objects, to_relations, to_rooms) in layers.items()
    }


def _name(
    unit: int,
    objects: Sequence[tuple[str, float]],
    relations: Sequence[tuple[tuple[str, str, str], float]],
) -> str:
    """For people to read: the first objects and the first relation."""
    parts = [", ".join(label for label, _ in objects[:_NAMED])]
    parts += [" ".join(triple) for triple, _ in relations[:1]]
    return "; ".join(filter(None, parts)) or f"unit {unit}"


def _strongest(
    weights: Floats, names: Sequence[Named], count: int
) -> list[tuple[tuple[Named, float], ...]]:
    """For each column of (names, units) the names of its largest positive weights."""
    if not len(weights):
        return [()] * weights.shape[1]
    count = min(count, len(weights))
    largest = np.argpartition(-weights.T, count - 1, axis=1)[:, :count]
    values = np.take_along_axis(weights.T, largest, axis=1)
    order = np.lexsort((largest, -values), axis=1)
    index = np.take_along_axis(largest, order, axis=1)
    values = np.take_along_axis(values, order, axis=1)
    return [
        tuple((names[i], value) for i, value in zip(places, column, strict=True) if value > 0)
        for places, column in zip(index.tolist(), values.tolist(), strict=True)
    ]
