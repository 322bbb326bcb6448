"""Small machines of every variant, and all their states."""

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
    "gbm": MachineSpec("gbm", V=3, A=2, units=2, T=4, C=2, coupled=True),
    "gbm-states": MachineSpec("gbm", V=2, A=2, units=2, states=3, T=4, C=2, profiles=2),
    "triway": MachineSpec("triway", V=2, A=2, units=2, K=2, T=4),
    "triway-states": MachineSpec(
        "triway", V=3, A=1, units=2, states=3, C=2, K=2, T=2, profiles=2, coupled=True
    ),
    "triway-implications": MachineSpec("triway", V=3, A=1, units=2, C=3, K=2, T=2, G=2),
}


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
    for parameter in machine.parameters():
        noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
        parameter.copy_(noise * scale)
    return with_symmetric_couplings(machine).requires_grad_(False)


@torch.no_grad()
def with_symmetric_couplings(machine: BoltzmannMachine) -> BoltzmannMachine:
    """The machine with symmetric couplings and a diagonal of 0, as training keeps them."""
    if machine.spec.coupled:
        machine.L.copy_((machine.L + machine.L.T) / 2).fill_diagonal_(0)
    return machine


def mean_rates(
    machine: BoltzmannMachine, v: Iterable[float], *, whole_scenes: bool = False
) -> Tensor:
    """sum_q p(q | v) a_q, (V,), or of a_q + u_q for whole scenes; 0 without sources."""
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
    states = product(range(spec.states), repeat=spec.units)
    return torch.stack([one[list(z)].flatten() for z in states])


@dataclass(frozen=True)
class Joint:
    """Every state of a small machine: v, r, h1 (N, units), room (N,), or -1, and energy (N,)."""

    machine: BoltzmannMachine
    edges: Edges
    v: Tensor
    r: Tensor
    h1: Tensor
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
        return self.log_sum(given & on) - self.log_sum(given & ~on)

    def draw(self, count: int, generator: torch.Generator, given: Tensor | None = None) -> Tensor:
        """Indices of exact samples, (count,), where `given` (N,) bool holds."""
        p = self.p if given is None else torch.where(given, self.p, 0.0)
        return torch.multinomial(p, count, replacement=True, generator=generator)


def enumerate_joint(machine: BoltzmannMachine, *rooms: int | None, source: int = -1) -> Joint:
    """All states with a finite energy. t is a unit with the states `rooms`, by default -1."""
    spec = machine.spec
    edges = machine.edges(torch.arange(spec.V).unsqueeze(0))
    visible, E = binary(spec.V), edges.valid.shape[1]
    t = torch.tensor([-1 if room is None else room for room in rooms or (-1,)])
    blocks = [visible, binary(E), unit_states(spec), t]
    index = torch.cartesian_prod(*(torch.arange(len(block)) for block in blocks))
    v, r, h1, room = (block[k] for block, k in zip(blocks, index.T, strict=True))
    allowed = (r <= machine.gate(edges, v)).all(1)
    v, r, h1, room = (block[allowed] for block in (v, r, h1, room))
    energy = machine.energy(v, r, h1, edges, room, torch.full((len(v),), source))
    return Joint(machine, edges, v, r, h1, room, energy)


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


def features_by_hand(given: Tensor) -> Tensor:
    """phi (F, n, n) of relations (A, n, n): pairs, then paths, then degrees."""
    A, n = len(given), given.shape[-1]
    table = (given > 0).tolist()
    both = range(2 * A)

    def holds(b: int, i: int, j: int) -> bool:
        """r_b(i, j), where b from A on are the relations read backwards."""
        return table[b][i][j] if b < A else table[b - A][j][i]

    phi = torch.zeros(2 * A * (2 * A + 3), n, n, dtype=torch.float64)
    for i, j in product(range(n), repeat=2):
        others = set(range(n)) - {i, j}
        pair = [i != j and holds(b, i, j) for b in both]
        path = [any(holds(b, i, k) and holds(c, k, j) for k in others) for b in both for c in both]
        outgoing = [min(3, sum(holds(b, i, k) for k in others)) for b in both]
        incoming = [min(3, sum(holds(b, k, j) for k in others)) for b in both]
        phi[:, i, j] = torch.tensor([float(x) for x in pair + path + outgoing + incoming])
    return phi


def implied_by_hand(
    machine: BoltzmannMachine, v: Tensor, given: Tensor, room: int = -1, *, apart: bool = False
) -> Tensor:
    """x (A, n, n) at v (V,), given relations; `apart` leaves out relations of the same pair."""
    spec = machine.spec
    gamma, B = machine.get_parameter("gamma"), machine.get_parameter("B")
    phi = features_by_hand(given)
    mean = machine.state_means(machine.hidden_logits(v[None], torch.tensor([room])))[0]
    z = [sum(float(B[q, k] * mean[k]) for k in range(spec.H1)) for q in range(spec.G)]
    x = torch.zeros(given.shape, dtype=torch.float64)
    for a in range(spec.A):
        for f in range(len(phi)):
            # The first features are those of the pair. The pair feature of a itself is r_e.
            if f != a and not (apart and f < 2 * spec.A):
                weight = float(gamma[0, a, f])
                weight += sum(z[q] * float(gamma[1 + q, a, f]) for q in range(spec.G))
                x[a] += weight * phi[f]
    return x


def relation_by_definition(joint: Joint, unit: int, where: Tensor, given: Tensor) -> float:
    """p(r_e = 1 | v, given) = E[sigmoid(ℓ_e(h1) + x_e)], h1 from the joint's states `where`."""
    e = joint.edges
    a, i, j = (int(end[0, unit]) for end in (e.relation, e.subject, e.object))
    v, h1 = joint.v[where], joint.h1[where]
    x = implied_by_hand(joint.machine, v[0], given, int(joint.room[0]))[a, i, j]
    logits = joint.machine.relation_logits(e, v, h1)[:, unit]
    weight = (-joint.energy[where]).softmax(0)
    return float((weight * (logits + x).sigmoid()).sum())
