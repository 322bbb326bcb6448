"""Statistics of the training scenes: numbers of instances, offsets, and places of classes."""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.compiling import compiled
from app.model.fields import TensorGroup
from app.scene.roles import IN, ON, UNDER, RoleCounts, find_row, role_counts
from app.scene.spatial_relations import CANONICAL, FRONT, LEFT, SUPPORTS
from app.scene.stands import HANGS, USUAL

Floats = NDArray[np.float64]
Table = NDArray[np.float32]
Ints = NDArray[np.integer[Any]]
Indices = NDArray[np.int64]

# ---------------------------------------------------------------------------- numbers of instances

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
    """Numbers of instances of K of a model's V classes: are there more chairs than listed?

    Machines score classes only. Let n be the number of instances of a class in the scene, of which
    the request lists k. Then, for n from k to M,

        p(n) ∝ s(n) exp(η log n + ζ log n log(M/n)) ρ^(n - k)
        η = a + b [k = 1] + c u + d_t + (1/√m) Σ_j e_j

    s(n) is the share of training scenes with n instances. A large η makes large numbers probable,
    and a large ζ makes numbers between 1 and M probable. ζ has the form of η, with weights of its
    own. u is 1 if the request lists another class several times, and 0 otherwise. The sum goes over
    the m other listed classes j, without structure. a, b, c, d (for the room type t) and e are
    weights of the class. A request that states a coverage above the model's coverage lowers ρ from
    1 to (1 - coverage) / (1 - model's coverage).

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
    """Return indices of classes with statistics, and the distributions of their numbers m.

    The formula of `Counts` is p(m) ∝ share(m) exp(η log m + ζ log m log(M/m)) ρ^(m - listed), from
    m = listed to M. `exponents` are η and ζ: sums of the weights that apply to the scene.
    """
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
        e, number = entry[rows[row]], listed[rows[row]]  # e is the row of the class in the tables
        for x in range(2):  # η and ζ
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


# ------------------------------------------------------------------------------------------ offsets

UNOBSERVED: Final = -1
"""Number of scenes for a relation that never occurs in training, so that an offset is unknown."""
_PER_METRE: Final = 1000.0  # offsets are rounded to millimetres


@dataclass(frozen=True, eq=False)
class Offsets(TensorGroup):
    """Normal distributions of offsets, for A canonical relations, V classes and P observed pairs.

    An offset is the vector in metres from the centre of a relation's object to the centre of its
    subject, in the viewer's axes (x away from the viewer, y left, z up). The tables contain only
    canonical relations. The opposite relation, with both classes exchanged, has the negative
    offset.

    Six numbers are three means along x, y and z, then three variances. The terms of the subject's
    and the object's class add to those of the relation, which are for any two classes.
    """

    prefix: ClassVar[str] = "offsets."
    integers = ("relation_scenes", "pair", "pair_scenes")

    relation: Annotated[Table, "A", 6]
    relation_scenes: Annotated[Ints, "A"]  # number of training scenes with each relation
    subject: Annotated[Table, "A", "V", 6]
    object: Annotated[Table, "A", "V", 6]
    pair: Annotated[Ints, "P"]  # keys (a V + subject) V + object in relation a, ascending
    pair_offset: Annotated[Table, "P", 6]  # means, then standard deviations
    pair_scenes: Annotated[Ints, "P"]  # number of training scenes with each pair in its relation

    def check(self, A: int, V: int, C: int) -> None:
        """Check the values for a machine with A relations and V classes."""
        self.require_keys("pair", A * V * V)
        is_right = (self.relation_scenes >= 0).all() and (self.pair_scenes >= 1).all()
        self.require(is_right, "relation_scenes must be at least 0 and pair_scenes at least 1")
        least = self.relation + self.subject.min(axis=1) + self.object.min(axis=1)
        variances = least[self.relation_scenes > 0, 3:]
        is_right = (variances > 0).all() and (self.pair_offset[:, 3:] > 0).all()
        self.require(is_right, "variances and standard deviations must be positive")

    def find(
        self, relation: Int[Ints, "n"], subject: Int[Ints, "n"], other: Int[Ints, "n"]
    ) -> tuple[Float[NDArray[np.float64], "n 6"], Int[NDArray[np.int64], "n"]]:
        """Return the offsets of pairs of classes, and the number of training scenes of each pair.

        An offset is mean (3) and standard deviation (3). If the number is 0, it is the sum of a
        term of the relation and one term of each class. `UNOBSERVED`: training lacks the relation.
        """
        return _look_up_offsets(self.tables, relation, subject, other)

    @cached_property
    def tables(self) -> tuple[NDArray[Any], ...]:
        """The arrays in the order that `_look_up_offsets` expects."""
        return tuple(self.tensors().values())


@compiled
def offsets_of_missing(
    tables: tuple[NDArray[Any], ...],  # `Offsets.tables`
    relation: Int[NDArray, " n"],
    missing: Int[NDArray, " n"],  # classes of the missing objects
    anchor: Int[NDArray, " n"],  # classes of the anchors
    outgoing: Bool[NDArray, " n"],  # whether the missing object is the relation's subject
    has_viewer: bool,
) -> tuple[Float[NDArray, "n 3"], Float[NDArray, "n 3"], Int[NDArray, " n"]]:
    """Return mean and standard deviation of the offset from each anchor to its missing object.

    Lengths are in metres, along the viewer's axes. The third result is the number of training
    scenes with the two classes in this relation, or `UNOBSERVED` for an unknown offset. Without a
    viewer, left and front have no offset, and the means of other offsets are vertical.
    """
    n = len(relation)
    subject, object_ = np.empty(n, np.int64), np.empty(n, np.int64)
    for k in range(n):
        subject[k], object_[k] = missing[k], anchor[k]
        if not outgoing[k]:
            subject[k], object_[k] = anchor[k], missing[k]
    offset, scenes = _look_up_offsets(tables, relation, subject, object_)
    mean, std = np.zeros((n, 3)), np.empty((n, 3))
    for k in range(n):
        sign = 1.0 if outgoing[k] else -1.0
        for axis in range(3):
            mean[k, axis], std[k, axis] = sign * offset[k, axis], offset[k, 3 + axis]
        if not has_viewer:
            if relation[k] == LEFT or relation[k] == FRONT:
                scenes[k] = UNOBSERVED
            # Any horizontal direction is equally likely, so x and y share E[x²] + E[y²] equally.
            square = mean[k, 0] ** 2 + mean[k, 1] ** 2 + std[k, 0] ** 2 + std[k, 1] ** 2
            for axis in range(2):
                mean[k, axis], std[k, axis] = 0.0, math.sqrt(square / 2)
    return mean, std, scenes


@compiled
def rotated(
    mean: Float[NDArray, "n 3"],
    std: Float[NDArray, "n 3"],
    axes: Float[NDArray, "3 3"],  # of the viewer, in the frame of the results
) -> tuple[Float[NDArray, "n 3"], Float[NDArray, "n 3"]]:
    """Return means and standard deviations in another frame, rounded to millimetres."""
    means, stds = np.empty_like(mean), np.empty_like(std)
    for k in range(len(mean)):
        for to in range(3):
            value = variance = 0.0
            for axis in range(3):
                value += axes[axis, to] * mean[k, axis]
                variance += (axes[axis, to] * std[k, axis]) ** 2
            # Adding 0.0 turns -0.0 into 0.0.
            means[k, to] = np.rint(value * _PER_METRE) / _PER_METRE + 0.0
            stds[k, to] = max(np.rint(math.sqrt(variance) * _PER_METRE), 1.0) / _PER_METRE
    return means, stds


@compiled
def _look_up_offsets(
    tables: tuple[NDArray[Any], ...],
    relation: Int[NDArray, " n"],
    subject: Int[NDArray, " n"],
    other: Int[NDArray, " n"],
) -> tuple[Float[NDArray, "n 6"], Int[NDArray, " n"]]:
    """Return means and standard deviations (metres) of offsets, and numbers of training scenes."""
    relation_offset, relation_scenes, subjects, objects, pair, pair_offset, pair_scenes = tables
    n, V = len(relation), subjects.shape[1]
    offset, scenes = np.empty((n, 6)), np.empty(n, np.int64)
    for k in range(n):
        a, i, j = relation[k], subject[k], other[k]
        row = find_row(pair, (a * V + i) * V + j)
        if row >= 0:
            for axis in range(6):
                offset[k, axis] = pair_offset[row, axis]
            scenes[k] = pair_scenes[row]
            continue
        # Without an own offset, a pair has the sum of the terms of a, i and j, with variances.
        scenes[k] = 0 if relation_scenes[a] > 0 else UNOBSERVED
        for axis in range(6):
            value = np.float64(relation_offset[a, axis])
            value = value + subjects[a, i, axis] + objects[a, j, axis]
            offset[k, axis] = value if axis < 3 else math.sqrt(value)
    return offset, scenes


# ------------------------------------------------------------------------------------------- places

_PLACE: Final = 10.0  # smoothing s, in scenes
_RELATION: Final = 3.0  # smoothing m, in scenes
_SUPPORTER: Final = 10.0  # smoothing of the supporters of a class, in scenes
_SEEN: Final = 0.5  # smoothing of the counts of supporters
_OTHER_ROLES: Final = 0.5  # smoothing of the counts of other roles
_SHOWN: Final = 2.0  # minimum number of scenes that show a relation


@dataclass(frozen=True, eq=False)
class Places(TensorGroup):
    """Counts of relations between classes, of the roles of boxes, and of objects on the floor.

    The counts serve two purposes. The roles decide between on, under and in for boxes that reach
    into each other (`app.scene.roles`). The triples tell which classes stand at a place, such as on
    a desk:

        p(i at a, j) = (N(a, i, j) + s · p(i at a)) / (N(a, any class, j) + s)
        p(i at a)    = (N(a, i, any class) + m · p(i)) / (N(a, any class, any class) + m)

    N is the number of scenes with a relation a from class i to class j, or in the other direction.
    """

    prefix: ClassVar[str] = "places."
    integers = ("triple", "role_pair")

    triple: Annotated[NDArray[np.int32], "N"]  # keys (a V + i) V + j of a(i, j), ascending
    triple_scenes: Annotated[NDArray[np.float32], "N"]  # number of training scenes with each triple
    frequency: Annotated[NDArray[np.float32], "V"]  # share of the listed classes in training
    role_pair: Annotated[NDArray[np.int32], "P"]  # this and the next two: see `RoleCounts`
    role_counts: Annotated[NDArray[np.float32], "P", 3]
    role_anchor: Annotated[NDArray[np.float32], "V", 3]
    stands: Annotated[NDArray[np.float32], "V", 3]  # shares: on the floor, hanging, supported
    # Share of the objects on or in each class whose bottoms are far below its top: seats, shelves.
    within: Annotated[NDArray[np.float32], "V"]

    def check(self, A: int, V: int, C: int) -> None:
        """Check the values for a machine with A relations and V classes."""
        self.require(len(self.triple), "there must be at least one triple")
        self.require_keys("triple", A * V * V)
        self.require_keys("role_pair", V * V)
        counts = self.triple_scenes, self.role_counts, self.role_anchor, self.stands, self.within
        is_right = all((array >= 0).all() for array in counts) and (self.frequency > 0).all()
        self.require(is_right, "counts must be at least 0, and frequencies must be above 0")

    @cached_property
    def roles(self) -> RoleCounts:
        """The roles of pairs of classes."""
        return RoleCounts(self.role_pair.astype(np.int64), self.role_counts, self.role_anchor)

    @cached_property
    def hanging(self) -> Bool[NDArray[np.bool_], "V"]:
        """Whether most objects of each class hang on a wall or from the ceiling."""
        return self.stands[:, HANGS] > USUAL

    def log_ratio(self, relation: int, anchor: int, *, outgoing: bool) -> Float[Floats, "V"]:
        """Return log p(i at a, j) - log p(i) of each class i, with relation a and anchor class j.

        ``outgoing`` means that the class i is the subject of the relation, and not the anchor.
        """
        start, classes, counts, back_off = self._by_anchor[int(outgoing)]
        V = len(self.frequency)
        begin, end = start[relation * V + anchor], start[relation * V + anchor + 1]
        smoothed = _PLACE * back_off[relation]
        smoothed[classes[begin:end]] += counts[begin:end]
        return np.log(smoothed / ((counts[begin:end].sum() + _PLACE) * self.frequency))

    def scenes(
        self, relations: Sequence[int], subject: Int[Indices, "N"], other: Int[Indices, "M"]
    ) -> Float[Floats, "R N M"]:
        """Return the number of training scenes with each relation of each two classes."""
        V = len(self.frequency)
        tables = self.triple, self.triple_scenes, V
        return np.stack([_triple_counts(*tables, a, subject, other) for a in relations])

    def supporters(
        self, subject: Int[Indices, "N"], other: Int[Indices, "M"]
    ) -> Float[Floats, "N M"]:
        """Return the share of each class among the objects on or in which each subject class is."""
        total, share = self._supporters
        of_pairs = _SUPPORTER * share[other] + self.scenes(SUPPORTS, subject, other).sum(0)
        return of_pairs / (total[subject, None] + _SUPPORTER)

    def any_supporters(self, other: Int[Indices, "M"]) -> Float[Floats, " M"]:
        """Return the share of each class among all supporters."""
        return self._supporters[1][other]

    @cached_property
    def _supporters(self) -> tuple[Float[Floats, "V"], Float[Floats, "V"]]:
        """Number of supporters of each class, and its share among all supporters."""
        V = len(self.frequency)
        is_support = np.isin(self.triple // (V * V), SUPPORTS)
        subject, other = np.divmod(self.triple[is_support] % (V * V), V)
        scenes = self.triple_scenes[is_support]
        total, count = (np.bincount(role, scenes, V).astype(float) for role in (subject, other))
        return total, (count + _SEEN) / (count + _SEEN).sum()

    def under_evidence(self, upper: int, lower: int) -> float:
        """Return log(n · n / m), with n scenes that show the lower class under the upper.

        m is the number of scenes that show it on or in the upper class. So the value is large if
        this role is usual, or if many scenes show it. It is -inf if no scene shows it.
        """
        counts = role_counts(self.roles, lower, upper).astype(float)
        if counts[UNDER] <= 0:
            return -math.inf
        return math.log(counts[UNDER] ** 2 / (counts[ON] + counts[IN] + _OTHER_ROLES))

    def literal_share(self, upper: int, lower: int) -> float:
        """Return how often "upper on top of lower" is said in these words: 1 without any "under".

        Other words of the same relation are "lower under upper".
        """
        on = float(role_counts(self.roles, upper, lower)[ON]) + _OTHER_ROLES
        return on / (on + float(role_counts(self.roles, lower, upper)[UNDER]))

    def means_under(self, upper: int, lower: int) -> bool:
        """Return whether "upper on top of lower" means lower under upper, as with desk and bin."""
        under = role_counts(self.roles, lower, upper)[UNDER]
        return bool(under >= _SHOWN and under > role_counts(self.roles, upper, lower)[ON])

    @cached_property
    def _by_anchor(self) -> tuple[tuple[NDArray[Any], ...], ...]:
        """For anchors as subjects, then as objects: the triples in the order of their anchor.

        The arrays are the first row of each (relation, anchor) and the end, (A V + 1,); class i and
        number of scenes of each row, both (N,); and p(i at a), (A, V).
        """
        V = len(self.frequency)
        a, i, j = self.triple // V // V, self.triple // V % V, self.triple % V
        A = len(CANONICAL)  # a relation may have no triple
        share = self.frequency.astype(np.float64) / self.frequency.sum()
        tables = []
        for anchor, other in ((i, j), (j, i)):
            key = a.astype(np.int64) * V + anchor
            order = np.argsort(key, kind="stable")
            back_off = np.zeros((A, V)) + _RELATION * share
            np.add.at(back_off, (a, other), self.triple_scenes)
            back_off /= back_off.sum(1, keepdims=True)
            start = np.searchsorted(key[order], np.arange(A * V + 1))
            tables.append(
                (start, other[order], self.triple_scenes[order].astype(np.float64), back_off)
            )
        return tuple(tables)


@compiled
def _triple_counts(
    triple: Int[NDArray, " R"],
    triple_scenes: Float[NDArray, " R"],
    V: int,
    relation: int,
    subject: Int[NDArray, " N"],
    other: Int[NDArray, " M"],
) -> Float[NDArray, "N M"]:
    """Return the counts of the triples (relation, subject, other), 0 without an entry."""
    counts = np.zeros((len(subject), len(other)))
    for i in range(len(subject)):
        for j in range(len(other)):
            row = find_row(triple, (relation * V + subject[i]) * V + other[j])
            if row >= 0:
                counts[i, j] = triple_scenes[row]
    return counts
