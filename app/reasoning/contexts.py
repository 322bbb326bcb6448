"""What each hidden unit stands for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor

from app.boltzmann import BoltzmannMachine, Triway
from app.boltzmann.edges import pair_edges
from app.reasoning.answers import ContextUnit
from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL

OBJECTS = 8
RELATIONS = 3
ROOM_TYPES = 3
"""How many of each a unit is described by, at most."""

_NAMED = 3
_BLOCK = 4096

Named = TypeVar("Named")


@torch.inference_mode()
def contexts(artifact: Artifact) -> dict[str, tuple[ContextUnit, ...]]:
    """Layer name to its units, each by what it favours: its largest positive weights.

    For h1 these are the columns of W, and of U for the relations seen in training; for h2, which
    meets objects and relations only through h1, those of W J and U J. Where the machine knows room
    types, the same is done with Q and Q J. Structure is left out.

    A relation's weight counts by how far it is above that relation's mean over the layer: what
    every unit favours (a faucet on a sink) says nothing of any of them.
    """
    machine, vocabulary = artifact.machine, artifact.vocabulary
    named = torch.tensor(~vocabulary.structure)
    labels = [vocabulary.labels[index] for index in named.nonzero().squeeze(1).tolist()]
    table = machine.triples.long()
    shown = named[table[:, 1:]].all(1)
    relations = [
        (vocabulary.labels[i], CANONICAL[a], vocabulary.labels[j])
        for a, i, j in table[shown].tolist()
    ]
    objects, standing, rooms = machine.W[named], _relation_weights(machine)[shown], machine.Q
    layers: dict[str, tuple[Tensor, Tensor, Tensor]] = {"h1": (objects, standing, rooms)}
    if machine.spec.H2:
        layers["h2"] = (objects @ machine.J, standing @ machine.J, rooms @ machine.J)
    return {
        layer: tuple(
            ContextUnit(unit, _name(unit, things, triples), things, triples, places)
            for unit, (things, triples, places) in enumerate(
                zip(
                    _strongest(to_objects, labels, OBJECTS),
                    _strongest(
                        to_relations - to_relations.mean(1, keepdim=True), relations, RELATIONS
                    ),
                    _strongest(to_rooms, vocabulary.room_types, ROOM_TYPES),
                    strict=True,
                )
            )
        )
        for layer, (to_objects, to_relations, to_rooms) in layers.items()
    }


def _relation_weights(machine: BoltzmannMachine) -> Tensor:
    """U of the relations seen in training, (T, H1)."""
    triples = machine.triples.long()
    if not isinstance(machine, Triway):
        return machine.relation_context(machine.edges(triples.new_zeros(1, 0)))[0]
    parts = [machine.W.new_zeros(0, machine.spec.H1)]
    for some in triples.split(_BLOCK):
        relation, subject, object_ = some.T
        pairs = pair_edges(subject.unsqueeze(1), machine.spec.A, objects=object_.unsqueeze(1))
        # All relations of a pair come at once.
        parts.append(machine.relation_context(pairs)[torch.arange(len(some)), relation])
    return torch.cat(parts)


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
    weights: Tensor, names: Sequence[Named], count: int
) -> list[tuple[tuple[Named, float], ...]]:
    """For each column of (names, units) the names of its largest positive weights."""
    if not len(weights):
        return [()] * weights.shape[1]
    values, index = weights.T.contiguous().topk(min(count, len(weights)), dim=1)
    return [
        tuple((names[i], value) for i, value in zip(places, column, strict=True) if value > 0)
        for places, column in zip(index.tolist(), values.tolist(), strict=True)
    ]
