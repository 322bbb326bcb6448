"""Gibbs sweeps leave p stationary.

Draw states exactly from the enumerated joint, run one sweep, and compare the histogram with p. The
yardstick is the total variation of as many exact draws (the Monte-Carlo floor), which separates a
wrong kernel from slow mixing: a stationary kernel stays at the floor however slowly it mixes.
"""

import numpy as np
import pytest
import torch

from tests.enumeration.small_machines import (
    SMALL,
    check_frequencies,
    code,
    enumerate_joint,
    small_machine,
)
from training.machines.gibbs import Chains, draw_states, sweep

CHAINS = 60_000


def conditions(spec):
    """Room type, source and possible classes of each kind of chain."""
    everything = torch.ones(spec.V, dtype=torch.bool)
    yield -1, -1, everything
    if spec.C:
        yield 1, -1, everything
    if spec.profiles:
        yield -1, 0, everything
        yield 0, 1, torch.arange(spec.V) != 1


@pytest.mark.parametrize("name", SMALL)
def test_kernel_is_stationary(name):
    """Chains under all conditions run side by side. Coupled classes: two random ones a sweep."""
    machine = small_machine(name)
    kinds = list(conditions(machine.spec))
    each = CHAINS // len(kinds)
    generator = torch.Generator().manual_seed(5)
    laws, blocks = [], []
    for kind, (room, source, possible) in enumerate(kinds):
        joint = enumerate_joint(machine, room, source=source)
        given = (joint.v <= possible.double()).all(1)
        p = torch.where(given, joint.p, 0.0)
        keys, which = np.unique(code(joint.v) + 1000 * kind, return_inverse=True)
        laws.append((keys, np.bincount(which, p / p.sum() / len(kinds))))
        pick = joint.draw(each, generator, given)
        constants = torch.full((each,), room), torch.full((each,), source)
        blocks.append((joint.v[pick], *constants, possible.expand(each, -1)))
    chains = Chains(*(torch.cat(block) for block in zip(*blocks, strict=True)))
    before = chains.v.clone()
    sweep(machine, chains, generator, classes=2)
    assert not torch.equal(chains.v, before)
    keys, law = (np.concatenate(part) for part in zip(*laws, strict=True))
    kind = np.repeat(np.arange(len(kinds)), each)
    check_frequencies(code(chains.v) + 1000 * kind, keys, law)


@pytest.mark.parametrize("states", [2, 3, 5])
def test_states_are_drawn_with_their_probabilities(states):
    """One of two units has extreme logits: its last state has the probability 1."""
    x = torch.tensor([0.3, -1.2, 0.8, 0.1][: states - 1] + [0.0] * (states - 2) + [800.0]).double()
    h1 = draw_states(x.expand(CHAINS, -1), states, torch.Generator().manual_seed(0))
    odds = np.exp([0.0, *x[: states - 1].tolist()])
    first = h1[:, : states - 1]
    assert set(first.sum(1).tolist()) == {0.0, 1.0}
    drawn = torch.cat([1 - first.sum(1, keepdim=True), first], 1).argmax(1).numpy()
    check_frequencies(drawn, np.arange(states), odds / odds.sum())
    assert bool((h1[:, -1] == 1).all())
    assert float(h1[:, states - 1 : -1].sum()) == 0
