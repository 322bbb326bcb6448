"""RBM, GBM and Triway of the paper against sums over all states of tiny machines."""

from __future__ import annotations

import itertools
import math

import pytest
import torch

from training.seed.learning import PATIENCE, phases, train
from training.seed.machines import GBM, RBM, Free, Machine, State, Triway
from training.seed.scenes import Scenes

V, H1 = 2, 2
TRIPLES = torch.tensor([[0, 0, 1], [1, 1, 0], [2, 1, 1]])  # the last one relates a class to itself
T = len(TRIPLES)

MACHINES = pytest.mark.parametrize(
    ("kind", "H2"), [(RBM, 0), (RBM, 1), (GBM, 0), (GBM, 2), (Triway, 0), (Triway, 2)]
)


def tiny(kind: type[Machine], H2: int, scale: float = 1.0) -> Machine:
    generator = torch.Generator().manual_seed(3)
    machine = kind(TRIPLES, V, H1, H2, generator).double()
    for weight in machine.parameters():
        weight.data = scale * torch.randn(weight.shape, generator=generator, dtype=torch.float64)
    return machine


def all_states(machine: Machine) -> State:
    """Every state of the machine; of a Triway without relations of absent objects."""
    sizes = [V, T, H1, len(machine.c2)]
    bits = torch.tensor(list(itertools.product([0.0, 1.0], repeat=sum(sizes)))).double()
    v, r, _, _ = bits.split(sizes, 1)
    if isinstance(machine, Triway):
        bits = bits[
            [bool((own <= gate).all()) for own, gate in zip(r, machine.gate(v), strict=True)]
        ]
    return State(*bits.split(sizes, 1))


def units(state: State) -> torch.Tensor:
    return torch.cat([state.v, state.r, state.h1, state.h2], 1)


@MACHINES
def test_the_energy_is_the_formula(kind, H2):
    machine = tiny(kind, H2)
    w = {name: weight.tolist() for name, weight in machine.named_parameters()}
    states = all_states(machine)
    expected = []
    for v, r, h1, h2 in zip(*(x.tolist() for x in vars(states).values()), strict=True):
        total = sum(x * y for x, y in zip(w["b"] + w["c1"] + w["c2"], v + h1 + h2, strict=True))
        total += sum(v[i] * w["W"][i][k] * h1[k] for i in range(V) for k in range(H1))
        total += sum(h1[k] * w["J"][k][m] * h2[m] for k in range(H1) for m in range(H2))
        for e, (_, i, j) in enumerate(TRIPLES.tolist()):
            logit = w["d"][e] + sum(w["U"][e][k] * h1[k] for k in range(H1))
            if kind is GBM:
                logit += w["g"][0][e] * v[i] + w["g"][1][e] * v[j]
            total += r[e] * logit * (v[i] * v[j] if kind is Triway else 1)
        expected.append(-total)
    torch.testing.assert_close(machine.energy(states), torch.tensor(expected).double())


@MACHINES
def test_conditionals_are_those_of_the_joint(kind, H2):
    """Each unit given all others: p = exp(-E on) / (exp(-E on) + exp(-E off))."""
    machine = tiny(kind, H2)
    states = all_states(machine)
    weights = (-machine.energy(states)).exp().tolist()
    joint = dict(zip(map(tuple, units(states).tolist()), weights, strict=True))
    everything = Free(torch.ones_like(states.v).bool(), torch.ones_like(states.r).bool())
    generator = torch.Generator().manual_seed(0)
    stated = torch.cat(
        [
            machine.sample_objects(states, everything, 1.0, generator)[1],
            machine.relation_logits(states.v, states.h1).sigmoid() * machine.gate(states.v),
            machine.h1_logits(states.v, states.r, states.h2).sigmoid(),
            machine.h2_logits(states.h1).sigmoid(),
        ],
        1,
    )
    for row, p in zip(units(states).tolist(), stated.tolist(), strict=True):
        for unit in range(len(row)):
            off, on = (joint.get((*row[:unit], x, *row[unit + 1 :]), 0.0) for x in (0.0, 1.0))
            assert p[unit] == pytest.approx(on / (on + off))


@MACHINES
def test_the_gradient_is_that_of_the_likelihood_in_the_limit(kind, H2):
    """With many negative sweeps; scenes without annotation have no part in relations."""
    machine = tiny(kind, H2, scale=0.6)
    states = all_states(machine)
    visible = torch.tensor([[1, 1, 1, 0, 1], [1, 0, 0, 0, 0], [1, 1, 0, 1, 0]]).double()
    log_p = (-machine.energy(states)).log_softmax(0)
    own = torch.cat([states.v, states.r], 1)
    loss = -torch.stack([log_p[(own == row).all(1)].logsumexp(0) for row in visible]).mean()
    exact = torch.autograd.grad(loss, list(machine.parameters()))
    many = visible.repeat(20_000, 1)
    always = torch.ones(len(many), dtype=torch.bool)
    scenes = Scenes(many[:, :V], many[:, V:], many[:, V:].sum(1), always)
    generator = torch.Generator().manual_seed(1)
    estimate, _, _ = phases(machine, scenes, generator, steps=15)
    estimated = torch.autograd.grad(estimate.mean(), list(machine.parameters()))
    for left, right in zip(estimated, exact, strict=True):
        torch.testing.assert_close(left, right, atol=0.012, rtol=0.0)  # 4 standard errors
    silent = Scenes(scenes.v, 0 * scenes.r, scenes.labelled, ~always)
    estimate, _, error = phases(machine, silent, generator)
    gradient = torch.autograd.grad(estimate.mean(), list(machine.parameters()))
    by_name = dict(zip(dict(machine.named_parameters()), gradient, strict=True))
    assert not any(by_name[name].any() for name in by_name.keys() & {"d", "U", "g"})
    assert float(error.sum()) == 0
    assert by_name["b"].any()


