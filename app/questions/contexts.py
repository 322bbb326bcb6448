"""Describe states of hidden units by the objects, relations and room types of largest weight."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL
from scene_client.schemas import ContextUnit, RelationName, WeightedLabel, WeightedRelation

OBJECTS = 8
RELATIONS = 3
ROOM_TYPES = 3
"""`OBJECTS`, `RELATIONS` and `ROOM_TYPES` are the maximum numbers in the description of a unit."""

_NAMED = 3
Floats = NDArray[np.float32]
Named = TypeVar("Named")
Weighted: TypeAlias = tuple[tuple[Named, float], ...]


def contexts(artifact: Artifact) -> dict[str, list[ContextUnit]]:
    """Describe the states of the hidden units of each layer by their largest positive weights.

    The weights of a state of layer h1 are its columns in W (objects), U (relations that occur in
    training) and Q (room types). State 0 of a unit has no weights and is left out. Layer h2 is
    connected to objects, relations and room types only through h1. The weights of a unit of h2 are
    therefore its columns in W J, U J and Q J. Q is empty for a machine without room types.
    Structural classes (floor, wall) are left out.

    From the weight of each relation, the function subtracts the mean over the states of the layer.
    So a relation that every state favours, such as a faucet on a sink, is not in any description.

    Returns:
        Maps the name of each layer, "h1" or "h2", to the descriptions of its states. They have
        the order of the units and of their states.
    """
    weights, vocabulary = artifact.weights, artifact.vocabulary
    named = ~vocabulary.structure
    labels = [vocabulary.labels[index] for index in np.flatnonzero(named).tolist()]
    table = weights["triples"]
    shown = named[table[:, 1:]].all(1)
    relations = [
        (vocabulary.labels[i], cast("RelationName", CANONICAL[a]), vocabulary.labels[j])
        for a, i, j in table[shown].tolist()
    ]
    rows = weights["W"][named], artifact.context_rows()[shown], weights["Q"]
    layers: dict[str, tuple[Floats, ...]] = {"h1": rows}
    if weights.spec.H2:
        layers["h2"] = tuple(matrix @ weights["J"] for matrix in rows)
    descriptions: dict[str, list[ContextUnit]] = {}
    for layer, (to_objects, to_relations, to_rooms) in layers.items():
        deviations = to_relations - to_relations.mean(1, keepdims=True)
        units = zip(
            _strongest(to_objects, labels, OBJECTS),
            _strongest(deviations, relations, RELATIONS),
            _strongest(to_rooms, vocabulary.room_types, ROOM_TYPES),
            strict=True,
        )
        others = weights.spec.states - 1 if layer == "h1" else 1
        descriptions[layer] = [
            _description(column // others, column % others + 1, *names)
            for column, names in enumerate(units)
        ]
    return descriptions


def _description(
    unit: int,
    state: int,
    objects: Weighted[str],
    relations: Weighted[tuple[str, RelationName, str]],
    rooms: Weighted[str],
) -> ContextUnit:
    """Return the description of a state. Its name has the first objects and the first relation."""
    parts = [", ".join(label for label, _ in objects[:_NAMED])]
    parts += [" ".join(triple) for triple, _ in relations[:1]]
    return ContextUnit(
        unit=unit,
        state=state,
        name="; ".join(filter(None, parts)) or f"unit {unit}, state {state}",
        objects=[WeightedLabel(label=label, weight=weight) for label, weight in objects],
        relations=[
            WeightedRelation(subject=subject, relation=relation, object=other, weight=weight)
            for (subject, relation, other), weight in relations
        ],
        room_types=[WeightedLabel(label=room, weight=weight) for room, weight in rooms],
    )


def _strongest(weights: Floats, names: Sequence[Named], count: int) -> list[Weighted[Named]]:
    """Return (name, weight) of the largest positive weights of each unit, largest first.

    Args:
        weights: (names, units) weights between each name and each unit.
        names: the names of objects, relations or room types.
        count: maximum number of results for each unit.
    """
    if not len(weights):
        return [()] * weights.shape[1]
    count = min(count, len(weights))
    largest = np.argpartition(-weights.T, count - 1, axis=1)[:, :count]
    values = np.take_along_axis(weights.T, largest, axis=1)
    order = np.lexsort((largest, -values), axis=1)
    columns = (np.take_along_axis(part, order, axis=1).tolist() for part in (largest, values))
    return [
        tuple((names[i], value) for i, value in zip(*pair, strict=True) if value > 0)
        for pair in zip(*columns, strict=True)
    ]
