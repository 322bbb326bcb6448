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
from training.evaluation.density_task import (
    DensitySettings,
    Ising,
    State,
    independent_density,
    log_partition,
    machine_density,
)

TRAIN = tensors([scene([0]), scene([0, 1]), scene([1]), scene([0, 1])], 2)
SETTINGS = DensitySettings(chains=200, temperatures=200, burn_in=50)


def one_layer(name: str):
    """A machine with one hidden layer, and training scenes of its classes."""
    machine = small_machine(name).float()
    return machine, tensors([scene([0]), scene([0, 1]), scene([1])], machine.spec.V)


@pytest.mark.parametrize("name", ONE_LAYER)
def test_log_likelihoods_are_those_of_the_joint(name):
    machine, train = one_layer(name)
    joint = enumerate_joint(small_machine(name))
    density = machine_density(machine, train, SETTINGS)
    for v in binary(machine.spec.V):
        exact = joint.log_sum(same(joint.v, v))
        ours = density.log_unnormalised(v.float().unsqueeze(0))
        assert float(ours) == pytest.approx(exact, abs=1e-4)


@pytest.mark.parametrize("name", ONE_LAYER)
def test_the_partition_function_lies_between_its_estimates(name):
    """Within 5 standard errors; the bounds are in expectation, so each is allowed .02 of slack."""
    machine, train = one_layer(name)
    exact = enumerate_joint(small_machine(name)).log_z
    below, above = log_partition(machine, train, SETTINGS)
    assert below.log_z == pytest.approx(exact, abs=5 * below.standard_error + 1e-3)
    assert above.log_z == pytest.approx(exact, abs=5 * above.standard_error + 1e-3)
    assert below.bound - 0.02 <= exact <= above.bound + 0.02


@pytest.mark.parametrize("name", TWO_LAYERS)
def test_machines_with_two_layers_have_no_density_here(name):
    assert machine_density(small_machine(name), TRAIN, SETTINGS) is None


def test_independent_classes_by_hand():
    """Frequencies (3.5/5, 3.5/5) after smoothing."""
    density = independent_density(TRAIN)
    p = 3.5 / 5
    value = density.log_unnormalised(torch.tensor([[1.0, 0]]))
    assert float(value) == pytest.approx(math.log(p) + math.log(1 - p))


def small_ising(V: int = 6) -> Ising:
    rng = np.random.default_rng(0)
    half = np.triu(rng.normal(0, 1, (V, V)), 1)
    return Ising(rng.normal(-0.5, 1, V), half + half.T)


def test_the_pairwise_model_by_enumeration():
    """Its conditionals are logistic in the others; log Z lies within 5 standard errors."""
    model = small_ising()
    V = len(model.b)
    every = binary(V).float()
    values = model.log_unnormalised(every)
    on = every.clone()
    on[:, 2] = 1.0
    off = on.clone()
    off[:, 2] = 0.0
    ratio = model.log_unnormalised(on) - model.log_unnormalised(off)
    logits = model.b[2] + every.double().numpy() @ model.W[:, 2]
    assert ratio.numpy() == pytest.approx(logits)
    exact = float(values.logsumexp(0))
    start = torch.zeros(400, V)
    base = np.linspace(-1.5, 1.0, V)
    below, above = model.log_partition(base, start, np.linspace(0, 1, 200).tolist(), 50, 0)
    assert below.log_z == pytest.approx(exact, abs=5 * below.standard_error)
    assert above.log_z == pytest.approx(exact, abs=5 * above.standard_error)
    assert below.bound - 0.02 <= exact <= above.bound + 0.02


@pytest.mark.parametrize("beta", [0.0, 0.5, 1.0])
def test_sweeps_sample_between_independent_classes_and_the_pairwise_model(beta):
    """Marginals of p ∝ base^(1 - β) model^β: 2,000 chains, within 5 standard errors (.056)."""
    model = small_ising()
    every = binary(len(model.b)).float()
    base = np.linspace(-1.5, 1.0, len(model.b))
    log_p = beta * model.log_unnormalised(every) + (1 - beta) * (every @ torch.tensor(base).float())
    p = log_p.softmax(0)
    exact = (p.unsqueeze(1) * every).sum(0).numpy()
    rng = np.random.default_rng(1)
    state = State(model, np.zeros((len(model.b), 2000)))
    for _ in range(50):
        state.sweep(base, beta, rng)
    assert state.v.mean(1) == pytest.approx(exact, abs=0.056)
    assert state.field == pytest.approx(model.W @ state.v)


def test_edges_must_be_symmetric():
    with pytest.raises(ValueError, match="symmetric"):
        Ising(np.zeros(2), np.array([[0.0, 1], [2, 0]]))
    with pytest.raises(ValueError, match=r"\(2, 2\)"):
        Ising(np.zeros(2), np.zeros((3, 3)))
