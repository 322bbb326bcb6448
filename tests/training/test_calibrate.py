"""The alarm threshold: kept in every source that is large enough, on the safe side."""

from __future__ import annotations

import numpy as np
import pytest

from tests.training.evaluation.scenes import WIDE, scene, tensors
from training.calibrate import fit_outlier
from training.evaluation.outliers import IntruderScores


def scores_of(levels):
    """One object a scene, log-odds spread by `levels` per scene; and the same with an intruder."""
    rng = np.random.default_rng(0)
    count = len(levels)
    clean = 3.0 + rng.normal(0.0, 1.0, count) * levels
    dirty = np.concatenate([clean, rng.normal(-4.0, 1.0, count)])
    place = np.arange(count)
    return IntruderScores(
        scene=np.concatenate([place, place, place]),
        log_odds=np.concatenate([clean, dirty]),
        intruder=np.repeat([False, False, True], count),
        size=np.full(3 * count, 4),
        clean=np.repeat([True, False, False], count),
        scenes=count,
        skipped=0,
    )


def alarms(sizes, spread):
    """Share of untouched scenes over the threshold, per source."""
    source = np.repeat(["a", "b"][: len(sizes)], sizes)
    scenes = tensors(
        [scene([0, 1], source=name, group=f"g{k // 4}") for k, name in enumerate(source)], WIDE
    )
    scores = scores_of(np.repeat(spread, sizes))
    entry, threshold = fit_outlier(scores, scenes)
    logits = entry.intercept + entry.slope * scores.log_odds + entry.log_count * np.log(4)
    over = 1 / (1 + np.exp(-logits)) >= threshold
    return [float(over[scores.clean][source == name].mean()) for name in np.unique(source)]


def test_alarms_are_rare_in_each_source_alike():
    """The second source's scenes are far more varied: one quantile over both would let it alarm in
    twice the promised share."""
    quiet, varied = alarms([400, 400], [1.0, 3.0])
    assert varied <= 0.035
    assert quiet <= varied
    assert varied > 0.005


@pytest.mark.parametrize("sizes", [[400, 30], [150, 100]])
def test_a_small_source_is_judged_with_the_rest(sizes):
    """A few scenes that are odd do not move the threshold to where nothing alarms."""
    shares = alarms(sizes, [1.0, 8.0])
    assert shares[1] > 0
