"""The alarm threshold: one rule for a calibrated machine and for any other score."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from app.registry import Calibration, CountSlope, PairSlope, Thresholds
from tests.training.evaluation.scenes import WIDE, WIDE_STRUCTURE, scene, tensors
from training.evaluation.alarms import MEDIUM, alarm_threshold, calibrated_alarm, fitted_alarm
from training.evaluation.outliers import intruder_scores


def drawn(sizes, seed=0):
    """Scenes of four classes, rare ones common in the second source; four to a place."""
    rng = np.random.default_rng(seed)
    scenes = []
    for source, size in zip("ab", sizes, strict=False):
        weight = np.arange(WIDE, 0, -1.0) ** (3 if source == "a" else 0)
        for k in range(size):
            classes = rng.choice(WIDE, 4, replace=False, p=weight / weight.sum())
            scenes.append(
                scene(sorted(classes.tolist()), source=source, group=f"{source}{seed} {k // 4}")
            )
    return tensors(scenes, WIDE)


def by_frequency(v):
    """Log-odds that depend on the class alone: many scenes have the same worst one."""
    return -torch.arange(float(WIDE)).expand_as(v)


def smooth(v):
    """Log-odds that differ from scene to scene."""
    return by_frequency(v) + (v @ torch.linspace(0, 1, WIDE) * 10).sin().unsqueeze(1)


def shares(score, alarm, scenes):
    """Share of untouched scenes with an alarm, by source."""
    scores = intruder_scores(scenes, WIDE_STRUCTURE, score)
    loud = alarm.raised(scores)
    alarms = np.bincount(scores.scene[loud & scores.clean], minlength=len(scenes)) > 0
    source = np.array([entry.source for entry in scenes.scenes])
    return {str(name): float(alarms[source == name].mean()) for name in np.unique(source)}


@pytest.mark.parametrize("score", [smooth, by_frequency])
def test_the_promise_is_kept_in_every_large_source(score):
    scenes = drawn([400, 400])
    found = shares(score, fitted_alarm(score, scenes, WIDE_STRUCTURE), scenes)
    assert max(found.values()) <= MEDIUM + 0.02


def test_the_source_that_alarms_most_sets_the_threshold():
    """One quantile over both sources would alarm in the varied one above the promised share."""
    scenes = drawn([600, 300])
    alarm = fitted_alarm(smooth, scenes, WIDE_STRUCTURE)
    alone = fitted_alarm(smooth, tensors(scenes.scenes[600:], WIDE), WIDE_STRUCTURE)
    tame = fitted_alarm(smooth, tensors(scenes.scenes[:600], WIDE), WIDE_STRUCTURE)
    assert alarm.threshold > tame.threshold
    assert alarm.threshold == pytest.approx(alone.threshold, abs=0.3)
    assert shares(smooth, alarm, scenes)["b"] > 0


def test_a_machine_and_a_baseline_of_the_same_scores_alarm_alike():
    """A monotone map of the suspicion moves the threshold with it, and no alarm."""
    scenes = drawn([400])
    scores = intruder_scores(scenes, WIDE_STRUCTURE, smooth)
    rng = np.random.default_rng
    plain = alarm_threshold(-scores.log_odds, scores, scenes, rng(0))
    mapped = alarm_threshold(1 - 2 * scores.log_odds, scores, scenes, rng(0))
    baseline = scores.false_alarms(-scores.log_odds >= plain).value
    assert scores.false_alarms(1 - 2 * scores.log_odds >= mapped).value == baseline
    assert 0 < baseline <= MEDIUM + 0.02


def test_a_smaller_share_of_alarms_has_a_higher_threshold():
    scenes = drawn([400])
    scores = intruder_scores(scenes, WIDE_STRUCTURE, smooth)
    limits = [
        alarm_threshold(-scores.log_odds, scores, scenes, np.random.default_rng(0), share)
        for share in (0.02, MEDIUM, 0.2)
    ]
    assert limits == sorted(limits, reverse=True)
    alarms = [scores.false_alarms(-scores.log_odds >= limit).value for limit in limits]
    for alarm, share in zip(alarms, (0.02, MEDIUM, 0.2), strict=True):
        assert 0 < alarm <= share + 0.02


def test_a_model_alarms_as_its_service_does():
    """By its probability, with its prior of intruders, at the medium threshold."""
    scenes = tensors([scene([0, 1, 2, 3])], WIDE)
    popularity = tuple(np.linspace(-2.0, 2.0, WIDE).tolist())
    entry = CountSlope(intercept=0.3, slope=-0.8, log_count=0.2)
    calibration = Calibration(
        relation=(PairSlope(),),
        outlier=entry,
        popularity=popularity,
        popularity_weight=0.5,
        outlier_thresholds=Thresholds(low=0.9, medium=0.4, high=0.1),
    )
    alarm = calibrated_alarm(calibration)
    scores = intruder_scores(scenes, WIDE_STRUCTURE, smooth)
    odds = scores.log_odds - 0.5 * np.array(popularity)[scores.thing]
    logits = 0.3 - 0.8 * odds + 0.2 * np.log(scores.size)
    assert alarm.suspicion(scores) == pytest.approx(1 / (1 + np.exp(-logits)))
    assert alarm.threshold == 0.4


def test_scenes_with_incomplete_object_lists_fit_no_alarm():
    scenes = drawn([300])
    odd = [replace(scene([0, 1, 10, 11]), complete=False) for _ in range(300)]
    every = tensors([*scenes.scenes, *odd], WIDE)
    alarm = fitted_alarm(smooth, every, WIDE_STRUCTURE)
    assert alarm.threshold == fitted_alarm(smooth, scenes, WIDE_STRUCTURE).threshold


def test_without_finite_suspicions_there_is_no_threshold():
    scenes = tensors([scene([0, 1]) for _ in range(5)], WIDE)
    with pytest.raises(ValueError, match="no untouched scene"):
        fitted_alarm(smooth, scenes, WIDE_STRUCTURE)
    with pytest.raises(FloatingPointError, match="not finite"):
        fitted_alarm(lambda v: torch.full_like(v, -torch.inf), drawn([20]), WIDE_STRUCTURE)
