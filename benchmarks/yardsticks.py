"""Machines with random weights for benchmarks, and models of other packages with equal weights."""

from __future__ import annotations

import numpy as np
import torch
from rbms.bernoulli_bernoulli.classes import BBRBM
from sklearn.neural_network import BernoulliRBM
from torch import Tensor

from training.machines import BoltzmannMachine, MachineSpec, build


def frequencies(V: int, objects: float) -> Tensor:
    """Return the frequency of each class, (classes,), by a Zipf–Mandelbrot law.

    As in real rooms, a few classes are in most scenes, and most classes are rare. A scene with
    these frequencies has about `objects` objects.
    """
    share = 1 / torch.arange(3.0, V + 3)
    return (objects * share / share.sum()).clamp(max=0.95)


def object_machine(spec: MachineSpec, objects: float) -> BoltzmannMachine:
    """Return a machine with random weights. Its scenes contain about `objects` objects."""
    machine = build(spec).requires_grad_(False)
    machine.initialise(torch.Generator().manual_seed(0), scale=0.1)
    p = frequencies(spec.V, objects)
    # All states of a hidden unit are equally likely. The object biases compensate their effect.
    mean = 1 / spec.states
    variance = machine.W.square().sum(1) * mean * (1 - mean)
    machine.b.copy_(p.logit() - machine.W.sum(1) * mean - variance / 2)
    machine.c1.copy_(-(p @ machine.W))
    return machine


def random_scenes(scenes: int, V: int, objects: int, generator: torch.Generator) -> Tensor:
    """Draw scenes of distinct classes by frequency. Return class indices (scenes, objects)."""
    weights = frequencies(V, objects).expand(scenes, V)
    return weights.multinomial(objects, generator=generator).sort(1).values


def presence(classes: Tensor, V: int) -> Tensor:
    """Convert class indices (scenes, objects) to presence (scenes, classes) float32."""
    return torch.zeros(len(classes), V).scatter_(1, classes, 1.0)


def scikit_learn(machine: BoltzmannMachine) -> BernoulliRBM:
    """Return a scikit-learn RBM with the object and hidden weights of a machine of binary units."""
    rbm = BernoulliRBM(machine.spec.H1)
    rbm.components_ = machine.W.T.contiguous().numpy()
    rbm.intercept_hidden_ = machine.c1.numpy().copy()
    rbm.intercept_visible_ = machine.b.numpy().copy()
    rbm.random_state_ = np.random.RandomState(0)
    return rbm


def rbms(machine: BoltzmannMachine) -> BBRBM:
    """Return an RBM of the `rbms` package with the object and hidden weights of a machine."""
    return BBRBM(machine.W.clone(), machine.b.clone(), machine.c1.clone())
