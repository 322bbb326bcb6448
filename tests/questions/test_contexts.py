"""Hidden units, described by their strongest objects, relations and room types."""

from __future__ import annotations

import pytest
import torch

from app.questions.contexts import contexts
from app.scene import CANONICAL
from tests.questions.artifacts import LABELS, LARGER, ROOMS, STRUCTURE, larger_artifact
from training.machines.arrays import machine_of


def relation_weights(machine):
    """The relations in training between classes without structure, and their rows of U, (n, H1)."""
    names, rows = [], []
    for a, i, j in machine.triples.tolist():
        if not {LABELS[i], LABELS[j]} & STRUCTURE:
            edges = machine.edges(torch.tensor([[i, j]]))
            ends = torch.stack([edges.relation[0], edges.subject[0], edges.object[0]], 1)
            unit = (ends == torch.tensor([a, i, j])).all(1).nonzero()[0, 0]
            names.append((LABELS[i], CANONICAL[a], LABELS[j]))
            rows.append(machine.relation_context(edges)[0, unit])
    return names, torch.stack(rows)


def strongest(names, weights, count):
    """The names with the largest positive weights, and these weights."""
    pairs = [(name, w) for name, w in zip(names, weights.tolist(), strict=False) if w > 0]
    return (
        zip(*sorted(pairs, key=lambda pair: -pair[1])[:count], strict=True) if pairs else ((), ())
    )


@pytest.mark.parametrize("name", LARGER)
def test_a_unit_is_described_by_its_largest_positive_weights(name):
    artifact = larger_artifact(name)
    machine = machine_of(artifact.weights)
    triples, rows = relation_weights(machine)
    objects = [label for label in LABELS if label not in STRUCTURE]
    weights = {"h1": (machine.W[: len(objects)], rows, machine.Q)}
    if machine.spec.H2:
        weights["h2"] = tuple(part @ machine.J for part in weights["h1"])
    layers = contexts(artifact)
    assert layers.keys() == weights.keys()
    for layer, (W, U, Q) in weights.items():
        U = U - U.mean(1, keepdim=True)
        assert [unit.unit for unit in layers[layer]] == list(range(W.shape[1]))
        for k, unit in enumerate(layers[layer]):
            for entries, expected in (
                (unit.objects, strongest(objects, W[:, k], 8)),
                (unit.relations, strongest(triples, U[:, k], 3)),
                (unit.room_types, strongest(ROOMS, Q[:, k], 3)),
            ):
                names, values = expected
                described = [
                    tuple(entry.model_dump(exclude={"weight"}).values()) for entry in entries
                ]
                assert described == [name if isinstance(name, tuple) else (name,) for name in names]
                assert [entry.weight for entry in entries] == pytest.approx(values, rel=1e-3)


@pytest.mark.parametrize("name", LARGER)
def test_a_unit_is_named_by_its_first_objects_and_relation(name):
    names = []
    for unit in (unit for units in contexts(larger_artifact(name)).values() for unit in units):
        objects = ", ".join(entry.label for entry in unit.objects[:3])
        relations = [f"{one.subject} {one.relation} {one.object}" for one in unit.relations[:1]]
        assert unit.name == "; ".join(filter(None, [objects, *relations]))
        names.append(unit.name)
    # Each unit has random weights of its own.
    assert len(set(names)) > 0.9 * len(names)


def test_a_unit_without_positive_weights_has_its_number_as_name():
    artifact = larger_artifact("triway-local", scale=0.0)
    assert [unit.name for unit in contexts(artifact)["h2"]] == ["unit 0", "unit 1", "unit 2"]
