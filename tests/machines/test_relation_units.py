"""The compiled relation part against its formulas in double precision."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from app.inference.relations import Ends, SharedUnits, to_log_odds
from training.machines import MachineSpec, build
from training.machines.arrays import weights_of


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


@pytest.mark.parametrize("sigma", [0.0, 0.3, 0.74, 0.8, 2.0, 10.0])
def test_log_odds_of_normal_logits(sigma):
    mean = np.linspace(-25, 25, 201)
    found = to_log_odds(mean, np.full(len(mean), 3**0.5 * sigma, dtype=np.float32))
    t = np.linspace(-9, 9, 20_001)
    weight = np.exp(-0.5 * t**2) / np.exp(-0.5 * t**2).sum()
    on = sigmoid(mean[:, None] + sigma * t) @ weight
    np.testing.assert_allclose(sigmoid(found.astype(float)), on, atol=4e-4)
    # Log-odds keep their sign and their tails: those of -l are minus those of l.
    np.testing.assert_allclose(found, -found[::-1], rtol=1e-5, atol=1e-5)
    if sigma == 0:
        np.testing.assert_allclose(found, mean, rtol=1e-6, atol=1e-6)


def test_residuals_are_found_and_nothing_else():
    machine = build(MachineSpec("triway", V=40, A=4, H1=70, K=2, T=500, form="local"))
    rng = np.random.default_rng(0)
    keys = np.sort(rng.choice(4 * 40 * 40, 500, replace=False))
    machine.set_triples(torch.tensor(np.stack([keys // 1600, keys // 40 % 40, keys % 40], 1)))
    with torch.no_grad():
        machine.residual.copy_(torch.arange(1.0, 501.0))
    expected = np.zeros(4 * 40 * 40)
    expected[keys] = np.arange(1.0, 501.0)
    # All other weights are zero.
    for parameter in (machine.d, machine.s, machine.o, machine.S, machine.O):
        parameter.detach().zero_()
    a, i, j = (part.reshape(-1) for part in np.indices((4, 40, 40)))
    none = np.zeros(len(a), np.float32)
    units = SharedUnits(weights_of(machine)).select(a, Ends(i, j, none, none, none, none))
    np.testing.assert_array_equal(units.base, expected)
