"""Direct effect of observed relations on the log-odds of others, beside that through h1.

What stands left of the chair that stands left of the bed stands left of the bed. Units that are
independent given h1 cannot know it. So relations that are given shift the log-odds of the others,

    log-odds of r_e given r_G  =  ℓ_e(h1) + x_e(r_G),       e = (a, i, j)
    x_e = sum_f (gamma[0,a,f] + sum_q z_q gamma[q,a,f]) phi_f(i, j; r_G),    z = B E[h1 | v]

as a room type shifts those of h1: a condition, so that everything else stays in closed form and
x = 0 where nothing is given. z lets the context say how strictly the rules hold: one source lists
every pair in sight, another a few neighbours. phi_f reads the 2A relations b in both directions,

    pair      r_b(i, j)                                           2A features
    path      there is a class k with r_b(i, k) and r_c(k, j)     (2A)²
    degree    other classes k with r_b(i, k), with r_b(k, j)      4A, counted up to 3

and never r_e itself. Relations are drawn, where that is asked, one group after the other.

Source: Mnih, Larochelle and Hinton, "Conditional restricted Boltzmann machines for structured
output prediction" (2011), for observed units as conditions.
"""

from __future__ import annotations

import torch
from torch import Tensor

# One more neighbour says less and less.
_MOST = 3.0


def implication_features(given: Tensor) -> Tensor:
    """phi, (B, F, n, n), of the relations that are given, (B, A, n, n), 1 where on.

    The pair feature of a itself is r_e where e is given: `implied` gives it no weight.
    """
    n = given.shape[-1]
    between = given * ~torch.eye(n, dtype=torch.bool, device=given.device)
    both = torch.cat([between, between.mT], 1)
    steps = both.shape[1]
    # All paths at once: (B, 2A·n, n) by (B, n, 2A·n).
    paths = both.flatten(1, 2) @ both.transpose(1, 2).flatten(2)
    paths = paths.view(len(given), steps, n, steps, n).transpose(2, 3).flatten(1, 2).clamp(max=1.0)
    outgoing = both.sum(-1, keepdim=True) - both
    incoming = both.sum(-2, keepdim=True) - both
    degrees = torch.cat([outgoing, incoming], 1).clamp(max=_MOST)
    return torch.cat([both, paths, degrees], 1)


def implied(gamma: Tensor, B: Tensor, given: Tensor, h1: Tensor, *, apart: bool = False) -> Tensor:
    """x, (B, A, n, n).

    Args:
        gamma: (1 + G, A, F).
        B: (G, H1).
        given: (B, A, n, n), 1 where a relation is given as holding, else 0.
        h1: (B, H1), means of the context given the objects.
        apart: without what the relations of a pair imply for each other.
    """
    A = given.shape[1]
    itself = torch.zeros(gamma.shape[1:], dtype=torch.bool, device=gamma.device)
    itself[:, :A].fill_diagonal_(True)
    if apart:
        # Paths and neighbours are those of other classes as they are.
        itself[:, : 2 * A] = True
    gamma = gamma.masked_fill(itself, 0.0)
    weight = gamma[0] + torch.einsum("bq,qaf->baf", h1 @ B.T, gamma[1:])
    features = implication_features(given)
    shifts: Tensor = (weight @ features.flatten(2)).view(given.shape)
    return shifts
