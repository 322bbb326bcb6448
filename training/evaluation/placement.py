"""T3b: one of a scene's triples is false; is it the one that fits least?

One triple is replaced, half of the time by another relation between its two classes, otherwise by
another present class at one of its ends. What replaces it is not true in the scene, nor is its
mirror image, which the rest of the triples would contradict outright. The triples are canonical and
distinct, so that what was replaced is gone in every spelling. Each triple is judged given the
others; scenes with fewer than two triples, or without a false one, are skipped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from training.batches import SceneTensors
from training.evaluation.cases import scene_rng
from training.evaluation.metrics import Ratio, Scored, lowest_is
from training.evaluation.relations import RelationScore, scorable, telling

_TRIES = 50

Triple = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class PlacementScores:
    """Scores of the N triples of all scenes, each with one false triple.

    Attributes:
        scene: (N,) position; score: (N,), higher = likelier true; false: (N,) bool.
        scenes, skipped: how many were given, and how many could not be scored.
    """

    scene: NDArray[np.int64]
    score: NDArray[np.float64]
    false: NDArray[np.bool_]
    scenes: int
    skipped: int

    def hit_at_1(self) -> Ratio:
        """Share of scenes whose false triple has the lowest score (ties in expectation)."""
        return lowest_is(self.scene, self.score, self.false, self.scenes)

    def auroc(self) -> Scored:
        """Area under the ROC, false triples against true ones."""
        return Scored("AUROC", self.scene, -self.score, self.false, self.scenes)


def alter(
    holds: NDArray[np.bool_], usable: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[Triple, Triple] | None:
    """A triple of a scene and the false one in its place; None where there is none.

    Args:
        holds: (A, n, n) what is true; usable: (A, n, n) which triples may be asked for.
    """
    triples = np.argwhere(holds & usable)
    if len(triples) < 2:
        return None
    A, n, _ = holds.shape
    a, x, y = triples[rng.integers(len(triples))].tolist()
    for _ in range(_TRIES):
        kind, other = rng.random(), int(rng.integers(n))
        if kind < 0.5:
            false = (int(rng.integers(A)), x, y)
        elif kind < 0.75:
            false = (a, x, other)
        else:
            false = (a, other, y)
        b, i, j = false
        if usable[false] and not holds[b, i, j] and not holds[b, j, i]:
            return (a, x, y), false
    return None


@torch.no_grad()
def placement_scores(
    scenes: SceneTensors,
    structure: Tensor,
    score: RelationScore,
    *,
    seed: int = 0,
    block: int = 16,
) -> PlacementScores:
    """Score every triple of every scene of which one is false.

    Args:
        score: gets the triples as observed ones; it must judge each without itself.
    """
    scene = [torch.zeros(0, dtype=torch.int64)]
    values = [torch.zeros(0, dtype=torch.float64)]
    false = [torch.zeros(0, dtype=torch.bool)]
    related = [k for k, entry in enumerate(scenes.scenes) if entry.evidence.holds.sum() >= 2]
    for index in torch.tensor(related, dtype=torch.int64).split(block):
        if not len(index):
            continue
        batch = scenes.batch(index)
        usable = scorable(batch, structure)
        truth = (batch.holds > 0) & usable
        stated = torch.zeros_like(truth)
        wrong = torch.zeros_like(truth)
        for row, k in enumerate(index.tolist()):
            rng = scene_rng(scenes.scenes[k], seed)
            case = alter(batch.holds[row].numpy() > 0, usable[row].numpy(), rng)
            if case is not None:
                before, after = case
                stated[row] = truth[row]
                stated[row][before] = False
                stated[row][after] = wrong[row][after] = True
        result = score(telling(batch, stated))
        scene.append(index[stated.nonzero()[:, 0]])
        values.append(result[stated].double())
        false.append(wrong[stated])
    place = torch.cat(scene).numpy()
    return PlacementScores(
        scene=place,
        score=torch.cat(values).numpy(),
        false=torch.cat(false).numpy(),
        scenes=len(scenes),
        skipped=len(scenes) - len(np.unique(place)),
    )
