"""Instance counts in the logits of a Triway machine, known and not."""

from __future__ import annotations

import math

import pytest
import torch

from training.machines import MachineSpec, build

CLASSES = torch.tensor([[0, 2]])


def machine_of():
    machine = build(MachineSpec("triway", V=3, A=1, H1=1, K=1)).double()
    with torch.no_grad():
        machine.n.copy_(torch.tensor([[0.5, 2.0]]))
        machine.usual.copy_(torch.tensor([0.1, 9.0, 0.7]))
    return machine.requires_grad_(False)


def logits(counts):
    machine = machine_of()
    v, h1 = torch.ones(1, 3).double(), torch.zeros(1, 1).double()
    return machine.relation_logits(machine.edges(CLASSES, counts), v, h1).view(2, 2)


@pytest.mark.parametrize(
    ("counts", "logs"),
    [
        ([3, 5], [math.log(3), math.log(5)]),
        # Without a count, the usual count of the class.
        ([0, 5], [0.1, math.log(5)]),
        ([0, 0], [0.1, 0.7]),
    ],
)
def test_logits_have_the_logs_of_both_counts(counts, logs):
    expected = torch.tensor([[0.5 * i + 2.0 * j for j in logs] for i in logs]).double()
    assert torch.allclose(logits(torch.tensor([counts])), expected)


def test_omitted_counts_are_one_each():
    assert not logits(None).any()
    assert torch.equal(logits(None), logits(torch.tensor([[1, 1]])))
