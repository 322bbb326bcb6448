"""The scorer against softplus differences in float64, for ordinary and for absurd weights."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from app.boltzmann import MachineSpec, build
from app.boltzmann.log_odds import object_log_odds
from app.boltzmann.mean_field import Evidence, mean_field
from app.boltzmann.scoring import ContextScorer

SIZES = st.integers(1, 40)
SEEDS = st.integers(0, 2**32)
# The largest |W| decides how many factors share a log: 1, some, all of them, or no products at all.
WEIGHTS = st.sampled_from([0.0, 1e-3, 1.0, 5.0, 12.0, 40.0, 63.9, 64.1, 90.0, 1e4])
LOGITS = st.sampled_from([0.0, 1.0, 10.0, 60.0, 85.0, 95.0, 110.0, 1e4])


def machine_with(W):
    machine = build(MachineSpec("rbm", V=W.shape[0], A=1, H1=W.shape[1])).requires_grad_(False)
    machine.W.copy_(W)
    return machine


def uniform(shape, largest, generator):
    return (2 * torch.rand(shape, generator=generator) - 1) * largest


def exact_gain(x, W):
    """Softplus differences in float64, (B, V)."""
    x, W = x.double().unsqueeze(1), W.double()
    zero = torch.zeros((), dtype=torch.float64)
    return (torch.logaddexp(zero, x + W) - torch.logaddexp(zero, x)).sum(-1)


def close_to_exact(gain, x, W):
    # Each factor is good to some float32 roundings, and there are H1 of them.
    torch.testing.assert_close(gain.double(), exact_gain(x, W), rtol=1e-5, atol=4e-7 * W.shape[1])


@given(V=SIZES, H1=SIZES, rows=st.integers(1, 5), weight=WEIGHTS, logit=LOGITS, seed=SEEDS)
def test_gain_is_exact_to_float32_rounding(V, H1, rows, weight, logit, seed):
    generator = torch.Generator().manual_seed(seed)
    W, x = uniform((V, H1), weight, generator), uniform((rows, H1), logit, generator)
    close_to_exact(ContextScorer(machine_with(W)).gain(x), x, W)


@given(
    V=SIZES,
    H1=SIZES,
    weight=st.sampled_from([17.0, 20.0, 64.0, 80.0, 88.0, 200.0]),
    logit=st.sampled_from([17.0, 88.0, 89.0, 104.0, 200.0]),
    seed=SEEDS,
)
def test_gain_neither_overflows_nor_cancels_at_the_corners(V, H1, weight, logit, seed):
    """Every weight ±weight, every logit ±logit: whole groups of factors are extreme at once."""
    generator = torch.Generator().manual_seed(seed)
    W = weight * torch.randint(0, 2, (V, H1), generator=generator).mul(2).sub(1.0)
    x = logit * torch.randint(0, 2, (2, H1), generator=generator).mul(2).sub(1.0)
    for signs in (W, W.abs(), -W.abs()):
        for logits in (x, x.abs(), -x.abs()):
            close_to_exact(ContextScorer(machine_with(signs)).gain(logits), logits, signs)


@given(V=SIZES, H1=SIZES, rows=st.integers(2, 70), weight=st.sampled_from([1.0, 90.0]), seed=SEEDS)
def test_a_row_alone_equals_the_row_in_a_batch_to_the_bit(V, H1, rows, weight, seed):
    generator = torch.Generator().manual_seed(seed)
    scorer = ContextScorer(machine_with(uniform((V, H1), weight, generator)))
    x = uniform((rows, H1), 8.0, generator)
    alone = torch.cat([scorer.gain(row.clone()) for row in x.split(1)])
    assert torch.equal(scorer.gain(x), alone)


def test_an_object_with_no_weight_gains_nothing():
    """0 up to the rounding of sigmoid(-x) + sigmoid(x), whatever the padding of the last group."""
    gain = ContextScorer(machine_with(torch.zeros(3, 17))).gain(torch.randn(4, 17))
    torch.testing.assert_close(gain, torch.zeros(4, 3), rtol=0, atol=1e-5)


@pytest.mark.parametrize("layers", [0, 5])
def test_scores_equal_the_log_odds_of_the_machine(layers):
    spec = MachineSpec("triway", V=30, A=2, H1=21, H2=layers, K=2, form="local")
    generator = torch.Generator().manual_seed(1)
    machine = build(spec).initialise(generator, scale=1.0).requires_grad_(False)
    machine.b.normal_(generator=generator)
    evidence = Evidence((torch.rand(3, 30, generator=generator) < 0.2).float())
    scores = machine.b + ContextScorer(machine).gain(mean_field(machine, evidence).y)
    torch.testing.assert_close(scores, object_log_odds(machine, evidence), rtol=1e-5, atol=1e-5)


def test_the_scorer_keeps_the_weights_it_was_built_from():
    machine = machine_with(torch.ones(2, 3))
    scorer = ContextScorer(machine)
    before = scorer.gain(torch.zeros(1, 3))
    machine.W.zero_()
    assert torch.equal(scorer.gain(torch.zeros(1, 3)), before)


def test_gains_can_take_part_in_later_arithmetic_with_gradients():
    """Not inference tensors: those may not enter a graph."""
    gain = ContextScorer(machine_with(torch.ones(2, 3))).gain(torch.zeros(1, 3))
    b = torch.zeros(2, requires_grad=True)
    (b * gain).sum().backward()
    assert torch.equal(b.grad, gain[0])


def test_no_scene_gives_no_row():
    assert ContextScorer(machine_with(torch.ones(2, 3))).gain(torch.zeros(0, 3)).shape == (0, 2)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_weights_that_are_not_finite_are_refused(value):
    W = torch.zeros(2, 3)
    W[1, 2] = value
    with pytest.raises(ValueError, match="W must be finite"):
        ContextScorer(machine_with(W))


@pytest.mark.parametrize("shape", [(3,), (1, 4), (1, 1, 3)])
def test_logits_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match=r"x must be \(B, 3\)"):
        ContextScorer(machine_with(torch.ones(2, 3))).gain(torch.zeros(shape))
