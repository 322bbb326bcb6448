"""The Gibbs kernels leave p stationary, and a fully related object can leave the chain.

Draw states exactly from the enumerated joint, run the kernel once, and compare the histogram with
p. The yardstick is the total variation of as many exact draws (the Monte-Carlo floor), which
separates a wrong kernel from slow mixing: a stationary kernel stays at the floor however slowly it
mixes. Relations that imply each other are drawn in turn given all else, which no joint describes:
there the histogram is that of v, h1 and h2.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.enumeration.small_machines import (
    SMALL,
    check_frequencies,
    draw_states,
    enumerate_joint,
    small_machine,
)
from training.machines.edges import present_classes
from training.machines.gibbs import FREE, Clamp, gibbs_step, initial_state
from training.machines.machine import State

CHAINS = 60_000


def state_code(machine, state):
    """One integer per chain from (v, r, h1, h2), with r laid out over all classes.

    Without r in a machine whose relations imply each other.
    """
    spec = machine.spec
    if spec.G:
        dense = state.v[:, :0]
    elif spec.variant == "triway":
        dense = torch.zeros(len(state.v), spec.A, spec.V, spec.V).double()
        e = state.edges
        index = (e.relation * spec.V + e.subject) * spec.V + e.object
        dense = dense.flatten(1).scatter_add(1, index, state.r * e.valid)
    else:
        dense = state.r
    bits = torch.cat([state.v, dense, state.h1, state.h2], 1).long()
    return (bits << torch.arange(bits.shape[1])).sum(1)


def check_stationary(joint, clamp, given, seed, **options):
    generator = torch.Generator().manual_seed(seed)
    machine = joint.machine
    state = draw_states(joint, CHAINS, generator, given)
    p = joint.p if given is None else torch.where(given, joint.p, 0.0)
    p = p / p.sum()
    all_states = State(joint.v, joint.h1, joint.h2, joint.r, joint.edges)
    if machine.spec.variant == "triway":
        frame = machine.edges(torch.arange(machine.spec.V).expand(len(joint.v), -1))
        all_states = replace(all_states, edges=frame)
    keys, which = state_code(machine, all_states).unique(return_inverse=True)
    p = torch.zeros(len(keys)).double().scatter_add(0, which, p)
    state = gibbs_step(machine, state, generator, clamp, **options)
    check_frequencies(state_code(machine, state).numpy(), keys.numpy(), p.numpy())


@pytest.mark.parametrize("name", SMALL)
def test_kernel_is_stationary(name):
    check_stationary(enumerate_joint(small_machine(name)), FREE, None, seed=5)


@pytest.mark.parametrize("name", [n for n, s in SMALL.items() if s.form == "seed"])
def test_plain_block_kernel_is_stationary(name):
    machine = small_machine(name)
    if machine.spec.variant == "triway":
        machine.kappa.zero_()
    check_stationary(enumerate_joint(machine), FREE, None, seed=6, collapsed=False)


def test_plain_block_kernel_refuses_a_compensated_machine():
    machine = small_machine("triway-seed")
    generator = torch.Generator().manual_seed(0)
    state = initial_state(machine, torch.ones(1, 2).double(), generator)
    with pytest.raises(ValueError, match="κ = 0"):
        gibbs_step(machine, state, generator, collapsed=False)


@pytest.mark.parametrize("name", SMALL)
def test_kernel_is_stationary_with_units_clamped_and_relations_observed(name):
    """v_0 clamped on, one hidden unit clamped off, one relation observed on, the rest free."""
    machine = small_machine(name)
    joint = enumerate_joint(machine)
    loop = (joint.edges.subject[0] == 0) & (joint.edges.object[0] == 0)
    unit = int(loop.nonzero()[0]) if bool(loop.any()) else 0
    held = [0] if bool(loop.any()) else [0, 1]
    mask_v = torch.zeros(1, machine.spec.V, dtype=torch.bool)
    mask_v[0, held] = True
    mask_h = torch.zeros(1, machine.spec.H1, dtype=torch.bool)
    mask_h[0, 1] = True
    observed = torch.zeros(1, joint.r.shape[1], dtype=torch.bool)
    observed[0, unit] = True
    given = (joint.v[:, held] > 0).all(1) & (joint.h1[:, 1] == 0) & (joint.r[:, unit] > 0)
    edges = joint.edges
    if machine.spec.variant == "triway":
        edges = machine.edges(torch.tensor([held]).expand(CHAINS, -1))
        # The first relation of class 0 to itself.
        observed = (torch.arange(edges.shape[1]) == 0).unsqueeze(0)
    observed = observed.expand(CHAINS, -1)
    clamp = Clamp(v=mask_v, h1=mask_h, edges=edges, r=observed.double(), observed=observed)
    check_stationary(joint, clamp, given, seed=7)


def test_a_fully_related_object_can_leave_the_chain():
    """Seed form: with all its relations on, an object still leaves under the collapsed kernel."""
    machine = small_machine("triway-seed")
    machine.d.fill_(3.0)
    machine.kappa.zero_()
    rows = 2000
    generator = torch.Generator().manual_seed(8)
    v = torch.ones(rows, machine.spec.V).double()
    state = initial_state(machine, v, generator)
    state = replace(state, r=torch.ones_like(state.r))
    plain = gibbs_step(machine, state, generator, collapsed=False)
    assert bool((plain.v == 1).all())
    machine.b.fill_(-40.0)
    collapsed = gibbs_step(machine, state, generator)
    assert float(collapsed.v.mean()) < 0.5


def test_tempering_scales_the_energy_in_the_seed_form():
    machine = small_machine("triway")
    joint = enumerate_joint(machine)
    cold = machine.scaled(0.5)
    energy = cold.energy(joint.v, joint.r, joint.h1, joint.h2, joint.edges)
    torch.testing.assert_close(energy, 0.5 * joint.energy)


def test_present_classes_puts_leading_ones_first():
    v = torch.tensor([[1.0, 0, 1, 1], [0, 0, 0, 1]])
    assert present_classes(v).tolist() == [[0, 2, 3], [3, -1, -1]]
    assert present_classes(v, torch.tensor([[3], [3]])).tolist() == [[3, 0, 2], [3, -1, -1]]
