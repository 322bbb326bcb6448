"""Hidden units, described by their strongest objects, relations and room types."""

from __future__ import annotations

import pytest
import torch

from app.questions.contexts import contexts
from app.scene import CANONICAL
from tests.questions.artifacts import LABELS, LARGER, ROOMS, STRUCTURE, larger_artifact
from training.machines.arrays import machine_of

OBJECTS = [{"label": label} for label in LABELS if label not in STRUCTURE]


def relation_weights(machine):
    """The relations in training between classes without structure, and their rows of U, (n, H1)."""
    entries, rows = [], []
    h1 = torch.eye(machine.spec.H1)
    v = torch.ones(len(h1), machine.spec.V)
    for a, i, j in machine.triples.tolist():
        if not {LABELS[i], LABELS[j]} & STRUCTURE:
            edges = machine.edges(torch.tensor([[i, j]]))
            none, each = (machine.relation_logits(edges, v, states) for states in (0 * h1, h1))
            ends = torch.stack([edges.relation[0], edges.subject[0], edges.object[0]], 1)
            unit = (ends == torch.tensor([a, i, j])).all(1).nonzero()[0, 0]
            entries.append({"subject": LABELS[i], "relation": CANONICAL[a], "object": LABELS[j]})
            rows.append((each - none)[:, unit])
    return entries, torch.stack(rows)


def strongest(entries, weights, count):
    """The entries with the largest positive weights, and these weights."""
    order = weights.argsort(descending=True)[:count].tolist()
    return [
        entries[k] | {"weight": pytest.approx(float(weights[k]), rel=1e-3)}
        for k in order
        if weights[k] > 0
    ]


@pytest.mark.parametrize("name", LARGER)
def test_a_unit_has_its_largest_positive_weights_and_a_name_of_them(name):
    artifact = larger_artifact(name)
    machine = machine_of(artifact.weights)
    relations, U = relation_weights(machine)
    rooms = [{"label": room} for room in ROOMS]
    weights = {"h1": (machine.W[: len(OBJECTS)], U, machine.Q)}
    if machine.spec.H2:
        weights["h2"] = tuple(part @ machine.J for part in weights["h1"])
    layers = contexts(artifact)
    assert layers.keys() == weights.keys()
    names = {unit.name for units in layers.values() for unit in units}
    # Each unit has random weights of its own.
    assert len(names) > 0.9 * sum(map(len, layers.values()))
    for layer, (W, U, Q) in weights.items():
        assert len(layers[layer]) == W.shape[1]
        for k, unit in enumerate(layers[layer]):
            objects = strongest(OBJECTS, W[:, k], 8)
            triples = strongest(relations, U[:, k] - U.mean(1), 3)
            parts = [", ".join(entry["label"] for entry in objects[:3])]
            parts += [" ".join(list(entry.values())[:3]) for entry in triples[:1]]
            others = machine.spec.states - 1 if layer == "h1" else 1
            assert unit.model_dump() == {
                "unit": k // others,
                "state": k % others + 1,
                "name": "; ".join(filter(None, parts)),
                "objects": objects,
                "relations": triples,
                "room_types": strongest(rooms, Q[:, k], 3),
            }


def test_a_unit_without_positive_weights_has_its_number_as_name():
    artifact = larger_artifact("triway", scale=0.0)
    assert [unit.name for unit in contexts(artifact)["h2"]] == [
        f"unit {k}, state 1" for k in range(3)
    ]
