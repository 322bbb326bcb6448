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
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.compiling import compiled
from app.model.fields import TensorGroup
from app.scene.roles import find_row

Floats = NDArray[np.float64]
Table = NDArray[np.float32]
Ints = NDArray[np.integer[Any]]


EXPONENTS: Final = 2
"""Exponents of the formula: the first raises large numbers, and the second numbers between 1 and M.
"""

INTERCEPT, SINGLE, SEVERAL, ROOM = 0, 1, 2, 3
"""Columns of `Counts.weights`: intercept, 1 if one object is listed, 1 if another class is listed
several times, and the first of C room types. The last V columns are those of the other classes."""

_LARGEST: Final = 64.0
_MOST: Final = 256


@dataclass(frozen=True, eq=False)
class Counts(TensorGroup):
    """Counts of K of a model's V classes.

    Attributes:
        classes: (K,) indices of the classes with statistics, in ascending order.
        most: (K,) maximum listed number, from 1 to M - 1. Too few groups of training scenes have
            more instances.
        log_share: (K, M) log of the share of scenes with 1, 2, ... instances, of the scenes with
            the class. The last column stands for M or more instances.
        weights: (K, 2, 3 + C + V) effects of the scene on the two exponents. A class has no effect
            on itself.
    """

    prefix: ClassVar[str] = "counts."
    integers = ("classes", "most")

    classes: Annotated[Ints, "K"]
    most: Annotated[Ints, "K"]
    log_share: Annotated[Table, "K", "M"]
    weights: Annotated[Table, "K", EXPONENTS, "features"]

    def check(self, A: int, V: int, C: int) -> None:
        """Check the values for a model with V classes and C room types."""
        K, M = self.log_share.shape
        self.require(K, "there must be at least one class")
        self.require_keys("classes", V)
        self.require(2 <= M <= _MOST, f"log_share must have 2 to {_MOST} columns")
        is_right = ((self.most >= 1) & (self.most < M)).all()
        self.require(is_right, "most must be from 1 to the columns of log_share minus 1")
        is_right = ((self.log_share <= 0) & (self.log_share >= -_LARGEST)).all()
        self.require(is_right, f"log_share must be between -{_LARGEST:g} and 0")
        is_right = (np.abs(self.weights) <= _LARGEST).all()
        self.require(is_right, f"weights must be between -{_LARGEST:g} and {_LARGEST:g}")
        on_itself = self.weights[np.arange(K), :, ROOM + C + self.classes]
        self.require(not on_itself.any(), "the weight of a class on itself must be 0")

    def distribution(
        self,
        V: int,
        classes: Int[Ints, "n"],
        listed: Int[Ints, "n"],
        room: int | None = None,
        unlisted: float = 1.0,
    ) -> tuple[Int[Ints, "k"], Float[Floats, "k M"]]:
        """Return the distributions of the numbers of instances of the listed classes.

        Args:
            V: number of classes of the model.
            classes: indices of the listed classes, without structure, in ascending order.
            listed: number of listed objects of each class.
            room: index of the room type, or None.
            unlisted: ρ of the formula.

        Returns:
            Indices into `classes` of the classes with statistics that cover the listed number, and
            the probability of 1, 2, ... M instances of each.
        """
        tables = self.classes, self.most, self.log_share, self.weights
        scene = classes, listed, -1 if room is None else room
        log_unlisted = math.log(max(unlisted, sys.float_info.min))
        return _distributions(*tables, *scene, self.weights.shape[-1] - V, log_unlisted)


@compiled
def _distributions(known, most, log_share, weights, classes, listed, room, first, log_unlisted):
    """Return the rows and distributions of `Counts.distribution`, (k,) and (k, M).

    Args:
        known, most, log_share, weights: see `Counts`. Column `first` of the weights is class 0.
        classes, listed: (n,) listed classes, and numbers of listed objects.
        room: index of the room type, or -1.
        log_unlisted: log ρ of the formula.
    """
    n, M = len(classes), log_share.shape[1]
    p, rows, k = np.empty((n, M), np.float64), np.empty(n, np.int64), 0
    exponents, several, entry = np.empty(2), 0, np.empty(n, np.int64)
    for i in range(n):
        several += listed[i] > 1
        entry[i] = find_row(known, classes[i])
        if entry[i] >= 0 and listed[i] <= most[entry[i]]:
            rows[k] = i
            k += 1
    for row in range(k):
        e, number = entry[rows[row]], listed[rows[row]]
        for x in range(2):
            exponents[x] = 0.0
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
        largest, total = -np.inf, 0.0
        for m in range(number, M + 1):
            log = math.log(m)
            value = log_share[e, m - 1] + exponents[0] * log + (m - number) * log_unlisted
            p[row, m - 1] = value + exponents[1] * log * (math.log(M) - log)
            largest = max(largest, p[row, m - 1])
        for m in range(number, M + 1):
            p[row, m - 1] = math.exp(p[row, m - 1] - largest)
            total += p[row, m - 1]
        for m in range(M):
            p[row, m] = p[row, m] / total if m + 1 >= number else 0.0
    return rows[:k], p[:k]
