"""Something on the desk: frequency table p(i | a, j), alone and times an object score.

    p(i | a, j) = (held + s · p(i | a)) / (held by any + s),   p(i | a) likewise on p(i) with m

separately for i as subject and as object. The product adds log-odds of what else is in the scene,

    score(i | rest) + w · log p(i | a, j) - u · log p(i),

where the last term takes out a popularity that both factors hold.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from training.baselines.fitting import Proposals
from training.baselines.popularity import frequency
from training.baselines.triple_counts import TripleCounts, count_triples
from training.batches import SceneTensors
from training.evaluation.missing import ObjectScore
from training.evaluation.placed import PlacedScore, Places

_PLACE = (0.3, 1.0, 3.0, 10.0)
_RELATION = (1.0, 10.0)
_WEIGHTS = (0.25, 0.5, 0.75, 1.0)
_CORRECTIONS = (0.0, 0.5, 1.0)


@dataclass(frozen=True, eq=False)
class PlacedTable:
    """The score: log_p (2, A, V, V), by outgoing, relation, anchor and missing class."""

    log_p: Tensor

    def __call__(self, places: Places) -> Tensor:
        """log p(i | a, j), (B, V)."""
        return self.log_p[places.outgoing.long(), places.relation, places.anchor]


@dataclass(frozen=True, eq=False)
class PlacedProduct:
    """The score: objects(v) + weight · table - correction · log popularity (V,)."""

    objects: ObjectScore
    table: PlacedTable
    log_popularity: Tensor
    weight: float
    correction: float

    def __call__(self, places: Places) -> Tensor:
        """Scores (B, V)."""
        added = self.weight * self.table(places) - self.correction * self.log_popularity
        return self.objects(places.v) + added


def smoothed_log_p(
    counts: TripleCounts, popularity: Tensor, place: float, relation: float
) -> Tensor:
    """log p(i | a, j), (2, A, V, V) as in `PlacedTable`.

    Args:
        popularity: p(i), (V,), need not sum to 1.
        place: s > 0, cases of p(i | a) added to each (a, j).
        relation: m > 0, cases of p(i) added to each a.
    """
    # Index 1: the missing class is the subject, so that the anchor comes last in `held`.
    held = torch.stack([counts.held, counts.held.mT])
    share = popularity / popularity.sum()
    any_anchor = held.sum(2)
    back_off = any_anchor + relation * share
    back_off = back_off / back_off.sum(-1, keepdim=True)
    table = held + place * back_off.unsqueeze(2)
    return (table / (held.sum(-1, keepdim=True) + place)).log()


def propose(train: SceneTensors, structure: Tensor, _seed: int) -> Proposals[PlacedScore]:
    """Smoothing of places × of relations."""
    counts = count_triples(train, structure)
    for place in _PLACE:
        for relation in _RELATION:
            log_p = smoothed_log_p(counts, frequency(train.v), place, relation)
            yield {"place": place, "relation": relation}, PlacedTable(log_p)


def times(
    objects: ObjectScore, table: PlacedTable
) -> Callable[[SceneTensors, Tensor, int], Proposals[PlacedScore]]:
    """Proposals for the product of a fitted object score and a fitted table."""

    def propose(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[PlacedScore]:
        log_popularity = frequency(train.v).log()
        for weight in _WEIGHTS:
            for correction in _CORRECTIONS:
                score = PlacedProduct(objects, table, log_popularity, weight, correction)
                yield {"weight": weight, "correction": correction}, score

    return propose
