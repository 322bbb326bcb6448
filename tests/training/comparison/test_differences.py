from __future__ import annotations

import numpy as np
import pytest

from training.comparison.differences import Difference, paired_over_groups
from training.evaluation.intervals import Figure, paired_difference
from training.evaluation.metrics import Ratio

RNG = np.random.default_rng(0)


def ratio(values) -> Ratio:
    values = np.asarray(values, dtype=np.float64)
    return Ratio(values, np.ones(len(values)))


def test_groups_of_one_are_scenes() -> None:
    a, b = ratio(RNG.random(40)), ratio(RNG.random(40))
    groups = [f"{k:02}" for k in range(40)]
    grouped, single = paired_over_groups(a, b, groups), paired_difference(a, b)
    assert grouped.value == pytest.approx(single.value)
    assert (grouped.low, grouped.high) == pytest.approx((single.low, single.high))


def test_copies_of_a_scene_narrow_no_interval() -> None:
    """Ten frames of each place tell what one frame of each does."""
    x, y = RNG.random(20), RNG.random(20)
    places = [f"{k:02}" for k in range(20)]
    one = paired_over_groups(ratio(x), ratio(y), places)
    ten = paired_over_groups(
        ratio(np.repeat(x, 10)), ratio(np.repeat(y, 10)), np.repeat(places, 10)
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
        found = paired_over_groups(a, ratio(np.zeros(len(groups))), groups, resamples=200)
        held += found.low <= 0 <= found.high
    assert 0.87 * trials <= held <= 0.99 * trials


def test_metrics_of_other_scenes_are_not_paired() -> None:
    with pytest.raises(ValueError, match="cannot pair"):
        paired_over_groups(ratio([1, 0]), ratio([1, 0, 1]), ["a", "b"])
    with pytest.raises(ValueError, match="cannot pair"):
        paired_over_groups(ratio([1, 0]), ratio([1, 0]), ["a", "b", "c"])


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [(0.01, 0.2, "better"), (-0.1, 0.1, "undecided"), (-0.2, -0.01, "worse")],
)
def test_a_verdict_needs_the_whole_interval(low, high, verdict) -> None:
    figure = Figure((low + high) / 2, low, high, 10)
    assert Difference("T2 missing", "MRR", True, 0.5, 0.5, figure).verdict == verdict
