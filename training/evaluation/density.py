"""Log-likelihood of a scene's objects, with log Z by AIS from below and from above.

All classes of the vocabulary count, structure among them; what a scene does not list is absent, as
it is in training. The room type is withheld. In the local form relations drop out of p(v), so the
machine is annealed without them. With h1 drawn from its mean field q given the scene,

    log p(v) = log mean_h [ exp(b·v + h·(c1 + v'W)) prod_l (1 + exp(c2 + h'J)_l) / q(h) ] - log Z

The mean is unbiased, so its log is too low in expectation; with the upper estimate of log Z the
log-likelihood is conservative twice over.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, softplus

from training.batches import SceneTensors
from training.evaluation.ising import Ising
from training.machines import BoltzmannMachine, MachineSpec, build
from training.machines.draws import fixed_uniforms
from training.machines.gibbs import initial_state, run
from training.machines.mean_field import Evidence, mean_field
from training.machines.partition import LogPartition, ais, independent_base, reverse_ais
from training.trainer import log_odds_of

_BLOCK = 16


@dataclass(frozen=True)
class DensitySettings:
    """Effort of the estimates.

    Attributes:
        chains, temperatures: of either AIS run.
        burn_in: Gibbs sweeps from training scenes before the reverse run.
        draws: of h1 for one scene.
    """

    chains: int = 128
    temperatures: int = 4000
    burn_in: int = 2000
    draws: int = 256

    def betas(self) -> list[float]:
        """From 0 to 1, denser where the model is nearly itself: most of the change lies there."""
        return [float(x) for x in 1 - np.linspace(1.0, 0.0, self.temperatures) ** 2]


@dataclass(frozen=True, eq=False)
class ObjectDensity:
    """A density over presence vectors.

    Attributes:
        log_unnormalised: presence (B, V) -> (B,) log-likelihood + log Z.
        lower, upper: log Z from below and from above, equal where it is exact.
        notes: what is known of the two estimates.
    """

    log_unnormalised: Callable[[Tensor], Tensor]
    lower: float
    upper: float
    notes: dict[str, float] = field(default_factory=dict)


def independent_density(train: SceneTensors) -> ObjectDensity:
    """Independent classes at their smoothed frequency."""
    logits = _log_odds(train)

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
    """The density of a pairwise model with biases b (V,) and edges W (V, V).

    Raises:
        ValueError: see `Ising`.
    """
    model = Ising(b.double().numpy(), W.double().numpy())
    generator = torch.Generator().manual_seed(seed)
    start = torch.randint(len(train), (settings.chains,), generator=generator)
    base = _log_odds(train).double().numpy()
    below, above = model.log_partition(
        base, train.v[start], settings.betas(), settings.burn_in, seed
    )
    return _density(model.log_unnormalised, below, above)


def machine_density(
    machine: BoltzmannMachine,
    train: SceneTensors,
    settings: DensitySettings = DensitySettings(),
    seed: int = 0,
) -> ObjectDensity:
    """The density of a machine of the local form.

    Args:
        train: where the annealing starts (independent at these frequencies) and the samples of the
            reverse run come from.

    Raises:
        ValueError: the machine is of the seed form, whose relations do not drop out.
    """
    if machine.relations_act:
        raise ValueError("objects have a density of their own in the local form alone")
    objects = object_part(machine)
    below, above = log_partition(objects, train, settings, seed)

    def log_unnormalised(v: Tensor) -> Tensor:
        return torch.cat([_log_sum(objects, some, settings.draws) for some in v.split(_BLOCK)])

    return _density(log_unnormalised, below, above)


def _density(
    log_unnormalised: Callable[[Tensor], Tensor], below: LogPartition, above: LogPartition
) -> ObjectDensity:
    notes = {
        "log Z, AIS": below.log_z,
        "standard error, AIS": below.standard_error,
        "log Z, reverse AIS": above.log_z,
        "standard error, reverse AIS": above.standard_error,
    }
    # The means of the log weights: bounds in expectation whatever the spread of the weights.
    return ObjectDensity(log_unnormalised, below.bound, above.bound, notes)


def object_part(machine: BoltzmannMachine) -> BoltzmannMachine:
    """The machine without relation units: p(v) is the same in the local form."""
    spec = machine.spec
    part = build(MachineSpec("gbm", V=spec.V, A=1, H1=spec.H1, H2=spec.H2, form="local"))
    with torch.no_grad():
        for name in ("b", "c1", "c2", "W", "J"):
            part.get_parameter(name).copy_(machine.get_parameter(name))
    return part.requires_grad_(False)


@torch.no_grad()
def log_partition(
    machine: BoltzmannMachine, train: SceneTensors, settings: DensitySettings, seed: int = 0
) -> tuple[LogPartition, LogPartition]:
    """(forward, reverse) AIS of a machine without relation units."""
    generator = torch.Generator().manual_seed(seed)
    betas = settings.betas()
    base = independent_base(machine, _log_odds(train))
    below = ais(machine, betas, settings.chains, generator, base)
    start = torch.randint(len(train), (settings.chains,), generator=generator)
    state = initial_state(machine, train.v[start], generator)
    state = run(machine, state, generator, settings.burn_in)
    return below, reverse_ais(machine, betas, state, generator, base)


@torch.no_grad()
def _log_sum(machine: BoltzmannMachine, v: Tensor, draws: int) -> Tensor:
    """log of the sum over h1 and h2, (B,)."""
    if not machine.spec.H2:
        return -machine.free_energy(v)
    y = mean_field(machine, Evidence(v)).y
    h1 = (fixed_uniforms(draws, machine.spec.H1).to(y.dtype).unsqueeze(1) < y.sigmoid()).to(y.dtype)
    log_q = (h1 * logsigmoid(y) + (1 - h1) * logsigmoid(-y)).sum(-1)
    second = softplus(machine.second_layer_logits(h1)).sum(-1)
    target = v @ machine.b + (h1 * (machine.c1 + v @ machine.W)).sum(-1) + second
    return (target - log_q).logsumexp(0) - float(np.log(draws))


def _log_odds(train: SceneTensors) -> Tensor:
    return log_odds_of(train.v.sum(0), torch.tensor(float(len(train))))
