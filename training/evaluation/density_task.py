"""Density: log-likelihood of the objects of a scene.

Annealed importance sampling (AIS) bounds the log partition function, log Z. All classes of the
vocabulary count, including structure. A class that a scene does not list is absent. The room type
is unobserved, and the base rates are those of the served mix. Relations do not affect p(v). For a
machine with one hidden layer,

    log p(v) = -F(v) - log Z

is exact up to log Z. The upper estimate of log Z lowers the log-likelihood. The reported
log-likelihood is therefore conservative. Machines with two hidden layers are left out.

The pairwise model is the fully visible Boltzmann machine (Ising model) of classes:
p(v) = exp(b·v + v'Wv / 2) / Z with symmetric W and zero diagonal. The annealing path starts at
beta = 0 with independent classes of log-odds a, where log Z has a closed form. The path ends at
beta = 1 with the model. At any other beta, the biases are (1 - beta) a + beta b, and the pairwise
weights are beta W. One Gibbs sweep updates each class once.

Source: Neal, "Annealed importance sampling" (2001), run in both directions as in
`training.machines.partition`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor
from torch.nn.functional import logsigmoid

from training.datasets.array_types import Floats, Rng
from training.datasets.batches import SceneTensors
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.model import Model, ObjectDensity
from training.evaluation.setting import Outcome, Setting
from training.machines import BoltzmannMachine
from training.machines.gibbs import start_chains, sweep
from training.machines.partition import LogPartition, ais, reverse_ais


@dataclass(frozen=True)
class DensitySettings:
    """Number of samples and sweeps of the density estimates.

    Attributes:
        chains: number of Gibbs chains of each AIS run.
        temperatures: number of inverse temperatures of each AIS run.
        burn_in: number of Gibbs sweeps from training scenes before the reverse AIS run.
    """

    chains: int = 128
    temperatures: int = 1000
    burn_in: int = 500

    def betas(self) -> list[float]:
        """Return inverse temperatures from 0 to 1, denser near 1, where p(v) changes most."""
        return [float(x) for x in 1 - np.linspace(1.0, 0.0, self.temperatures) ** 2]


def independent_density(train: SceneTensors) -> ObjectDensity:
    """Return the density of independent classes at their smoothed training frequencies."""
    logits = _class_log_odds(train)

    def log_p(v: Tensor) -> Tensor:
        return torch.where(v > 0, logsigmoid(logits), logsigmoid(-logits)).sum(1)

    return ObjectDensity(log_p, 0.0, 0.0)


def ising_density(
    b: Tensor,
    W: Tensor,
    train: SceneTensors,
    settings: DensitySettings = DensitySettings(),
    seed: int = 0,
) -> ObjectDensity:
    """Return the density of a pairwise model with biases b (V,) and pairwise weights W (V, V)."""
    model = Ising(b.double().numpy(), W.double().numpy())
    generator = torch.Generator().manual_seed(seed)
    start = torch.randint(len(train), (settings.chains,), generator=generator)
    base = _class_log_odds(train).double().numpy()
    below, above = model.log_partition(
        base, train.v[start], settings.betas(), settings.burn_in, seed
    )
    return _density(model.log_unnormalised, below, above)


def machine_density(
    machine: BoltzmannMachine,
    train: SceneTensors,
    settings: DensitySettings = DensitySettings(),
    seed: int = 0,
) -> ObjectDensity | None:
    """Return the density of a machine with one hidden layer, or None for two layers.

    Annealing starts at independent classes with the frequencies of the training scenes. The Gibbs
    chains of the reverse run start at these scenes.
    """
    if machine.spec.H2:
        return None
    below, above = log_partition(machine, train, settings, seed)
    return _density(lambda v: -machine.free_energy(v), below, above)


def _density(
    log_unnormalised: Callable[[Tensor], Tensor], below: LogPartition, above: LogPartition
) -> ObjectDensity:
    notes = {
        "log Z, AIS": below.log_z,
        "standard error, AIS": below.standard_error,
        "log Z, reverse AIS": above.log_z,
        "standard error, reverse AIS": above.standard_error,
    }
    # The mean log weights are bounds of log Z in expectation for any spread of the weights.
    return ObjectDensity(log_unnormalised, below.bound, above.bound, notes)


@torch.no_grad()
def log_partition(
    machine: BoltzmannMachine, train: SceneTensors, settings: DensitySettings, seed: int = 0
) -> tuple[LogPartition, LogPartition]:
    """Run forward and reverse AIS for the objects of a machine."""
    generator = torch.Generator().manual_seed(seed)
    betas = settings.betas()
    base = _class_log_odds(train)
    below = ais(machine, betas, settings.chains, generator, base)
    start = torch.randint(len(train), (settings.chains,), generator=generator)
    chains = start_chains(machine, train.v[start], generator)
    for _ in range(settings.burn_in):
        sweep(machine, chains, generator)
    return below, reverse_ais(machine, betas, chains, generator, base)


def _class_log_odds(train: SceneTensors) -> Tensor:
    count = train.v.sum(0)
    return ((count + 0.5) / (len(train) - count + 0.5)).log()


def density_task(model: Model, setting: Setting) -> Outcome | None:
    """Measure the log-likelihood of the objects in nats, with the lower and upper log Z."""
    density = model.density(setting) if model.density else None
    if density is None or setting.train is None:
        return None
    scenes = setting.some()
    log_sum = density.log_unnormalised(scenes.v).double().numpy()
    base = independent_density(setting.train).log_unnormalised(scenes.v).double().numpy()
    metrics: dict[str, Metric] = {
        "log-likelihood, upper log Z": Ratio.of_scenes(log_sum - density.upper),
        "log-likelihood, lower log Z": Ratio.of_scenes(log_sum - density.lower),
        "log-likelihood, independent classes": Ratio.of_scenes(base),
        "gain over independent classes, upper log Z": Ratio.of_scenes(
            log_sum - density.upper - base
        ),
    }
    notes = {"log Z, upper": density.upper, "log Z, lower": density.lower} | density.notes
    return Outcome.over(scenes, metrics, 0, notes)


@dataclass(frozen=True, eq=False)
class Ising:
    """A fully visible Boltzmann machine with biases b (V,) and pairwise weights W (V, V).

    Raises:
        ValueError: the shapes of b and W disagree, or W is not symmetric with a zero diagonal.
    """

    b: Floats
    W: Floats

    def __post_init__(self) -> None:
        V = len(self.b)
        if self.W.shape != (V, V):
            raise ValueError(f"W must be ({V}, {V}), not {self.W.shape}")
        if np.diagonal(self.W).any() or not np.allclose(self.W, self.W.T):
            raise ValueError("W must be symmetric with a zero diagonal")

    def log_unnormalised(self, v: Tensor) -> Tensor:
        """Return b·v + v'Wv / 2, (B,), for presence (B, V)."""
        x = v.double()
        W = torch.from_numpy(self.W)
        return x @ torch.from_numpy(self.b) + ((x @ W) * x).sum(1) / 2

    def log_partition(
        self, a: Floats, start: Tensor, betas: Sequence[float], burn_in: int, seed: int
    ) -> tuple[LogPartition, LogPartition]:
        """Run forward and reverse annealing with one chain per row of `start`.

        Args:
            a: (V,) log-odds of the independent classes at beta = 0.
            start: (chains, V) initial presence of the reverse chains.
            betas: inverse temperatures, increasing from 0 to 1.
            burn_in: number of sweeps of the reverse chains at beta = 1 before annealing.
        """
        rng = np.random.default_rng(seed)
        log_base = float(np.logaddexp(0, a).sum())
        chains = len(start)
        state = State(self, (rng.random((len(a), chains)) < expit(a)[:, None]).astype(float))
        weight = np.zeros(chains)
        for warm, cold in pairwise(betas):
            weight += (cold - warm) * state.gain(a)
            state.sweep(a, cold, rng)
        below = LogPartition.of_weights(log_base, torch.from_numpy(weight))
        state = State(self, start.double().numpy().T.copy())
        for _ in range(burn_in):
            state.sweep(a, 1.0, rng)
        weight = np.zeros(chains)
        for warm, cold in zip(betas[-2::-1], betas[:0:-1], strict=True):
            state.sweep(a, cold, rng)
            weight -= (cold - warm) * state.gain(a)
        return below, LogPartition.of_weights(log_base, torch.from_numpy(weight), reverse=True)


class State:
    """The states of all Gibbs chains, (classes, chains).

    The class axis comes first, so that the values of one class are contiguous in memory.
    """

    def __init__(self, model: Ising, v: Floats) -> None:
        self.model = model
        self.v = v
        self.field = model.W @ v

    def gain(self, a: Floats) -> Floats:
        """Return the log ratio of the pairwise model to independent classes, (chains,)."""
        linear = (self.model.b - a) @ self.v
        return np.asarray(linear + (self.field * self.v).sum(0) / 2)

    def sweep(self, a: Floats, beta: float, rng: Rng) -> None:
        """Sample each class once given the other classes, at the inverse temperature `beta`."""
        uniform = rng.random(self.v.shape)
        logits = np.log(uniform) - np.log1p(-uniform)
        bias = (1 - beta) * a + beta * self.model.b
        for i, (logit, old) in enumerate(zip(logits, self.v, strict=True)):
            new = logit < bias[i] + beta * self.field[i]
            changed = np.flatnonzero(new != old)
            if len(changed):
                self.field[:, changed] += np.outer(self.model.W[i], new[changed] - old[changed])
                self.v[i] = new
