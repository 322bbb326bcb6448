"""Log-likelihoods of small machines against the enumerated joint."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tests.enumeration.small_machines import (
    ONE_LAYER,
    TWO_LAYERS,
    binary,
    enumerate_joint,
    same,
    small_machine,
)
from tests.training.evaluation.scenes import scene, tensors
from training.evaluation import density_task
from training.evaluation.density_task import independent_density, ising_machine, machine_density

TRAIN = tensors([scene([0]), scene([0, 1]), scene([1]), scene([0, 1])], 2)


@pytest.fixture(autouse=True)
def _effort(monkeypatch):
    for name, value in (("CHAINS", 200), ("TEMPERATURES", 200), ("BURN_IN", 50)):
        monkeypatch.setattr(density_task, name, value)


def check_log_z(density, exact):
    """Within 5 standard errors; the bounds are in expectation, so each is allowed .02 of slack."""
    for direction in ("AIS", "reverse AIS"):
        error = 5 * density.notes[f"standard error, {direction}"] + 1e-3
        assert density.notes[f"log Z, {direction}"] == pytest.approx(exact, abs=error)
    assert density.lower - 0.02 <= exact <= density.upper + 0.02


@pytest.mark.parametrize("name", ONE_LAYER)
def test_log_likelihoods_are_those_of_the_joint(name):
    machine = small_machine(name).float()
    train = tensors([scene([0]), scene([0, 1]), scene([1])], machine.spec.V)
    joint = enumerate_joint(small_machine(name))
    density = machine_density(machine, train)
    for v in binary(machine.spec.V):
        exact = joint.log_sum(same(joint.v, v))
        ours = density.log_unnormalised(v.float().unsqueeze(0))
        assert float(ours) == pytest.approx(exact, abs=1e-4)
    check_log_z(density, joint.log_z)


@pytest.mark.parametrize("name", TWO_LAYERS)
def test_machines_with_two_layers_have_no_density(name):
    assert machine_density(small_machine(name), TRAIN) is None


def test_independent_classes_by_hand():
    """Frequencies (3.5/5, 3.5/5) after smoothing."""
    density = independent_density(TRAIN)
    p = 3.5 / 5
    value = density.log_unnormalised(torch.tensor([[1.0, 0]]))
    assert float(value) == pytest.approx(math.log(p) + math.log(1 - p))


def test_the_pairwise_model_by_enumeration():
    """log Z and -F have log 2 of the hidden unit without weights in common."""
    rng = np.random.default_rng(0)
    half = np.triu(rng.normal(0, 1, (6, 6)), 1)
    b, W = (torch.tensor(x).float() for x in (rng.normal(-0.5, 1, 6), half + half.T))
    every = binary(6).float()
    log_p = every @ b + ((every @ W) * every).sum(1) / 2 + math.log(2)
    train = tensors([scene([k, 5]) for k in range(5)], 6)
    density = machine_density(ising_machine(b, W), train)
    torch.testing.assert_close(density.log_unnormalised(every), log_p)
    check_log_z(density, float(log_p.logsumexp(0)))
