"""The bootstrap: coverage, pairing, and what happens where nothing can be said."""

from __future__ import annotations

import numpy as np
import pytest

from training.evaluation.intervals import Figure, paired_difference
from training.evaluation.metrics import Ratio


def mean_of(x):
    return Ratio(np.asarray(x, dtype=np.float64), np.ones(len(x)))


def test_the_interval_covers_the_truth():
    """Means of 200 samples of N(0, 1) x 100 scenes: 0 is within the 95 % interval 170 to 199 times.

    A binomial of 200 and .95 leaves that range with probability below 1e-4.
    """
    rng = np.random.default_rng(0)
    covered = 0
    for k in range(200):
        figure = mean_of(rng.normal(size=100)).figure(resamples=300, seed=k)
        covered += figure.low <= 0 <= figure.high
    assert 170 <= covered <= 199


def test_a_paired_difference_sees_what_two_intervals_hide():
    """A gain of .1 in every scene, under a spread of 3 that both models share."""
    shared = 3 * np.random.default_rng(0).normal(size=100)
    a, b = mean_of(shared + 0.1), mean_of(shared)
    assert a.figure().low < b.figure().high
    difference = paired_difference(a, b)
    assert difference.above_zero
    assert (difference.value, difference.low) == pytest.approx((0.1, 0.1))
    assert not paired_difference(b, a).above_zero
    assert paired_difference(a, a) == Figure(0.0, 0.0, 0.0, 100)


def test_the_difference_of_two_equal_models_is_rarely_above_zero():
    """60 pairs of unrelated scores with equal means: above zero in 2.5 % of them.

    More than 7 of 60 happen with probability below 2e-4.
    """
    rng = np.random.default_rng(0)
    above = [
        paired_difference(
            mean_of(rng.normal(size=80)), mean_of(rng.normal(size=80)), resamples=300
        ).above_zero
        for _ in range(60)
    ]
    assert sum(above) <= 7


def test_only_the_same_scenes_can_be_paired():
    with pytest.raises(ValueError, match="cannot pair 2 scenes with 3"):
        paired_difference(mean_of([1, 2]), mean_of([1, 2, 3]))


def test_nothing_scored_is_an_error():
    with pytest.raises(ValueError, match="no scene"):
        Ratio(np.zeros(2), np.zeros(2))
