"""Implications of observed relations: the formula by hand, and draws one after the other."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.enumeration.implied import implied_by_hand
from tests.enumeration.small_machines import random_weights
from training.machines import MachineSpec, Triway, build
from training.machines.draws import draw_hidden
from training.machines.gibbs import Clamp, sample_relations
from training.machines.log_odds import object_log_odds, relation_log_odds
from training.machines.mean_field import Evidence


@st.composite
def relations(draw):
    """(A, n, n) of one or two relations between up to 4 classes, from few to all of them."""
    A, n = draw(st.integers(1, 2)), draw(st.integers(0, 4))
    density = draw(st.sampled_from([0.1, 0.4, 0.8, 1.0]))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**32)))
    return (torch.rand(A, n, n, generator=generator) < density).double()


def machine_of(G=2, A=1, V=4, seed=0):
    """A local Triway of one layer, every weight from N(0, 1)."""
    machine = build(MachineSpec("triway", V=V, A=A, H1=3, K=2, C=2, G=G, form="local")).double()
    return random_weights(machine, torch.Generator().manual_seed(seed))


def without(machine: Triway) -> Triway:
    """The same machine without implications."""
    plain = build(replace(machine.spec, G=0)).double()
    state = machine.state_dict()
    plain.load_state_dict({k: v for k, v in state.items() if k not in ("gamma", "B")})
    return plain.requires_grad_(False)


@given(relations(), st.sampled_from([None, 0, 1]))
def test_implications_equal_the_formula_by_hand(grid, room):
    """x of a machine is that by hand, at E[h1 | v], however much the relations say of h1."""
    A, n, _ = grid.shape
    machine = machine_of(A=A)
    v = torch.zeros(1, 4).double()
    v[0, :n] = 1
    rooms = None if room is None else torch.tensor([room])
    padded = torch.zeros(A, 4, 4).double()
    padded[:, :n, :n] = grid
    edges = machine.edges(torch.arange(4).unsqueeze(0))
    r = padded.reshape(1, -1)
    draws = draw_hidden(machine, Evidence(v, edges, r, r > 0, rooms), draws=4)
    ours = draws.implied(machine, edges, r).reshape(padded.shape)
    torch.testing.assert_close(ours, implied_by_hand(machine, v[0], padded, room))


def test_without_observed_relations_nothing_changes():
    """Nor does anything that is not of relations: objects are judged as without implications."""
    machine = machine_of(A=2)
    plain = without(machine)
    generator = torch.Generator().manual_seed(1)
    v = (torch.rand(20, 4, generator=generator) < 0.6).double()
    classes = torch.arange(4).expand(20, -1)
    frames = [m.edges(classes) for m in (machine, plain)]
    both = list(zip((machine, plain), frames, strict=True))
    torch.testing.assert_close(*(relation_log_odds(m, e, Evidence(v, e)) for m, e in both))
    torch.testing.assert_close(machine.free_energy(v), plain.free_energy(v))
    gate = frames[0].ends_present(v)
    r = (torch.rand(gate.shape, generator=generator) < 0.3) * gate
    torch.testing.assert_close(*(object_log_odds(m, Evidence(v, e, r, r > 0)) for m, e in both))
    one, other = (relation_log_odds(m, e, Evidence(v, e, r, r > 0))[0] for m, e in both)
    assert float((one - other)[gate > 0].abs().max()) > 0.1


def test_relations_observed_in_another_layout_are_refused():
    machine = machine_of()
    edges, other = (machine.edges(torch.arange(4).unsqueeze(0)) for _ in range(2))
    r = torch.ones(1, 16).double()
    with pytest.raises(ValueError, match="layout"):
        relation_log_odds(machine, other, Evidence(torch.ones(1, 4).double(), edges, r, r > 0))


# -- draws ----------------------------------------------------------------------------------------


@settings(max_examples=30)
@given(st.integers(0, 2**32), st.floats(0, 1))
def test_clamped_relations_stay(seed, share):
    machine = machine_of(A=2)
    generator = torch.Generator().manual_seed(seed)
    edges = machine.edges(torch.tensor([[2, 0, 3]]).expand(5, -1))
    v = torch.tensor([[1.0, 1, 1, 1], [1, 0, 1, 1]]).double()[[0, 1, 0, 1, 0]]
    r = (torch.rand(5, 18, generator=generator) < 0.5).double()
    observed = torch.rand(5, 18, generator=generator) < share
    h1 = torch.ones(5, 3).double()
    clamp = Clamp(edges=edges, r=r, observed=observed)
    drawn, values = sample_relations(machine, v, h1, generator, clamp)
    seen = drawn.unflatten(values)[..., :3, :3].reshape(5, -1)
    assert drawn.subjects[:, :3].tolist() == [[2, 0, 3]] * 5
    assert bool((seen == r)[observed].all())
    assert bool((values <= machine.gate(drawn, v)).all())


@pytest.mark.parametrize("seed", [0, 4])
def test_two_relations_follow_the_chain_rule(seed):
    """r(0, 1) and r(1, 0), the loops clamped, 40,000 chains: all four frequencies within five
    standard errors of the mean over both orders; fails by chance with probability < 3e-6."""
    machine = machine_of(A=1, V=2, seed=seed)
    machine.gamma.mul_(2.0)
    rows = 40_000
    v, h1 = torch.ones(rows, 2).double(), torch.tensor([[1.0, 0, 1]]).double().expand(rows, -1)
    frame = machine.edges(torch.arange(2).expand(rows, -1))
    loops = torch.tensor([[True, False, False, True]]).expand(rows, -1)
    r = torch.tensor([[1.0, 0, 0, 0]]).double().expand(rows, -1)
    generator = torch.Generator().manual_seed(seed)
    room = torch.ones(rows, dtype=torch.int64)
    clamp = Clamp(edges=frame, r=r, observed=loops, room=room)
    drawn = sample_relations(machine, v, h1, generator, clamp)[1]
    logits = machine.relation_logits(frame, v[:1], h1[:1])[0].view(2, 2)

    def p(unit, value, given):
        grid = torch.tensor([[[1.0, 0], [0, 0]]]).double()
        for place, on in given.items():
            grid[0][place] = on
        x = implied_by_hand(machine, v[0], grid, room=1)[0]
        on = float((logits + x)[unit].sigmoid())
        return on if value else 1 - on

    first, second = (0, 1), (1, 0)
    orders = []
    for a, b in itertools.product((0.0, 1.0), repeat=2):
        one = p(first, a, {}) * p(second, b, {first: a})
        other = p(second, b, {}) * p(first, a, {second: b})
        orders.append((one, other, p(first, a, {}) * p(second, b, {})))
        expected = (one + other) / 2
        share = float(((drawn[:, 1] == a) & (drawn[:, 2] == b)).double().mean())
        assert abs(share - expected) <= 5 * (expected * (1 - expected) / rows) ** 0.5
    # One order alone, or both relations at once, gives other shares.
    assert max(abs(one - other) for one, other, _ in orders) > 0.03
    assert max(abs((one + other) / 2 - both) for one, other, both in orders) > 0.03
