"""Implications of observed relations: the formula by hand, the tensors and the service."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from app.inference.posterior import context_of
from app.inference.relations import ObservedRelations, relation_units
from tests.enumeration.small_machines import implied_by_hand, random_weights
from training.machines import MachineSpec, build
from training.machines.arrays import weights_of
from training.machines.triway import implied

V = 6


@st.composite
def relations(draw):
    """(A, n, n) of one or two relations between up to 6 classes, from few to all of them."""
    A, n = draw(st.integers(1, 2)), draw(st.integers(0, V))
    density = draw(st.sampled_from([0.1, 0.4, 0.8, 1.0]))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**32)))
    return (torch.rand(A, n, n, generator=generator) < density).double()


def machine_of(A=1, states=2):
    """A Triway with every weight from N(0, 1)."""
    machine = build(MachineSpec("triway", V=V, A=A, units=3, states=states, K=2, C=2, G=2))
    return random_weights(machine, torch.Generator().manual_seed(0))


def in_service(machine, observed, n=V, room=None):
    """The relations between the first n classes in the service, given observed relations."""
    weights, ones = weights_of(machine), np.ones(n, np.float32)
    context = context_of(weights, np.arange(n), ones, 0 * ones, room, observed)
    return relation_units(weights).between(context)


@settings(max_examples=50)
@given(relations(), st.sampled_from([-1, 0, 1]), st.sampled_from([2, 4]))
def test_implications_equal_the_formula_by_hand(grid, room, states):
    """The tensors and the service, which lists only relations that hold.

    Also without the effects between relations of the same pair (`apart`).
    """
    A, n, _ = grid.shape
    machine = machine_of(A, states)
    v = torch.zeros(1, V).double()
    v[0, :n] = 1
    padded = torch.zeros(A, V, V).double()
    padded[:, :n, :n] = grid
    a, i, j = (index.numpy() for index in grid.nonzero(as_tuple=True))
    observed = ObservedRelations(a, i, j, np.ones(len(a), np.float32))
    found = in_service(machine, observed, n, None if room < 0 else room)
    machine.double()
    h1 = machine.state_means(machine.context(v, torch.tensor([room]))[0])
    expected = implied_by_hand(machine, v[0], padded, room)
    edges = machine.edges(torch.arange(V).unsqueeze(0))
    ours = machine.implied(edges, padded.reshape(1, -1), h1)
    torch.testing.assert_close(ours.reshape(padded.shape), expected)
    alone = implied_by_hand(machine, v[0], padded, room, apart=True)
    ours = implied(machine.gamma, machine.B, padded[None], h1, apart=True)[0]
    torch.testing.assert_close(ours, alone)
    between = ~np.eye(n, dtype=bool)
    for shift, law in ((found.shift, expected), (found.apart, alone)):
        law = law[:, :n, :n].numpy()[:, between]
        np.testing.assert_allclose(shift[:, between], law, rtol=1e-4, atol=1e-4)


def test_without_observed_relations_nothing_changes():
    machine = machine_of(2)
    edges = machine.edges(torch.arange(V).unsqueeze(0))
    none = torch.zeros(1, 2 * V * V)
    assert not machine.implied(edges, none, torch.full((1, 3), 0.3)).any()
    plain = build(replace(machine.spec, G=0))
    assert not plain.implied(edges, none + 1, torch.full((1, 3), 0.3)).any()
    off = ObservedRelations(*(np.array([k]) for k in (0, 1, 2)), np.zeros(1, np.float32))
    for observed, shape in ((None, (0, 0, 0)), (off, (2, V, V))):
        shift = in_service(machine, observed).shift
        assert shift.shape == shape
        assert not shift.any()


def test_relations_in_another_layout_are_refused():
    machine = machine_of()
    table = build(MachineSpec("rbm", V=V, A=1, units=1, T=0)).edges(torch.arange(V)[None])
    with pytest.raises(TypeError, match="PairEdges"):
        machine.relation_logits(table, torch.ones(1, V), torch.zeros(1, 3))
