"""Describe hidden units by the objects, relations and room types with the largest weights."""

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
"""A unit's description holds at most this many objects, relations and room types."""

_NAMED = 3
Floats = NDArray[np.float32]
Named = TypeVar("Named")


@dataclass(frozen=True, slots=True)
class ContextUnit:
    """Description of a hidden unit by the classes that it favours.

    Attributes:
        unit: its number in the layer.
        name: readable name.
        objects: (label, weight) of the objects with the largest weights.
        relations: ((subject, relation, object), weight) of the relations with the largest weights.
            The mean weight over the layer is subtracted.
        room_types: (room type, weight) of the room types with the largest weights.
    """

    unit: int
    name: str
    objects: tuple[tuple[str, float], ...]
    relations: tuple[tuple[tuple[str, str, str], float], ...]
    room_types: tuple[tuple[str, float], ...]


def contexts(artifact: Artifact) -> dict[str, tuple[ContextUnit, ...]]:
    """Describe the hidden units of each layer by their largest positive weights.

    The weights of layer h1 are the columns of W (objects), U (relations seen in training) and Q
    (room types). Layer h2 is connected to them only through h1, so its weights are the columns of
    W J, U J and Q J. Q is empty for a machine without room types. Structure is left out.

    The mean weight of each relation over the layer is subtracted. So a relation that every unit
    favours (a faucet on a sink) describes no unit.

    Returns:
        Layer name to its units, in the order of the layer.
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
    """Readable name: the first three objects and the first relation."""
    parts = [", ".join(label for label, _ in objects[:_NAMED])]
    parts += [" ".join(triple) for triple, _ in relations[:1]]
    return "; ".join(filter(None, parts)) or f"unit {unit}"


def _strongest(
    weights: Floats, names: Sequence[Named], count: int
) -> list[tuple[tuple[Named, float], ...]]:
    """The names with the largest positive weights, for each column of weights (names, units)."""
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
