"""Metrics by hand, pooled, and through JSON."""

from __future__ import annotations

import json

import numpy as np
import pytest

from training.evaluation.metrics import (
    Macro,
    Ratio,
    Resampled,
    Scored,
    metric_from_dict,
    metric_to_dict,
    pool,
)


def ints(*values):
    return np.array(values, dtype=np.int64)


def floats(*values):
    return np.array(values, dtype=np.float64)


RATIO = Ratio(floats(1, 0, 3), floats(2, 0, 4))
MACRO = Macro(ints(0, 0, 1, 1), ints(7, 7, 7, 2), floats(1, 0, 0.5, 1), 3)
SCORED = Scored("AUROC", ints(0, 0, 1), floats(3, 1, 2), np.array([True, False, False]), 2)
RESAMPLED = Resampled.of(lambda weight: float(weight @ [1, 2]) / 2, 2, 9, 50)


def test_ratios_by_hand():
    assert RATIO.value == pytest.approx(4 / 6)
    assert (RATIO.n, RATIO.scenes) == (6, 3)
    assert RATIO.mean_over_scenes().value == pytest.approx((1 / 2 + 3 / 4) / 2)


def test_macro_counts_every_group_alike():
    assert MACRO.value == pytest.approx((1.5 / 3 + 1) / 2)
    assert (MACRO.n, MACRO.scenes) == (2, 3)
    # Without scene 0 class 7 keeps one item.
    assert MACRO.at(floats(0, 1, 1)) == pytest.approx((0.5 + 1) / 2)


def test_resampling_counts_items_as_often_as_their_scene():
    weight = floats(2, 1)
    twice = Scored(
        "AUROC", ints(0, 0, 0, 0, 1), floats(3, 1, 3, 1, 2), np.array([1, 0, 1, 0, 0], bool), 2
    )
    assert SCORED.at(weight) == pytest.approx(twice.value)


@pytest.mark.parametrize("metric", [RATIO, MACRO, SCORED], ids=["ratio", "macro", "scored"])
def test_pooling_is_measuring_the_union(metric):
    both = pool([metric, metric])
    assert both is not None
    assert both.scenes == 2 * metric.scenes
    assert both.value == pytest.approx(metric.value)
    first = np.concatenate([np.ones(metric.scenes), np.zeros(metric.scenes)])
    assert both.at(first) == pytest.approx(metric.value)


def test_metrics_of_whole_sets_do_not_pool():
    assert pool([RESAMPLED, RESAMPLED]) is None
    with pytest.raises(ValueError, match="2 kinds"):
        pool([RATIO, MACRO])


@pytest.mark.parametrize(
    "metric", [RATIO, MACRO, SCORED, RESAMPLED], ids=["ratio", "macro", "scored", "resampled"]
)
def test_metrics_survive_json(metric):
    again = metric_from_dict(json.loads(json.dumps(metric_to_dict(metric), allow_nan=False)))
    assert again.figure() == metric.figure()


def test_an_unknown_kind_is_an_error():
    with pytest.raises(ValueError, match="kind must be"):
        metric_from_dict({"kind": "guess"})
    with pytest.raises(ValueError, match="unknown statistic"):
        Scored("guess", ints(0), floats(0), np.array([True]), 1)


@pytest.mark.parametrize("seed", range(3))
def test_an_interval_holds_its_value_though_rare_groups_drop_out(seed):
    """Most groups are in one scene and do badly: resamples without them would be too good."""
    rng = np.random.default_rng(seed)
    group = np.concatenate([np.zeros(100, np.int64), np.arange(1, 60)])
    scene = rng.integers(100, size=len(group))
    value = np.where(group == 0, 0.9, rng.random(len(group)) * 0.1)
    figure = Macro(scene, group, value, 100).figure()
    assert figure.low < figure.value < figure.high


def test_the_interval_of_a_calibration_error_holds_its_value():
    rng = np.random.default_rng(0)
    probability = rng.random(300)
    truth = rng.random(300) < probability
    figure = Scored("ECE", np.arange(300) % 50, probability, truth, 50).figure()
    assert figure.low < figure.value < figure.high
