"""The registry of small machines. It has every variant, so each takes every enumeration test."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from app.inference.variants import VARIANTS
from training.machines import BoltzmannMachine, MachineSpec, build
from training.machines.machine import State

TRIPLES = [(0, 0, 1), (0, 1, 0), (1, 0, 0), (1, 1, 0)]


def smallest(variant: str) -> MachineSpec:
    """Two units of everything that a variant has."""
    kind = VARIANTS[variant]
    return MachineSpec(variant, V=2, A=2, H1=2, H2=2 * kind.two_layers, K=2 * kind.factorised, T=4)


SMALL: dict[str, MachineSpec] = {
    **{variant: smallest(variant) for variant in VARIANTS},
    "rbm-three-classes": MachineSpec("rbm", V=3, A=2, H1=3, T=4, C=2),
    "gbm-one-layer": MachineSpec("gbm", V=3, A=2, H1=2, T=4, C=2),
    "rbm-local": MachineSpec("rbm", V=2, A=2, H1=2, T=4, C=3, form="local"),
    "gbm-local": MachineSpec("gbm", V=2, A=2, H1=2, H2=2, T=4, form="local"),
    "triway-seed": MachineSpec("triway", V=2, A=2, H1=2, K=2, T=2, form="seed"),
    "triway-local": MachineSpec("triway", V=2, A=2, H1=2, K=2, T=2, C=3, form="local"),
    "triway-implications": MachineSpec("triway", V=3, A=1, H1=2, K=2, T=2, C=3, G=2, form="local"),
    "triway-local-two-layers": MachineSpec("triway", V=2, A=2, H1=2, H2=2, K=2, T=4, form="local"),
}
ONE_LAYER = [name for name, spec in SMALL.items() if not spec.H2]
SEED_FORM = [name for name, spec in SMALL.items() if spec.form == "seed"]


def small_machine(name: str, seed: int = 0, scale: float = 0.8) -> BoltzmannMachine:
    """A float64 machine with every parameter drawn from N(0, scale²), κ included."""
    spec = SMALL[name]
    generator = torch.Generator().manual_seed(seed)
    machine = build(spec).double()
    if spec.T:
        machine.set_triples(torch.tensor(TRIPLES[: spec.T]))
    with torch.no_grad():
        for parameter in machine.parameters():
            noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter.copy_(noise * scale)
        if spec.variant == "triway" and spec.form == "local":
            machine.kappa.zero_()
    return machine.requires_grad_(False)


def random_weights(
    machine: BoltzmannMachine, generator: torch.Generator, scale: float = 1.0
) -> BoltzmannMachine:
    """The machine with every weight but κ drawn from N(0, scale²)."""
    machine.requires_grad_(False)
    for name, parameter in machine.named_parameters():
        if name != "kappa":
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * scale)
    return machine


def binary(units: int) -> Tensor:
    """All 2^units binary vectors, (2^units, units) float64."""
    codes = torch.arange(2**units).unsqueeze(1)
    return (codes >> torch.arange(units) & 1).double()


@dataclass(frozen=True)
class Joint:
    """Every state of a small machine with its log-probability.

    v, r, h1, h2: (N, units); log_p: (N,); edges: the frame of all classes that r is laid out on.
    """

    machine: BoltzmannMachine
    edges: object
    v: Tensor
    r: Tensor
    h1: Tensor
    h2: Tensor
    energy: Tensor
    log_z: float
    room: Tensor | None

    @property
    def p(self) -> Tensor:
        return (-self.energy - self.log_z).exp()

    def log_sum(self, where: Tensor) -> float:
        """log sum of exp(-E) over the states of a bool mask."""
        return float((-self.energy[where]).logsumexp(0))

    def log_odds(self, on: Tensor, given: Tensor) -> float:
        """log p(on | given) - log p(not on | given)."""
        return self.log_sum(given & on) - self.log_sum(given & ~on)


def full_frame(machine: BoltzmannMachine) -> object:
    """The relation units between all classes."""
    return machine.edges(torch.arange(machine.spec.V).unsqueeze(0))


def enumerate_joint(machine: BoltzmannMachine, room: int | None = None) -> Joint:
    """All states (v, r, h1, h2) that have a finite energy."""
    spec = machine.spec
    edges = full_frame(machine)
    sizes = [spec.V, edges.shape[-1], spec.H1, spec.H2]
    states = binary(sum(sizes))
    v, r, h1, h2 = states.split(sizes, dim=1)
    allowed = (r <= machine.gate(edges, v)).all(1)
    v, r, h1, h2 = v[allowed], r[allowed], h1[allowed], h2[allowed]
    rooms = None if room is None else torch.full((len(v),), room)
    energy = machine.energy(v, r, h1, h2, edges, rooms).detach()
    log_z = float((-energy).logsumexp(0))
    return Joint(machine, edges, v, r, h1, h2, energy, log_z, rooms)


def same(block: Tensor, value: Tensor) -> Tensor:
    """(N,) bool: rows of a block that equal a value."""
    return (block == value).all(1)


def draw_states(
    joint: Joint, count: int, generator: torch.Generator, given: Tensor | None = None
) -> State:
    """Exact samples of the joint, where `given` (N,) bool holds."""
    p = joint.p if given is None else torch.where(given, joint.p, 0.0)
    pick = torch.multinomial(p, count, replacement=True, generator=generator)
    edges = joint.edges
    if joint.machine.spec.variant == "triway":
        edges = joint.machine.edges(torch.arange(joint.machine.spec.V).expand(count, -1))
    return State(joint.v[pick], joint.h1[pick], joint.h2[pick], joint.r[pick], edges)


def check_frequencies(codes: np.ndarray, keys: np.ndarray, p: np.ndarray) -> None:
    """Compare a histogram of codes with the law p of the sorted keys.

    The total variation is within 1.1 of its mean for exact draws, and McDiarmid's slack: one chain
    moves it by 1/N, so P(TV > E + t) <= exp(-2 N t²) = 1e-9.
    """
    index = np.searchsorted(keys, codes).clip(max=len(keys) - 1)
    assert (keys[index] == codes).all()
    assert (p[index] > 0).all(), "a state of probability zero"
    frequency = np.bincount(index, minlength=len(keys)) / len(codes)
    floor = 0.5 * np.sqrt(2 * p * (1 - p) / (math.pi * len(codes))).sum()
    slack = math.sqrt(9 * math.log(10) / (2 * len(codes)))
    assert 0.5 * np.abs(frequency - p).sum() < 1.1 * floor + slack
