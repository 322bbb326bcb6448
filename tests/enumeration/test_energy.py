"""The energy against its formula, term by term, and F against its definition."""

import math

import pytest
import torch

from tests.enumeration.small_machines import (
    SMALL,
    binary,
    enumerate_joint,
    left_out,
    mean_rates,
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


def energy_by_hand(machine, edges, v, r, states, logs, room, source):
    """E with one loop for each sum. `states` are the states z_m of the hidden units, from 0."""
    spec, Z = machine.spec, machine.spec.states
    p = dict(machine.named_parameters())
    entries = [m * (Z - 1) + z - 1 for m, z in enumerate(states) if z]
    on = v.nonzero().flatten().tolist()
    total = sum(-p["b"][i] - p["u"][source, i] for i in on)
    total -= sum(p["a"][source, i] for i in on) if source >= 0 else 0
    if room >= 0:
        total -= p["e"][room] + (p["y"][source, room] if source >= 0 else 0)
        total -= sum(p["Y"][room, i] for i in on) if spec.coupled else 0
    if spec.coupled:
        total -= sum((p["L"][i, j] + p["L"][j, i]) / 2 for i in on for j in on if i < j)
    for k in entries:
        total -= p["c1"][k] + sum(p["W"][i, k] for i in on)
        total -= p["Q"][room, k] if room >= 0 else 0
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
        v, r = (
            torch.randint(2, (n,), generator=generator).double()
            for n in (spec.V, edges.valid.shape[1])
        )
        room, source = (
            int(torch.randint(-1, n, (), generator=generator)) for n in (spec.C, spec.profiles)
        )
        number = int(torch.randint(len(all_h1), (), generator=generator))
        states = [number // spec.states**m % spec.states for m in reversed(range(spec.units))]
        tensors = (torch.tensor([k]) for k in (room, source))
        ours = machine.energy(v[None], r[None], all_h1[number][None], edges, *tensors)
        by_hand = energy_by_hand(machine, edges, v, r, states, logs, room, source)
        assert float(ours) == pytest.approx(by_hand, rel=1e-12)


@pytest.mark.parametrize("name", SMALL)
def test_free_energy_is_the_sum_over_states(name):
    """F is -log sum exp(-E) over h1 and r, so an unobserved relation has the sum 1."""
    machine = small_machine(name)
    source = machine.spec.profiles - 1
    joint = enumerate_joint(machine, *range(-1, machine.spec.C), source=source)
    free = machine.free_energy(joint.v, joint.room, torch.full((len(joint.v),), source))
    fixed = torch.cat((joint.v, joint.room.unsqueeze(1)), 1)
    _, group = fixed.unique(dim=0, return_inverse=True)
    for g in range(int(group.max()) + 1):
        rows = group == g
        assert float(free[rows][0]) == pytest.approx(-joint.log_sum(rows), rel=1e-10)


@pytest.mark.parametrize("name", SMALL)
def test_conditionals_of_relations_and_hidden_units(name):
    """Each logit is the log-odds of its unit in the joint, given all other units."""
    machine = small_machine(name)
    spec, joint = machine.spec, enumerate_joint(machine)
    logits = machine.relation_logits(joint.edges, joint.v, joint.h1)
    means = machine.state_means(machine.hidden_logits(joint.v))
    gate = machine.gate(joint.edges, joint.v)
    pick = torch.randint(len(joint.v), (25,), generator=torch.Generator().manual_seed(2))
    for n in pick.tolist():
        v, r = same(joint.v, joint.v[n]), joint.r == joint.r[n]
        h1 = same(joint.h1, joint.h1[n])
        for e in range(r.shape[1]):
            others = torch.arange(r.shape[1]) != e
            if gate[n, e]:
                exact = joint.log_odds(joint.r[:, e] > 0, v & h1 & r[:, others].all(1))
                assert float(logits[n, e]) == pytest.approx(exact, abs=1e-9)
        for k in range(spec.H1):
            # With relations summed out.
            exact = joint.log_odds(joint.h1[:, k] > 0, v)
            assert float(means[n, k].logit()) == pytest.approx(exact, abs=1e-9)


# In the joint, the room type t is a unit with C + 1 states, of which one is "not listed". A list of
# classes means v_j = 0 for every other class j: a log-odds is that of v_i given all other classes.
# The joint of an unknown source has the mean base rates given the listed classes. The joint also
# has the base rates u of whole scenes, which the answers leave out.

# Each machine without and with a room type, and without and with a source.
CASES = [
    (name, room, source)
    for name, spec in SMALL.items()
    for room in sorted({-1, spec.C - 1})
    for source in sorted({-1, spec.profiles - 1})
]


@pytest.mark.parametrize(("name", "room", "source"), CASES)
def test_object_log_odds_are_those_of_the_joint(name, room, source):
    machine = small_machine(name)
    joint = enumerate_joint(machine, *range(-1, machine.spec.C), source=source)
    for i, v, given in left_out(joint):
        exact = joint.log_odds(joint.v[:, i] > 0, given & (joint.room == room))
        exact -= float(machine.u[source, i])
        if source < 0:
            exact += float(mean_rates(machine, v)[i])
        conditions = {"room": torch.tensor([room]), "source": torch.tensor([source])}
        ours = machine.object_log_odds(v[None], **conditions)
        assert float(ours[0, i]) == pytest.approx(exact, abs=1e-9)


@pytest.mark.parametrize("name", SMALL)
def test_kappa_is_added_to_log_odds_and_is_no_part_of_the_energy(name):
    machine, plain = small_machine(name), small_machine(name)
    plain.kappa.zero_()
    v, share = binary(machine.spec.V), torch.arange(2**machine.spec.V) % 4
    torch.testing.assert_close(
        machine.object_log_odds(v, share=share), plain.object_log_odds(v) + machine.kappa[share]
    )
    assert torch.equal(enumerate_joint(machine).energy, enumerate_joint(plain).energy)
    assert torch.equal(machine.object_log_odds(v), plain.object_log_odds(v))


@pytest.mark.parametrize("name", [name for name, spec in SMALL.items() if spec.C])
def test_room_types_are_those_of_the_joint(name):
    """p(t | v) of each source; of an unknown source, the mean over p(q | v) = softmax(f + a v)."""
    machine = small_machine(name)
    C, sources = machine.spec.C, range(machine.spec.profiles) or (-1,)
    joints = [enumerate_joint(machine, *range(C), source=q) for q in sources]
    for v in binary(machine.spec.V):
        rows = [
            [joint.log_sum(same(joint.v, v) & (joint.room == t)) for t in range(C)]
            for joint in joints
        ]
        by_source = torch.tensor(rows).double().softmax(1)
        for q, p in zip(sources, by_source, strict=True):
            ours = machine.room_log_p(v[None], torch.tensor([q]))[0].exp()
            torch.testing.assert_close(ours, p, rtol=1e-6, atol=0)
        weights = torch.ones(len(by_source)).double()
        if machine.spec.profiles:
            weights = torch.stack([(machine.f[q] + v @ machine.a[q]).exp() for q in sources])
        mean = (weights / weights.sum()) @ by_source
        torch.testing.assert_close(machine.room_log_p(v[None])[0].exp(), mean, rtol=1e-6, atol=0)
