"""Hidden units by their strongest objects, relations and room types."""

from __future__ import annotations

import pytest
import torch

from app.questions.contexts import contexts
from app.scene import CANONICAL
from tests.questions.artifacts import LABELS, LARGER, ROOMS, STRUCTURE, larger_artifact
from training.machines.arrays import machine_of


def relation_weights(machine):
    """For each layer and unit the relations that have an entry of their own, each U_e by itself."""
    told = []
    for a, i, j in machine.triples.tolist():
        if not {LABELS[i], LABELS[j]} & STRUCTURE:
            edges = machine.edges(torch.tensor([[i, j]]))
            ends = torch.stack([edges.relation[0], edges.subject[0], edges.object[0]], 1)
            place = (ends == torch.tensor([a, i, j])).all(1).nonzero()[0, 0]
            row = machine.relation_context(edges)[0, place]
            told.append(((LABELS[i], CANONICAL[a], LABELS[j]), row))
    layers = {"h1": machine.spec.H1}
    if machine.spec.H2:
        layers["h2"] = machine.spec.H2
        told = [(triple, torch.cat([row, row @ machine.J])) for triple, row in told]
    first = {"h1": 0, "h2": machine.spec.H1}
    parts = {
        layer: [(triple, row[first[layer] :][:size]) for triple, row in told]
        for layer, size in layers.items()
    }
    return {
        layer: [
            [(triple, (row[unit] - row.mean()).item()) for triple, row in parts[layer]]
            for unit in range(size)
        ]
        for layer, size in layers.items()
    }


@pytest.mark.parametrize("name", LARGER)
def test_a_unit_is_named_by_its_first_objects_and_relation(name):
    names = []
    for units in contexts(larger_artifact(name)).values():
        for unit in units:
            things = ", ".join(label for label, _ in unit.objects[:3])
            standing = " ".join(unit.relations[0][0]) if unit.relations else ""
            assert unit.name == "; ".join(part for part in (things, standing) if part)
            names.append(unit.name)
    # Random weights favour each something else.
    assert len(set(names)) > 0.9 * len(names)


def test_a_unit_that_favours_nothing_has_its_number():
    artifact = larger_artifact("triway-local", scale=0.0)
    assert [unit.name for unit in contexts(artifact)["h2"]] == ["unit 0", "unit 1", "unit 2"]


@pytest.mark.parametrize("name", LARGER)
def test_every_unit_by_its_largest_positive_weights(name):
    artifact = larger_artifact(name)
    machine = machine_of(artifact.weights)
    layers = {"h1": (machine.W, machine.Q)}
    if machine.spec.H2:
        layers["h2"] = (machine.W @ machine.J, machine.Q @ machine.J)
    relations = relation_weights(machine_of(artifact.weights))
    found = contexts(artifact)
    assert set(found) == set(layers)
    for layer, (objects, rooms) in layers.items():
        assert [unit.unit for unit in found[layer]] == list(range(objects.shape[1]))
        for unit in found[layer]:
            weights = dict(zip(LABELS, objects[:, unit.unit].tolist(), strict=True))
            named = {k: w for k, w in weights.items() if k not in STRUCTURE and w > 0}
            expected = sorted(named.items(), key=lambda entry: -entry[1])[:8]
            assert [label for label, _ in unit.objects] == [label for label, _ in expected]
            assert [w for _, w in unit.objects] == pytest.approx([w for _, w in expected], rel=1e-5)
            told = [(triple, w) for triple, w in relations[layer][unit.unit] if w > 0]
            told = sorted(told, key=lambda entry: -entry[1])[:3]
            assert [triple for triple, _ in unit.relations] == [triple for triple, _ in told]
            assert [w for _, w in unit.relations] == pytest.approx([w for _, w in told], rel=1e-3)
            column = rooms[:, unit.unit].tolist()
            likely = [(room, w) for room, w in zip(ROOMS, column, strict=False) if w > 0]
            likely.sort(key=lambda entry: -entry[1])
            assert [room for room, _ in unit.room_types] == [room for room, _ in likely]
