"""The sparse product of a binary v equals the dense one, at any density."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from training.machines.gibbs import presence_product


@given(
    chains=st.integers(0, 40),
    V=st.integers(1, 50),
    H=st.integers(1, 20),
    density=st.sampled_from([0.0, 0.03, 0.1, 0.13, 0.5, 1.0]),
    seed=st.integers(0, 2**32),
)
def test_equals_the_dense_product(chains, V, H, density, seed):
    generator = torch.Generator().manual_seed(seed)
    W = torch.randn(V, H, generator=generator, dtype=torch.float64)
    v = (torch.rand(chains, V, generator=generator) < density).double()
    torch.testing.assert_close(presence_product(v, W), v @ W)


def test_is_differentiable_in_the_weights():
    W = torch.ones(100, 3, requires_grad=True)
    v = torch.zeros(20, 100)
    v[:, 7] = 1
    presence_product(v, W).sum().backward()
    assert torch.equal(W.grad[7], torch.full((3,), 20.0))
    assert float(W.grad.sum()) == 60
