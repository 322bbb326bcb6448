"""Benchmark of training: time of one step of the object fit, which asks for unlisted classes.

The fit computes the log-odds of all classes in closed form. The reference computes the same
log-odds from free energies. It needs two copies of each scene for each class: with the class, and
without.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import softplus

from benchmarks.report import Result
from benchmarks.timing import interleave
from benchmarks.yardsticks import object_machine, presence, random_scenes
from training.fit.configuration import ObjectsConfig
from training.fit.objects import ObjectFit, ObjectScenes, random_parts
from training.machines import BoltzmannMachine, MachineSpec

OURS, COPIES = "ours, closed form", "free energies of 2 V copies"


def training_step(
    *,
    V: int = 417,
    units: int = 8,
    states: int = 32,
    scenes: int = 32,
    objects: int = 12,
    rounds: int = 5,
) -> Result:
    """Time one step with closed-form log-odds, and one with a free energy for each class.

    Both steps compute the loss of random parts of scenes, its gradient, and an update by Adam. The
    machine has couplings between its V classes. Persistent chains and priors are left out. Each of
    the rounds times both steps.
    """
    generator = torch.Generator().manual_seed(0)
    v = presence(random_scenes(scenes, V, objects, generator), V)
    unknown = torch.full((scenes,), -1)
    data = ObjectScenes(
        *(v, unknown, torch.zeros(scenes, dtype=torch.int64), torch.ones(scenes)),
        shows=torch.ones(1, V, dtype=torch.bool),
        observed=torch.ones(scenes, V, dtype=torch.bool),
        sources=("random",),
    )
    config = ObjectsConfig(
        batch_size=scenes, generative_weight=0, weight_prior=0, coupling_prior=0, rate_prior=0
    )
    spec = MachineSpec(
        "triway", V=V, A=1, units=units, states=states, K=1, profiles=1, coupled=True
    )
    ours, other = (object_machine(spec, objects).requires_grad_(True) for _ in range(2))
    listed = random_parts(v, config.leave_one_out, generator).listed
    absent = listed == 0
    log_odds = ours.object_log_odds(listed, source=torch.zeros(scenes, dtype=torch.int64))
    difference = (free_energy_log_odds(ours, listed) - log_odds)[absent]
    timings = interleave(
        {OURS: ObjectFit(ours, data, config, 0).step, COPIES: _copies_step(other, v, config)},
        rounds=rounds,
        slice_seconds=0.3,
    )
    return Result(
        title=f"One step of the object fit, {scenes} scenes of {objects} objects, {V} classes, "
        "one thread",
        subject=OURS,
        timings=timings,
        targets={COPIES: 50},
        facts={"largest difference of log-odds": float(difference.detach().abs().max())},
    )


def free_energy_log_odds(machine: BoltzmannMachine, listed: Tensor) -> Tensor:
    """Return the log-odds of each class given the others, (scenes, classes), by free energies."""
    V = machine.spec.V
    present = listed.repeat_interleave(V, 0)
    absent = present.clone()
    rows = torch.arange(len(present))
    present[rows, rows % V] = 1
    absent[rows, rows % V] = 0
    source = torch.zeros(len(present), dtype=torch.int64)
    free = [machine.free_energy(v, source=source) for v in (absent, present)]
    return (free[0] - free[1]).view(-1, V)


def _copies_step(machine: BoltzmannMachine, v: Tensor, config: ObjectsConfig) -> Callable[[], None]:
    """Return a function that runs one step with the free energies of the copies."""
    generator = torch.Generator().manual_seed(0)
    weights = [machine.b, machine.c1, machine.W, machine.L, machine.kappa]
    optimiser = torch.optim.Adam(weights, lr=config.learning_rate)

    def step() -> None:
        parts = random_parts(v, config.leave_one_out, generator)
        log_odds = free_energy_log_odds(machine, parts.listed) + machine.kappa[parts.share]
        hidden = v - parts.listed
        weight = (1 - parts.listed) * torch.where(hidden > 0, parts.weight.unsqueeze(1), 1.0)
        loss = ((softplus(log_odds) - hidden * log_odds) * weight).sum() / len(v)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    return step
