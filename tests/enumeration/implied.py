"""What given relations imply, written out with loops, and r_e by its conditional definition."""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor

from tests.enumeration.small_machines import Joint
from training.machines import BoltzmannMachine


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
    """x (A, n, n) of a machine of one layer at v (V,), given relations.

    With `apart`, relations of the same pair have no effect.
    """
    spec = machine.spec
    gamma, B = machine.get_parameter("gamma"), machine.get_parameter("B")
    phi = features_by_hand(given)
    mean = machine.state_means(machine.context(v[None], torch.tensor([room]))[0])[0]
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
    """p(r_e = 1 | v, given) = E[sigmoid(ℓ_e(h1) + x_e)], h1 from the joint.

    Args:
        unit: e, its place in `joint.edges`.
        where: (N,) bool, the states with this v and the observed relations other than e.
        given: (A, V, V), 1 where a relation is observed as holding.
    """
    e = joint.edges
    a, i, j = (int(end[0, unit]) for end in (e.relation, e.subject, e.object))
    v, h1 = joint.v[where], joint.h1[where]
    x = implied_by_hand(joint.machine, v[0], given, int(joint.room[0]))[a, i, j]
    logits = joint.machine.relation_logits(e, v, h1)[:, unit]
    weight = (-joint.energy[where]).softmax(0)
    return float((weight * (logits + x).sigmoid()).sum())
