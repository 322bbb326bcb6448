"""Training of the machines: contrastive divergence, reconstruction error and early stopping.

The positive phase samples the context given the scene. The negative phase samples objects given
context and relations, and then relations given context and objects, at temperature 1. A step adds
.5 (<-dE/dw>_positive - <-dE/dw>_negative) to each weight w. Both phases sample their last context
with the same random numbers, so most of the noise cancels. An unlisted relation of an annotated
scene is false. The relations of a scene without annotation occur in neither phase.

The error E of the paper is the squared difference between the probabilities at the start of the
positive phase (0 or 1) and at the end of the negative phase, summed over units and averaged over
scenes. Training stops if the validation error, objects plus relations, has not fallen for
`PATIENCE` epochs, and the weights of the best epoch are kept.

Sources: Hinton, "Training products of experts by minimizing contrastive divergence" (2002);
Bozcan et al. (2018).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from training.seed.machines import Free, Machine, State
from training.seed.scenes import Material, Scenes

LEARNING_RATE: Final = 0.5
BATCH: Final = 32
PATIENCE: Final = 30
EPOCHS: Final = 200
LARGEST_WEIGHT: Final = 50.0
"""Limit of |w|. A larger weight is a sign of divergence: a logit of 20 is a certainty of 1e-9."""
KINDS: Final = ("objects", "relations")


@dataclass(frozen=True)
class Epoch:
    """Errors E of objects and relations, which are 0 without annotated scenes."""

    objects: float
    relations: float
    validation_objects: float
    validation_relations: float
    seconds: float


def phases(
    machine: Machine, scenes: Scenes, generator: torch.Generator, steps: int = 1
) -> tuple[State, State, Float[Tensor, "B"], Float[Tensor, "B"]]:
    """Run both phases. Return their last states, and the errors E of objects and of relations."""
    v, r, free = scenes.v, scenes.r, Free.of(scenes.v, scenes.annotated, scenes.r)
    start = state = State(v, r, *machine.hidden(v, r, generator))
    object_p, relation_p = v, r
    for _ in range(steps):
        state, object_p, relation_p = machine.sweep(state, free, 1.0, generator)
    hidden = (start.h1, start.h2)
    draws = [torch.rand(h.shape, generator=generator, dtype=h.dtype) for h in hidden]
    positive, negative = (_with_context(machine, end, draws) for end in (start, state))
    object_error = (v - object_p).square().sum(1)
    relation_error = ((r - relation_p) * free.r).square().sum(1)
    return positive, negative, object_error, relation_error


def _with_context(machine: Machine, state: State, draws: Sequence[Tensor]) -> State:
    """Sample h1 and h2 with these random numbers. Return the state with the mean of h1 given h2."""
    visible = machine.h1_logits(state.v, state.r, torch.zeros_like(state.h2))
    h1 = (draws[0] < (visible + state.h2 @ machine.J.T).sigmoid()).to(visible.dtype)
    h2 = (draws[1] < machine.h2_logits(h1).sigmoid()).to(visible.dtype)
    return State(state.v, state.r, (visible + h2 @ machine.J.T).sigmoid(), h2)


def train(
    machine: Machine,
    material: Material,
    generator: torch.Generator,
    epochs: int = EPOCHS,
    rate: float = LEARNING_RATE,
) -> list[Epoch]:
    """Train a machine in place, and return the errors of each epoch."""
    history: list[Epoch] = []
    best, best_epoch, weights = math.inf, 0, machine.state_dict()
    for epoch in range(epochs):
        history.append(_epoch(machine, material, generator, rate))
        _check(machine, len(history), rate)
        score = history[-1].validation_objects + history[-1].validation_relations
        if score < best:
            best, best_epoch = score, epoch
            weights = {name: value.clone() for name, value in machine.state_dict().items()}
        elif epoch - best_epoch >= PATIENCE:
            break
    machine.load_state_dict(weights)
    return history


def _epoch(machine: Machine, material: Material, generator: torch.Generator, rate: float) -> Epoch:
    start, own = time.perf_counter(), []
    for index in torch.randperm(len(material.train), generator=generator).split(BATCH):
        positive, negative, *error = phases(machine, material.train.rows(index), generator)
        machine.update(positive, negative, rate)
        own.append(error)
    seconds = time.perf_counter() - start
    validation = errors(machine, material.validation, generator)
    return Epoch(*_averages(own, material.train), *validation, seconds)


def errors(machine: Machine, scenes: Scenes, generator: torch.Generator) -> tuple[float, float]:
    """Return the error E of objects and of relations, averaged over scenes."""
    batches = torch.arange(len(scenes)).split(BATCH)
    own = [phases(machine, scenes.rows(index), generator)[2:] for index in batches]
    return _averages(own, scenes)


def _averages(own: Sequence[Sequence[Tensor]], scenes: Scenes) -> tuple[float, float]:
    objects, relations = (float(torch.cat(error).sum()) for error in zip(*own, strict=True))
    return objects / len(scenes), relations / max(int(scenes.annotated.sum()), 1)


def _check(machine: Machine, epoch: int, rate: float) -> None:
    for name, weight in machine.named_parameters():
        largest = float(weight.abs().max()) if weight.numel() else 0.0
        if not largest <= LARGEST_WEIGHT:  # also true for NaN
            raise FloatingPointError(
                f"training diverged in epoch {epoch}: a weight of {name} has the size "
                f"{largest:.4g}, the limit is {LARGEST_WEIGHT:g}. Use a smaller learning rate than "
                f"{rate:g}"
            )
