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
from typing import Final

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.questions.answer import Fields, significant
from app.questions.posterior import present
from app.registry.artifact import Artifact
from app.registry.counts import INTERCEPT, ROOM, SEVERAL, SINGLE, Counts
from app.scene.scene import Scene

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LIKELY: Final = 0.5
"""Minimum probability of further instances at which an answer contains a class."""

_TAIL: Final = 0.1  # probability of a count below `low`, and of a count above `high`


def more(
    artifact: Artifact,
    scene: Scene,
    *,
    top_k: int = 10,
    candidates: Collection[int] | None = None,
    coverage: float | None = None,
) -> list[Fields]:
    """Return the listed classes with probably more instances than listed, likeliest first.

    Listed objects count as present, whatever their confidence. The answer never contains structural
    classes, classes without statistics, or classes with more listed objects than these cover.

    Args:
        scene: the listed objects and the room type.
        top_k: maximum number of classes in the answer.
        candidates: indices of classes. The answer then contains these classes at any probability,
            and no others. None means all classes with a probability of at least `LIKELY`.
        coverage: probability that the request lists an object of the scene. Only values above the
            model's coverage change the answer. At 1, the scene has no further instances.

    Returns:
        The fields of `scene_client.schemas.MoreInstances`. `low` and `high` are limits of the
        number of instances, which is between them with a probability of at least 0.8.

    Raises:
        ValueError: the machine does not know the class of an object or the room type.
    """
    if artifact.counts is None:
        return []
    listing = present(scene, artifact.spec)
    plain = ~artifact.vocabulary.structure[listing.classes]
    classes, listed = listing.classes[plain], listing.counts[plain]
    usual, unlisted = artifact.calibration.coverage, 1.0
    if coverage is not None and coverage > usual:
        unlisted = (1 - coverage) / (1 - usual)
    rows, p = distribution(
        artifact.counts, artifact.spec.V, classes, listed, scene.room_type, unlisted
    )
    classes, listed = classes[rows], listed[rows]
    numbers, cumulative = np.arange(1, p.shape[1] + 1), p.cumsum(axis=1)
    p_more = 1 - p[np.arange(len(p)), listed - 1]
    usable = p_more >= LIKELY if candidates is None else np.isin(classes, list(candidates))
    order = np.flatnonzero(usable)
    order = order[np.argsort(-p_more[order], kind="stable")][:top_k]
    if not len(order):
        return []
    cumulative = cumulative[order]
    columns = (
        classes[order].tolist(),
        listed[order].tolist(),
        significant(p[order] @ numbers),
        ((cumulative < _TAIL).sum(axis=1) + 1).tolist(),
        ((cumulative < 1 - _TAIL).sum(axis=1) + 1).tolist(),
        significant(p_more[order]),
    )
    return [
        {
            "label": artifact.vocabulary.labels[index],
            "listed_count": count,
            "expected_count": expected,
            "low": low,
            "high": high,
            "probability": probability,
        }
        for index, count, expected, low, high, probability in zip(*columns, strict=True)
    ]


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
    entry = np.searchsorted(counts.classes, classes)
    entry[entry == len(counts.classes)] = 0
    rows = np.flatnonzero((counts.classes[entry] == classes) & (listed <= counts.most[entry]))
    is_several = listed > 1
    has_others = is_several.sum() > is_several[rows]
    first = counts.weights.shape[-1] - V
    log_unlisted = math.log(max(unlisted, sys.float_info.min))
    entry, k, room_index = entry[rows], listed[rows], -1 if room is None else room
    tables = counts.log_share, counts.weights
    scene = entry, k, has_others, classes, first, room_index, log_unlisted
    return rows, _distributions(*tables, *scene)


@compiled
def _distributions(
    log_share: NDArray[np.float32],
    weights: NDArray[np.float32],
    entry: Ints,
    listed: Ints,
    has_others: NDArray[np.bool_],
    classes: Ints,
    first: int,
    room: int,
    log_unlisted: float,
) -> Floats:
    """Return the distributions of `distribution`, (k, M).

    Args:
        entry, listed: (k,) rows of the statistics, and numbers of listed objects.
        has_others: (k,) True if another class is listed several times.
        classes: (n,) listed classes. `first` is the column of class 0 in the weights.
        room: index of the room type, or -1.
    """
    M = log_share.shape[1]
    p, exponents = np.empty((len(entry), M), np.float64), np.empty(2, np.float64)
    for row in range(len(entry)):
        e, k, largest = entry[row], listed[row], -np.inf
        for x in range(2):
            # The effect of a class on itself is 0, so the sum over all listed classes is correct.
            effects = 0.0
            for j in range(len(classes)):
                effects += weights[e, x, first + classes[j]]
            total = weights[e, x, INTERCEPT] + effects / math.sqrt(max(len(classes) - 1, 1))
            if k == 1:
                total += weights[e, x, SINGLE]
            if has_others[row]:
                total += weights[e, x, SEVERAL]
            if room >= 0:
                total += weights[e, x, ROOM + room]
            exponents[x] = total
        for n in range(1, M + 1):
            log, value = math.log(n), -np.inf
            if n >= k:
                value = log_share[e, n - 1] + exponents[0] * log + (n - k) * log_unlisted
                value += exponents[1] * log * (math.log(M) - log)
            p[row, n - 1] = value
            largest = max(largest, value)
        sum_p = 0.0
        for n in range(M):
            p[row, n] = math.exp(p[row, n] - largest)
            sum_p += p[row, n]
        for n in range(M):
            p[row, n] /= sum_p
    return p


@lru_cache(maxsize=8)
def functions(M: int) -> Floats:
    """Return log n and log n log(M/n) for n = 1, 2, ... M, (2, M). The exponents multiply them.

    The array is read-only.
    """
    log = np.log(np.arange(1, M + 1))
    values = np.stack([log, log * (math.log(M) - log)])
    values.flags.writeable = False
    return values
