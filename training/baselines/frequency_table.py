"""Smoothed frequency table p(r | i, j): the strong baseline for relations.

R. Zellers et al., "Neural Motifs: Scene Graph Parsing with Global Context", CVPR 2018: the labels
of the two ends predict most relations. A pair seen rarely falls back on its ends, an end seen
rarely on p(r):

    p(r | i, j) = (held + s · [p(r | i as subject) + p(r | j as object)] / 2) / (together + s)
    p(r | i)    = (held with i + m · p(r)) / (pairs with i + m), likewise p(r | j)
"""

from __future__ import annotations

from torch import Tensor

from training.baselines.fitting import Proposals
from training.baselines.triple_counts import TripleCounts, TripleTable, count_triples
from training.batches import SceneTensors
from training.evaluation.relations import RelationScore

_PAIR = (1.0, 3.0, 10.0, 30.0, 100.0)
_END = (3.0, 30.0)
_MULTIPLICITY = (0.0, 0.5, 1.0)


def smoothed_log_odds(counts: TripleCounts, pair: float, end: float) -> Tensor:
    """logit p(r | i, j), (A, V, V).

    Args:
        pair: s > 0, cases of back-off added to a pair.
        end: m > 0, cases of p(r) added to an end.
    """
    overall = counts.overall()[:, None]
    subject = (counts.held.sum(2) + end * overall) / (counts.together.sum(1) + end)
    object_ = (counts.held.sum(1) + end * overall) / (counts.together.sum(0) + end)
    back_off = (subject[:, :, None] + object_[:, None, :]) / 2
    return ((counts.held + pair * back_off) / (counts.together + pair)).logit(eps=1e-7)


def propose(train: SceneTensors, structure: Tensor, _seed: int) -> Proposals[RelationScore]:
    """Smoothing of pairs × of ends × weight of the instance counts.

    The weight moves nothing where counts are withheld (all 1).
    """
    counts = count_triples(train, structure)
    for pair in _PAIR:
        for end in _END:
            table = smoothed_log_odds(counts, pair, end)
            for weight in _MULTIPLICITY:
                parameters = {"pair": pair, "end": end, "multiplicity": weight}
                yield parameters, TripleTable(table, weight)
