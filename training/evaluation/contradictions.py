"""Contradictions between the relations of a scene."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from app.scene import CANONICAL
from training.evaluation.metrics import Metric, Ratio

_ON_TOP = CANONICAL.index("on-top")


def count_contradictions(holds: Float[Tensor, "B A n n"]) -> Int[Tensor, "B 4"]:
    """Count contradictory relations between different classes of each scene.

    The columns are, summed over the canonical relations: the pairs of classes with a relation in
    both directions, and the pairs with a relation in at least one direction. Then two truth values
    follow: the on-top relations form a cycle, and the scene has an on-top relation.
    """
    n = holds.shape[-1]
    edges = (holds > 0) & ~torch.eye(n, dtype=torch.bool)
    upper = torch.ones(n, n, dtype=torch.bool).triu(1)
    mirrored, related = edges & edges.mT & upper, (edges | edges.mT) & upper
    on_top = torch.zeros(len(holds), 1, 1, dtype=torch.bool)
    if holds.shape[1] > _ON_TOP and n:
        on_top = edges[:, _ON_TOP]
    is_cyclic = transitive_closure(on_top).diagonal(dim1=-2, dim2=-1).any(1)
    has_on_top = on_top.flatten(1).any(1)
    counts = mirrored.flatten(1).sum(1), related.flatten(1).sum(1), is_cyclic, has_on_top
    return torch.stack([count.long() for count in counts], 1)


def contradiction_metrics(counts: Int[Tensor, "B 4"]) -> dict[str, Metric]:
    """Return the share of mirrored relations and the share of scenes with an on-top cycle.

    A share is left out if no scene has a relation for it. `counts` are `count_contradictions`.
    """
    mirrored, related, cyclic, stacked = counts.double().numpy().T
    parts = {"mirrored relations": (mirrored, related), "on-top cycles": (cyclic, stacked)}
    return {name: Ratio(part, whole) for name, (part, whole) in parts.items() if whole.any()}


def transitive_closure(pairs: Bool[Tensor, "*B n n"]) -> Bool[Tensor, "*B n n"]:
    """Return all pairs that a chain of given pairs connects."""
    reach = pairs.float()
    while True:
        longer = ((reach + reach @ reach) > 0).float()
        if torch.equal(longer, reach):
            return reach > 0
        reach = longer
