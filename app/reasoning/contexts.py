"""What each hidden unit stands for."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from app.reasoning.answers import ContextUnit
from app.registry.artifact import Artifact

OBJECTS = 8
ROOM_TYPES = 3
"""How many of each a unit is described by, at most."""


@torch.inference_mode()
def contexts(artifact: Artifact) -> dict[str, tuple[ContextUnit, ...]]:
    """Layer name to its units, each by the objects it favours: its largest positive weights.

    For h1 these are the columns of W; for h2, which meets objects only through h1, those of W J.
    Where the machine knows room types, the same is done with Q and Q J. Structure is left out.
    """
    machine, vocabulary = artifact.machine, artifact.vocabulary
    named = torch.tensor(~vocabulary.structure)
    labels = [vocabulary.labels[index] for index in named.nonzero().squeeze(1).tolist()]
    objects, rooms = machine.W[named], machine.Q
    layers: dict[str, tuple[Tensor, Tensor]] = {"h1": (objects, rooms)}
    if machine.spec.H2:
        layers["h2"] = (objects @ machine.J, rooms @ machine.J)
    return {
        layer: tuple(
            ContextUnit(unit, things, places)
            for unit, (things, places) in enumerate(
                zip(
                    _strongest(to_objects, labels, OBJECTS),
                    _strongest(to_rooms, vocabulary.room_types, ROOM_TYPES),
                    strict=True,
                )
            )
        )
        for layer, (to_objects, to_rooms) in layers.items()
    }


def _strongest(
    weights: Tensor, names: Sequence[str], count: int
) -> list[tuple[tuple[str, float], ...]]:
    """For each column of (names, units) the names of its largest positive weights."""
    if not len(weights):
        return [()] * weights.shape[1]
    values, index = weights.sort(dim=0, descending=True, stable=True)
    return [
        tuple((names[i], value) for i, value in zip(places, column, strict=True) if value > 0)
        for places, column in zip(index[:count].T.tolist(), values[:count].T.tolist(), strict=True)
    ]
