import itertools
import math

import pytest
import torch

from tests.enumeration.small_machines import check_frequencies, code
from training.seed.machines import (
    GBM,
    PATIENCE,
    RBM,
    Free,
    GatedRBM,
    Machine,
    State,
    Triway,
    phases,
    train,
)
from training.seed.scenes import Scenes

V, H1 = 2, 2
TRIPLES = torch.tensor([[0, 0, 1], [1, 1, 0], [2, 1, 1]])  # the last one relates a class to itself
T = len(TRIPLES)

MACHINES = pytest.mark.parametrize(
    ("kind", "H2"), [(RBM, 0), (RBM, 1), (GBM, 0), (GBM, 2), (Triway, 0), (Triway, 2)]
)
EXACT = pytest.mark.parametrize(("kind", "H2"), [(RBM, 0), (RBM, 1), (GBM, 0), (GBM, 2)])


def tiny(kind: type[Machine], H2: int, scale: float = 1.0) -> Machine:
    generator = torch.Generator().manual_seed(3)
    machine = kind(TRIPLES, V, H1, H2, generator).double()
    for weight in machine.parameters():
        weight.data = scale * torch.randn(weight.shape, generator=generator, dtype=torch.float64)
    return machine


def all_states(machine: Machine) -> State:
    sizes = [V, T, H1, len(machine.c2)]
    bits = torch.tensor(list(itertools.product([0.0, 1.0], repeat=sum(sizes)))).double()
    return State(*bits.split(sizes, 1))


def log_weight(machine: Machine, states: State, w: dict[str, torch.Tensor]) -> torch.Tensor:
    """-E of each state, term by term as in the docstring, with the weights w."""
    v, r, h1, h2 = states.v, states.r, states.h1, states.h2
    total = v @ w["b"] + h1 @ w["c1"] + h2 @ w["c2"]
    total = total + ((v @ w["W"]) * h1).sum(1) + ((h1 @ w["J"]) * h2).sum(1)
    for e, (_, i, j) in enumerate(TRIPLES.tolist()):
        logit = w["d"][e] + h1 @ w["U"][e]
        if isinstance(machine, GBM):
            logit = logit + w["g"][0, e] * v[:, i] + w["g"][1, e] * v[:, j]
        gate = v[:, i] * v[:, j] if isinstance(machine, Triway) else 1
        total = total + r[:, e] * gate * logit
    return total


def weights_of(machine: Machine) -> dict[str, torch.Tensor]:
    return dict(machine.named_parameters())


def units(state: State) -> torch.Tensor:
    return torch.cat([state.v, state.r, state.h1, state.h2], 1)


@MACHINES
def test_an_update_adds_the_gradient_of_the_energy(kind, H2):
    machine = tiny(kind, H2)
    states = all_states(machine)
    states = State(states.v, states.r * machine.gate(states.v), states.h1, states.h2)
    positive, negative = (State(*(x[k::2] for x in vars(states).values())) for k in (0, 1))
    before = {name: w.detach().clone().requires_grad_() for name, w in weights_of(machine).items()}
    difference = log_weight(machine, positive, before) - log_weight(machine, negative, before)
    gradient = torch.autograd.grad(difference.mean(), list(before.values()))
    machine.update(positive, negative, 0.7)
    for (name, w), own in zip(before.items(), gradient, strict=True):
        torch.testing.assert_close(weights_of(machine)[name].data, w.data + 0.7 * own)


@MACHINES
def test_conditionals_are_those_of_the_energy(kind, H2):
    """Each unit given all others: p = exp(-E on) / (exp(-E on) + exp(-E off)). In a Triway, this
    holds in the states without relations of absent objects. Such relations are off in each
    sample."""
    machine = tiny(kind, H2)
    states = all_states(machine)
    weights = log_weight(machine, states, weights_of(machine)).exp().tolist()
    joint = dict(zip(map(tuple, units(states).tolist()), weights, strict=True))
    gate = machine.gate(states.v)
    states = State(*(x[(states.r <= gate).all(1)] for x in vars(states).values()))
    everything = Free(torch.ones_like(states.v).bool(), torch.ones_like(states.r).bool())
    generator = torch.Generator().manual_seed(0)
    gate = machine.gate(states.v)
    stated = torch.cat(
        [
            machine.sample_objects(states, everything, 1.0, generator)[1],
            machine.relation_logits(states.v, states.h1).sigmoid(),
            machine.h1_logits(states.v, states.r, states.h2).sigmoid(),
            machine.h2_logits(states.h1).sigmoid(),
        ],
        1,
    )
    closed = torch.cat([0 * states.v, 1 - gate, 0 * states.h1, 0 * states.h2], 1).bool()
    for row, ps, skipped in zip(
        units(states).tolist(), stated.tolist(), closed.tolist(), strict=True
    ):
        for unit, p in enumerate(ps):
            off, on = (joint[(*row[:unit], x, *row[unit + 1 :])] for x in (0.0, 1.0))
            assert skipped[unit] or p == pytest.approx(on / (on + off))


