"""When a scene is called wrong: one rule for machines and baselines.

An alarm in a given share of untouched scenes is promised. Alarms of one place come together, places
differ, and a source of one kind may be far more varied than another. So the threshold is kept for
each source by itself, on the safe side of what resampled groups leave open.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from app.registry import Calibration
from training.batches import SceneTensors
from training.evaluation.cases import some_scenes
from training.evaluation.missing import ObjectScore
from training.evaluation.outliers import IntruderScores, intruder_scores
from training.trainer import subset

Floats = NDArray[np.float64]

MEDIUM = 0.1
"""Share of untouched scenes that raise an alarm at the default sensitivity."""

_RESAMPLES = 200
# New places differ: the threshold is on the safe side in so many of the resampled sets of groups.
_CONFIDENCE = 0.7
# Scenes of a source whose share of alarms is kept by itself, and of small sources together.
_SOURCE_SCENES = 200
_SMALL_SCENES = 30
_SCENES = 1500


@dataclass(frozen=True, eq=False)
class Alarm:
    """When a scene is called wrong.

    Attributes:
        suspicion: scores (N,) of each judged object, higher = more an intruder.
        threshold: from which an object raises the alarm.
        short: the same for lists of 1, 2, ... classes, structure aside.
    """

    suspicion: Callable[[IntruderScores], Floats]
    threshold: float
    short: tuple[float, ...] = ()

    def raised(self, scores: IntruderScores) -> NDArray[np.bool_]:
        """Whether each scored object raises the alarm, (N,)."""
        limits = np.array([*self.short, self.threshold])
        limit = limits[np.minimum(scores.listed - 1, len(self.short))]
        loud: NDArray[np.bool_] = self.suspicion(scores) >= limit
        return loud


def calibrated_alarm(calibration: Calibration) -> Alarm:
    """The service's own: its probability of an intruder, and its default threshold."""
    entry = calibration.outlier
    popularity = np.array(calibration.popularity)

    def suspicion(scores: IntruderScores) -> Floats:
        if len(popularity):
            scores = scores.with_prior(calibration.popularity_weight * popularity)
        return np.asarray(1 / (1 + np.exp(-entry.log_odds(scores.log_odds, scores.size))))

    short = tuple(limits.medium for limits in calibration.short_list_thresholds)
    return Alarm(suspicion, calibration.outlier_thresholds.medium, short)


def fitted_alarm(
    score: ObjectScore, validation: SceneTensors, structure: Tensor, seed: int = 0
) -> Alarm:
    """The alarm of a score that has no calibration, by log-odds alone.

    Args:
        validation: those with complete object lists are judged, at most 1,500.
        structure: (V,) bool.
    """
    complete = subset(validation, validation.complete.nonzero().squeeze(1))
    scenes = some_scenes(complete, _SCENES, seed)
    scores = intruder_scores(scenes, structure, score, seed=seed)
    threshold = alarm_threshold(-scores.log_odds, scores, scenes, np.random.default_rng(seed))
    return Alarm(lambda asked: -asked.log_odds, threshold)


def alarm_threshold(
    suspicion: Floats,
    scores: IntruderScores,
    scenes: SceneTensors,
    rng: np.random.Generator,
    share: float = MEDIUM,
) -> float:
    """The suspicion from which an object raises the alarm.

    The share of false alarms is kept in each source by itself: a robot's scenes are of one kind,
    and one quantile over all kinds would alarm often in the most varied one and never in others.

    Args:
        suspicion: (N,) of each scored object; higher = more an intruder.
        scores: of `scenes`, with untouched ones among them.
        share: of untouched scenes of the hardest large source that raise an alarm.

    Raises:
        ValueError: no untouched scene was scored.
        FloatingPointError: one of them has no finite suspicion.
    """
    worst = np.full(len(scenes), -np.inf)
    np.maximum.at(worst, scores.scene[scores.clean], suspicion[scores.clean])
    judged = np.bincount(scores.scene[scores.clean], minlength=len(scenes)) > 0
    if not judged.any():
        raise ValueError("no untouched scene was scored: there is nothing to fit an alarm on")
    if not np.isfinite(worst[judged]).all():
        raise FloatingPointError("the suspicion of an untouched scene is not finite")
    group = np.array([scene.group for scene in scenes.scenes])[judged]
    return kept_in_each_source(worst[judged], group, scenes.source.numpy()[judged], rng, share)


def kept_in_each_source(
    worst: Floats,
    group: NDArray[np.str_],
    source: NDArray[np.int64],
    rng: np.random.Generator,
    share: float,
) -> float:
    """The threshold that the given share of scenes reaches in the hardest source, and less in
    others.

    Small sources are judged together, and by their quantile as it is: of few places, resampled ones
    say little more than the strangest scene does.

    Args:
        worst: (N,) the most suspicious score of each untouched scene.
        group: (N,) places; source: (N,) numbers.
    """
    kinds, sizes = np.unique(source, return_counts=True)
    large = [source == kind for kind in kinds[sizes >= _SOURCE_SCENES]]
    small = np.isin(source, kinds[sizes < _SOURCE_SCENES])
    bounds = [_bound(worst[some], group[some], rng, share) for some in large]
    if small.sum() >= _SMALL_SCENES or not large:
        bounds.append(float(np.quantile(worst[small], 1 - share)))
    # What reaches the threshold raises the alarm, and many scenes may have one and the same worst
    # suspicion (a class's popularity): these stay below.
    return float(np.nextafter(max(bounds), np.inf))


def _bound(worst: Floats, group: NDArray[np.str_], rng: np.random.Generator, share: float) -> float:
    """The threshold that a share of scenes exceeds, on the safe side.

    Scenes of one place raise alarms together, so the share in new places is uncertain: a high
    quantile of the threshold over resampled groups.
    """
    members = [worst[group == name] for name in np.unique(group)]
    found = []
    for _ in range(_RESAMPLES):
        drawn = rng.integers(len(members), size=len(members))
        scenes = np.concatenate([members[k] for k in drawn])
        found.append(np.quantile(scenes, 1 - share))
    return float(np.quantile(found, _CONFIDENCE))
