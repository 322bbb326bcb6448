import json
from dataclasses import replace

import numpy as np
import pytest

from training.evaluation import metrics
from training.evaluation.report import from_json, pool, to_json
from training.evaluation.results import mean_over_seeds


def ints(*values):
    return np.array(values, dtype=np.int64)


def floats(*values):
    return np.array(values, dtype=np.float64)


def mean_of(values):
    return metrics.Ratio.of_scenes(np.asarray(values, dtype=np.float64))


RATIO = metrics.Ratio(floats(1, 0, 3), floats(2, 0, 4))
SCORED = metrics.Scored(
    "Brier skill", ints(0, 0, 1), floats(0.9, 0.1, 0.4), np.array([True, False, False]), ints(0, 1)
)
RESAMPLED = metrics.Resampled.of(lambda weight: float(weight @ [1, 2]) / 2, ints(4, 7), 9, 50)
POOLABLE = {"ratio": RATIO, "scored": SCORED}
each = pytest.mark.parametrize("metric", POOLABLE.values(), ids=POOLABLE)


def test_metrics_by_hand():
    assert RATIO.value == pytest.approx(4 / 6)
    assert (RATIO.n, len(RATIO.groups)) == (6, 3)
    assert RATIO.mean_over_scenes().value == pytest.approx((1 / 2 + 3 / 4) / 2)


@each
def test_pooling_is_measuring_the_union(metric):
    """Data sources can share a group."""
    count = len(metric.groups)
    both = pool([metric, replace(metric, groups=metric.groups + count)])
    assert len(both.groups) == 2 * count
    assert both.value == pytest.approx(metric.value)
    first = np.concatenate([np.ones(count), np.zeros(count)])
    assert both.at(first) == pytest.approx(metric.value)
    shared = pool([metric, metric])
    np.testing.assert_array_equal(shared.groups, metric.groups)
    weight = floats(*range(1, count + 1))
    assert shared.at(weight) == pytest.approx(metric.at(weight))


@each
def test_groups_sum_their_scenes(metric):
    """Two of the scenes are near-duplicates: a resample draws both or neither."""
    ids, index = np.unique([9, 9, 5][: len(metric.groups)], return_inverse=True)
    grouped = metric.by(ids[index])
    assert grouped.value == pytest.approx(metric.value)
    assert grouped.groups.tolist() == ids.tolist()
    weight = 2.0 * np.arange(len(ids)) + 1
    assert grouped.at(weight) == pytest.approx(metric.at(weight[index]))


def test_metrics_of_whole_sets_do_not_pool():
    assert pool([RESAMPLED, RESAMPLED]) is None


@pytest.mark.parametrize(
    ("compute", "message"),
    [
        (lambda: pool([RATIO, SCORED]), "2 types"),
        (lambda: metrics.Ratio(np.zeros(2), np.zeros(2)), "no scene"),
        (lambda: mean_of([1, 2]).by(ints(3, 3)).figure(), "at least two groups"),
        (lambda: mean_of([1, 2]) - RATIO, "different items"),
        *(
            (
                lambda groups=groups: metrics.paired_difference(
                    mean_of([1, 2, 3]).by(ints(0, 1, 4)), mean_of(np.ones(3)).by(groups)
                ),
                f"cannot pair 3 groups with {len(set(groups))} other",
            )
            for groups in (ints(0, 1, 2), ints(0, 2, 2))
        ),
    ],
)
def test_metrics_that_are_undefined(compute, message):
    with pytest.raises(ValueError, match=message):
        compute()


@pytest.mark.parametrize("metric", [*POOLABLE.values(), RESAMPLED], ids=[*POOLABLE, "resampled"])
def test_metrics_survive_json(metric):
    text = json.dumps(metric, default=to_json, allow_nan=False)
    again = json.loads(text, object_hook=from_json)
    assert again.figure() == metric.figure()


RNG = np.random.default_rng(0)
SCORE = RNG.normal(size=60)
P = 1 / (1 + np.exp(-SCORE))
TRUTH = RNG.random(60) < 0.3


def scored(statistic, p, truth):
    """The statistic of items that have a group each."""
    groups = np.arange(len(p))
    return metrics.Scored(statistic, groups, np.asarray(p, dtype=float), np.asarray(truth), groups)


