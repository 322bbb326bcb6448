"""Log-odds of intruders by hand, and thresholds that keep the share of alarms in every source."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.training.evaluation.scenes import NO_STRUCTURE, WIDE, WIDE_STRUCTURE, scene, tensors
from training.evaluation.alarms import ALARMS
from training.fit.intruder_scores import IntruderScores, alarm_threshold, intruder_scores


def test_metrics_by_hand():
    """Two scenes of two objects and an intruder each; the second one is not found."""
    scores = IntruderScores(
        scene=np.array([0, 0, 0, 1, 1, 1, 0, 0, 1, 1]),
        log_odds=np.array([1.0, 2, -1, 0, 3, 1, 1, 2, 0, 3]),
        intruder=np.array([0, 0, 1, 0, 0, 1, 0, 0, 0, 0], dtype=np.bool_),
        size=np.array([3, 3, 3, 3, 3, 3, 2, 2, 2, 2]),
        clean=np.arange(10) >= 6,
        thing=np.array([0, 1, 2, 1, 2, 0, 0, 1, 1, 2]),
        scenes=3,
        skipped=1,
    )
    assert scores.hit_at_1().value == pytest.approx(1 / 2)
    # Intruders at -1 and 1, others at 1, 2, 0, 3: 4 pairs + 2.5 pairs of 8.
    assert scores.dirty.metric("AUROC").value == pytest.approx(6.5 / 8)
    suspicion = -scores.log_odds
    assert scores.false_alarms(suspicion >= 0.0).value == pytest.approx(1 / 2)
    assert scores.false_alarms(suspicion >= 0.5).value == 0.0
    assert scores.caught(suspicion >= 0.5).value == pytest.approx(1 / 2)
    # Class 0 is often an intruder: the second scene's is found, and the first one's still.
    likely = scores.with_prior(np.array([1.5, 0.0, 0.0]))
    assert likely.log_odds.tolist() == [-0.5, 2, -1, 0, 3, -0.5, -0.5, 2, 0, 3]
    assert likely.hit_at_1().value == 1.0


def test_scores_that_know_everything_or_nothing():
    data = tensors([scene([0, 1, 2]) for _ in range(5)])
    known = lambda v: torch.tensor([5.0, 5, 5, -5, -5]).expand_as(v)  # noqa: E731
    scores = intruder_scores(data, NO_STRUCTURE, known)
    assert scores.hit_at_1().value == scores.dirty.metric("AUROC").value == 1.0
    assert scores.dirty.metric("average precision").value == 1.0
    wrong = intruder_scores(data, NO_STRUCTURE, lambda v: -known(v))
    assert wrong.hit_at_1().value == wrong.dirty.metric("AUROC").value == 0.0
    none = intruder_scores(data, NO_STRUCTURE, torch.zeros_like)
    assert (none.hit_at_1().value, none.dirty.metric("AUROC").value) == pytest.approx(
        (1 / 4, 1 / 2)
    )
    # 5 true ones among 20 equal scores.
    expected = sum((1 + (k - 1) * 4 / 19) / k for k in range(1, 21)) / 20
    assert none.dirty.metric("average precision").value == pytest.approx(expected)


def test_an_object_is_judged_by_the_rest_without_itself():
    seen = []

    def spy(v):
        seen.append(v.sum(1).tolist())
        return torch.zeros_like(v)

    intruder_scores(tensors([scene([0, 1, 2])]), NO_STRUCTURE, spy)
    assert seen == [[2, 2, 2], [3, 3, 3, 3]]


def varied(sizes, seed=0):
    """Scenes of four classes, rare ones common in the second source; four to a place."""
    rng = np.random.default_rng(seed)
    scenes = []
    for source, size in zip("ab", sizes, strict=False):
        weight = np.arange(WIDE, 0, -1.0) ** (3 if source == "a" else 0)
        for k in range(size):
            classes = rng.choice(WIDE, 4, replace=False, p=weight / weight.sum())
            group = f"{source}{seed} {k // 4}"
            scenes.append(scene(sorted(classes.tolist()), source=source, group=group))
    return tensors(scenes, WIDE)


def by_frequency(v):
    """Log-odds that depend on the class alone: many scenes have the same worst one."""
    return -torch.arange(float(WIDE)).expand_as(v)


def smooth(v):
    """Log-odds that differ from scene to scene."""
    return by_frequency(v) + (v @ torch.linspace(0, 1, WIDE) * 10).sin().unsqueeze(1)


def limit_of(score, scenes):
    """The threshold of the suspicion, fitted to untouched scenes."""
    scores = intruder_scores(scenes, WIDE_STRUCTURE, score)
    return alarm_threshold(-scores.log_odds, scores, scenes, np.random.default_rng(0))


def shares(score, limit, scenes):
    """Share of untouched scenes with an alarm, by source."""
    scores = intruder_scores(scenes, WIDE_STRUCTURE, score)
    loud = -scores.log_odds >= limit
    alarms = np.bincount(scores.scene[loud & scores.clean], minlength=len(scenes)) > 0
    source = np.array([entry.source for entry in scenes.scenes])
    return {str(name): float(alarms[source == name].mean()) for name in np.unique(source)}


@pytest.mark.parametrize("score", [smooth, by_frequency])
def test_the_promise_is_kept_in_every_large_source(score):
    scenes = varied([400, 400])
    found = shares(score, limit_of(score, scenes), scenes)
    assert max(found.values()) <= ALARMS["medium"] + 0.02


def test_the_source_that_alarms_most_sets_the_threshold():
    """One quantile over both sources would alarm in the varied one above the promised share."""
    scenes = varied([600, 300])
    both, tame, alone = (
        limit_of(smooth, tensors(some, WIDE))
        for some in (scenes.scenes, scenes.scenes[:600], scenes.scenes[600:])
    )
    assert both > tame
    assert both == pytest.approx(alone, abs=0.3)
    assert shares(smooth, both, scenes)["b"] > 0


def test_a_smaller_share_of_alarms_has_a_higher_threshold():
    """And a monotone map of the suspicion moves the threshold with it, and no alarm."""
    scenes = varied([400])
    scores = intruder_scores(scenes, WIDE_STRUCTURE, smooth)
    limits = []
    for share in (0.02, ALARMS["medium"], 0.2):
        alarms = []
        for suspicion in (-scores.log_odds, 1 - 2 * scores.log_odds):
            rng = np.random.default_rng(0)
            limit = alarm_threshold(suspicion, scores, scenes, rng, share)
            alarms.append(scores.false_alarms(suspicion >= limit).value)
        limits.append(limit)
        assert alarms[0] == alarms[1]
        assert 0 < alarms[0] <= share + 0.02
    assert limits == sorted(limits, reverse=True)


def test_without_finite_suspicions_there_is_no_threshold():
    with pytest.raises(ValueError, match="no clean scene"):
        limit_of(smooth, tensors([scene([0, 1]) for _ in range(5)], WIDE))
    with pytest.raises(FloatingPointError, match="not finite"):
        limit_of(lambda v: torch.full_like(v, -torch.inf), varied([20]))
