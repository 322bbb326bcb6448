"""T1a: the annotated relations of a scene, given its classes alone.

R-precision over all ordered pairs i ≠ j of present classes × canonical relations: as many
predictions as there are annotated triples. Unlisted is counted as wrong although annotators list
only a few relations a scene. Structure classes are no ends. Scenes without annotated triples are
skipped. What is scored sees no relation, given or held out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from training.batches import Batch, SceneTensors
from training.evaluation.metrics import Ratio
from training.machines import BoltzmannMachine
from training.machines.edges import triple_keys
from training.machines.log_odds import relation_log_odds
from training.machines.mean_field import Evidence

# Scores (B, A, n, n) of the relations between the classes of a batch.
RelationScore = Callable[[Batch], Tensor]


def machine_score(machine: BoltzmannMachine, *, draws: int = 64) -> RelationScore:
    """Log-odds of every relation with all relations unobserved, whatever the batch says of them."""

    def score(batch: Batch) -> Tensor:
        edges = machine.edges(batch.classes, batch.counts)
        values, _ = relation_log_odds(machine, edges, Evidence(batch.v, edges), count=draws)
        return machine.between(edges, values, batch.classes)

    return score


@dataclass(frozen=True, eq=False)
class Candidates:
    """The triples of one scene that are ranked, k of them.

    Attributes:
        scene: place of the scene among those that were scored.
        relation: (k,) int64; key: (k,) int64, see `triple_keys`.
        score: (k,); truth: (k,) bool, annotated.
    """

    scene: int
    relation: NDArray[np.int64]
    key: NDArray[np.int64]
    score: NDArray[np.float64]
    truth: NDArray[np.bool_]

    def where(self, mask: NDArray[np.bool_]) -> Candidates:
        """Some of them."""
        return Candidates(
            self.scene, self.relation[mask], self.key[mask], self.score[mask], self.truth[mask]
        )


def scorable(batch: Batch, structure: Tensor) -> Tensor:
    """(B, A, n, n) bool: the triples between two different classes that are no structure."""
    n = batch.classes.shape[1]
    usable = (batch.classes >= 0) & ~structure[batch.classes.clamp(min=0)]
    pair = usable[:, :, None] & usable[:, None, :] & ~torch.eye(n, dtype=torch.bool)
    return pair[:, None].expand_as(batch.holds)


def telling(batch: Batch, given: Tensor) -> Batch:
    """The batch with nothing known of its relations but those that are given, (B, A, n, n) bool."""
    return replace(batch, holds=given.to(batch.holds.dtype), observed=given)


@torch.no_grad()
def score_scenes(
    scenes: SceneTensors, score: RelationScore, *, counts: bool = True, block: int = 32
) -> list[tuple[Batch, Tensor]]:
    """Batches of the scenes that have annotated triples, with their scores (B, A, n, n).

    Args:
        counts: say how many instances of each class there are; otherwise 0, nobody counted.
    """
    scored = []
    related = [k for k, scene in enumerate(scenes.scenes) if scene.evidence.holds.any()]
    for index in torch.tensor(related, dtype=torch.int64).split(block):
        if len(index):
            batch = scenes.batch(index)
            asked = telling(batch, torch.zeros_like(batch.observed))
            if not counts:
                asked = replace(asked, counts=torch.zeros_like(asked.counts))
            scored.append((batch, score(asked)))
    return scored


def candidates(scored: Iterable[tuple[Batch, Tensor]], structure: Tensor) -> list[Candidates]:
    """The candidates of every scored scene, see `score_scenes`."""
    return number(
        scene
        for batch, values in scored
        for scene in candidates_of(batch, values, scorable(batch, structure))
    )


def candidates_of(batch: Batch, values: Tensor, mask: Tensor) -> Iterator[Candidates]:
    """Candidates of each scene of a batch, by its place there.

    Args:
        values, mask: (B, A, n, n) scores, and which triples are candidates.

    Raises:
        FloatingPointError: the score of a candidate is nan.
    """
    for row in range(len(batch)):
        relation, x, y = mask[row].nonzero(as_tuple=True)
        own = batch.classes[row]
        score = values[row, relation, x, y].double().numpy()
        if np.isnan(score).any():
            raise FloatingPointError(f"the score of scene {row} of a batch is not a number")
        yield Candidates(
            scene=row,
            relation=relation.numpy(),
            key=triple_keys(relation, own[x], own[y], batch.v.shape[1]).numpy(),
            score=score,
            truth=(batch.holds[row, relation, x, y] > 0).numpy(),
        )


def number(scenes: Iterable[Candidates]) -> list[Candidates]:
    """The scenes numbered in the order in which they come."""
    return [replace(scene, scene=place) for place, scene in enumerate(scenes)]


@dataclass(frozen=True, eq=False)
class RelationRanking:
    """Per scene: annotated triples, and how many were among as many predictions.

    Attributes:
        annotated: (scenes,) int64, 0 where skipped; hits: (scenes,).
        skipped: scenes without annotated triples among the candidates.
    """

    annotated: NDArray[np.int64]
    hits: NDArray[np.float64]
    skipped: int

    def pooled(self) -> Ratio:
        """R-precision pooled over scenes."""
        return Ratio(self.hits, self.annotated.astype(np.float64))

    def per_scene(self) -> Ratio:
        """Mean over scenes of their R-precision."""
        return self.pooled().mean_over_scenes()


def rank(scored: Iterable[Candidates], scenes: int, *, first: int | None = None) -> RelationRanking:
    """Annotated triples among the best candidates.

    Args:
        scored: candidates of the scenes that have any.
        scenes: how many scenes there are.
        first: how many predictions; as many as the scene has annotated triples by default.
    """
    annotated, hits = np.zeros(scenes, dtype=np.int64), np.zeros(scenes)
    for scene in scored:
        if count := int(scene.truth.sum()):
            annotated[scene.scene] = count
            hits[scene.scene] = expected_hits(scene.score, scene.truth, first or count)
    return RelationRanking(annotated, hits, skipped=int((annotated == 0).sum()))


def rank_scored(
    scored: Iterable[tuple[Batch, Tensor]], structure: Tensor, scenes: int
) -> RelationRanking:
    """R-precision of scores, see `score_scenes`; `scenes` is how many there were in all."""
    return rank(candidates(scored, structure), scenes)


def of_relation(scored: Sequence[Candidates], relation: int) -> list[Candidates]:
    """Candidates of one canonical relation."""
    return [scene.where(scene.relation == relation) for scene in scored]


def unseen(scored: Sequence[Candidates], seen: Tensor, classes: int) -> list[Candidates]:
    """Candidates that never held in training (zero-shot).

    Args:
        seen: (T, 3) of the (a, i, j) that did; see `training.batches.seen_triples`.
        classes: V.
    """
    relation, subject, object_ = seen.long().unbind(1)
    keys = triple_keys(relation, subject, object_, classes).numpy()
    return [scene.where(~np.isin(scene.key, keys)) for scene in scored]


def rank_relations(
    scenes: SceneTensors, structure: Tensor, score: RelationScore
) -> RelationRanking:
    """R-precision of a score on a set of scenes."""
    return rank_scored(score_scenes(scenes, score), structure, len(scenes))


def expected_hits(score: NDArray[np.float64], truth: NDArray[np.bool_], count: int) -> float:
    """True items among the first `count`, in expectation under random order of ties."""
    if count >= len(score):
        return float(truth.sum())
    threshold = np.partition(score, -count)[-count]
    above, level = score > threshold, score == threshold
    share = (count - above.sum()) / level.sum()
    return float(truth[above].sum() + share * truth[level].sum())
