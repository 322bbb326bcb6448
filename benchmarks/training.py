"""Benchmark of training: time of one contrastive-divergence step.

Our Triway machine has relation units only for pairs of present objects (active pairs), and shares
weights between them. The dense machine has a unit and weights for every pair of classes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch

from benchmarks.report import Result
from benchmarks.timing import interleave
from benchmarks.yardsticks import frequencies, presence, random_scenes
from training.datasets.batches import Batch
from training.fit.configuration import ObjectiveConfig
from training.fit.objectives.contrastive import ContrastiveDivergence
from training.machines import MachineSpec, build

OURS, LOCAL, DENSE = "ours, seed form", "ours, local form", "dense Triway"

_RATE = 0.01
_HOLDS = 0.1


def training_step(
    *,
    V: int = 417,
    A: int = 4,
    H1: int = 200,
    H2: int = 100,
    K: int = 32,
    scenes: int = 32,
    objects: int = 12,
    rounds: int = 5,
) -> Result:
    """Time one CD-1 step of our Triway machine, and of a dense machine with all V + A·V² units.

    Args:
        V: number of object classes.
        A: number of relations.
        H1: number of units in the first hidden layer.
        H2: number of units in the second hidden layer.
        K: rank of the relation weights.
        scenes: number of scenes per step.
        objects: number of objects per scene.
        rounds: number of rounds; each round times every machine.
    """
    generator = torch.Generator().manual_seed(0)
    classes = random_scenes(scenes, V, objects, generator)
    pairs = (scenes, A, objects, objects)
    batch = Batch(
        v=presence(classes, V),
        classes=classes,
        counts=torch.ones_like(classes),
        holds=(torch.rand(pairs, generator=generator) < _HOLDS).float(),
        observed=torch.ones(pairs, dtype=torch.bool),
        room=torch.full((scenes,), -1),
        source=torch.zeros(scenes, dtype=torch.int64),
    )
    spec = MachineSpec("triway", V=V, A=A, H1=H1, H2=H2, K=K, form="seed")
    dense_units = V + A * V * V
    timings = interleave(
        {
            OURS: _triway_step(spec, batch, objects, generator),
            LOCAL: _triway_step(replace(spec, form="local"), batch, objects, generator),
            DENSE: _dense_step(batch, A, H1, generator),
        },
        rounds=rounds,
        slice_seconds=0.3,
    )
    return Result(
        name="training",
        title=f"One CD-1 step, {scenes} scenes of {objects} objects, {V} classes, one thread",
        subject=OURS,
        timings=timings,
        targets={DENSE: 200},
        facts={
            "weights, ours": build(spec).parameter_count,
            "weights, dense": dense_units * H1 + dense_units + H1,
        },
    )


def _triway_step(
    spec: MachineSpec, batch: Batch, objects: int, generator: torch.Generator
) -> Callable[[], None]:
    """Return a function that runs one training step: loss, gradients by autograd, and update."""
    machine = build(spec).initialise(generator, scale=0.05)
    with torch.no_grad():
        machine.b.copy_(frequencies(spec.V, objects).logit())
        machine.get_parameter("d").fill_(math.log(_HOLDS))
    config = ObjectiveConfig(name="contrastive_divergence", k=1)
    objective = ContrastiveDivergence(config, machine)
    trained = [parameter for parameter in machine.parameters() if parameter.requires_grad]
    optimiser = torch.optim.SGD(trained, lr=_RATE, fused=True)

    def step() -> None:
        optimiser.zero_grad(set_to_none=True)
        objective.loss(machine, batch, generator).backward()
        objective.adjust_gradients(machine)
        optimiser.step()

    return step


def _dense_step(batch: Batch, A: int, H: int, generator: torch.Generator) -> Callable[[], None]:
    """Return a function that runs one training step of a dense machine with one hidden layer.

    The visible layer x has a unit for each object class and for each of the A·V² relations. A
    relation can be on only if both its objects are on, and it then forces these objects on. The
    step adds gradients directly to the weights, without autograd.
    """
    scenes, V = batch.v.shape
    x = torch.zeros(scenes, V + A * V * V)
    x[:, :V] = batch.v
    grid = x[:, V:].view(scenes, A, V, V)
    for row, classes in enumerate(batch.classes):
        grid[row, :, classes[:, None], classes[None, :]] = batch.holds[row]
    weights = torch.randn(x.shape[1], H, generator=generator).mul_(0.001)
    bias, c = torch.full((x.shape[1],), -4.0), torch.zeros(H)

    @torch.no_grad()
    def step() -> None:
        data = torch.addmm(c, x, weights).sigmoid_()
        h = torch.bernoulli(data, generator=generator)
        p = torch.addmm(bias, h, weights.T).sigmoid_()
        related = grid.amax(1)
        held = torch.maximum(related.amax(1), related.amax(2))
        v = torch.bernoulli(p[:, :V], generator=generator).maximum(held)
        pairs = v[:, :, None] * v[:, None, :]
        p[:, V:].view(grid.shape).mul_(pairs.unsqueeze(1))
        y = torch.bernoulli(p, generator=generator)
        y[:, :V] = v
        model = torch.addmm(c, y, weights).sigmoid_()
        weights.addmm_(x.T, data, alpha=_RATE / scenes).addmm_(y.T, model, alpha=-_RATE / scenes)
        bias.add_((x - y).mean(0), alpha=_RATE)
        c.add_((data - model).mean(0), alpha=_RATE)

    return step
