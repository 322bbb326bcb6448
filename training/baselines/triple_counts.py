"""How often each relation held between each pair of classes, and tables of that size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from training.batches import Batch, SceneTensors


@dataclass(frozen=True, eq=False)
class TripleCounts:
    """Scenes per (a, i, j); nothing is counted of structure classes and of i = j.

    Attributes:
        held: (A, V, V) scenes in which the relation held.
        together: (V, V) scenes with annotated relations in which both classes were present.
    """

    held: Tensor
    together: Tensor

    def overall(self) -> Tensor:
        """p(r) of a pair of classes, (A,); one case is added to both sides."""
        return (self.held.sum((1, 2)) + 1.0) / (self.together.sum() + 2.0)


def count_triples(scenes: SceneTensors, structure: Tensor) -> TripleCounts:
    """Counts over the scenes with annotated relations.

    What is not listed counts as off, as T1 counts it, even where the geometry left a pair
    unobserved: rates among observed pairs alone overrate relations that are looked for only where
    they hold (validation R-precision .323 against .343 on procthor, .10 against .34 on bedrooms).

    Raises:
        ValueError: no scene has any.
    """
    V = scenes.v.shape[1]
    related = [scene.evidence for scene in scenes.scenes if scene.evidence.observed.any()]
    if not related:
        raise ValueError(f"no relation was observed in {len(scenes)} training scenes")
    A = related[0].holds.shape[0]
    held = np.zeros((A, V, V), dtype=np.float32)
    together = np.zeros((V, V), dtype=np.float32)
    for e in related:
        held[np.ix_(np.arange(A), e.classes, e.classes)] += e.holds
        together[np.ix_(e.classes, e.classes)] += 1.0
    skip = structure.numpy()
    pair = ~(skip[:, None] | skip | np.eye(V, dtype=np.bool_))
    return TripleCounts(torch.from_numpy(held * pair), torch.from_numpy(together * pair))


@dataclass(frozen=True, eq=False)
class TripleTable:
    """A relation score that is looked up: table[a, i, j] + g · log(n_i n_j).

    It reads the classes and counts of a batch, never its relations.

    Attributes:
        log_odds: (A, V, V).
        multiplicity: g, what more instances at either end add; 0 ignores counts.
    """

    log_odds: Tensor
    multiplicity: float = 0.0

    def __call__(self, batch: Batch) -> Tensor:
        """Log-odds (B, A, n, n), of no meaning where padded."""
        index = batch.classes.clamp(min=0)
        values = self.log_odds[:, index[:, :, None], index[:, None, :]].movedim(0, 1)
        if self.multiplicity:
            logs = batch.counts.clamp(min=1).to(values.dtype).log()
            values = values + self.multiplicity * (logs[:, None, :, None] + logs[:, None, None, :])
        return values
