"""The energy against its formula, term by term, and F against its definition."""

from __future__ import annotations

import math

import pytest
import torch

from tests.enumeration.small_machines import (
    SMALL,
    enumerate_joint,
    same,
    small_machine,
    unit_states,
)


def relation_logit(machine, e, v, h1, logs):
    """ℓ_e written out with loops, as on the page, for the log of the instances of each class."""
    spec, (a, i, j) = machine.spec, e
    h = [float(x) for x in h1]
    table = [tuple(t) for t in machine.triples.tolist()]
    p = dict(machine.named_parameters())
    if spec.variant in ("rbm", "gbm"):
        t = table.index(e)
        logit = p["d"][t] + sum(p["U"][t, k] * h[k] for k in range(spec.H1))
        if spec.variant == "gbm":
            logit += p["g"][t, 0] * v[i] + p["g"][t, 1] * v[j]
        return float(logit)
    w = p["s"][a, i] + p["o"][a, j]
    w += sum(p["S"][i, k] * p["R"][a, k] * p["O"][j, k] for k in range(spec.K))
    if e in table:
        w += p["residual"][table.index(e)]
    w = w + p["n"][a, 0] * logs[i] + p["n"][a, 1] * logs[j]
    for x in range(spec.H1):
        U = sum(p["S"][i, k] * p["O"][j, k] * p["M"][a, k, x] for k in range(spec.K))
        w = w + (p["P"][a, x] + U) * h[x]
    return float(p["d"][a] + w)


def energy_by_hand(machine, edges, v, r, states, h2, logs, room, source):
    """E with one loop for each sum. `states` are the states z_m of the hidden units, from 0."""
    spec, Z = machine.spec, machine.spec.states
    p = dict(machine.named_parameters())
    entries = [m * (Z - 1) + z - 1 for m, z in enumerate(states) if z]
    on, on2 = v.nonzero().flatten().tolist(), h2.nonzero().flatten().tolist()
    total = sum(-p["b"][i] - p["u"][source, i] for i in on)
    total -= sum(p["a"][source, i] for i in on) if source >= 0 else 0
    if room >= 0:
        total -= p["e"][room] + (p["y"][source, room] if source >= 0 else 0)
        total -= sum(p["Y"][room, i] for i in on) if spec.coupled else 0
    if spec.coupled:
        total -= sum((p["L"][i, j] + p["L"][j, i]) / 2 for i in on for j in on if i < j)
    for k in entries:
        total -= p["c1"][k] + sum(p["W"][i, k] for i in on) + sum(p["J"][k, x] for x in on2)
        total -= p["Q"][room, k] if room >= 0 else 0
    total -= sum(p["c2"][x] for x in on2)
    h1 = torch.zeros(spec.H1).index_fill(0, torch.tensor(entries, dtype=torch.int64), 1.0)
    ends = (x[0].tolist() for x in (edges.relation, edges.subject, edges.object))
    for unit, (a, i, j) in enumerate(zip(*ends, strict=True)):
        if spec.variant == "triway" and not v[i] * v[j]:
            if r[unit]:
                return math.inf
            continue
        logit = relation_logit(machine, (a, i, j), v, h1, logs)
        total += math.log1p(math.exp(logit)) - float(r[unit]) * logit
    return float(total)


@pytest.mark.parametrize("counted", [True, False])
@pytest.mark.parametrize("name", SMALL)
def test_energy_is_the_formula(name, counted):
    """Without counts, each class has one instance; of an unknown count (0), the usual log."""
    machine = small_machine(name)
    spec = machine.spec
    counts = torch.tensor([0, 2, 3])[: spec.V]
    edges = machine.edges(torch.arange(spec.V)[None], counts[None] if counted else None)
    logs = counts.double().log() if counted else torch.zeros(spec.V).double()
    if counted and spec.variant == "triway":
        logs[0] = machine.usual[0]
    generator = torch.Generator().manual_seed(1)
    all_h1 = unit_states(spec)
    for _ in range(60):
        v, r, h2 = (
            torch.randint(2, (n,), generator=generator).double()
            for n in (spec.V, edges.valid.shape[1], spec.H2)
        )
        room, source = (
            int(torch.randint(-1, n, (), generator=generator)) for n in (spec.C, spec.profiles)
        )
        number = int(torch.randint(len(all_h1), (), generator=generator))
        states = [number // spec.states**m % spec.states for m in reversed(range(spec.units))]
        tensors = (torch.tensor([k]) for k in (room, source))
        ours = machine.energy(v[None], r[None], all_h1[number][None], h2[None], edges, *tensors)
        by_hand = energy_by_hand(machine, edges, v, r, states, h2, logs, room, source)
        assert float(ours) == pytest.approx(by_hand, rel=1e-12)


@pytest.mark.parametrize("name", SMALL)
def test_free_energy_is_the_sum_over_states(name):
    """F is -log sum exp(-E) over h1 and r, so an unobserved relation has the sum 1."""
    machine = small_machine(name)
    source = machine.spec.profiles - 1
    joint = enumerate_joint(machine, *range(-1, machine.spec.C), source=source)
    sources = torch.full((len(joint.v),), source)
    h2 = joint.h2 if machine.spec.H2 else None
    free = machine.free_energy(joint.v, h2, joint.room, sources)
    fixed = torch.cat((joint.v, joint.h2, joint.room.unsqueeze(1)), 1)
    _, group = fixed.unique(dim=0, return_inverse=True)
    for g in range(int(group.max()) + 1):
        rows = group == g
        assert float(free[rows][0]) == pytest.approx(-joint.log_sum(rows), rel=1e-10)


def test_free_energy_of_two_layers_needs_the_second():
    with pytest.raises(ValueError, match="pass h2"):
        small_machine("gbm").free_energy(torch.ones(1, 2).double())


@pytest.mark.parametrize("name", SMALL)
def test_conditionals_of_relations_and_hidden_units(name):
    """Each logit is the log-odds of its unit in the joint, given all other units."""
    machine = small_machine(name)
    spec, joint = machine.spec, enumerate_joint(machine)
    logits = machine.relation_logits(joint.edges, joint.v, joint.h1)
    second = machine.second_layer_logits(joint.h1)
    x = machine.c1 + joint.v @ machine.W + joint.h2 @ machine.J.T
    means = machine.state_means(x)
    gate = machine.gate(joint.edges, joint.v)
    pick = torch.randint(len(joint.v), (25,), generator=torch.Generator().manual_seed(2))
    for n in pick.tolist():
        v, r = same(joint.v, joint.v[n]), joint.r == joint.r[n]
        h1, h2 = same(joint.h1, joint.h1[n]), joint.h2 == joint.h2[n]
        for e in range(r.shape[1]):
            others = torch.arange(r.shape[1]) != e
            if gate[n, e]:
                exact = joint.log_odds(joint.r[:, e] > 0, v & h1 & h2.all(1) & r[:, others].all(1))
                assert float(logits[n, e]) == pytest.approx(exact, abs=1e-9)
        for k in range(spec.H2):
            others = torch.arange(spec.H2) != k
            exact = joint.log_odds(joint.h2[:, k] > 0, v & r.all(1) & h1 & h2[:, others].all(1))
            assert float(second[n, k]) == pytest.approx(exact, abs=1e-9)
        for k in range(spec.H1):
            # With relations summed out.
            exact = joint.log_odds(joint.h1[:, k] > 0, v & h2.all(1))
            assert float(means[n, k].logit()) == pytest.approx(exact, abs=1e-9)
