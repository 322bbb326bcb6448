"""The scorer against softplus differences in float64, for ordinary and for absurd weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from app.inference.objects import ContextScorer

SIZES = st.integers(1, 40)
SEEDS = st.integers(0, 2**32)
# The largest |W| decides how many factors share a log: 1, some, all of them, or no products at all.
WEIGHTS = st.sampled_from([0.0, 1e-3, 1.0, 5.0, 12.0, 17.0, 40.0, 63.9, 64.1, 88.0, 200.0, 1e4])
LOGITS = st.sampled_from([0.0, 1.0, 10.0, 17.0, 60.0, 88.0, 89.0, 95.0, 104.0, 1e4])


def gains(W, x):
    """Of rows x (B, H1), (B, V)."""
    scorer = ContextScorer(W.numpy())
    return torch.from_numpy(scorer.gain(x.numpy()))


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


@given(
    V=SIZES,
    H1=SIZES,
    rows=st.integers(1, 5),
    weight=WEIGHTS,
    logit=LOGITS,
    are_corners=st.booleans(),
    seed=SEEDS,
)
def test_gain_is_exact_to_float32_rounding(V, H1, rows, weight, logit, are_corners, seed):
    """At the corners every weight is ±weight and every logit ±logit, so that whole groups of
    factors are extreme at once."""
    generator = torch.Generator().manual_seed(seed)
    W, x = uniform((V, H1), weight, generator), uniform((rows, H1), logit, generator)
    if are_corners:
        W, x = W.sign() * weight, x.sign() * logit
    for weights in (W, W.abs(), -W.abs()):
        for logits in (x, x.abs(), -x.abs()):
            close_to_exact(gains(weights, logits), logits, weights)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_weights_that_are_not_finite_are_refused(value):
    W = torch.zeros(2, 3)
    W[1, 2] = value
    with pytest.raises(ValueError, match="weights must be finite"):
        ContextScorer(W.numpy())


@pytest.mark.parametrize("shape", [(4,), (3, 1), ()])
def test_logits_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match=r"x must have the shape \(\.\.\., 3\)"):
        ContextScorer(np.ones((2, 3), np.float32)).gain(np.zeros(shape))
