"""Log-odds of objects with and without intruders, and thresholds of the alarm.

The alarm threshold aims at a fixed share of alarms in clean scenes (scenes without an intruder).
The alarms in scenes of one place are correlated, and sources differ in their variety. So the
threshold keeps the share within each source, with a safety margin from resampled groups.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from training.datasets.array_types import Flags, Floats, Ints, Rng
from training.datasets.batches import SceneTensors
from training.evaluation.alarms import ALARMS, SOURCE_SCENES
from training.evaluation.intruders import draw_intruders
from training.evaluation.metrics import Items, Ratio

_RESAMPLES = 200
# The threshold keeps the target share of alarms in this share of the resampled sets of groups.
_CONFIDENCE = 0.7
# Minimum number of scenes of all small sources together for a threshold.
_SMALL_SCENES = 30


@dataclass(frozen=True, eq=False)
class IntruderScores:
    """Log-odds of each object given the other objects, for scenes without and with an intruder.

    A scene is scored twice: once as it is (clean), and once with its intruder. The arrays have one
    entry for each object of each scored scene.

    Attributes:
        scene: (objects,) index of the scene.
        thing: (objects,) class of the object.
        log_odds: (objects,) log-odds of the object.
        intruder: (objects,) bool, True if the object is the intruder.
        size: (objects,) number of distinct classes in the scored scene.
        clean: (objects,) bool, True if the scored scene has no intruder.
        skipped: number of scenes that are too small or have no possible intruder.
    """

    scene: Ints
    thing: Ints
    log_odds: Floats
    intruder: Flags
    size: Ints
    clean: Flags
    scenes: int
    skipped: int

    @property
    def listed(self) -> Ints:
        """(objects,) number of distinct classes in the scored scene, without structure classes."""
        as_scored = 2 * self.scene + self.clean
        counts: Ints = np.bincount(as_scored)[as_scored]
        return counts

    def with_prior(self, prior: Floats) -> IntruderScores:
        """Subtract the prior log-odds that a class is an intruder, `prior` (classes,)."""
        return replace(self, log_odds=self.log_odds - prior[self.thing])

    @property
    def dirty(self) -> Items:
        """The objects of scenes with an intruder as items: negated log-odds, true for intruders."""
        rows = ~self.clean
        score, truth = -self.log_odds[rows], self.intruder[rows]
        return Items(self.scene[rows], score, truth, self.scenes, self.skipped)

    def hit_at_1(self) -> Ratio:
        """Return the share of scenes whose intruder has the lowest log-odds; expected over ties."""
        return self.dirty.hit_at_1()

    def false_alarms(self, alarms: Flags) -> Ratio:
        """Return the share of clean scenes with an alarm, for the alarms `alarms` (objects,)."""
        return self._alarms(alarms, self.clean)

    def caught(self, alarms: Flags) -> Ratio:
        """Return the share of intruders with an alarm, for the alarms `alarms` (objects,)."""
        return self._alarms(alarms, self.intruder)

    def _alarms(self, alarms: Flags, judged: Flags) -> Ratio:
        has_object = np.bincount(self.scene[judged], minlength=self.scenes) > 0
        has_alarm = np.bincount(self.scene[judged & alarms], minlength=self.scenes) > 0
        return Ratio.of_scenes(has_alarm, has_object)


Score = Callable[[Tensor], Tensor]


@torch.no_grad()
def intruder_scores(
    scenes: SceneTensors,
    structure: Tensor,
    score: Score,
    *,
    weights: Tensor | None = None,
    seed: int = 0,
) -> IntruderScores:
    """Score every object of every scene, without an intruder and with an intruder.

    All relations are unobserved.

    Args:
        score: function that takes presence (rows, classes) and returns log-odds (rows, classes).
    """
    added = draw_intruders(scenes, structure, weights, seed)
    blocks = []
    for index in (added >= 0).nonzero().squeeze(1).split(32):
        clean, intruder = scenes.v[index], added[index]
        blocks.append((clean, index, torch.full_like(intruder, -1)))
        blocks.append((clean.scatter(1, intruder.unsqueeze(1), 1.0), index, intruder))
    return _scores(blocks, structure, score, len(scenes), int((added < 0).sum()))


@torch.no_grad()
def clean_scores(v: Tensor, structure: Tensor, score: Score) -> IntruderScores:
    """Score every object of the scenes `v` (scenes, classes), without intruders."""
    blocks = [
        (v[index], index, torch.full_like(index, -1)) for index in torch.arange(len(v)).split(64)
    ]
    return _scores(blocks, structure, score, len(v), 0)


def _scores(
    blocks: list[tuple[Tensor, Tensor, Tensor]],
    structure: Tensor,
    score: Score,
    scenes: int,
    skipped: int,
) -> IntruderScores:
    """Score the objects of blocks of (presence, scene indices, intruders or -1)."""
    parts = []
    for v, index, added in blocks:
        row, things = ((v > 0) & ~structure).nonzero(as_tuple=True)
        log_odds = torch.zeros(0)
        if len(row):
            other_objects = v[row].scatter(1, things.unsqueeze(1), 0.0)
            log_odds = score(other_objects).gather(1, things.unsqueeze(1)).squeeze(1)
        parts.append(
            {
                "scene": index[row],
                "thing": things,
                "log_odds": log_odds.double(),
                "intruder": things == added[row],
                "size": (v > 0).sum(1)[row],
                "clean": added[row] < 0,
            }
        )
    columns = {name: torch.cat([part[name] for part in parts]).numpy() for name in parts[0]}
    return IntruderScores(**columns, scenes=scenes, skipped=skipped)


def alarm_threshold(
    suspicion: Floats,
    scores: IntruderScores,
    scenes: SceneTensors,
    rng: Rng,
    share: float = ALARMS["medium"],
) -> float:
    """Compute the suspicion from which an object raises the alarm, see `kept_in_each_source`.

    Args:
        suspicion: (N,) score per object; higher = more likely an intruder.
        scores: scored objects of `scenes`, including clean scenes.
        share: share of alarms in clean scenes of the large source with the highest threshold.

    Raises:
        ValueError: the scores contain no clean scene.
        FloatingPointError: a clean scene has a suspicion that is not finite.
    """
    worst = np.full(len(scenes), -np.inf)
    np.maximum.at(worst, scores.scene[scores.clean], suspicion[scores.clean])
    is_clean = np.bincount(scores.scene[scores.clean], minlength=len(scenes)) > 0
    if not is_clean.any():
        raise ValueError("the scores contain no clean scene, which the alarm threshold needs")
    if not np.isfinite(worst[is_clean]).all():
        raise FloatingPointError("the suspicion of a clean scene is not finite")
    group = np.array([scene.group for scene in scenes.scenes])[is_clean]
    return kept_in_each_source(worst[is_clean], group, scenes.source.numpy()[is_clean], rng, share)


def kept_in_each_source(
    worst: Floats, group: NDArray[np.str_], source: Ints, rng: Rng, share: float
) -> float:
    """Return the threshold that keeps the share of alarms within every source.

    A robot sees scenes of one source. So the source with the highest threshold decides, and other
    sources have fewer alarms. Small sources are pooled and use their plain quantile, because
    resampling a few places mostly reflects their strangest scene.

    Args:
        worst: (N,) highest suspicion of each clean scene.
        group: (N,) group of each scene.
        source: (N,) index of the source of each scene.
    """
    kinds, sizes = np.unique(source, return_counts=True)
    large = [source == kind for kind in kinds[sizes >= SOURCE_SCENES]]
    is_small = np.isin(source, kinds[sizes < SOURCE_SCENES])
    limits = [_cautious_threshold(worst[scenes], group[scenes], rng, share) for scenes in large]
    if is_small.sum() >= _SMALL_SCENES or not large:
        limits.append(float(np.quantile(worst[is_small], 1 - share)))
    # A suspicion equal to the threshold raises the alarm. Many scenes may share one value, such as
    # the popularity of a class, so the threshold moves just above it.
    return float(np.nextafter(max(limits), np.inf))


def _cautious_threshold(worst: Floats, group: NDArray[np.str_], rng: Rng, share: float) -> float:
    """Return a threshold that a share of scenes exceeds, with a safety margin.

    Scenes of one place raise alarms together, so the share in new places is uncertain. The margin
    is a high quantile of the threshold over resampled groups.
    """
    members = [worst[group == name] for name in np.unique(group)]
    thresholds = []
    for _ in range(_RESAMPLES):
        sample = rng.integers(len(members), size=len(members))
        thresholds.append(np.quantile(np.concatenate([members[k] for k in sample]), 1 - share))
    return float(np.quantile(thresholds, _CONFIDENCE))