@EXACT
def test_the_gradient_is_that_of_the_likelihood_in_the_limit(kind, H2):
    """With many negative sweeps; scenes without annotation have no part in relations."""
    machine = tiny(kind, H2, scale=0.6)
    states, own = all_states(machine), weights_of(machine)
    visible = torch.tensor([[1, 1, 1, 0, 1], [1, 0, 0, 0, 0], [1, 1, 0, 1, 0]]).double()
    leaves = {name: w.detach().clone().requires_grad_() for name, w in own.items()}
    log_p = log_weight(machine, states, leaves).log_softmax(0)
    seen = torch.cat([states.v, states.r], 1)
    mean = torch.stack([log_p[(seen == row).all(1)].logsumexp(0) for row in visible]).mean()
    exact = torch.autograd.grad(mean, list(leaves.values()))
    many = visible.repeat(20_000, 1)
    always = torch.ones(len(many), dtype=torch.bool)
    scenes = Scenes(many[:, :V], many[:, V:], many[:, V:].sum(1), always)
    positive, negative, _, _ = phases(machine, scenes, torch.Generator().manual_seed(1), steps=15)
    machine.update(positive, negative, 1.0)
    for name, gradient in zip(leaves, exact, strict=True):
        step = own[name].data - leaves[name].data
        torch.testing.assert_close(step, gradient, atol=0.012, rtol=0.0)  # 4 standard errors


@MACHINES
def test_scenes_without_annotation_have_no_part_in_relations(kind, H2):
    machine = tiny(kind, H2)
    v = torch.tensor([[1.0, 1.0], [1.0, 0.0]]).double()
    scenes = Scenes(v, torch.zeros(2, T).double(), torch.zeros(2), torch.zeros(2).bool())
    before = {name: w.clone() for name, w in weights_of(machine).items()}
    positive, negative, _, error = phases(machine, scenes, torch.Generator().manual_seed(1))
    machine.update(positive, negative, 1.0)
    changed = {name for name, w in weights_of(machine).items() if not torch.equal(w, before[name])}
    assert "W" in changed
    assert not changed & {"d", "U", "g"}
    assert float(error.sum()) == 0


@EXACT
@pytest.mark.parametrize("temperature", [1.0, 2.0])
def test_a_sweep_leaves_the_distribution_as_it_is(kind, H2, temperature):
    """The frequencies of states after a sweep of exact draws."""
    machine = tiny(kind, H2)
    states, generator = all_states(machine), torch.Generator().manual_seed(0)
    p = (log_weight(machine, states, weights_of(machine)) / temperature).softmax(0).detach()
    draws = torch.multinomial(p, 500_000, replacement=True, generator=generator)
    start = State(*(x[draws] for x in vars(states).values()))
    free = Free(torch.ones_like(start.v).bool(), torch.ones_like(start.r).bool())
    state, _, _ = machine.sweep(start, free, temperature, generator)
    keys = code(units(states))
    order = keys.argsort()
    check_frequencies(code(units(state)), keys[order], p.numpy()[order])


@pytest.mark.parametrize("kind", [GatedRBM, Triway])
def test_only_present_objects_are_related(kind):
    machine, generator = tiny(kind, 0), torch.Generator().manual_seed(0)
    ones = torch.ones(500, V).double(), torch.ones(500, T).double()
    state = State(*ones, torch.zeros(500, H1).double(), torch.zeros(500, 0).double())
    free = Free(ones[0].bool(), ones[1].bool())
    for _ in range(5):
        state, _, _ = machine.sweep(state, free, 1.0, generator)
        assert bool((state.r <= machine.gate(state.v)).all())
    assert 0 < float(state.v.mean()) < 1
    assert 0 < float(state.r.mean()) < 1


def test_units_that_are_not_free_stay():
    machine = tiny(GBM, 1)
    state = State(torch.ones(9, V).double(), *(torch.zeros(9, n).double() for n in (T, H1, 1)))
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
    *_, objects, relations = phases(machine, few_scenes(), torch.Generator().manual_seed(0))
    assert objects.tolist() == [2, 1]
    assert relations.tolist() == [2, 0]


class Parts:
    train = validation = few_scenes()


def test_training_stops_early_and_keeps_the_best_weights(monkeypatch):
    scores = iter([3.0, 1.0, *[2.0] * 100])
    machine = tiny(RBM, 0).float()
    weights = []

    def keep(*_):
        weights.append(machine.b.clone())
        return next(scores), 0.0

    monkeypatch.setattr("training.seed.machines.errors", keep)
    assert len(train(machine, Parts, torch.Generator().manual_seed(0))) == 2 + PATIENCE
    assert torch.equal(machine.b, weights[1])


def many_units(kind: type[Machine]) -> Machine:
    triples = torch.tensor([[0, i, i + 1] for i in range(39)])
    return kind(triples, 40, 20, 0, torch.Generator().manual_seed(0))


class SparseParts:
    v = torch.eye(40)[:16] + torch.eye(40)[1:17] + torch.eye(40)[2:18]
    r = torch.eye(39)[:16] + torch.eye(39)[1:17]
    train = validation = Scenes(v, r, r.sum(1), torch.ones(16, dtype=torch.bool))


@pytest.mark.parametrize("rate", [500.0, math.nan])
def test_a_large_learning_rate_diverges_and_the_error_names_weight_and_rate(rate):
    match = rf"epoch \d+: a weight of \w+ has the size .* Use a smaller learning rate than {rate:g}"
    with pytest.raises(FloatingPointError, match=match):
        train(many_units(Triway), SparseParts, torch.Generator().manual_seed(0), rate=rate)


def test_training_at_the_rate_of_the_paper_does_not_diverge():
    history = train(many_units(Triway), SparseParts, torch.Generator().manual_seed(0), epochs=100)
    assert history[-1].objects < history[0].objects / 2
    assert history[-1].relations < history[0].relations / 2
