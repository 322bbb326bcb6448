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

import math
import sys
from collections.abc import Collection
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from app.model.count_statistics import Counts, count_distributions
from app.model.scene_model import SceneModel
from app.questions.answer import Fields, named, significant
from app.questions.posterior import Present
from app.questions.ranking import best
from app.scene.scene import Scene

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LIKELY: Final = 0.5
"""Minimum probability of further instances at which an answer contains a class."""

_OUTSIDE: Final = 0.1  # probability of a count below `low`, and of a count above `high`

_FIELDS: Final = ("listed_count", "expected_count", "low", "high", "probability")


def more(
    model: SceneModel,
    scene: Scene,
    listing: Present,
    *,
    top_k: int = 10,
    candidates: Collection[int] | None = None,
    coverage: float | None = None,
) -> list[Fields]:
    """Return the listed classes with probably more instances than listed, likeliest first.

    Listed objects count as present, whatever their confidence. The answer never contains structural
    classes, classes without statistics, or classes with more listed objects than these cover.

    Args:
        scene: the listed objects and the room type. The first object of a class is its name in
            the request.
        listing: the classes of the listed objects.
        top_k: maximum number of classes in the answer.
        candidates: indices of classes. The answer then contains these classes at any probability,
            and no others. None means all classes with a probability of at least `LIKELY`.
        coverage: probability that the request lists an object of the scene. Only values above the
            model's coverage change the answer. At 1, the scene has no further instances.

    Returns:
        The fields of `scene_client.schemas.MoreInstances`. `low` and `high` are limits of the
        number of instances, which is between them with a probability of at least 0.8.
    """
    if model.counts is None:
        return []
    # Words without a class have no statistics; their classes follow those of the statistics.
    size = model.vocabulary.trained
    plain = ~model.vocabulary.structure[listing.classes] & (listing.classes < size)
    classes, listed = listing.classes[plain], listing.counts[plain]
    own, unlisted = model.calibration.coverage, 1.0
    if coverage is not None and coverage > own:
        unlisted = (1 - coverage) / (1 - own)
    rows, p = distribution(model.counts, size, classes, listed, scene.room_type, unlisted)
    classes, listed = classes[rows], listed[rows]
    numbers, cumulative = np.arange(1, p.shape[1] + 1), p.cumsum(axis=1)
    p_more = 1 - cumulative[np.arange(len(p)), listed - 1]
    usable = p_more >= LIKELY if candidates is None else np.isin(classes, list(candidates))
    order = best(p_more, usable, top_k)
    if not len(order):
        return []
    labels, first = model.vocabulary.labels, listing.first[plain][rows][order]
    names = [
        named(labels[index], scene.objects[number].label)
        for index, number in zip(classes[order].tolist(), first.tolist(), strict=True)
    ]
    columns = (
        listed[order].tolist(),
        significant(p[order] @ numbers),
        *(
            ((cumulative[order] < share).sum(axis=1) + 1).tolist()
            for share in (_OUTSIDE, 1 - _OUTSIDE)
        ),
        significant(p_more[order]),
    )
    return [
        name | dict(zip(_FIELDS, values, strict=True))
        for name, *values in zip(names, *columns, strict=True)
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
    scene = classes, listed, -1 if room is None else room
    log_unlisted = math.log(max(unlisted, sys.float_info.min))
    tables = counts.classes, counts.most, counts.log_share, counts.weights
    first = counts.weights.shape[-1] - V
    return count_distributions(*tables, *scene, first, log_unlisted)


@lru_cache(maxsize=8)
def functions(M: int) -> Floats:
    """Return log n and log n log(M/n) for n = 1, 2, ... M, (2, M). The exponents multiply them.

    The array is read-only.
    """
    log = np.log(np.arange(1, M + 1))
    values = np.stack([log, log * (math.log(M) - log)])
    values.flags.writeable = False
    return values
