"""Draws have their probabilities, well below the 8 bits that decide most; sparse products."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from training.machines.bernoulli import bernoulli
from training.machines.gibbs import presence_product

DRAWS = 2_000_000
# Certain units, the middle of a byte, its edges, a tie's fraction alone, the last float below one.
PROBABILITIES = [0.0, 1e-6, 1e-4, 1 / 256, 0.1, 0.5, 0.7312, 255.5 / 256, 1 - 2**-24, 1.0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("p", PROBABILITIES)
def test_frequency(p, dtype):
    """Within 6 standard deviations and 10: by Bernstein fails by chance with probability < 1e-6.

    Certain units are certain.
    """
    generator = torch.Generator().manual_seed(3)
    drawn = bernoulli(torch.full((DRAWS,), p, dtype=dtype), generator)
    deviation = math.sqrt(DRAWS * p * (1 - p))
    assert drawn.dtype == dtype
    tolerance = 6 * deviation + 10 if 0 < p < 1 else 0
    assert abs(float(drawn.double().sum()) - DRAWS * p) <= tolerance


def test_neighbouring_draws_are_independent():
    """Draws share 64-bit words: no correlation at any lag within one, to 5 standard deviations."""
    generator = torch.Generator().manual_seed(5)
    drawn = bernoulli(torch.full((DRAWS,), 0.3), generator) - 0.3
    for lag in range(1, 17):
        correlation = float((drawn[:-lag] * drawn[lag:]).mean()) / 0.21
        assert abs(correlation) < 5 / math.sqrt(DRAWS)


@given(
    chains=st.integers(0, 40),
    V=st.integers(1, 50),
    H=st.integers(1, 20),
    density=st.sampled_from([0.0, 0.03, 0.1, 0.13, 0.5, 1.0]),
    seed=st.integers(0, 2**32),
)
def test_the_sparse_product_equals_the_dense_one(chains, V, H, density, seed):
    generator = torch.Generator().manual_seed(seed)
    W = torch.randn(V, H, generator=generator, dtype=torch.float64)
    v = (torch.rand(chains, V, generator=generator) < density).double()
    torch.testing.assert_close(presence_product(v, W), v @ W)
