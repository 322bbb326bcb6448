"""The oracle: removed classes, the number of draws, and the digits of probabilities.

Comparisons with the joint and with the closed form prove everything else.
"""

from __future__ import annotations

import pytest
import torch

from tests.questions.artifacts import LARGER, larger_artifact, scene_of
from training.fit.oracle.evidence import draw_context, observe
from training.fit.oracle.units import mean_log_p
from training.machines.arrays import machine_of


@pytest.mark.parametrize("name", LARGER)
def test_the_relations_of_removed_classes_are_unobserved(name):
    machine = machine_of(larger_artifact(name).weights)
    scene = observe(machine, scene_of([0, 1, 2], [(0, 0, 1), (1, 1, 2), (2, 2, 0)]))
    removed = torch.tensor([[True, False, False], [False, True, True], [False, False, False]])
    rest, edges = scene.without(removed), scene.units.edges
    assert torch.equal(rest.v[:, :3] == 0, removed)
    removed = torch.nn.functional.pad(removed, (0, machine.spec.V - 3))
    gone = removed[:, edges.subject[0]] | removed[:, edges.object[0]]
    assert torch.equal(rest.observed, scene.evidence.observed & ~gone)


def test_both_tails_of_a_probability_keep_their_digits():
    weight = torch.full((2, 1), 0.5)
    logits = torch.tensor([[-80.0, 20.0, 0.0], [-80.0, 22.0, 0.0]])
    for log_p, values in zip(mean_log_p(weight, logits), (logits, -logits), strict=True):
        expected = values.double().sigmoid().mean(0).log()
        torch.testing.assert_close(log_p.double(), expected, atol=1e-4, rtol=1e-6)


def test_many_relations_get_fewer_draws(monkeypatch):
    machine = machine_of(larger_artifact("triway-local").weights)
    small = observe(machine, scene_of([0, 1], [(0, 0, 1)])).evidence
    assert len(draw_context(machine, small).h1) == 64
    monkeypatch.setattr("training.fit.oracle.evidence._RELATION_DRAWS", 16 * 16)
    assert len(draw_context(machine, small).h1) == 16
    assert len(draw_context(machine, small, rows=1000).h1) == 8
