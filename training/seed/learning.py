"""Training of the machines: contrastive divergence, reconstruction error and early stopping.

One step takes 32 scenes. The positive phase samples the context given the scene. The negative
phase samples objects given context and relations, and then relations given context and objects, at
temperature 1. The update is gradient descent with learning rate .5 on <E>_positive - <E>_negative.
An unlisted relation of an annotated scene is false. The relations of a scene without annotation
occur in neither phase.

The error E of the paper is the squared difference between the scene and the probabilities at the
end of the negative phase, summed over units and averaged over scenes. Objects and relations are
separate. Training stops if the error of the validation scenes, objects plus relations, has not
fallen for `PATIENCE` epochs, and the weights of the best epoch are kept.

Sources: Hinton, "Training products of experts by minimizing contrastive divergence" (2002);
Bozcan et al. (2018).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from training.seed.machines import Free, Machine, State, Variant, bernoulli
from training.seed.scenes import Material, Scenes

LEARNING_RATE: Final = 0.5
BATCH: Final = 32
PATIENCE: Final = 30
EPOCHS: Final = 200

Progress = Callable[[int, "Epoch"], None]


@dataclass(frozen=True)
class Epoch:
    """Errors E of objects and relations, for the training and the validation scenes.

    Without annotated scenes, the errors of relations are 0.
    """

    objects: float
    relations: float
    validation_objects: float
    validation_relations: float
    seconds: float


def phases(
    machine: Machine, scenes: Scenes, generator: torch.Generator, steps: int = 1
) -> tuple[State, State, Tensor, Tensor]:
    """Run the positive phase and `steps` sweeps of the negative phase.

    Returns:
        The states at the end of the positive and of the negative phase, where the mean of h1 given
        all other units replaces h1; the error E of the objects, (B,), and of the relations, (B,).
    """
    v, r, annotated = scenes.v, scenes.r, scenes.annotated.unsqueeze(1)
    h1, h2 = machine.hidden(v, r, generator)
    free = Free(torch.ones_like(v, dtype=torch.bool), annotated.expand(r.shape))
    state = State(v, r, h1, h2)
    object_p, relation_p = v, r
    for _ in range(steps):
        state, object_p, relation_p = machine.sweep(state, free, 1.0, generator)
    positive = State(v, r, machine.h1_logits(v, r, h2).sigmoid(), h2)
    h2 = bernoulli(machine.h2_logits(state.h1).sigmoid(), generator)
    logits = machine.h1_logits(state.v, state.r, h2)
    negative = State(state.v, state.r, logits.sigmoid(), h2)
    object_error = (v - object_p).square().sum(1)
    relation_error = ((r - relation_p) * annotated).square().sum(1)
    return positive, negative, object_error, relation_error


def errors(machine: Machine, scenes: Scenes, generator: torch.Generator) -> tuple[float, float]:
    """Return the error E of objects and of relations, averaged over scenes."""
    parts = [
        phases(machine, scenes.rows(index), generator)[2:]
        for index in torch.arange(len(scenes)).split(BATCH)
    ]
    objects, relations = (torch.cat(error) for error in zip(*parts, strict=True))
    return float(objects.mean()), float(relations.sum()) / max(int(scenes.annotated.sum()), 1)


def new_machine(variant: Variant, material: Material, generator: torch.Generator) -> Machine:
    """Return an untrained machine for these scenes."""
    V = len(material.vocabulary)
    return variant.kind(material.triples, V, variant.H1, variant.H2, generator)


def train(
    machine: Machine,
    material: Material,
    generator: torch.Generator,
    progress: Progress,
    epochs: int = EPOCHS,
) -> list[Epoch]:
    """Train a machine in place, and return the errors of each epoch.

    Raises:
        FloatingPointError: the weights have diverged.
    """
    history: list[Epoch] = []
    best, best_epoch, weights = math.inf, 0, machine.state_dict()
    for epoch in range(epochs):
        history.append(_epoch(machine, material, generator))
        progress(epoch, history[-1])
        score = history[-1].validation_objects + history[-1].validation_relations
        if not math.isfinite(score):
            raise FloatingPointError(f"the weights diverged in epoch {epoch + 1}")
        if score < best:
            best, best_epoch = score, epoch
            weights = {name: value.clone() for name, value in machine.state_dict().items()}
        elif epoch - best_epoch >= PATIENCE:
            break
    machine.load_state_dict(weights)
    return history


def _epoch(
    machine: Machine,
    material: Material,
    generator: torch.Generator,
) -> Epoch:
    start, scenes = time.perf_counter(), material.train
    objects = relations = 0.0
    for index in torch.randperm(len(scenes), generator=generator).split(BATCH):
        positive, negative, *own = phases(machine, scenes.rows(index), generator)
        machine.update(positive, negative, LEARNING_RATE)
        object_error, relation_error = own
        objects += float(object_error.sum())
        relations += float(relation_error.sum())
    seconds = time.perf_counter() - start
    return Epoch(
        objects / len(scenes),
        relations / max(int(scenes.annotated.sum()), 1),
        *errors(machine, material.validation, generator),
        seconds,
    )