@pytest.mark.parametrize("statistic", metrics.STATISTICS)
def test_weights_are_copies(statistic):
    weight = RNG.integers(0, 3, size=60)
    copied = scored(statistic, np.repeat(P, weight), np.repeat(TRUTH, weight))
    assert scored(statistic, P, TRUTH).at(weight.astype(float)) == pytest.approx(copied.value)


def test_calibration_error_by_hand():
    """Ten bins of one item each: |p - y| of each."""
    p = np.linspace(0.05, 0.95, metrics.BINS)
    y = p > 0.5
    assert scored("ECE", p, y).value == pytest.approx(np.abs(p - y).mean())
    # 20 items in two levels: .2 with 3 of 10 true, .9 with 8 of 10 true.
    y = np.concatenate([np.arange(10) < 3, np.arange(10) < 8])
    assert scored("ECE", np.repeat([0.2, 0.9], 10), y).value == pytest.approx(0.1)
    # A constant at the base rate is calibrated, in whatever order the items come.
    y, flat = np.arange(30) < 6, np.full(30, 0.2)
    assert scored("ECE", flat, y).value == pytest.approx(0.0, abs=1e-12)
    assert scored("Brier skill", flat, y).value == pytest.approx(0.0)
    assert scored("Brier skill", y, y).value == pytest.approx(1.0)
    assert np.isnan(scored("Brier skill", P, np.zeros(60, bool)).value)


def test_the_calibration_error_is_the_mean_gap_of_the_reliability_curve():
    error = scored("ECE", P, TRUTH)
    probability, frequency = error.reliability()
    assert len(probability) == metrics.BINS
    assert (probability.mean(), frequency.mean()) == pytest.approx((P.mean(), TRUTH.mean()))
    assert np.abs(probability - frequency).mean() == pytest.approx(error.value)


@pytest.mark.parametrize("seed", range(3))
def test_an_interval_holds_a_value_that_moves_under_resampling(seed):
    """Resampling inflates calibration errors."""
    rng = np.random.default_rng(seed)
    probability = rng.random(300)
    truth = rng.random(300) < probability
    figure = metrics.Scored("ECE", np.arange(300) % 50, probability, truth, np.arange(50)).figure()
    assert figure.low < figure.value < figure.high


def test_a_paired_difference_has_a_narrower_interval_than_the_metrics():
    """A gain of .1 in every scene, under a spread of 3 that both models share."""
    shared = 3 * np.random.default_rng(0).normal(size=100)
    a, b = mean_of(shared + 0.1), mean_of(shared)
    assert a.figure().low < b.figure().high
    difference = metrics.paired_difference(a, b)
    assert (difference.value, difference.low) == pytest.approx((0.1, 0.1))
    assert metrics.paired_difference(b, a).high < 0
    assert metrics.paired_difference(a, a) == metrics.Figure(0.0, 0.0, 0.0, 100)


def test_copies_of_a_scene_in_a_group_narrow_no_interval():
    """Ten frames of each place tell what one frame of each does; groups of one are scenes."""
    x, y, places = RNG.random(20), RNG.random(20), np.arange(20)
    one = metrics.paired_difference(mean_of(x), mean_of(y))
    # Student's t with 19 degrees of freedom instead of a normal distribution; n - 1 instead of n.
    wider = 2.0930 / 1.9600 * np.sqrt(20 / 19)
    limits = np.percentile(mean_of(x).draws - mean_of(y).draws, [2.5, 97.5]) - one.value
    assert (one.low, one.high) == pytest.approx(tuple(one.value + wider * limits), rel=1e-4)
    a, b = mean_of(np.repeat(x, 10)), mean_of(np.repeat(y, 10))
    ten = metrics.paired_difference(*(metric.by(np.repeat(places, 10)) for metric in (a, b)))
    assert (ten.low, ten.high) == pytest.approx((one.low, one.high))
    naive = metrics.paired_difference(a, b)
    assert naive.high - naive.low < 0.6 * (one.high - one.low)


def test_a_mean_over_seeds_is_resampled_scene_by_scene():
    mean = mean_over_seeds([mean_of([0, 1, 1, 0]), mean_of([1, 1, 0, 0])])
    together = mean_of([0.5, 1.0, 0.5, 0.0])
    assert mean.value == together.value
    np.testing.assert_allclose(mean.draws, together.draws)
    difference = metrics.paired_difference(mean, together)
    assert (difference.low, difference.high) == pytest.approx((0.0, 0.0))
