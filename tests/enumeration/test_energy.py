"""Energies against the formulas of the model page, term by term, and F against its definition."""

from __future__ import annotations

import math

import pytest
import torch

from tests.enumeration.small_machines import (
    ONE_LAYER,
    SEED_FORM,
    SMALL,
    binary,
    enumerate_joint,
    full_frame,
    same,
    small_machine,
)


def relation_logit(machine, e, v, h1, logs):
    """ℓ_e written out with loops, as on the page, for the log of the instances of each class."""
    spec, (a, i, j) = machine.spec, e
    h = [float(x) for x in h1]
    table = [tuple(t) for t in machine.triples.tolist()]
    p = {name: value.detach() for name, value in machine.named_parameters()}
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
        w = w + shared(p, spec, e, x) * h[x]
    return float(p["d"][a] + w)


def shared(p, spec, e, x):
    """U_e at hidden unit x, through the factors."""
    a, i, j = e
    return p["P"][a, x] + sum(p["S"][i, k] * p["O"][j, k] * p["M"][a, k, x] for k in range(spec.K))


def energy_by_hand(machine, edges, v, r, h1, h2, logs, room):
    spec = machine.spec
    p = {name: value.detach() for name, value in machine.named_parameters()}
    c1 = p["c1"] if room is None else p["c1"] + p["Q"][room]
    total = -float(p["b"] @ v + c1 @ h1 + p["c2"] @ h2 + v @ p["W"] @ h1 + h1 @ p["J"] @ h2)
    gated = spec.variant == "triway"
    ends = (x[0].tolist() for x in (edges.relation, edges.subject, edges.object))
    for unit, (a, i, j) in enumerate(zip(*ends, strict=True)):
        active = bool(v[i] * v[j]) or not gated
        if r[unit] and not active:
            return math.inf
        if not active:
            continue
        logit = relation_logit(machine, (a, i, j), v, h1, logs)
        total -= float(r[unit]) * logit
        if spec.form == "local":
            total += math.log1p(math.exp(logit))
        elif gated:
            total -= float(p["kappa"][a])
    return total


@pytest.mark.parametrize("counted", [True, False])
@pytest.mark.parametrize("name", SMALL)
def test_energy_is_the_formula(name, counted):
    """Without counts, each class has one instance; of an unknown count (0), the usual log."""
    machine = small_machine(name)
    counts = torch.tensor([0, 2, 3])[: machine.spec.V]
    edges = machine.edges(torch.arange(machine.spec.V)[None], counts[None] if counted else None)
    logs = counts.double().log() if counted else torch.zeros(machine.spec.V).double()
    if counted and machine.spec.variant == "triway":
        logs[0] = machine.usual[0]
    generator = torch.Generator().manual_seed(1)
    room = 1 if machine.spec.C else None
    for _ in range(60):
        v, r, h1, h2 = (
            torch.randint(2, (n,), generator=generator).double()
            for n in (machine.spec.V, edges.shape[-1], machine.spec.H1, machine.spec.H2)
        )
        rooms = None if room is None else torch.tensor([room])
        ours = machine.energy(v[None], r[None], h1[None], h2[None], edges, rooms)
        assert float(ours) == pytest.approx(
            energy_by_hand(machine, edges, v, r, h1, h2, logs, room), rel=1e-12
        )


@pytest.mark.parametrize("name", SMALL)
@pytest.mark.parametrize("room", [None, 1])
def test_free_energy_is_the_sum_over_states(name, room):
    """F is -log sum exp(-E) over h1, in the local form also over the relations."""
    machine = small_machine(name)
    is_seed = name in SEED_FORM
    joint = enumerate_joint(machine, room if machine.spec.C and not is_seed else None)
    relations = (joint.r, joint.edges) if is_seed else (None, None)
    h2 = joint.h2 if machine.spec.H2 else None
    free = machine.free_energy(joint.v, *relations, h2, joint.room)
    given = torch.cat((joint.v, joint.h2, *([joint.r] if is_seed else [])), 1)
    _, group = given.unique(dim=0, return_inverse=True)
    for g in range(int(group.max()) + 1):
        rows = group == g
        assert float(free[rows][0]) == pytest.approx(-joint.log_sum(rows), rel=1e-10)


@pytest.mark.parametrize("name", SMALL)
def test_free_energy_refuses_what_has_no_closed_form(name):
    machine = small_machine(name)
    v = torch.ones(1, machine.spec.V).double()
    edges = full_frame(machine)
    r = torch.zeros(1, edges.shape[-1]).double()
    h2 = torch.zeros(1, machine.spec.H2).double() if machine.spec.H2 else None
    given = (v, r, edges, h2) if machine.spec.form == "local" else (v, None, None, h2)
    with pytest.raises(ValueError, match="no closed form"):
        machine.free_energy(*given)


@pytest.mark.parametrize("name", SMALL)
def test_conditionals_of_every_block(name):
    machine = small_machine(name)
    joint = enumerate_joint(machine)
    generator = torch.Generator().manual_seed(2)
    logits = machine.relation_logits(joint.edges, joint.v, joint.h1)
    second = machine.second_layer_logits(joint.h1)
    gate = machine.gate(joint.edges, joint.v)
    for n in torch.randint(len(joint.v), (40,), generator=generator).tolist():
        v, r, h1, h2 = (joint.v == joint.v[n], joint.r == joint.r[n], joint.h1 == joint.h1[n],
                        joint.h2 == joint.h2[n])  # fmt: skip
        rest = v.all(1) & h1.all(1) & h2.all(1)
        for e in range(r.shape[1]):
            others = torch.ones(r.shape[1], dtype=torch.bool)
            others[e] = False
            if gate[n, e]:
                exact = joint.log_odds(joint.r[:, e] > 0, rest & r[:, others].all(1))
                assert float(logits[n, e]) == pytest.approx(exact, abs=1e-9)
        for k in range(machine.spec.H2):
            others = torch.arange(machine.spec.H2) != k
            given = v.all(1) & r.all(1) & h1.all(1) & h2[:, others].all(1)
            exact = joint.log_odds(joint.h2[:, k] > 0, given)
            assert float(second[n, k]) == pytest.approx(exact, abs=1e-9)


@pytest.mark.parametrize("name", ONE_LAYER)
def test_attraction_is_what_summing_relations_adds(name):
    """log sum_{R_i} exp(-E) at v_i = 1 minus at v_i = 0, given h1, is b_i + W_i·h1 + attraction."""
    machine = small_machine(name)
    joint = enumerate_joint(machine)
    for h1 in binary(machine.spec.H1):
        for v in binary(machine.spec.V):
            for i in range(machine.spec.V):
                others = torch.arange(machine.spec.V) != i
                given = same(joint.h1, h1) & same(joint.v[:, others], v[others])
                exact = joint.log_odds(joint.v[:, i] > 0, given)
                absent = v.clone()
                absent[i] = 0
                gain = machine.attraction(absent[None], h1[None], joint.edges, torch.tensor([[i]]))
                ours = machine.object_logits(h1[None])[0, i] + gain[0, 0]
                assert float(ours) == pytest.approx(exact, abs=1e-9)
