"""T3: one absent class added to a scene; is it the one that fits least?

Every relation is unobserved. Scenes under three classes are skipped. The intruder is drawn from the
absent, non-structure classes by one of three laws: uniformly, by popularity in training, or
uniformly from the classes that training saw in the same room type.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from training.batches import SceneTensors
from training.evaluation.cases import scene_rng
from training.evaluation.metrics import Ratio, Scored, lowest_is
from training.evaluation.missing import ObjectScore


@dataclass(frozen=True, eq=False)
class IntruderScores:
    """Log-odds of each object given the rest, for clean scenes and for the same with an intruder.

    Attributes:
        scene: (N,) position of the scene; log_odds: (N,); intruder: (N,) bool; size: (N,) number of
            distinct classes in the scene as scored; clean: (N,) bool, scored without an intruder.
        thing: (N,) its class.
        scenes: how many were given; skipped: too small, or without a class to add.
    """

    scene: NDArray[np.int64]
    log_odds: NDArray[np.float64]
    intruder: NDArray[np.bool_]
    size: NDArray[np.int64]
    clean: NDArray[np.bool_]
    thing: NDArray[np.int64]
    scenes: int
    skipped: int

    @property
    def listed(self) -> NDArray[np.int64]:
        """(N,) number of distinct classes in the scene as scored, structure aside."""
        as_scored = 2 * self.scene + self.clean
        counts: NDArray[np.int64] = np.bincount(as_scored)[as_scored]
        return counts

    def with_prior(self, prior: NDArray[np.float64]) -> IntruderScores:
        """With the log-odds of being an intruder taken from each class, (V,)."""
        return replace(self, log_odds=self.log_odds - prior[self.thing])

    def hit_at_1(self) -> Ratio:
        """Share of scenes whose intruder has the lowest log-odds (ties in expectation)."""
        rows = ~self.clean
        return lowest_is(self.scene[rows], self.log_odds[rows], self.intruder[rows], self.scenes)

    def auroc(self) -> Scored:
        """Area under the ROC of -log-odds, intruders against the objects they joined."""
        return self._scored("AUROC")

    def average_precision(self) -> Scored:
        """Average precision of the same ranking."""
        return self._scored("average precision")

    def _scored(self, statistic: str) -> Scored:
        rows = ~self.clean
        scene, score = self.scene[rows], -self.log_odds[rows]
        return Scored(statistic, scene, score, self.intruder[rows], self.scenes)

    def false_alarms(self, loud: NDArray[np.bool_]) -> Ratio:
        """Share of untouched scenes in which some object is loud, (N,)."""
        return self._alarms(loud, self.clean)

    def caught(self, loud: NDArray[np.bool_]) -> Ratio:
        """Share of intruders that are loud, (N,)."""
        return self._alarms(loud, self.intruder)

    def _alarms(self, loud: NDArray[np.bool_], judged: NDArray[np.bool_]) -> Ratio:
        there = np.bincount(self.scene[judged], minlength=self.scenes) > 0
        alarm = np.bincount(self.scene[judged & loud], minlength=self.scenes) > 0
        return Ratio(alarm.astype(np.float64), there.astype(np.float64))


def by_popularity(scenes: SceneTensors, train: SceneTensors) -> Tensor:
    """Weights (N, V): in how many of the training scenes each class is."""
    return train.v.sum(0).expand(len(scenes), -1)


def by_room(scenes: SceneTensors, train: SceneTensors) -> Tensor:
    """Weights (N, V): 1 for classes that training saw in the scene's room type; 0 if unknown."""
    weights = torch.zeros_like(scenes.v)
    for room in scenes.room.unique().tolist():
        if room >= 0:
            seen = (train.v[train.room == room] > 0).any(0)
            weights[scenes.room == room] = seen.to(weights.dtype)
    return weights


def draw_intruders(
    scenes: SceneTensors, structure: Tensor, weights: Tensor | None = None, seed: int = 0
) -> Tensor:
    """An intruder for each scene, (N,) int64; -1 where a scene is skipped.

    Args:
        structure: (V,) bool.
        weights: (N, V) or None for uniform, how likely each class is to be drawn if absent.
    """
    present = scenes.v > 0
    absent = (~present & ~structure).double()
    if weights is not None:
        absent = absent * weights
    enough = ((present & ~structure).sum(1) >= 3) & (absent.sum(1) > 0)
    intruders = torch.full((len(scenes),), -1, dtype=torch.int64)
    for k in enough.nonzero().squeeze(1).tolist():
        p = absent[k].numpy()
        rng = scene_rng(scenes.scenes[k], seed)
        intruders[k] = int(rng.choice(len(p), p=p / p.sum()))
    return intruders


@torch.no_grad()
def intruder_scores(
    scenes: SceneTensors,
    structure: Tensor,
    score: ObjectScore,
    *,
    weights: Tensor | None = None,
    seed: int = 0,
    block: int = 32,
) -> IntruderScores:
    """Score every object of every scene, clean and with one intruder; see `draw_intruders`."""
    added = draw_intruders(scenes, structure, weights, seed)
    kept = (added >= 0).nonzero().squeeze(1)
    blocks = (
        part
        for index in kept.split(block)
        if len(index)
        for part in _scored_blocks(scenes.v[index], index, added[index], structure, score)
    )
    return _scores(blocks, len(scenes), len(kept))


@torch.no_grad()
def clean_scores(
    v: Tensor, structure: Tensor, score: ObjectScore, block: int = 64
) -> IntruderScores:
    """Score every object of every scene (N, V) as it is."""
    index = torch.arange(len(v))
    blocks = (
        _scored(v[some], some, torch.full_like(some, -1), structure, score, clean=True)
        for some in index.split(block)
        if len(some)
    )
    return _scores(blocks, len(v), len(v))


_Columns = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def _scores(blocks: Iterable[_Columns], scenes: int, kept: int) -> IntruderScores:
    nothing = torch.zeros(0, dtype=torch.int64)
    parts = [(nothing, nothing.double(), nothing.bool(), nothing, nothing.bool(), nothing), *blocks]
    placed, log_odds, intruder, sizes, untouched, thing = (
        torch.cat(column).numpy() for column in zip(*parts, strict=True)
    )
    return IntruderScores(
        placed,
        log_odds,
        intruder,
        sizes,
        untouched,
        thing,
        scenes=scenes,
        skipped=scenes - kept,
    )


def _scored_blocks(
    clean: Tensor, index: Tensor, added: Tensor, structure: Tensor, score: ObjectScore
) -> Iterator[_Columns]:
    dirty = clean.scatter(1, added.unsqueeze(1), 1.0)
    yield _scored(clean, index, added, structure, score, clean=True)
    yield _scored(dirty, index, added, structure, score, clean=False)


def _scored(
    v: Tensor, index: Tensor, added: Tensor, structure: Tensor, score: ObjectScore, *, clean: bool
) -> _Columns:
    row, thing = ((v > 0) & ~structure).nonzero(as_tuple=True)
    rest = v[row].scatter(1, thing.unsqueeze(1), 0.0)
    odds = score(rest).gather(1, thing.unsqueeze(1)).squeeze(1)
    bad = (thing == added[row]) & (not clean)
    size = (v > 0).sum(1)[row]
    return index[row], odds.double(), bad, size, torch.full_like(bad, clean), thing
