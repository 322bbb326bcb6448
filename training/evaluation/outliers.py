"""T3: one absent class added to a scene; is it the one that fits least?

Every relation is unobserved. Scenes under three classes are skipped. The intruder is drawn
uniformly from the absent, non-structure classes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import rankdata
from torch import Tensor

from training.batches import SceneTensors
from training.evaluation.intervals import Figure, bootstrap, ratio_figure
from training.evaluation.missing import ObjectScore


@dataclass(frozen=True)
class IntruderScores:
    """Log-odds of each object given the rest, for clean scenes and for the same with an intruder.

    Attributes:
        scene: (N,) position of the scene; log_odds: (N,); intruder: (N,) bool; size: (N,) number of
            distinct classes in the scene as scored; clean: (N,) bool, scored without an intruder.
    """

    scene: NDArray[np.int64]
    log_odds: NDArray[np.float64]
    intruder: NDArray[np.bool_]
    size: NDArray[np.int64]
    clean: NDArray[np.bool_]
    skipped: int

    def hit_at_1(self) -> Figure:
        """Share of scenes whose intruder has the lowest log-odds (ties in expectation)."""
        hits = []
        for scene in np.unique(self.scene):
            rows = (self.scene == scene) & ~self.clean
            lowest = self.log_odds[rows] == self.log_odds[rows].min()
            hits.append(float((lowest & self.intruder[rows]).sum() / lowest.sum()))
        return ratio_figure(np.array(hits), np.ones(len(hits)))

    def auroc(self) -> Figure:
        """Area under the ROC of -log-odds, intruders against the objects they joined."""
        rows = ~self.clean
        scene, odds, bad = self.scene[rows], self.log_odds[rows], self.intruder[rows]
        names, place = np.unique(scene, return_inverse=True)
        order = np.argsort(place, kind="stable")
        bounds = np.searchsorted(place[order], np.arange(len(names) + 1))

        def area(chosen: NDArray[np.int64]) -> float:
            index = np.concatenate([order[bounds[k] : bounds[k + 1]] for k in chosen])
            rank = rankdata(-odds[index])
            positive = bad[index]
            p, q = int(positive.sum()), int((~positive).sum())
            return float((rank[positive].sum() - p * (p + 1) / 2) / (p * q))

        return bootstrap(area, len(names), int(bad.sum()), resamples=200)


@torch.no_grad()
def intruder_scores(
    scenes: SceneTensors,
    structure: Tensor,
    score: ObjectScore,
    *,
    seed: int = 0,
    block: int = 32,
) -> IntruderScores:
    """Score every object of every scene, clean and with one uniformly drawn intruder."""
    generator = torch.Generator().manual_seed(seed)
    kept = (((scenes.v > 0) & ~structure).sum(1) >= 3).nonzero().squeeze(1)
    parts: list[tuple[Tensor, ...]] = []
    for start in range(0, len(kept), block):
        index = kept[start : start + block]
        clean = scenes.v[index]
        absent = ((clean == 0) & ~structure).float()
        added = torch.multinomial(absent, 1, generator=generator)
        dirty = clean.scatter(1, added, 1.0)
        for v, is_clean in ((clean, True), (dirty, False)):
            row, thing = ((v > 0) & ~structure).nonzero(as_tuple=True)
            rest = v[row].scatter(1, thing.unsqueeze(1), 0.0)
            odds = score(rest).gather(1, thing.unsqueeze(1)).squeeze(1)
            bad = (thing == added[row, 0]) & (not is_clean)
            size = (v > 0).sum(1)[row]
            flag = torch.full_like(bad, is_clean)
            parts.append((index[row], odds.double(), bad, size, flag))
    placed, log_odds, intruder, sizes, untouched = (
        torch.cat(column).numpy() for column in zip(*parts, strict=True)
    )
    return IntruderScores(
        placed, log_odds, intruder, sizes, untouched, skipped=len(scenes) - len(kept)
    )
