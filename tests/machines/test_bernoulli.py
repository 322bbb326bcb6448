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
# The middle of a byte, its edges, a tie's fraction alone, and the least float32 below one.
PROBABILITIES = [1e-6, 1e-4, 1 / 256, 0.1, 0.5, 0.7312, 255.5 / 256, 1 - 2**-24]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("p", PROBABILITIES)
def test_frequency(p, dtype):
    """Within 6 standard deviations and 10: by Bernstein fails by chance with probability < 1e-6."""
    generator = torch.Generator().manual_seed(3)
    drawn = bernoulli(torch.full((DRAWS,), p, dtype=dtype), generator)
    deviation = math.sqrt(DRAWS * p * (1 - p))
    assert drawn.dtype == dtype
    assert abs(float(drawn.double().sum()) - DRAWS * p) < 6 * deviation + 10


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_certain_units_are_certain(dtype):
    generator = torch.Generator().manual_seed(4)
    assert float(bernoulli(torch.zeros(DRAWS, dtype=dtype), generator).max()) == 0
    assert float(bernoulli(torch.ones(DRAWS, dtype=dtype), generator).min()) == 1


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
