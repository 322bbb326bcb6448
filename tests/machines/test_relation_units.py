"""Relations in the service: moments of logits, the quadrature, and implications by hand."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit

from app.inference.relation_units import (
    NEVER,
    ObservedRelations,
    encode,
    relation_units,
    to_log_odds,
)
from tests.enumeration.small_machines import implied_by_hand, random_weights, unit_states
from tests.questions.artifacts import random_machine
from training.machines import MachineSpec, build, weights_of

V, A = 6, 2


@pytest.mark.parametrize("sigma", [0.0, 0.3, 0.74, 0.8, 2.0, 10.0])
def test_log_odds_of_normal_logits(sigma):
    """The error in the probability is at most 0.0004."""
    mean = np.linspace(-25, 25, 201)
    found = to_log_odds(mean, np.full(len(mean), 3**0.5 * sigma, dtype=np.float32))
    t = np.linspace(-9, 9, 20_001)
    weight = np.exp(-0.5 * t**2) / np.exp(-0.5 * t**2).sum()
    on = expit(mean[:, None] + sigma * t) @ weight
    np.testing.assert_allclose(expit(found.astype(float)), on, atol=4e-4)
    # Log-odds keep their sign and their tails: those of -l are minus those of l.
    np.testing.assert_allclose(found, -found[::-1], rtol=1e-5, atol=1e-5)
    if sigma == 0:
        np.testing.assert_allclose(found, mean, rtol=1e-6, atol=1e-6)


SPECS = {
    "rbm": MachineSpec("rbm", V=V, A=A, units=4, states=3, T=40, C=2),
    "gbm": MachineSpec("gbm", V=V, A=A, units=6, T=40, C=2),
    "triway": MachineSpec("triway", V=V, A=A, units=6, K=2, T=40, C=2),
    "triway-states": MachineSpec("triway", V=V, A=A, units=4, states=4, K=2, T=40, C=2),
}
CLASSES, LOG_COUNTS = np.array([4, 0, 3]), np.log([1, 3, 2]).astype(np.float32)


def exact_logits(machine, v, room):
    """ℓ of every state of h1, (states, units), and p(state | v), (states,), by the tensors."""
    h1 = unit_states(machine.spec)
    x = machine.hidden_logits(v, torch.tensor([room]))
    p = (h1 @ x[0]).softmax(0)
    counts = torch.ones(V, dtype=torch.int64)
    counts[CLASSES] = torch.from_numpy(np.exp(LOG_COUNTS)).round().long()
    edges = machine.edges(torch.arange(V)[None], counts[None])
    grid = torch.full((len(h1), A, V, V), float(NEVER)).double()
    units = edges.relation[0], edges.subject[0], edges.object[0]
    grid[:, *units] = machine.relation_logits(edges, v.expand(len(h1), -1), h1)
    return grid, p


def moments(grid, p):
    mean = torch.einsum("s,saij->aij", p, grid)
    variance = torch.einsum("s,saij->aij", p, (grid - mean) ** 2)
    return mean.numpy(), variance.numpy()


def scene_of(machine, room):
    v = torch.zeros(1, V).double()
    v[0, CLASSES] = 1
    weights = weights_of(machine)
    ones = np.ones(len(CLASSES), np.float32)
    context = encode(weights, CLASSES, ones, LOG_COUNTS, None if room < 0 else room)
    return v, weights, context


@pytest.mark.parametrize("room", [-1, 1])
@pytest.mark.parametrize("name", SPECS)
def test_mean_and_variance_are_those_over_all_states_of_h1(name, room):
    """Of relations between listed classes, and of placements, in which a candidate is present."""
    machine = random_machine(SPECS[name], 0.8)
    v, weights, context = scene_of(machine, room)
    units, machine = relation_units(weights), machine.double()
    between = units.logits(context)
    grid = np.ix_(range(A), CLASSES, CLASSES)
    mean, variance = (m[grid] for m in moments(*exact_logits(machine, v, room)))
    np.testing.assert_allclose(between.mean, mean, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(between.spread**2 / 3, variance, rtol=1e-3, atol=1e-4)
    for candidate in (1, 5):
        v[0, candidate] = 1
        mean, variance = moments(*exact_logits(machine, v, room))
        v[0, candidate] = 0
        expected = to_log_odds(mean, np.sqrt(3 * variance).astype(np.float32))
        out, back = units.placement_log_odds(context, np.array([candidate]), np.arange(3))
        np.testing.assert_allclose(out[0], expected[:, candidate, CLASSES], atol=2e-3)
        np.testing.assert_allclose(back[0], expected[:, CLASSES, candidate], atol=2e-3)
        one, _ = units.placement_log_odds(context, np.array([candidate]), np.arange(3), only=1)
        np.testing.assert_allclose(one[0, 0], out[0, 1], rtol=1e-6)


@st.composite
def relations(draw):
    """(A, n, n) of one or two relations between up to 6 classes, from few to all of them."""
    A, n = draw(st.integers(1, 2)), draw(st.integers(0, V))
    density = draw(st.sampled_from([0.1, 0.4, 0.8, 1.0]))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**32)))
    return (torch.rand(A, n, n, generator=generator) < density).double()


def coupled_machine(A=1, states=2):
    """A Triway with every weight from N(0, 1)."""
    machine = build(MachineSpec("triway", V=V, A=A, units=3, states=states, K=2, C=2, G=2))
    return random_weights(machine, torch.Generator().manual_seed(0))


def in_service(machine, observed, n=V, room=None):
    """The relations between the first n classes in the service, given observed relations."""
    weights, ones = weights_of(machine), np.ones(n, np.float32)
    context = encode(weights, np.arange(n), ones, 0 * ones, room, observed)
    return relation_units(weights).logits(context)


@settings(max_examples=50)
@given(relations(), st.sampled_from([-1, 0, 1]), st.sampled_from([2, 4]))
def test_implications_equal_the_formula_by_hand(grid, room, states):
    """The tensors and the service, also without effects between relations of the same pair."""
    A, n, _ = grid.shape
    machine = coupled_machine(A, states)
    v = torch.zeros(1, V).double()
    v[0, :n] = 1
    padded = torch.zeros(A, V, V).double()
    padded[:, :n, :n] = grid
    a, i, j = (index.numpy() for index in grid.nonzero(as_tuple=True))
    observed = ObservedRelations(a, i, j, np.ones(len(a), np.float32))
    found = in_service(machine, observed, n, None if room < 0 else room)
    machine.double()
    h1 = machine.state_means(machine.hidden_logits(v, torch.tensor([room])))
    expected = implied_by_hand(machine, v[0], padded, room)
    edges = machine.edges(torch.arange(V).unsqueeze(0))
    ours = machine.implied(edges, padded.reshape(1, -1), h1)
    torch.testing.assert_close(ours.reshape(padded.shape), expected)
    alone = implied_by_hand(machine, v[0], padded, room, apart=True)
    between = ~np.eye(n, dtype=bool)
    for shift, law in ((found.shift, expected), (found.shift_by_others, alone)):
        law = law[:, :n, :n].numpy()[:, between]
        np.testing.assert_allclose(shift[:, between], law, rtol=1e-4, atol=1e-4)
