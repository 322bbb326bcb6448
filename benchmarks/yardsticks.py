"""Our machines, and the same weights in other people's models."""

from __future__ import annotations

import numpy as np
import torch
from rbms.bernoulli_bernoulli.classes import BBRBM
from sklearn.neural_network import BernoulliRBM
from torch import Tensor

from training.machines import BoltzmannMachine, MachineSpec, build


def frequencies(V: int, objects: float) -> Tensor:
    """(V,) how often each class is present, by a Zipf–Mandelbrot law; adds to `objects`.

    As in rooms, a few classes are in most scenes and the many others in hardly any.
    """
    share = 1 / torch.arange(3.0, V + 3)
    return (objects * share / share.sum()).clamp(max=0.95)


def object_machine(spec: MachineSpec, objects: float) -> BoltzmannMachine:
    """A machine with random weights whose scenes hold about so many objects."""
    machine = build(spec).requires_grad_(False)
    machine.initialise(torch.Generator().manual_seed(0), scale=0.1)
    p = frequencies(spec.V, objects)
    # Half of the hidden units are on; the biases make up for what they add to the objects.
    machine.b.copy_(p.logit() - machine.W.sum(1) / 2 - machine.W.square().sum(1) / 8)
    machine.c1.copy_(-(p @ machine.W))
    return machine


def random_scenes(scenes: int, V: int, objects: int, generator: torch.Generator) -> Tensor:
    """(scenes, objects) int64: distinct classes, drawn by their frequencies and sorted."""
    weights = frequencies(V, objects).expand(scenes, V)
    return weights.multinomial(objects, generator=generator).sort(1).values


def presence(classes: Tensor, V: int) -> Tensor:
    """(B, V) float32 from (B, n) class indices."""
    return torch.zeros(len(classes), V).scatter_(1, classes, 1.0)


def scikit_learn(machine: BoltzmannMachine) -> BernoulliRBM:
    """The objects and context of a machine as a fitted `BernoulliRBM`, float32."""
    rbm = BernoulliRBM(machine.spec.H1)
    rbm.components_ = machine.W.T.contiguous().numpy()
    rbm.intercept_hidden_ = machine.c1.numpy().copy()
    rbm.intercept_visible_ = machine.b.numpy().copy()
    rbm.random_state_ = np.random.RandomState(0)
    return rbm


def rbms(machine: BoltzmannMachine) -> BBRBM:
    """The objects and context of a machine as an RBM of the `rbms` package."""
    return BBRBM(machine.W.clone(), machine.b.clone(), machine.c1.clone())
