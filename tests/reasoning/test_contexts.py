"""Hidden units by their strongest objects and room types."""

from __future__ import annotations

import pytest

from app.reasoning import contexts
from tests.reasoning.artifacts import LABELS, LARGER, ROOMS, STRUCTURE, larger_artifact


@pytest.mark.parametrize("name", LARGER)
def test_every_unit_by_its_largest_positive_weights(name):
    artifact = larger_artifact(name)
    machine = artifact.machine
    layers = {"h1": (machine.W, machine.Q)}
    if machine.spec.H2:
        layers["h2"] = (machine.W @ machine.J, machine.Q @ machine.J)
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
            column = rooms[:, unit.unit].tolist()
            likely = [(room, w) for room, w in zip(ROOMS, column, strict=False) if w > 0]
            likely.sort(key=lambda entry: -entry[1])
            assert [room for room, _ in unit.room_types] == [room for room, _ in likely]
