"""T1b: the other half of a scene's relations, given its classes and a random half of them.

The triples are canonical and distinct before they are split, so that no triple is held out in one
spelling (left) and given in the other (right). Given triples are no candidates, nor are their
mirror images a(y, x), which a given a(x, y) all but excludes. Everything that is not given is
unobserved. Scenes with fewer than two triples are skipped. Otherwise as T1a.
"""

from __future__ import annotations

import torch
from torch import Tensor

from training.batches import SceneTensors
from training.evaluation.cases import scene_rng
from training.evaluation.relations import (
    Candidates,
    RelationScore,
    candidates_of,
    number,
    scorable,
    telling,
)


def random_half(truth: Tensor, scenes: SceneTensors, index: Tensor, seed: int) -> Tensor:
    """Half of each scene's triples (rounded down), (B, A, n, n) bool.

    Args:
        truth: (B, A, n, n) bool, the triples to choose from.
        index: (B,) positions of the scenes.
    """
    given = torch.zeros_like(truth)
    for row, k in enumerate(index.tolist()):
        triples = truth[row].nonzero()
        order = scene_rng(scenes.scenes[k], seed).permutation(len(triples))
        chosen = triples[torch.from_numpy(order[: len(triples) // 2])]
        given[row][tuple(chosen.T)] = True
    return given


@torch.no_grad()
def complete_scenes(
    scenes: SceneTensors,
    structure: Tensor,
    score: RelationScore,
    *,
    seed: int = 0,
    block: int = 16,
) -> list[Candidates]:
    """The candidates of every scene with two triples or more, scored given half of the triples."""
    found: list[Candidates] = []
    related = [k for k, scene in enumerate(scenes.scenes) if scene.evidence.holds.sum() >= 2]
    for index in torch.tensor(related, dtype=torch.int64).split(block):
        if not len(index):
            continue
        batch = scenes.batch(index)
        mask = scorable(batch, structure)
        given = random_half((batch.holds > 0) & mask, scenes, index, seed)
        values = score(telling(batch, given))
        # A single triple cannot be divided: nothing of it was given.
        divided = given.any(-1).any(-1).any(-1)[:, None, None, None]
        found += candidates_of(batch, values, mask & ~given & ~given.mT & divided)
    return number(found)
