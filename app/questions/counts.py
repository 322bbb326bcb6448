"""The numbers of instances of the listed classes: are there more chairs, or a second nightstand?

The models score classes. This module adds statistics of counts. Let n be the number of instances of
a class in the scene, of which the request lists k. Then, for n from k to M,

    p(n) ∝ s(n) exp(η log n + ζ log n log(M/n)) ρ^(n - k)
    η = a + b [k = 1] + c u + d_t + (1/√m) Σ_j e_j

s(n) is the share of training scenes with n instances. A large η makes large numbers probable, and a
large ζ makes numbers between 1 and M probable. ζ has the form of η, with weights of its own. u is 1
if the request lists another class several times, and 0 otherwise. The sum goes over the m other
listed classes j, without structure. a, b, c, d (for the room type t) and e are weights of the
class. A request that states a coverage above the model's coverage lowers ρ from 1 to
(1 - coverage) / (1 - model's coverage).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Collection
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.questions.answer import Fields, significant
from app.questions.posterior import Present
from app.questions.ranking import best
from app.registry.artifact import Artifact
from app.registry.counts import INTERCEPT, ROOM, SEVERAL, SINGLE, Counts

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LIKELY: Final = 0.5
"""Minimum probability of further instances at which an answer contains a class."""

_FIELDS: Final = ("label", "listed_count", "expected_count", "low", "high", "probability")
_TAIL: Final = 0.1  # probability of a count below `low`, and of a count above `high`


def more(
    artifact: Artifact,
    listing: Present,
    room: int | None = None,
    *,
    top_k: int = 10,
    candidates: Collection[int] | None = None,
    coverage: float | None = None,
) -> list[Fields]:
    """Return the listed classes with probably more instances than listed, likeliest first.

    Listed objects count as present, whatever their confidence. The answer never contains structural
    classes, classes without statistics, or classes with more listed objects than these cover.

    Args:
        listing: the classes of the listed objects.
        room: index of the room type, or None.
        top_k: maximum number of classes in the answer.
        candidates: indices of classes. The answer then contains these classes at any probability,
            and no others. None means all classes with a probability of at least `LIKELY`.
        coverage: probability that the request lists an object of the scene. Only values above the
            model's coverage change the answer. At 1, the scene has no further instances.

    Returns:
        The fields of `scene_client.schemas.MoreInstances`. `low` and `high` are limits of the
        number of instances, which is between them with a probability of at least 0.8.
    """
    if artifact.counts is None:
        return []
    plain = ~artifact.vocabulary.structure[listing.classes]
    classes, listed = listing.classes[plain], listing.counts[plain]
    usual, unlisted = artifact.calibration.coverage, 1.0
    if coverage is not None and coverage > usual:
        unlisted = (1 - coverage) / (1 - usual)
    rows, p = distribution(artifact.counts, artifact.spec.V, classes, listed, room, unlisted)
    classes, listed = classes[rows], listed[rows]
    p_more, expected, low, high = _summaries(p, listed)
    usable = p_more >= LIKELY if candidates is None else np.isin(classes, list(candidates))
    order = best(p_more, usable, top_k)
    if not len(order):
        return []
    labels = artifact.vocabulary.labels
    columns = (
        [labels[index] for index in classes[order].tolist()],
        listed[order].tolist(),
        significant(expected[order]),
        low[order].tolist(),
        high[order].tolist(),
        significant(p_more[order]),
    )
    return [dict(zip(_FIELDS, values, strict=True)) for values in zip(*columns, strict=True)]


def distribution(
    counts: Counts,
    V: int,
    classes: Ints,
    listed: Ints,
    room: int | None = None,
    unlisted: float = 1.0,
) -> tuple[Ints, Floats]:
    """Return the distributions of the numbers of instances of the listed classes.

    Args:
        counts: statistics of the model.
        V: number of classes of the model.
        classes: (n,) indices of the listed classes, without structure, in ascending order.
        listed: (n,) number of listed objects of each class.
        room: index of the room type, or None.
        unlisted: ρ of the formula.

    Returns:
        Indices into `classes` of the k classes with statistics that cover the listed number, (k,).
        Then the probability of 1, 2, ... M instances, (k, M).
    """
    scene = classes, listed, -1 if room is None else room
    log_unlisted = math.log(max(unlisted, sys.float_info.min))
    tables = counts.classes, counts.most, counts.log_share, counts.weights
    first = counts.weights.shape[-1] - V
    rows, p = _distributions(*tables, *scene, first, log_unlisted)
    return rows, p


@compiled
def _distributions(
    known: NDArray[np.integer[Any]],
    most: NDArray[np.integer[Any]],
    log_share: NDArray[np.float32],
    weights: NDArray[np.float32],
    classes: Ints,
    listed: Ints,
    room: int,
    first: int,
    log_unlisted: float,
) -> tuple[Ints, Floats]:
    """Return the classes and the distributions of `distribution`, (k,) and (k, M).

    Args:
        known, most, log_share, weights: see `Counts`. Column `first` of the weights is class 0.
        classes, listed: (n,) listed classes, and numbers of listed objects.
        room: index of the room type, or -1.
    """
    n, M = len(classes), log_share.shape[1]
    p, rows, k = np.empty((n, M), np.float64), np.empty(n, np.int64), 0
    several = (listed > 1).sum()
    entry = np.searchsorted(known, classes)
    for i in range(n):
        e = entry[i]
        if e < len(known) and known[e] == classes[i] and listed[i] <= most[e]:
            rows[k] = i
            k += 1
    for row in range(k):
        e, number = entry[rows[row]], listed[rows[row]]
        exponents = np.zeros(2)
        for x in range(2):
            # The effect of a class on itself is 0, so the sum over all listed classes is correct.
            for j in range(n):
                exponents[x] += weights[e, x, first + classes[j]]
            exponents[x] /= math.sqrt(max(n - 1, 1))
            exponents[x] += weights[e, x, INTERCEPT]
            if number == 1:
                exponents[x] += weights[e, x, SINGLE]
            if several > (number > 1):
                exponents[x] += weights[e, x, SEVERAL]
            if room >= 0:
                exponents[x] += weights[e, x, ROOM + room]
        p[row] = -np.inf
        for m in range(number, M + 1):
            log = math.log(m)
            value = log_share[e, m - 1] + exponents[0] * log + (m - number) * log_unlisted
            p[row, m - 1] = value + exponents[1] * log * (math.log(M) - log)
        p[row] = np.exp(p[row] - p[row].max())
        p[row] /= p[row].sum()
    return rows[:k], p[:k]


@compiled
def _summaries(p: Floats, listed: Ints) -> tuple[Floats, Floats, Ints, Ints]:
    """Return the columns of `more` for k classes: P(n > listed), E[n], `low` and `high`.

    Args:
        p: (k, M) probability of 1, 2, ... M instances.
        listed: (k,) number of listed objects of each class.
    """
    p_more, expected = np.zeros(len(p)), np.zeros(len(p))
    low, high = np.ones(len(p), np.int64), np.ones(len(p), np.int64)
    for row in range(len(p)):
        cumulative = 0.0
        for m in range(p.shape[1]):
            cumulative += p[row, m]
            expected[row] += (m + 1) * p[row, m]
            low[row] += cumulative < _TAIL
            high[row] += cumulative < 1 - _TAIL
            if m + 1 == listed[row]:
                p_more[row] = 1 - cumulative
    return p_more, expected, low, high


@lru_cache(maxsize=8)
def functions(M: int) -> Floats:
    """Return log n and log n log(M/n) for n = 1, 2, ... M, (2, M). The exponents multiply them.

    The array is read-only.
    """
    log = np.log(np.arange(1, M + 1))
    values = np.stack([log, log * (math.log(M) - log)])
    values.flags.writeable = False
    return values
