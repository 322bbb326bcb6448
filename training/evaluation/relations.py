"""T1a: the annotated relations of a scene, given its classes alone.

R-precision over all ordered pairs i ≠ j of present classes × canonical relations: as many
predictions as there are annotated triples. Unlisted is counted as wrong although annotators list
only a few relations a scene. Structure classes are no ends. Scenes without annotated triples are
skipped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from app.boltzmann import BoltzmannMachine, Triway
from app.boltzmann.edges import Edges, find_triples, pair_edges, triple_keys
from app.boltzmann.log_odds import relation_log_odds
from app.boltzmann.mean_field import Evidence
from training.batches import Batch, SceneTensors
from training.evaluation.intervals import Figure, ratio_figure

# Scores (B, A, n, n) of the relations between the classes of a batch.
RelationScore = Callable[[Batch], Tensor]


def machine_score(
    machine: BoltzmannMachine, *, counts: bool = True, draws: int = 64
) -> RelationScore:
    """Log-odds of every relation with all relations unobserved.

    Args:
        counts: let the Triway see how many instances of each class there are.
    """

    def score(batch: Batch) -> Tensor:
        n, A = batch.classes.shape[1], machine.spec.A
        if isinstance(machine, Triway):
            edges: Edges = machine.edges(batch.classes, batch.counts if counts else None)
            values, _ = relation_log_odds(machine, edges, Evidence(batch.v, edges), count=draws)
            return values.unflatten(1, (A, n, n))
        edges = machine.edges(batch.classes)
        units, _ = relation_log_odds(machine, edges, Evidence(batch.v, edges), count=draws)
        return spread_units(machine, batch.classes, units)

    return score


def spread_units(machine: BoltzmannMachine, classes: Tensor, values: Tensor) -> Tensor:
    """Values (B, T) of an ungated machine's units on (B, A, n, n); -inf where there is no unit."""
    pairs = pair_edges(classes, machine.spec.A)
    keys = triple_keys(pairs.relation, pairs.subject, pairs.object, machine.spec.V)
    position, found = find_triples(machine.triple_keys, keys)
    if not machine.spec.T:
        return pairs.unflatten(torch.full(keys.shape, -torch.inf))
    spread = values.gather(1, position)
    return pairs.unflatten(torch.where(found & pairs.valid, spread, -torch.inf))


@dataclass(frozen=True)
class RelationRanking:
    """Per scene: annotated triples, and how many were among as many predictions."""

    annotated: NDArray[np.int64]
    hits: NDArray[np.float64]
    skipped: int

    def pooled(self) -> Figure:
        """R-precision pooled over scenes."""
        return ratio_figure(self.hits, self.annotated.astype(np.float64))

    def per_scene(self) -> Figure:
        """Mean over scenes of their R-precision."""
        some = self.annotated > 0
        return ratio_figure(self.hits[some] / self.annotated[some], np.ones(int(some.sum())))


@torch.no_grad()
def rank_relations(
    scenes: SceneTensors,
    structure: Tensor,
    score: RelationScore,
    *,
    relation: int | None = None,
    block: int = 64,
) -> RelationRanking:
    """R-precision of a score.

    Args:
        relation: only this canonical relation.
    """
    annotated, hits, skipped = [], [], 0
    for start in range(0, len(scenes), block):
        index = torch.arange(start, min(start + block, len(scenes)))
        index = index[[bool(scenes.scenes[k].evidence.holds.any()) for k in index.tolist()]]
        skipped += min(block, len(scenes) - start) - len(index)
        if not len(index):
            continue
        batch = scenes.batch(index)
        values = score(batch)
        n = batch.classes.shape[1]
        usable = (batch.classes >= 0) & ~structure[batch.classes.clamp(min=0)]
        pair = usable[:, :, None] & usable[:, None, :] & ~torch.eye(n, dtype=torch.bool)
        pair = pair[:, None].expand_as(batch.holds)
        if relation is not None:
            keep = torch.arange(batch.holds.shape[1]) == relation
            pair = pair & keep[:, None, None]
        truth = (batch.holds > 0) & pair
        for row in range(len(batch)):
            count = int(truth[row].sum())
            if not count:
                skipped += 1
                continue
            annotated.append(count)
            hits.append(expected_hits(values[row][pair[row]], truth[row][pair[row]], count))
    return RelationRanking(np.array(annotated, dtype=np.int64), np.array(hits), skipped)


def expected_hits(values: Tensor, truth: Tensor, count: int) -> float:
    """True items among the first `count`, in expectation under random order of ties."""
    threshold = values.topk(count).values[-1]
    above, level = values > threshold, values == threshold
    room = count - int(above.sum())
    share = room / max(int(level.sum()), 1)
    return float((truth & above).sum()) + share * float((truth & level).sum())
