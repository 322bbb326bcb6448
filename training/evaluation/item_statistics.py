"""Statistics of scored items, for statistics that are not sums over scenes.

An item is an answer with a score and a truth value. Each function takes the scores (items,) and
truth values (items,). It returns a function that takes item weights (items,) and returns the
statistic. A weight is the number of times that a bootstrap resample contains the item. For items of
equal score, the statistic is the expectation under random order. An undefined statistic is NaN.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from training.datasets.array_types import Flags, Floats

Prepared = Callable[[Floats], float]

BINS = 10
_EDGES = np.linspace(0.0, 1.0, BINS + 1)


def _by_score(
    score: Floats, truth: Flags
) -> tuple[Floats, Callable[[Floats], tuple[Floats, Floats]]]:
    """Return the distinct scores, lowest first, and a function that counts the items of each.

    The function takes item weights (items,). It returns the total weight of all items and of the
    true items of each score, both (scores,).
    """
    scores, level = np.unique(score, return_inverse=True)

    def count(weight: Floats) -> tuple[Floats, Floats]:
        total = np.bincount(level, weights=weight, minlength=len(scores)).astype(np.float64)
        true = np.bincount(level, weights=weight * truth, minlength=len(scores))
        return total, true.astype(np.float64)

    return scores, count


def calibration_error(score: Floats, truth: Flags) -> Prepared:
    """Return the expected calibration error (ECE) of probabilities.

    The items are sorted by probability and divided into `BINS` bins of equal weight. The ECE is the
    mean over bins of |mean probability - share of true items|.
    """
    scores, count = _by_score(score, truth)

    def at(weight: Floats) -> float:
        totals, true = count(weight)
        if not totals.sum():
            return float("nan")
        p, y = _bins(scores, totals, true)
        return float(np.abs(p - y) @ np.full(BINS, 1 / BINS))

    return at


def brier_skill(score: Floats, truth: Flags) -> Prepared:
    """Return the Brier skill: 1 - Brier score / Brier score of the base rate.

    The base rate is the share of true items. The skill is 0 if all probabilities are the base rate.
    """
    scores, count = _by_score(score, truth)

    def at(weight: Floats) -> float:
        totals, true = count(weight)
        total = totals.sum()
        rate = true.sum() / total if total else 0.0
        base = rate * (1 - rate)
        brier = (true * (1 - scores) ** 2 + (totals - true) * scores**2).sum()
        return float(1 - brier / total / base) if base > 0 else float("nan")

    return at


def reliability(score: Floats, truth: Flags) -> tuple[Floats, Floats]:
    """Return the mean probability and the share of true items of each bin, both (bins,)."""
    scores, count = _by_score(score, truth)
    return _bins(scores, *count(np.ones(len(score))))


def _bins(scores: Floats, totals: Floats, true: Floats) -> tuple[Floats, Floats]:
    """Return the mean score and the share of true items of each bin of `calibration_error`.

    If a bin border divides items of equal score, each bin gets a proportional part of the true
    items among them.
    """
    total = totals.sum()
    edges = total * _EDGES
    last = np.zeros(len(totals) + 1)
    np.cumsum(totals, out=last[1:])

    def means(values: Floats) -> Floats:
        sums = np.zeros(len(values) + 1)
        np.cumsum(values, out=sums[1:])
        upto = np.interp(edges, last, sums)
        return (upto[1:] - upto[:-1]) * (BINS / total)

    return means(totals * scores), means(true)


STATISTICS: dict[str, Callable[[Floats, Flags], Prepared]] = {
    "ECE": calibration_error,
    "Brier skill": brier_skill,
}
