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
from tests.enumeration.implied import implied_by_hand
from tests.enumeration.small_machines import random_weights
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


def machine_of(A=1, states=2, seed=0):
    """A Triway with every weight from N(0, 1)."""
    machine = build(MachineSpec("triway", V=V, A=A, units=3, states=states, K=2, C=2, G=2))
    return random_weights(machine, torch.Generator().manual_seed(seed))


def in_service(machine, grid, room):
    """Shift and apart of the service, (A, n, n), for the first n classes."""
    n = grid.shape[1]
    a, i, j = (index.numpy() for index in grid.nonzero(as_tuple=True))
    observed = ObservedRelations(a, i, j, np.ones(len(a), np.float32))
    weights, ones = weights_of(machine), np.ones(n, np.float32)
    context = context_of(weights, np.arange(n), ones, 0 * ones, room, observed)
    between = relation_units(weights).between(context)
    return between.shift, between.apart


@settings(max_examples=50)
@given(relations(), st.sampled_from([None, 0, 1]))
def test_implications_equal_the_formula_by_hand(grid, room):
    """The tensors and the service, which lists only relations that hold."""
    A, n, _ = grid.shape
    machine = machine_of(A)
    v = torch.zeros(1, V).double()
    v[0, :n] = 1
    padded = torch.zeros(A, V, V).double()
    padded[:, :n, :n] = grid
    shift, _ = in_service(machine, grid, room)
    machine.double()
    expected = implied_by_hand(machine, v[0], padded, room)
    x, _ = machine.context(v, None if room is None else torch.tensor([room]))
    edges = machine.edges(torch.arange(V).unsqueeze(0))
    ours = machine.implied(edges, padded.reshape(1, -1), machine.state_means(x))
    torch.testing.assert_close(ours.reshape(padded.shape), expected)
    between = ~np.eye(n, dtype=bool)
    np.testing.assert_allclose(
        shift[:, between], expected[:, :n, :n].numpy()[:, between], rtol=1e-4, atol=1e-4
    )


@given(relations())
def test_the_service_equals_the_tensors_with_more_states(grid):
    """Also without the effects between relations of the same pair (`apart`)."""
    A, n, _ = grid.shape
    machine = machine_of(A, states=4)
    found = in_service(machine, grid, 1)
    machine.double()
    v = torch.zeros(1, V).double()
    v[0, :n] = 1
    h1 = machine.state_means(machine.context(v, torch.tensor([1]))[0])
    between = ~np.eye(n, dtype=bool)
    for shift, apart in zip(found, (False, True), strict=True):
        expected = implied(machine.gamma, machine.B, grid[None], h1, apart=apart)[0].numpy()
        np.testing.assert_allclose(shift[:, between], expected[:, between], rtol=1e-4, atol=1e-4)


def test_without_observed_relations_nothing_changes():
    machine = machine_of(2)
    edges = machine.edges(torch.arange(V).unsqueeze(0))
    none = torch.zeros(1, 2 * V * V)
    assert not machine.implied(edges, none, torch.full((1, 3), 0.3)).any()
    plain = build(replace(machine.spec, G=0))
    assert not plain.implied(edges, none + 1, torch.full((1, 3), 0.3)).any()
    weights, ones = weights_of(machine), np.ones(V, np.float32)
    off = ObservedRelations(*(np.array([k]) for k in (0, 1, 2)), np.zeros(1, np.float32))
    for observed, shape in ((None, (0, 0, 0)), (off, (2, V, V))):
        context = context_of(weights, np.arange(V), ones, 0 * ones, None, observed)
        shift = relation_units(weights).between(context).shift
        assert shift.shape == shape
        assert not shift.any()


def test_relations_in_another_layout_are_refused():
    machine = machine_of()
    table = build(MachineSpec("rbm", V=V, A=1, units=1, T=0)).edges(torch.arange(V)[None])
    with pytest.raises(TypeError, match="PairEdges"):
        machine.relation_logits(table, torch.ones(1, V), torch.zeros(1, 3))
