from __future__ import annotations

import numpy as np
import pytest

from training.evaluation.intervals import paired_difference
from training.evaluation.metrics import Ratio

RNG = np.random.default_rng(0)


def ratio(values) -> Ratio:
    values = np.asarray(values, dtype=np.float64)
    return Ratio(values, np.ones(len(values)))


def test_groups_of_one_are_scenes() -> None:
    a, b = ratio(RNG.random(40)), ratio(RNG.random(40))
    groups = [f"{k:02}" for k in range(40)]
    grouped, single = paired_difference(a, b, groups=groups), paired_difference(a, b)
    assert grouped.value == pytest.approx(single.value)
    assert (grouped.low, grouped.high) == pytest.approx((single.low, single.high))


def test_copies_of_a_scene_narrow_no_interval() -> None:
    """Ten frames of each place tell what one frame of each does."""
    x, y = RNG.random(20), RNG.random(20)
    places = [f"{k:02}" for k in range(20)]
    one = paired_difference(ratio(x), ratio(y), groups=places)
    ten = paired_difference(
        ratio(np.repeat(x, 10)), ratio(np.repeat(y, 10)), groups=np.repeat(places, 10).tolist()
    )
    assert (ten.low, ten.high) == pytest.approx((one.low, one.high))
    naive = paired_difference(ratio(np.repeat(x, 10)), ratio(np.repeat(y, 10)))
    assert naive.high - naive.low < 0.6 * (one.high - one.low)


def test_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    """Groups of unequal size whose scenes are alike; the true difference is 0."""
    rng, held, trials = np.random.default_rng(1), 0, 200
    for _ in range(trials):
        sizes = rng.integers(1, 6, 30)
        groups = np.repeat(np.arange(30), sizes).astype(str)
        effect = np.repeat(rng.normal(0, 1, 30), sizes)
        a = ratio(effect + rng.normal(0, 0.2, len(groups)))
        found = paired_difference(
            a, ratio(np.zeros(len(groups))), groups=groups.tolist(), resamples=200
        )
        held += found.low <= 0 <= found.high
    assert 0.87 * trials <= held <= 0.99 * trials


def test_metrics_of_other_scenes_are_not_paired() -> None:
    with pytest.raises(ValueError, match="cannot pair"):
        paired_difference(ratio([1, 0]), ratio([1, 0, 1]), groups=["a", "b"])
    with pytest.raises(ValueError, match="cannot pair"):
        paired_difference(ratio([1, 0]), ratio([1, 0]), groups=["a", "b", "c"])
