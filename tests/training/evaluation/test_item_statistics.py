"""AUROC, average precision and calibration against by-hand values and scikit-learn."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from sklearn.metrics import average_precision_score, roc_auc_score

from training.evaluation.item_statistics import (
    BINS,
    auroc,
    average_precision,
    brier_skill,
    calibration_error,
    reliability,
)

RNG = np.random.default_rng(0)
SCORE = RNG.normal(size=60)
TRUTH = RNG.random(60) < 0.3
ONE = np.ones(60)


def test_rankings_are_scikit_learn_s_where_nothing_ties():
    assert auroc(SCORE, TRUTH)(ONE) == pytest.approx(roc_auc_score(TRUTH, SCORE))
    assert average_precision(SCORE, TRUTH)(ONE) == pytest.approx(
        average_precision_score(TRUTH, SCORE)
    )


def test_weights_are_copies():
    weight = RNG.integers(0, 3, size=60)
    copied, truth = np.repeat(SCORE, weight), np.repeat(TRUTH, weight)
    for statistic in (auroc, average_precision, calibration_error, brier_skill):
        values = 1 / (1 + np.exp(-SCORE)), 1 / (1 + np.exp(-copied))
        weighted = statistic(values[0], TRUTH)(weight.astype(float))
        assert weighted == pytest.approx(statistic(values[1], truth)(np.ones(len(copied))))


def test_ties_score_their_expectation_under_random_order():
    score = np.array([2.0, 1, 1, 1, 0])
    truth = np.array([False, True, False, True, True])
    expected = []
    for order in permutations((1, 2, 3)):
        broken = score.copy()
        broken[list(order)] += np.array([0.2, 0.1, 0.0])
        expected.append(average_precision_score(truth, broken))
    value = average_precision(score, truth)(np.ones(5))
    assert value == pytest.approx(np.mean(expected))
    assert auroc(np.zeros(5), truth)(np.ones(5)) == pytest.approx(0.5)


def test_one_sided_truth_has_no_ranking():
    assert np.isnan(auroc(SCORE, np.ones(60, bool))(ONE))
    assert np.isnan(average_precision(SCORE, np.zeros(60, bool))(ONE))
    assert np.isnan(brier_skill(SCORE, np.zeros(60, bool))(ONE))


def test_calibration_error_by_hand():
    """Ten bins of one item each: |p - y| of each."""
    p = np.linspace(0.05, 0.95, BINS)
    y = p > 0.5
    assert calibration_error(p, y)(np.ones(BINS)) == pytest.approx(np.abs(p - y).mean())
    # 20 items in two levels: .2 with 3 of 10 true, .9 with 8 of 10 true.
    p = np.repeat([0.2, 0.9], 10)
    y = np.concatenate([np.arange(10) < 3, np.arange(10) < 8])
    assert calibration_error(p, y)(np.ones(20)) == pytest.approx(0.1)


def test_equal_probabilities_are_not_divided_by_their_truth():
    """A constant at the base rate is calibrated, in whatever order the items come."""
    y = np.arange(30) < 6
    assert calibration_error(np.full(30, 0.2), y)(np.ones(30)) == pytest.approx(0.0, abs=1e-12)
    assert brier_skill(np.full(30, 0.2), y)(np.ones(30)) == pytest.approx(0.0)
    assert brier_skill(y.astype(float), y)(np.ones(30)) == pytest.approx(1.0)


def test_reliability_is_what_the_error_is_made_of():
    p = 1 / (1 + np.exp(-SCORE))
    bins = reliability(p, TRUTH)
    assert bins.mass == pytest.approx(np.full(BINS, 1 / BINS))
    assert bins.mass @ bins.probability == pytest.approx(p.mean())
    assert bins.mass @ bins.frequency == pytest.approx(TRUTH.mean())
    gap = np.abs(bins.probability - bins.frequency) @ bins.mass
    assert gap == pytest.approx(calibration_error(p, TRUTH)(ONE))
