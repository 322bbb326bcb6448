"""Task T3: add an absent class to a scene as an intruder; measure its rank and the alarm.

A score ranks the objects by their log-odds given the other objects. A published model gets the
labels of all instances of the scene and no other evidence. Its hit@1 follows the ranking of the
service, by probability of being an intruder. The hit@1 by log-odds is also reported. Structure is
not ranked and raises no alarm. For ties, a metric is the expectation under random order.

The alarm threshold aims at a fixed share of alarms in clean scenes (scenes without an intruder). It
follows the same rule for machines and baselines. The alarms in scenes of one place are correlated,
and sources differ in their variety. So the threshold keeps the share within each source, with a
safety margin from resampled groups.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from app.questions import Sensitivity
from app.questions.posterior import calibrated
from app.registry import Artifact, Calibration
from app.scene import Scene
from training.datasets import EncodedScene
from training.datasets.array_types import Flags, Floats, Ints, Rng
from training.datasets.batches import SceneTensors, subset
from training.datasets.cases import scene_rng, some_scenes
from training.evaluation.alarms import ALARMS, SOURCE_SCENES
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
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.model import Alarm, Model, ObjectScore
from training.evaluation.setting import Outcome, Setting

_RESAMPLES = 200
# The threshold keeps the target share of alarms in this share of the resampled sets of groups.
_CONFIDENCE = 0.7
# Minimum number of scenes of all small sources together for a threshold.
_SMALL_SCENES = 30
_SCENES = 1500


def calibrated_alarm(calibration: Calibration) -> Alarm | None:
    """Return the default alarm rule of the service, or None if the model judges no object."""
    entry, presets = calibration.outlier, calibration.outlier_thresholds
    if entry is None or presets is None:
        return None
    popularity = np.array(calibration.popularity)

    def suspicion(scores: IntruderScores) -> Floats:
        if len(popularity):
            scores = scores.with_prior(calibration.popularity_weight * popularity)
        return np.asarray(1 / (1 + np.exp(-calibrated(entry, scores.log_odds, scores.size))))

    short = tuple(limits.medium for limits in calibration.short_list_thresholds)
    return Alarm(suspicion, presets.medium, short)


def fitted_alarm(
    score: ObjectScore, validation: SceneTensors, structure: Tensor, seed: int = 0
) -> Alarm:
    """Fit the alarm of a score without calibration, on at most 1,500 complete scenes."""
    complete = subset(validation, validation.complete.nonzero().squeeze(1))
    scenes = some_scenes(complete, _SCENES, seed)
    scores = intruder_scores(scenes, structure, score, seed=seed)
    threshold = alarm_threshold(-scores.log_odds, scores, scenes, np.random.default_rng(seed))
    return Alarm(lambda scored: -scored.log_odds, threshold)


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


# Lengths of short lists, as at the start of an exploration by a robot.
_SHORT_LISTS = (1, 2, 4, 6)


def outliers_task(model: Model, setting: Setting, law: Law | None = None) -> Outcome | None:
    """Measure T3 with an object score, for intruders of a law, or uniform ones without a law."""
    if model.outliers is None or (law is not None and setting.train is None):
        return None
    scenes = setting.some()
    weights = None if law is None or setting.train is None else law(scenes, setting.train)
    scores = intruder_scores(
        scenes, setting.structure, model.outliers, weights=weights, seed=setting.seed
    )
    if not len(scores.scene):
        return None
    metrics: dict[str, Metric] = {
        "hit@1": scores.hit_at_1(),
        "AUROC": scores.dirty.metric("AUROC"),
        "average precision": scores.dirty.metric("average precision"),
    }
    if model.alarm is not None:
        alarms_raised = model.alarm.raised(scores)
        metrics["alarms in untouched scenes"] = scores.false_alarms(alarms_raised)
        metrics["intruders caught"] = scores.caught(alarms_raised)
    return Outcome(metrics, len(scenes), scores.skipped)


def signature_task(model: Model, setting: Setting) -> Outcome | None:
    """Measure T3 signature; a baseline ranks by log-odds only."""
    if setting.train is None:
        return None
    structure, seed = setting.structure, setting.seed
    all_weights = by_signature(setting.scenes, setting.train)
    all_intruders = draw_intruders(setting.scenes, structure, all_weights, seed)
    index = (all_intruders >= 0).nonzero().squeeze(1)
    if not len(index):
        return None
    scenes = setting.at(index).some()
    weights = by_signature(scenes, setting.train)
    if model.artifact is not None:
        intruders = draw_intruders(scenes, structure, weights, seed)
        metrics = judge_intruders(model.artifact, scenes, structure, intruders)
    elif model.outliers is not None:
        scores = intruder_scores(scenes, structure, model.outliers, weights=weights, seed=seed)
        metrics = dict.fromkeys(("hit@1", "hit@1, log-odds alone"), scores.hit_at_1())
    else:
        return None
    return Outcome(metrics, len(scenes), 0)


def sensitivity_task(model: Model, setting: Setting) -> Outcome | None:
    """Measure alarms in clean scenes and detected intruders at each sensitivity."""
    artifact = model.artifact
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
        metrics[f"alarms, {sensitivity}"] = alarms(artifact, cases, structure, sensitivity, judged)
    sizes = ((scenes.v > 0) & ~structure).sum(1).numpy()
    for listed in _SHORT_LISTS:
        is_longer = judged & (sizes > listed)
        if is_longer.any():
            cases = [
                first_classes(scene, structure, listed, scene_rng(scene, setting.seed))
                for scene in scenes.scenes
            ]
            share = alarms(artifact, cases, structure, "medium", is_longer)
            metrics[f"alarms, medium, {listed} listed"] = share
    return Outcome(metrics, len(scenes), int((~judged).sum()))


def judge_intruders(
    artifact: Artifact, scenes: SceneTensors, structure: Tensor, intruders: Tensor, law: str = ""
) -> dict[str, Metric]:
    """Return hit@1 by probability and by log-odds, and the detected share at each sensitivity.

    `intruders` (N,) are classes from `draw_intruders`; `law` is the suffix of the metric names.
    """
    index = np.flatnonzero((intruders >= 0).numpy())
    cases = [
        with_intruder(artifact, labels_alone(scenes.scenes[k]), int(intruders[k]))
        for k in index.tolist()
    ]
    answers = {
        name: ask_every(partial(judge, artifact, sensitivity=name), cases) for name in SENSITIVITIES
    }
    is_thing = [things(case, structure.numpy()) for case in cases]

    def hits(column: int, sign: int) -> Ratio:
        shares = [
            share_of_first(np.where(mask, sign * columns[:, column], -np.inf), -1)
            for mask, columns in zip(is_thing, answers["medium"], strict=True)
        ]
        return Ratio.of_items(index, np.array(shares), len(scenes))

    metrics: dict[str, Metric] = {
        f"hit@1{law}": hits(0, 1),
        f"hit@1{law}, log-odds alone": hits(1, -1),
    }
    for name, all_columns in answers.items():
        caught = np.array([columns[-1, 2] for columns in all_columns])
        metrics[f"caught{law}, {name}"] = Ratio.of_items(index, caught, len(scenes))
    return metrics


def share_of_first(values: Floats, target: int) -> float:
    """Return 1 if the value at `target` is the highest, else 0; 1/m for m equal highest values."""
    is_highest = values == values.max()
    return float(is_highest[target] / is_highest.sum())


def alarms(
    artifact: Artifact,
    cases: Sequence[Scene],
    structure: Tensor,
    sensitivity: Sensitivity,
    judged: Flags,
) -> Ratio:
    """Return the share of judged clean scenes with an object flagged as an outlier."""
    answers = ask_every(partial(judge, artifact, sensitivity=sensitivity), cases)
    has_alarm = [
        bool(((columns[:, 2] > 0) & things(case, structure.numpy())).any())
        for case, columns in zip(cases, answers, strict=True)
    ]
    return Ratio.of_scenes(np.array(has_alarm) & judged, judged)


def first_classes(encoded: EncodedScene, structure: Tensor, listed: int, rng: Rng) -> Scene:
    """Return a scene of structure and all instances of ``listed`` random classes."""
    classes = np.unique(encoded.instance_classes)
    hidden = rng.permutation(classes[~structure.numpy()[classes]])[listed:]
    shown = np.flatnonzero(~np.isin(encoded.instance_classes, hidden))
    return labels_alone(encoded, shown.tolist())
