"""Statistics of scored items, for statistics that are not sums over scenes.

An item is an answer with a score and a truth value. A statistic is a function of the distinct
scores, lowest first, and of the total weight of all items and of the true items of each score, all
(scores,). The weight of an item is the number of times that a bootstrap resample contains it. For
items of equal score, the statistic is the expectation under random order. An undefined statistic is
NaN.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from training.datasets.array_types import Flags, Floats

BINS = 10
_EDGES = np.linspace(0.0, 1.0, BINS + 1)


def by_score(
    score: Floats, truth: Flags
) -> tuple[Floats, Callable[[Floats], tuple[Floats, Floats]]]:
    """Return the distinct scores, and a function from item weights (items,) to their weights."""
    scores, level = np.unique(score, return_inverse=True)

    def count(weight: Floats) -> tuple[Floats, Floats]:
        total = np.bincount(level, weights=weight, minlength=len(scores)).astype(np.float64)
        true = np.bincount(level, weights=weight * truth, minlength=len(scores))
        return total, true.astype(np.float64)

    return scores, count


def calibration_error(scores: Floats, totals: Floats, true: Floats) -> float:
    """Return the expected calibration error (ECE) of probabilities.

    The items are sorted by probability and divided into `BINS` bins of equal weight. The ECE is the
    mean over bins of |mean probability - share of true items|.
    """
    if not totals.sum():
        return float("nan")
    p, y = reliability(scores, totals, true)
    return float(np.abs(p - y) @ np.full(BINS, 1 / BINS))


def brier_skill(scores: Floats, totals: Floats, true: Floats) -> float:
    """Return the Brier skill: 1 - Brier score / Brier score of the base rate.

    The base rate is the share of true items. The skill is 0 if all probabilities are the base rate.
    """
    total = totals.sum()
    rate = true.sum() / total if total else 0.0
    base = rate * (1 - rate)
    brier = (true * (1 - scores) ** 2 + (totals - true) * scores**2).sum()
    return float(1 - brier / total / base) if base > 0 else float("nan")


def reliability(scores: Floats, totals: Floats, true: Floats) -> tuple[Floats, Floats]:
    """Return the mean probability and the share of true items of each bin, both (bins,).

    If a bin border divides items of equal score, each bin gets a proportional part of the true
    items among them.
    """
    total = totals.sum()
    last = np.concatenate([[0.0], np.cumsum(totals)])

    def means(values: Floats) -> Floats:
        upto = np.interp(total * _EDGES, last, np.concatenate([[0.0], np.cumsum(values)]))
        return (upto[1:] - upto[:-1]) * (BINS / total)

    return means(totals * scores), means(true)


STATISTICS: dict[str, Callable[[Floats, Floats, Floats], float]] = {
    "ECE": calibration_error,
    "Brier skill": brier_skill,
}
