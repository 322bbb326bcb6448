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

    Too few groups of training scenes have more than `most` instances. The last column of
    `log_share` stands for M or more instances. `weights` are the effects of the scene, (3 + C + V),
    on the two exponents. A class has no effect on itself.
    """

    prefix: ClassVar[str] = "counts."
    integers = ("classes", "most")

    classes: Annotated[Ints, "K"]  # ascending
    most: Annotated[Ints, "K"]  # maximum listed number, from 1 to M - 1
    log_share: Annotated[Table, "K", "M"]  # of scenes with 1, 2, ... instances, of those with any
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
        classes: Int[Ints, "n"],  # without structure, ascending
        listed: Int[Ints, "n"],  # number of objects of each class
        room: int | None = None,
        unlisted: float = 1.0,  # ρ of the formula
    ) -> tuple[Int[Ints, "k"], Float[Floats, "k M"]]:
        """Return the distributions of the numbers of instances of the listed classes.

        The first result has indices into `classes`: those with statistics that cover the listed
        number. The second one has the probabilities of 1, 2, ... M instances.
        """
        tables = self.classes, self.most, self.log_share, self.weights
        scene = classes, listed, -1 if room is None else room
        log_unlisted = math.log(max(unlisted, sys.float_info.min))
        return _distributions(*tables, *scene, self.weights.shape[-1] - V, log_unlisted)


@compiled
def _distributions(
    with_statistics: Int[NDArray, " K"],
    most: Int[NDArray, " K"],
    log_share: Float[NDArray, "K M"],
    weights: Float[NDArray, "K 2 features"],
    classes: Int[NDArray, " n"],
    listed: Int[NDArray, " n"],
    room: int,  # -1: unknown
    first: int,  # column of class 0 in `weights`
    log_unlisted: float,  # log ρ of the formula
) -> tuple[Int[NDArray, " k"], Float[NDArray, "k M"]]:
    """Return the rows and distributions of `Counts.distribution`."""
    n, M = len(classes), log_share.shape[1]
    p, rows, k = np.empty((n, M), np.float64), np.empty(n, np.int64), 0
    exponents, several, entry = np.empty(2), 0, np.empty(n, np.int64)
    for i in range(n):
        several += listed[i] > 1
        entry[i] = find_row(with_statistics, classes[i])
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
