"""Density: log-likelihood of the objects of a scene.

Annealed importance sampling (AIS) bounds the log partition function, log Z. All classes of the
vocabulary count, including structure. A class that a scene does not list is absent. The room type
is unobserved, and the base rates are those of the served mix. Relations do not affect p(v). For a
machine with one hidden layer,

    log p(v) = -F(v) - log Z

is exact up to log Z. The upper estimate of log Z lowers the log-likelihood. The reported
log-likelihood is therefore conservative. Machines with two hidden layers are left out.

Source: Neal, "Annealed importance sampling" (2001), run in both directions as in
`training.machines.partition`.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from training.datasets.batches import SceneTensors
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.model import DensityOf, ObjectDensity
from training.evaluation.setting import Outcome, Setting
from training.machines import BoltzmannMachine, MachineSpec, build
from training.machines.gibbs import start_chains, sweep
from training.machines.partition import LogPartition, ais, reverse_ais

CHAINS = 128
"""Number of Gibbs chains of each AIS run."""

TEMPERATURES = 1000
"""Number of inverse temperatures of each AIS run."""

BURN_IN = 500
"""Number of Gibbs sweeps from training scenes before the reverse AIS run."""


def independent_density(train: SceneTensors) -> ObjectDensity:
    """Return the density of independent classes at their smoothed training frequencies."""
    logits = _class_log_odds(train)

    def log_p(v: Tensor) -> Tensor:
        return torch.where(v > 0, logsigmoid(logits), logsigmoid(-logits)).sum(1)

    return ObjectDensity(log_p, 0.0, 0.0)


@torch.no_grad()
def ising_machine(b: Tensor, W: Tensor) -> BoltzmannMachine:
    """Return the pairwise model p(v) = exp(b·v + v'Wv / 2) / Z, with b (V,) and W (V, V).

    It is a machine with couplings whose hidden unit has no weights. W is symmetric and has a zero
    diagonal.
    """
    machine = build(MachineSpec("rbm", V=len(b), A=1, units=1, coupled=True))
    machine.b.copy_(b)
    machine.L.copy_(W)
    return machine.requires_grad_(False)


def machine_density(
    machine: BoltzmannMachine, train: SceneTensors, seed: int = 0
) -> ObjectDensity | None:
    """Return the density of a machine with one hidden layer, or None for two layers.

    Annealing starts at independent classes with the frequencies of the training scenes. The Gibbs
    chains of the reverse run start at these scenes.
    """
    if machine.spec.H2:
        return None
    below, above = log_partition(machine, train, seed)
    notes = {
        "log Z, AIS": below.log_z,
        "standard error, AIS": below.standard_error,
        "log Z, reverse AIS": above.log_z,
        "standard error, reverse AIS": above.standard_error,
    }
    # The mean log weights are bounds of log Z in expectation for any spread of the weights.
    return ObjectDensity(lambda v: -machine.free_energy(v), below.bound, above.bound, notes)


@torch.no_grad()
def log_partition(
    machine: BoltzmannMachine, train: SceneTensors, seed: int
) -> tuple[LogPartition, LogPartition]:
    """Run forward and reverse AIS for the objects of a machine."""
    generator = torch.Generator().manual_seed(seed)
    # Denser near 1, where p(v) changes most.
    betas = (1 - np.linspace(1.0, 0.0, TEMPERATURES) ** 2).tolist()
    base = _class_log_odds(train)
    below = ais(machine, betas, CHAINS, generator, base)
    start = torch.randint(len(train), (CHAINS,), generator=generator)
    chains = start_chains(machine, train.v[start], generator)
    for _ in range(BURN_IN):
        sweep(machine, chains, generator)
    return below, reverse_ais(machine, betas, chains, generator, base)


def _class_log_odds(train: SceneTensors) -> Tensor:
    count = train.v.sum(0)
    return ((count + 0.5) / (len(train) - count + 0.5)).log()


def density_task(density_of: DensityOf, setting: Setting) -> Outcome | None:
    """Measure the log-likelihood of the objects in nats, with the lower and upper log Z."""
    density = density_of(setting)
    if density is None or setting.train is None:
        return None
    scenes = setting.some()
    log_sum = density.log_unnormalised(scenes.v).double().numpy()
    base = independent_density(setting.train).log_unnormalised(scenes.v).double().numpy()
    values = {
        "log-likelihood, upper log Z": log_sum - density.upper,
        "log-likelihood, lower log Z": log_sum - density.lower,
        "log-likelihood, independent classes": base,
        "gain over independent classes, upper log Z": log_sum - density.upper - base,
    }
    metrics: dict[str, Metric] = {name: Ratio.of_scenes(value) for name, value in values.items()}
    notes = {"log Z, upper": density.upper, "log Z, lower": density.lower} | density.notes
    return Outcome.over(scenes, metrics, 0, notes)
