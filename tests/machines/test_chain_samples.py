"""Chain samples as bits, and chains that start at samples which suit their evidence."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.enumeration.small_machines import random_weights
from training.machines import MachineSpec, build
from training.machines.chain_samples import ChainSamples, pack_scenes, unpack_scenes, words
from training.machines.gibbs import FREE, Clamp, initial_state

V = 35
CHAINS = 20_000


@given(st.integers(1, 9), st.integers(1, 100), st.integers(0, 2**32))
def test_scenes_are_read_back_from_their_bits(scenes, classes, seed):
    generator = torch.Generator().manual_seed(seed)
    v = (torch.rand(scenes, classes, generator=generator) < 0.5).float()
    packed = pack_scenes(v)
    assert packed.dtype == torch.int32
    assert packed.shape == (scenes, words(classes))
    assert torch.equal(unpack_scenes(packed, classes), v)


def machine_of(N=6, H2=0, form="local", seed=0):
    """Every weight from N(0, 1); distinct random samples."""
    spec = MachineSpec("triway", V=V, A=1, H1=4, H2=H2, K=2, C=2, N=N, form=form)
    generator = torch.Generator().manual_seed(seed)
    machine = random_weights(build(spec).double(), generator)
    if N:
        stored = (torch.rand(N, V, generator=generator) < 0.4).float()
        assert len(stored.unique(dim=0)) == N
        machine.fantasies.copy_(pack_scenes(stored))
        machine.fantasy_rooms.copy_(torch.arange(N) % 3 - 1)
    return machine


def start_chains(machine, observed, generator, clamp=FREE):
    return ChainSamples(machine).start(observed, generator, clamp)


def evidence(*classes, chains=CHAINS):
    v = torch.zeros(chains, V).double()
    v[:, list(classes)] = 1
    return v


def by_formula(machine, classes, room=None, held=()):
    """Share of chains that start at each sample, by the module's docstring, one layer."""
    stored = unpack_scenes(machine.fantasies, V).double()
    x = machine.c1 + stored @ machine.W
    log_p = (machine.b + x.sigmoid() @ machine.W.T).sigmoid().log()
    log_w = log_p[:, list(classes)].sum(1) + x[:, list(held)].sigmoid().log().sum(1)
    if room is not None:
        log_w = log_w - 6.0 * (machine.fantasy_rooms != room)
    return log_w.softmax(0).tolist()


@pytest.mark.parametrize(
    ("classes", "room", "held"),
    [([], None, ()), ([0], None, ()), ([3, 33], None, ()), ([5], 1, ()), ([], None, (2,)),
     ([1], 0, (0, 3))],
)  # fmt: skip
def test_samples_are_weighed_by_the_formula(classes, room, held):
    """Shares of 20,000 chains within five standard errors: six samples fail by chance with
    probability < 4e-6."""
    machine = machine_of()
    clamp = Clamp(
        h1=torch.tensor([k in held for k in range(4)]),
        room=None if room is None else torch.full((CHAINS,), room),
    )
    state = start_chains(machine, evidence(*classes), torch.Generator().manual_seed(1), clamp)
    expected = by_formula(machine, classes, room, held)
    assert max(expected) > 1.05 * min(expected) or not (classes or held or room is not None)
    stored = unpack_scenes(machine.fantasies, V).double().maximum(evidence(*classes, chains=1))
    assert len(stored.unique(dim=0)) == len(stored)
    total = 0.0
    for v, p in zip(stored, expected, strict=True):
        share = float((state.v == v).all(1).double().mean())
        assert abs(share - p) <= 5 * math.sqrt(p * (1 - p) / CHAINS)
        total += share
    assert total == pytest.approx(1)
    assert bool((state.h1[:, list(held)] == 1).all())


def test_a_room_type_without_samples_takes_any_sample():
    machine = machine_of()
    machine.fantasy_rooms.fill_(0)
    clamp = Clamp(room=torch.full((200,), 1))
    samples = ChainSamples(machine)
    plain = samples.log_weight(evidence(3, chains=200))
    weight = samples.log_weight(evidence(3, chains=200), clamp)
    assert torch.allclose(weight - plain, (samples.h1 @ machine.Q[1]).expand(200, -1))


@pytest.mark.parametrize("N", [0, 6])
@pytest.mark.parametrize("H2", [0, 3])
def test_chains_hold_what_is_given(N, H2):
    machine = machine_of(N=N, H2=H2)
    chains = torch.zeros(40, V).double()
    generator = torch.Generator().manual_seed(2)
    chains[torch.rand(40, V, generator=generator) < 0.2] = 1
    held = Clamp(h1=torch.tensor([False, True, False, False]), h2=torch.arange(H2) == 2)
    state = start_chains(machine, chains, generator, held)
    assert bool((state.v >= chains).all())
    assert bool((state.h1[:, 1] == 1).all())
    assert state.h2.shape == (40, H2)
    assert not H2 or bool((state.h2[:, 2] == 1).all())
    assert set(state.h1.unique().tolist()) == {0.0, 1.0}
    again = start_chains(machine, chains, generator.manual_seed(2), held)
    other = start_chains(machine, chains, generator.manual_seed(2), held)
    assert torch.equal(again.v, other.v)
    assert torch.equal(again.h1, other.h1)


@pytest.mark.parametrize("form", ["seed", "local"])
def test_without_samples_chains_start_at_their_evidence(form):
    machine = machine_of(N=0, form=form)
    chains = evidence(2, 9, chains=7)
    state = start_chains(machine, chains, torch.Generator().manual_seed(5))
    plain = initial_state(machine, chains, torch.Generator().manual_seed(5))
    assert torch.equal(state.v, chains)
    assert torch.equal(state.h1, plain.h1)
    assert torch.equal(state.r, plain.r)
