"""Small machines of every variant, and all their states."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from torch import Tensor

from training.machines import BoltzmannMachine, MachineSpec, build
from training.machines.edges import Edges

TRIPLES = [(0, 0, 1), (0, 1, 0), (1, 0, 0), (1, 1, 0)]

SMALL: dict[str, MachineSpec] = {
    "rbm": MachineSpec("rbm", V=3, A=2, units=3, T=4, C=2),
    "rbm-states": MachineSpec(
        "rbm", V=3, A=2, units=2, states=3, C=2, T=4, profiles=2, coupled=True
    ),
    "gbm": MachineSpec("gbm", V=2, A=2, units=2, H2=2, T=4),
    "gbm-one-layer": MachineSpec("gbm", V=3, A=2, units=2, T=4, C=2, coupled=True),
    "gbm-states": MachineSpec("gbm", V=2, A=2, units=2, states=3, H2=2, T=4, C=2, profiles=2),
    "triway": MachineSpec("triway", V=2, A=2, units=2, K=2, T=4),
    "triway-states": MachineSpec(
        "triway", V=3, A=1, units=2, states=3, C=2, K=2, T=2, profiles=2, coupled=True
    ),
    "triway-implications": MachineSpec("triway", V=3, A=1, units=2, C=3, K=2, T=2, G=2),
    "triway-deep": MachineSpec(
        "triway", V=2, A=2, units=2, states=3, H2=2, C=2, K=2, T=4, profiles=2
    ),
}
ONE_LAYER = [name for name, spec in SMALL.items() if not spec.H2]
TWO_LAYERS = [name for name, spec in SMALL.items() if spec.H2]


def small_machine(name: str, seed: int = 0, scale: float = 0.8) -> BoltzmannMachine:
    """A float64 machine with every parameter drawn from N(0, scale²), kappa included."""
    spec = SMALL[name]
    machine = build(spec).double()
    if spec.T:
        machine.set_triples(torch.tensor(TRIPLES[: spec.T]))
    return random_weights(machine, torch.Generator().manual_seed(seed), scale)


@torch.no_grad()
def random_weights(
    machine: BoltzmannMachine, generator: torch.Generator, scale: float = 1.0
) -> BoltzmannMachine:
    """The machine with every weight drawn from N(0, scale²)."""
    for parameter in machine.parameters():
        noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
        parameter.copy_(noise * scale)
    return machine.requires_grad_(False)


def mean_rates(
    machine: BoltzmannMachine, v: Iterable[float], *, whole_scenes: bool = False
) -> Tensor:
    """sum_q p(q | v) a_q, (V,), by a loop over the sources; 0 for a machine without sources.

    In whole scenes, the rates are a_q + u_q.
    """
    total, weights, v = torch.zeros(machine.spec.V, dtype=torch.float64), 0.0, list(v)
    for f, a, u in zip(machine.f.double(), machine.a.double(), machine.u.double(), strict=False):
        weight = math.exp(f + sum(float(rate) for rate, on in zip(a, v, strict=True) if on))
        total, weights = total + weight * (a + u * whole_scenes), weights + weight
    return total / weights if weights else total


def with_mean_rates(machine: BoltzmannMachine, classes: Sequence[int] = ()) -> BoltzmannMachine:
    """A float64 copy whose biases are those of whole scenes given the required classes, if any."""
    copied = copy.deepcopy(machine).double()
    if len(classes) and machine.spec.profiles:
        required = [i in classes for i in range(machine.spec.V)]
        copied.b += mean_rates(machine, required, whole_scenes=True)
        copied.u[-1] = 0
    return copied


def binary(units: int) -> Tensor:
    """All 2^units binary vectors, (2^units, units) float64."""
    codes = torch.arange(2**units).unsqueeze(1)
    return (codes >> torch.arange(units) & 1).double()


def code(*blocks: Tensor | np.ndarray) -> np.ndarray:
    """One integer for each row of binary blocks, (..., units)."""
    bits = np.concatenate(blocks, -1).astype(np.int64)
    return (bits << np.arange(bits.shape[-1])).sum(-1)


def unit_states(spec: MachineSpec) -> Tensor:
    """All Z^units states of h1, (Z^units, H1) float64. The first state of a unit is all 0."""
    one = torch.eye(spec.states, dtype=torch.float64)[:, 1:]
    return torch.stack(
        [one[list(z)].flatten() for z in product(range(spec.states), repeat=spec.units)]
    )


@dataclass(frozen=True)
class Joint:
    """Every state of a small machine, with its energy.

    v, r, h1, h2: (N, units); room: (N,), -1 for "not listed"; energy: (N,); edges: the layout of r
    between all classes.
    """

    machine: BoltzmannMachine
    edges: Edges
    v: Tensor
    r: Tensor
    h1: Tensor
    h2: Tensor
    room: Tensor
    energy: Tensor

    @property
    def log_z(self) -> float:
        return float((-self.energy).logsumexp(0))

    @property
    def p(self) -> Tensor:
        return (-self.energy - self.log_z).exp()

    def log_sum(self, where: Tensor) -> float:
        """log sum of exp(-E) over the states of a bool mask."""
        return float((-self.energy[where]).logsumexp(0))

    def log_odds(self, on: Tensor, given: Tensor) -> float:
        """log p(on | given) - log p(not on | given)."""
        return self.log_sum(given & on) - self.log_sum(given & ~on)

    def draw(self, count: int, generator: torch.Generator, given: Tensor | None = None) -> Tensor:
        """Indices of exact samples, (count,), where `given` (N,) bool holds."""
        p = self.p if given is None else torch.where(given, self.p, 0.0)
        return torch.multinomial(p, count, replacement=True, generator=generator)


def enumerate_joint(machine: BoltzmannMachine, *rooms: int | None, source: int = -1) -> Joint:
    """All states with a finite energy; the room type t is a unit with the given states.

    None and -1 mean "not listed". By default, it is the only state of t.
    """
    spec = machine.spec
    edges = machine.edges(torch.arange(spec.V).unsqueeze(0))
    visible, E = binary(spec.V), edges.valid.shape[1]
    t = torch.tensor([-1 if room is None else room for room in rooms or (-1,)])
    blocks = [visible, binary(E), unit_states(spec), binary(spec.H2)]
    index = torch.cartesian_prod(*(torch.arange(len(block)) for block in [*blocks, t]))
    v, r, h1, h2 = (block[k] for block, k in zip(blocks, index.T, strict=False))
    allowed = (r <= machine.gate(edges, v)).all(1)
    v, r, h1, h2, room = (block[allowed] for block in (v, r, h1, h2, t[index[:, 4]]))
    energy = machine.energy(v, r, h1, h2, edges, room, torch.full((len(v),), source))
    return Joint(machine, edges, v, r, h1, h2, room, energy)


def same(block: Tensor, value: Tensor) -> Tensor:
    """(N,) bool: rows of a block that equal a value."""
    return (block == value).all(1)


def left_out(joint: Joint):
    """Every v and class i: (i, v without i, states with the other classes as in v)."""
    V = joint.machine.spec.V
    for v in binary(V):
        for i in range(V):
            if not v[i]:
                others = torch.arange(V) != i
                yield i, v, same(joint.v[:, others], v[others])


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
