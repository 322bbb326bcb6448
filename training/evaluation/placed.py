"""T2-at: one class left out, and one relation of it known with the other end ("on the desk").

Each removable class that stood in a relation to another class is left out in turn with all its
instances and relations. One of these relations, drawn at random, tells where it was: its direction
and the class at its other end, never the removed class. All absent classes are ranked. Relations
between equal classes or with structure are not asked; scenes under two classes are skipped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from training.batches import SceneTensors
from training.evaluation.cases import scene_rng
from training.evaluation.metrics import Ratio
from training.evaluation.missing import LeaveOneOut, rank_blocks


@dataclass(frozen=True, eq=False)
class Places:
    """B scenes with a class left out, and where it stood.

    Attributes:
        v: (B, V) presence of what stayed.
        counts: (B, V) instances of what stayed, 0 elsewhere.
        relation: (B,) int64 canonical.
        anchor: (B,) int64 class at the other end.
        outgoing: (B,) bool: the missing class is the subject of the relation.
    """

    v: Tensor
    counts: Tensor
    relation: Tensor
    anchor: Tensor
    outgoing: Tensor

    def rows(self, index: Tensor) -> Places:
        """Some of them."""
        return Places(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


# Scores (B, V) of every class: the higher, the likelier missing from that place.
PlacedScore = Callable[[Places], Tensor]


@dataclass(frozen=True, eq=False)
class PlacedRanking:
    """Every removed class; relation (N,) says by which canonical relation it was asked for."""

    ranking: LeaveOneOut
    relation: NDArray[np.int64]

    def mrr(self, relation: int | None = None) -> Ratio:
        """Mean reciprocal rank, of one relation if given."""
        some = np.ones(len(self.relation), dtype=np.bool_)
        if relation is not None:
            some = self.relation == relation
        value = self.ranking.reciprocal_rank()[some]
        return Ratio.of_items(self.ranking.scene[some], value, self.ranking.scenes)


def removed_places(
    scenes: SceneTensors, structure: Tensor, seed: int = 0
) -> tuple[Tensor, Tensor, Places]:
    """Positions of the scenes (N,), removed classes (N,), and what stayed."""
    found: list[tuple[int, int, int, int, bool]] = []
    plain = ~structure.numpy()
    for k, scene in enumerate(scenes.scenes):
        evidence = scene.evidence
        usable = plain[evidence.classes]
        if usable.sum() < 2:
            continue
        pair = usable[:, None] & usable & ~np.eye(len(usable), dtype=np.bool_)
        triples = np.argwhere(evidence.holds & pair)
        rng = scene_rng(scene, seed)
        for x in np.unique(triples[:, 1:]):
            touching = triples[(triples[:, 1:] == x).any(1)]
            a, i, j = touching[rng.integers(len(touching))].tolist()
            anchor = j if i == x else i
            target, other = evidence.classes[[x, anchor]].tolist()
            found.append((k, target, a, other, bool(i == x)))
    table = torch.tensor(found, dtype=torch.int64).reshape(-1, 5)
    row, target, relation, anchor, outgoing = table.unbind(1)
    v = scenes.v[row].scatter(1, target.unsqueeze(1), 0.0)
    counts = torch.zeros_like(v)
    for place, k in enumerate(row.tolist()):
        evidence = scenes.scenes[k].evidence
        counts[place, torch.from_numpy(evidence.classes)] = torch.from_numpy(
            evidence.counts
        ).float()
    return row, target, Places(v, counts * v, relation, anchor, outgoing.bool())


@torch.no_grad()
def leave_one_out_at(
    scenes: SceneTensors,
    structure: Tensor,
    score: PlacedScore,
    *,
    seed: int = 0,
    block: int = 16,
) -> PlacedRanking:
    """Rank every removed class among all absent ones, given where it stood."""
    row, target, places = removed_places(scenes, structure, seed)

    def blocks() -> list[tuple[Tensor, Tensor, Tensor]]:
        every = []
        for index in torch.arange(len(row)).split(block):
            if not len(index):
                continue
            some = places.rows(index)
            values = score(some).masked_fill((some.v > 0) | structure, -torch.inf)
            every.append((row[index], target[index], values))
        return every

    skipped = len(scenes) - len(row.unique())
    return PlacedRanking(rank_blocks(blocks(), len(scenes), skipped), places.relation.numpy())
