"""T1a: the annotated relations of a scene, given its classes alone.

R-precision over all ordered pairs i ≠ j of present classes × canonical relations: as many
predictions as there are annotated triples. Unlisted is counted as wrong although annotators list
only a few relations a scene. Structure classes are no ends. Scenes without annotated triples are
skipped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
def score_scenes(
    scenes: SceneTensors, score: RelationScore, *, block: int = 64
) -> list[tuple[Batch, Tensor]]:
    """Batches of the scenes that have annotated triples, with their scores (B, A, n, n)."""
    related = [k for k, scene in enumerate(scenes.scenes) if scene.evidence.holds.any()]
    batches = [scenes.batch(part) for part in torch.tensor(related).split(block) if len(part)]
    return [(batch, score(batch)) for batch in batches]


def rank_scored(
    scored: Sequence[tuple[Batch, Tensor]],
    structure: Tensor,
    scenes: int,
    *,
    relation: int | None = None,
) -> RelationRanking:
    """R-precision of scores.

    Args:
        scored: see `score_scenes`.
        scenes: how many there were, those without triples among them.
        relation: only this canonical relation.
    """
    annotated, hits = [], []
    for batch, values in scored:
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
            if count:
                annotated.append(count)
                hits.append(expected_hits(values[row][pair[row]], truth[row][pair[row]], count))
    skipped = scenes - len(annotated)
    return RelationRanking(np.array(annotated, dtype=np.int64), np.array(hits), skipped)


def rank_relations(
    scenes: SceneTensors, structure: Tensor, score: RelationScore
) -> RelationRanking:
    """R-precision of a score on a set of scenes."""
    return rank_scored(score_scenes(scenes, score), structure, len(scenes))


def expected_hits(values: Tensor, truth: Tensor, count: int) -> float:
    """True items among the first `count`, in expectation under random order of ties."""
    threshold = values.topk(count).values[-1]
    above, level = values > threshold, values == threshold
    room = count - int(above.sum())
    share = room / max(int(level.sum()), 1)
    return float((truth & above).sum()) + share * float((truth & level).sum())
