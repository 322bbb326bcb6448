"""T3: one absent class is added to a scene; is it the one that fits least? And the alarm.

A score answers by the log-odds of each object given the rest. A published model is asked as a robot
asks: all instances of the scene as labels, nothing else. hit@1 then follows the service's ranking,
the probability of being an intruder; hit@1 by log-odds stands beside it. Structure raises no alarm
and takes no rank. Ties score their expectation.

An alarm in a given share of untouched scenes is promised, by one rule for machines and baselines.
Alarms of one place come together, places differ, and a source of one kind may be far more varied
than another. So the threshold is kept for each source by itself, on the safe side of what resampled
groups leave open.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from app.questions import Sensitivity
from app.registry import Artifact, Calibration
from app.scene import Scene
from training.batches import SceneTensors, subset
from training.cases import scene_rng, some_scenes
from training.datasets import EncodedScene
from training.evaluation.asking import (
    SENSITIVITIES,
    ask_every,
    judge,
    labels_alone,
    things,
    with_intruder,
)
from training.evaluation.intruders import (
    IntruderScores,
    Law,
    by_popularity,
    by_signature,
    draw_intruders,
    intruder_scores,
)
from training.evaluation.metrics import Flags, Floats, Ints, Metric, Ratio
from training.evaluation.missing import ObjectScore
from training.evaluation.setting import Contender, Outcome, Setting

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

    def raised(self, scores: IntruderScores) -> Flags:
        """Whether each scored object raises the alarm, (N,)."""
        limits = np.array([*self.short, self.threshold])
        limit = limits[np.minimum(scores.listed - 1, len(self.short))]
        loud: Flags = self.suspicion(scores) >= limit
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
    source: Ints,
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


# ------------------------------------------------------------------------------------------ tasks

# Lists of so few classes are asked too: a robot that has just begun to look.
_SHORT_LISTS = (1, 2, 4)


def outliers_task(contender: Contender, setting: Setting, law: Law | None = None) -> Outcome | None:
    """T3 by a score: uniform intruders by default."""
    if contender.objects is None or (law is not None and setting.train is None):
        return None
    scenes = setting.some()
    weights = None if law is None or setting.train is None else law(scenes, setting.train)
    scores = intruder_scores(
        scenes, setting.structure, contender.objects, weights=weights, seed=setting.seed
    )
    if not len(scores.scene):
        return None
    metrics: dict[str, Metric] = {
        "hit@1": scores.hit_at_1(),
        "AUROC": scores.dirty.metric("AUROC"),
        "average precision": scores.dirty.metric("average precision"),
    }
    if contender.alarm is not None:
        loud = contender.alarm.raised(scores)
        metrics["alarms in untouched scenes"] = scores.false_alarms(loud)
        metrics["intruders caught"] = scores.caught(loud)
    return Outcome(metrics, len(scenes), scores.skipped)


def signature_task(contender: Contender, setting: Setting) -> Outcome | None:
    """T3 signature; a baseline ranks by log-odds alone."""
    if setting.train is None:
        return None
    structure, seed = setting.structure, setting.seed
    every = by_signature(setting.scenes, setting.train)
    drawn = draw_intruders(setting.scenes, structure, every, seed)
    index = (drawn >= 0).nonzero().squeeze(1)
    if not len(index):
        return None
    scenes = setting.at(index).some()
    own = by_signature(scenes, setting.train)
    if contender.artifact is not None:
        intruders = draw_intruders(scenes, structure, own, seed)
        metrics = judge_intruders(contender.artifact, scenes, structure, intruders)
    elif contender.objects is not None:
        scores = intruder_scores(scenes, structure, contender.objects, weights=own, seed=seed)
        metrics = dict.fromkeys(("hit@1", "hit@1, log-odds alone"), scores.hit_at_1())
    else:
        return None
    return Outcome(metrics, len(scenes), 0)


def sensitivity_task(contender: Contender, setting: Setting) -> Outcome | None:
    """Alarms in untouched scenes, and intruders caught, at each sensitivity."""
    artifact = contender.artifact
    if artifact is None:
        return None
    scenes, structure = setting.some(), setting.structure
    laws: dict[str, Tensor | None] = {"uniform": None}
    if setting.train is not None:
        laws["by popularity"] = by_popularity(scenes, setting.train)
    metrics: dict[str, Metric] = {}
    judged = np.zeros(len(scenes), dtype=np.bool_)
    for name, weights in laws.items():
        intruders = draw_intruders(scenes, structure, weights, setting.seed)
        if (intruders >= 0).any():
            judged |= (intruders >= 0).numpy()
            metrics |= judge_intruders(artifact, scenes, structure, intruders, f", {name}")
    if not metrics:
        return None
    cases = [labels_alone(scene) for scene in scenes.scenes]
    for sensitivity in SENSITIVITIES:
        share = alarms(artifact, cases, structure, sensitivity, judged)
        metrics[f"alarms, {sensitivity}"] = share
    plain = ((scenes.v > 0) & ~structure).sum(1).numpy()
    for listed in _SHORT_LISTS:
        large = judged & (plain > listed)
        if large.any():
            cases = [
                first_classes(scene, structure, listed, scene_rng(scene, setting.seed))
                for scene in scenes.scenes
            ]
            share = alarms(artifact, cases, structure, "medium", large)
            metrics[f"alarms, medium, {listed} listed"] = share
    return Outcome(metrics, len(scenes), int((~judged).sum()))


def judge_intruders(
    artifact: Artifact, scenes: SceneTensors, structure: Tensor, intruders: Tensor, law: str = ""
) -> dict[str, Metric]:
    """hit@1 by probability and by log-odds, and the share caught at each sensitivity.

    Args:
        intruders: (N,) classes, -1 for scenes that are not asked.
        law: what the names of the metrics say of the intruders.

    Raises:
        LeakError: see `ask_every`.
    """
    asked = (intruders >= 0).numpy()
    places = np.flatnonzero(asked).tolist()
    cases = [
        with_intruder(artifact, labels_alone(scenes.scenes[k]), int(intruders[k])) for k in places
    ]
    hits, hits_by_odds = np.zeros(len(asked)), np.zeros(len(asked))
    caught: dict[str, Metric] = {}
    for name in SENSITIVITIES:
        flagged = np.zeros(len(asked))
        found = ask_every(partial(verdict, artifact, name), cases)
        for k, case, columns in zip(places, cases, found, strict=True):
            flagged[k] = columns[-1, 2]
            if name == "medium":
                plain = things(case, structure.numpy())
                hits[k] = share_of_first(np.where(plain, columns[:, 0], -np.inf), -1)
                hits_by_odds[k] = share_of_first(np.where(plain, -columns[:, 1], -np.inf), -1)
        caught[f"caught{law}, {name}"] = Ratio.of_scenes(flagged, asked)
    return {
        f"hit@1{law}": Ratio.of_scenes(hits, asked),
        f"hit@1{law}, log-odds alone": Ratio.of_scenes(hits_by_odds, asked),
    } | caught


def verdict(artifact: Artifact, sensitivity: Sensitivity, scene: Scene) -> Floats:
    """(n, 3) of its objects: probability, log-odds, called an outlier."""
    found = judge(artifact, scene, sensitivity)
    return np.column_stack([found.probability, found.log_odds, found.is_outlier])


def share_of_first(values: Floats, target: int) -> float:
    """Whether the value at `target` is the highest; ties in expectation."""
    best = values == values.max()
    return float(best[target] / best.sum())


def alarms(
    artifact: Artifact,
    cases: Sequence[Scene],
    structure: Tensor,
    sensitivity: Sensitivity,
    judged: Flags,
) -> Ratio:
    """Share of the judged of N untouched scenes with an object that is called an outlier."""
    found = ask_every(partial(verdict, artifact, sensitivity), cases)
    loud = [
        bool(((columns[:, 2] > 0) & things(case, structure.numpy())).any())
        for case, columns in zip(cases, found, strict=True)
    ]
    return Ratio.of_scenes(np.array(loud) & judged, judged)


def first_classes(
    encoded: EncodedScene, structure: Tensor, listed: int, rng: np.random.Generator
) -> Scene:
    """All instances of so many of its classes, drawn at random, and its structure."""
    every = np.unique(encoded.instance_classes)
    hidden = rng.permutation(every[~structure.numpy()[every]])[listed:]
    kept = np.flatnonzero(~np.isin(encoded.instance_classes, hidden))
    return labels_alone(encoded, kept.tolist())