@MACHINES
@pytest.mark.parametrize("temperature", [1.0, 2.0])
def test_a_sweep_leaves_the_distribution_as_it_is(kind, H2, temperature):
    """Total variation after a sweep of exact draws, against that of a second set of draws."""
    machine = tiny(kind, H2)
    states, generator = all_states(machine), torch.Generator().manual_seed(0)
    rows = units(states)
    p = (-machine.energy(states) / temperature).softmax(0).detach()
    code = 2.0 ** torch.arange(rows.shape[1]).double()
    order = (rows @ code).argsort()
    keys = (rows @ code)[order]

    def variation(drawn):
        counts = torch.bincount(torch.searchsorted(keys, drawn @ code), minlength=len(keys))
        return float((counts / len(drawn) - p[order]).abs().sum() / 2)

    n = 200_000
    draws = [torch.multinomial(p, n, replacement=True, generator=generator) for _ in range(2)]
    start = State(*(x[draws[0]] for x in vars(states).values()))
    free = Free(torch.ones_like(start.v).bool(), torch.ones_like(start.r).bool())
    with torch.no_grad():
        state, _, _ = machine.sweep(start, free, temperature, generator)
    assert variation(units(state)) < 1.5 * variation(rows[draws[1]])


def test_only_present_objects_are_related_and_a_related_object_can_leave():
    machine = tiny(Triway, 0, scale=0.0)
    ones = torch.ones(2_000, V).double(), torch.ones(2_000, T).double()
    state = State(*ones, torch.zeros(2_000, H1).double(), torch.zeros(2_000, 0).double())
    free, generator = Free(ones[0].bool(), ones[1].bool()), torch.Generator().manual_seed(0)
    state, object_p, _ = machine.sweep(state, free, 1.0, generator)
    assert bool((object_p == 1).all())
    for _ in range(30):
        state, _, _ = machine.sweep(state, free, 1.0, generator)
        assert bool((state.r <= machine.gate(state.v)).all())
    # 4, 1, 4 and 1 states of r for the four states of v: (1, 1) has 8, (0, 1) has 2, others 1.
    assert float((state.v.sum(1) == 0).double().mean()) == pytest.approx(1 / 12, abs=0.03)


def test_units_that_are_not_free_stay():
    machine = tiny(GBM, 1)
    state = State(
        torch.ones(9, V).double(), torch.zeros(9, T).double(), *torch.zeros(2, 9, 1).double()
    )
    state = State(state.v, state.r, torch.zeros(9, H1).double(), state.h2)
    free = Free(torch.zeros(9, V).bool(), torch.zeros(9, T).bool())
    after, _, _ = machine.sweep(state, free, 1.0, torch.Generator().manual_seed(0))
    assert torch.equal(after.v, state.v)
    assert torch.equal(after.r, state.r)


def few_scenes() -> Scenes:
    v = torch.tensor([[1.0, 1.0], [1.0, 0.0]])
    r = torch.tensor([[1.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    return Scenes(v, r, r.sum(1), torch.tensor([True, False]))


def test_the_error_is_a_sum_over_units():
    """All probabilities are 0: each present object and each listed relation counts 1."""
    machine = tiny(RBM, 0, scale=0.0).float()
    machine.b.data.fill_(-50.0)
    machine.d.data.fill_(-50.0)
    _, objects, relations = phases(machine, few_scenes(), torch.Generator().manual_seed(0))
    assert objects.tolist() == [2, 1]
    assert relations.tolist() == [2, 0]


class Parts:
    train = validation = few_scenes()


def test_training_stops_early_and_keeps_the_best_weights(monkeypatch):
    scores = iter([3.0, 1.0, *[2.0] * 100])
    monkeypatch.setattr("training.seed.learning.errors", lambda *_: (next(scores), 0.0))
    machine = tiny(RBM, 0).float()
    weights = []

    def keep(*_):
        weights.append(machine.b.detach().clone())

    history = train(machine, Parts, torch.Generator().manual_seed(0), keep)
    assert len(history) == 2 + PATIENCE
    assert torch.equal(machine.b, weights[1])
    monkeypatch.setattr("training.seed.learning.errors", lambda *_: (math.nan, 0.0))
    with pytest.raises(FloatingPointError, match="diverged in epoch 1"):
        train(machine, Parts, torch.Generator().manual_seed(0), keep)
