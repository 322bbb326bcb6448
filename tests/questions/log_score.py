"""Score of a sampled scene: its log-likelihood up to a constant of the machine.

The energy has two forms (`training.machines.machine`). At temperature 1, the score of objects v and
relations r is:

    local form   b·v + sum_k softplus(x_k) + log p(r | v, h1)
    seed form    b·v + sum_k softplus(x_k + sum_e r_e U_ek) + sum_e r_e ℓ⁰_e

with x = c1 + v'W + J m. Z is the partition function. In the seed form, the score is log p(v, r) +
log Z. In the local form, the score is log p(v) + log Z, plus the log-likelihood of r given the
hidden units h1 from which r was sampled. With a second hidden layer h2, m is the mean field of h2.
The score then also contains c2·m and the entropy of m, and is a lower bound of the exact value.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.special import entr

from training.machines import BoltzmannMachine
from training.machines.edges import Edges
from training.machines.mean_field import Evidence, mean_field


def log_score(
    machine: BoltzmannMachine,
    v: Tensor,
    r: Tensor,
    edges: Edges,
    h1: Tensor,
    room: Tensor | None,
) -> Tensor:
    """Return the score of each scene, (scenes,).

    Args:
        v: presence of objects, (scenes, classes).
        r: relations, (scenes, units). A unit with gate 0 must be 0.
        edges: layout of the relation units in r.
        h1: hidden units from which the relations were sampled, (scenes, hidden units).
        room: index of the room type of each scene, (scenes,). None means unknown.
    """
    known = torch.ones_like(r, dtype=torch.bool)
    local = not machine.relations_act
    evidence = Evidence(v, room=room) if local else Evidence(v, edges, r, known, room)
    m = mean_field(machine, evidence).h2 if machine.spec.H2 else None
    if local:
        gate = machine.gate(edges, v)
        logits = machine.relation_logits(edges, v, h1)
        explained = machine.relation_term(logits, gate, r, known).sum(-1)
        score = explained - machine.free_energy(v, h2=m, room=room)
    else:
        score = -machine.free_energy(v, r, edges, h2=m, room=room)
    return score if m is None else score + (entr(m) + entr(1 - m)).sum(-1)
