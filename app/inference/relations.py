"""Probabilities of relations: p(r_e = 1) = E[sigmoid(ℓ_e(h1))] with ℓ_e(h1) = base_e + U_e·h1.

The logit ℓ_e is a sum of many small independent terms. This module treats it as normal, with

    mean base_e + U_e·m   and variance   σ_e² = sum_k U_ek² m_k (1 - m_k)

where m are the means of h1. Quadrature gives the mean of sigmoid(ℓ_e). For its errors, see
docs/decisions/inference.md. The variant of the machine defines base and U: each unit of `FreeUnits`
has its own row of U, and `SharedUnits` computes U from factors. All variants share the other code.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.inference import relation_kernels as kernels
from app.inference.elementary import sigmoid

if TYPE_CHECKING:
    from app.inference.weights import Weights

Floats = NDArray[np.float32]
Places = NDArray[np.int64]
Mask = NDArray[np.bool_]

SWEEPS: Final = 10
"""Number of iterations of a mean field. The shipped machines converge in this number. It is fixed,
so that answers are reproducible."""

NO_UNIT: Final = np.float32(-30.0)
"""Lower limit of the log-odds of a relation."""

NEVER: Final = np.float32(-1e4)
"""Logit of a relation without a unit. Such a relation is off at any temperature."""

Table = tuple[NDArray[np.int32], NDArray[np.int32]]

NOTHING: Final[Floats] = np.zeros((0, 0, 0), dtype=np.float32)

# The number of pairs is padded to a multiple of this number, to fill whole vector registers.
_WHOLE: Final = 32

# Maximum mean variance of a logit that `_directions` may neglect. A probability changes by about
# 1/20 of the neglected variance. `indoor-triway` keeps 11 of 33 directions. All 33 would double the
# time of /relations and change p by at most 0.005.
_LEFT_OUT: Final = 4e-3


def to_log_odds(mean: Floats, spread: Floats) -> Floats:
    """Return the log-odds of the mean of sigmoid(ℓ) for normal logits ℓ. The minimum is `NO_UNIT`.

    For σ < 0.75, the quadrature has three nodes: 0 and ±√3 σ, with weights 4 : 1 : 1. The error in
    p is at most 0.0003. With u = e^-|mean| and q = e^spread, the sigmoids are u/(1 + u),
    uq/(1 + uq) and u/(q + u). These forms cannot overflow. For larger σ, such as 10, the function
    uses the trapezoidal rule.

    Args:
        mean: means of the logits.
        spread: √3 σ of the logits.
    """
    found = mean.ravel().astype(np.float32)
    # ravel() makes the arrays contiguous: numba would compile the kernel again for another layout.
    kernels.log_odds(found, spread.ravel(), NO_UNIT)
    return found.reshape(mean.shape)


@dataclass(frozen=True, slots=True)
class Given:
    """E observed relation units between the n classes of a scene, each on or off.

    Attributes:
        a: (E,) indices of the relations.
        i, j: (E,) indices of subject and object class, from 0 to n - 1.
        r: (E,) 1 if the relation holds, else 0.
        g: (E,) presence of both ends.
    """

    a: Places
    i: Places
    j: Places
    r: Floats
    g: Floats


class Units(NamedTuple):
    """The requested relations for which the machine has a unit.

    Attributes:
        place: (E,) index of each unit in the request.
        a: (E,) indices of the relations.
        base: (E,) logit ℓ_e without U_e·h1.
        z: (E, K') factors of each unit: U_e = G[a]'z_e. If G is empty, z_e is U_e itself.
    """

    place: Places
    a: Places
    base: Floats
    z: Floats


@dataclass(frozen=True, slots=True)
class Context:
    """The hidden units of a scene, given its observed objects and relations.

    Attributes:
        classes: (n,) int64, distinct indices of the classes in the scene.
        presence: (n,) presence of each class.
        log_counts: (n,) log of the number of instances of each class.
        x: (H1,) logits of h1 given the objects.
        y: (H1,) logits of h1 given objects and relations, for questions about relations.
        given: observed relations, or None without observed relations.
        units: relation units of `given`.
        slopes: slopes of `units`, for questions about relations; see `RelationUnits.fixed_point`.
        object_y, object_slopes: y and slopes for questions about objects.
        through: (n, H1) contribution of each class to y through the second layer, or None for a
            machine with one layer.
    """

    classes: Places
    presence: Floats
    log_counts: Floats
    x: Floats
    y: Floats
    given: Given | None
    units: Units | None
    slopes: Floats
    object_y: Floats
    object_slopes: Floats
    through: Floats | None

    def ends(self, i: Places, j: Places) -> Ends:
        """Return `Ends` for the pairs (i, j) of indices into `classes`."""
        p, n = self.presence, self.log_counts
        return Ends(self.classes[i], self.classes[j], n[i], n[j], p[i], p[j])


class Ends(NamedTuple):
    """Both ends of some pairs: subject and object class, log of their counts, and their presence.

    All arrays have the same shape.
    """

    i: Places
    j: Places
    log_i: Floats
    log_j: Floats
    p_i: Floats
    p_j: Floats


class Between(NamedTuple):
    """The logits of all relations between the n classes, and the effects of observed relations.

    Without observed relations, slopes, shift and apart are empty.

    Attributes:
        mean, spread: (A, n, n) mean and √3 σ of the logits; see `RelationUnits.normal`.
        slopes: (A, n, n) slopes of observed relations, and 0 for other relations.
        shift: (A, n, n) change of each logit by implications of the observed relations.
        apart: (A, n, n) like `shift`, but without observed relations between the same two classes.
    """

    mean: Floats
    spread: Floats
    slopes: Floats
    shift: Floats
    apart: Floats


class SharedArrays(NamedTuple):
    """Weights of a Triway's units for the compiled kernels.

    Attributes:
        S, O: (V, K + 1) factors of subject and object class. The last column is 1.
        s, o: (V, A) weights of subject and object class.
        n: (A, 2) weights of the log counts of both ends.
        start, key: look-up table of `pair_rows`.
        residual: (pairs + 1, A) residual weights w'. The last row is 0.
    """

    S: Floats
    O: Floats  # noqa: E741
    s: Floats
    o: Floats
    n: Floats
    start: NDArray[np.int32]
    key: NDArray[np.int32]
    residual: Floats


class RelationUnits(ABC):
    """The relation units of a machine.

    Attributes:
        G: (A, K', H1) weights that all units of a relation share. G is empty if each unit has its
            own row of U.
    """

    G: Floats

    def __init__(self, weights: Weights) -> None:
        self._W, self._A, self._V = weights["W"], weights.spec.A, weights.spec.V

    @abstractmethod
    def select(self, a: Places, ends: Ends) -> Units:
        """Return the units of relations a (E,) between ``ends``, if the machine has these units."""

    @abstractmethod
    def normal(
        self, means: Floats, ends: Ends, only: int | None = None, *, known: bool = False
    ) -> tuple[Floats, Floats]:
        """Return mean and √3 σ of the logits of R relations for P pairs, both (B, R, P).

        A relation without a unit has the mean `NEVER`.

        Args:
            means: (B, H1) means of h1.
            ends: both ends of each pair, (B, P).
            only: index of one relation (R = 1), or None for all relations (R = A).
            known: whether all means are 0 or 1. The variance is then 0.
        """

    def rows(self, units: Units) -> Floats:
        """Return the rows U_e of units, (E, H1)."""
        if not len(self.G):
            return units.z
        found: Floats = kernels.expanded(self.G, units.a, units.z)
        return found

    def rows_of(self, a: Places, i: Places, j: Places) -> Floats:
        """Return the rows U_e of relations a between classes i and j, (E, H1).

        Relations without a unit have no row.
        """
        none = np.zeros(len(a), np.float32)
        return self.rows(self.select(a, Ends(i, j, none, none, none, none)))

    def fixed_point(
        self, x: Floats, given: Given, ends: Ends, sweeps: int = SWEEPS
    ) -> tuple[Floats, Units, Floats]:
        """Compute the mean field given observed relations.

        The result is y (H1,), the units of the observed relations, and their slopes. The iteration
        starts at y = x. m = sigmoid(y) are the means of h1, and g is the presence of both ends:

            y = x + sum_e slope_e U_e,   slope_e = g_e (r_e - sigmoid(base_e + U_e·m))
        """
        units = self.select(given.a, ends)
        G, z = self.G, units.z
        if 2 * len(z) < G.shape[0] * G.shape[1]:
            # With few units, products with rows of U are faster than products with G.
            G, z = NOTHING, self.rows(units)
        r, g = given.r[units.place], given.g[units.place]
        y, slopes = kernels.fixed_point(x, G, units.a, units.base, z, r, g, sweeps)
        return y, units, slopes

    def between(self, context: Context) -> Between:
        """Return the logits of all relations between the classes of a scene."""
        n = len(context.classes)
        mean, spread = self.normal(sigmoid(context.y)[None], context.ends(*all_pairs(n)))
        shape = self._A, n, n
        return Between(mean.reshape(shape), spread.reshape(shape), *self.said(context))

    def said(self, context: Context) -> tuple[Floats, Floats, Floats]:
        """Return the values `slopes`, `shift` and `apart` of `Between`."""
        given, units, n = context.given, context.units, len(context.classes)
        if given is None or units is None:
            return NOTHING, NOTHING, NOTHING
        slopes = np.zeros((self._A, n, n), dtype=np.float32)
        where = units.place
        slopes[given.a[where], given.i[where], given.j[where]] = context.slopes
        return slopes, *self.implied(context.x, n, given)

    def implied(self, x: Floats, n: int, given: Given) -> tuple[Floats, Floats]:
        """Return the values `shift` and `apart` of `Between`.

        Args:
            x: (H1,) logits of h1 given the objects.
            n: number of classes in the scene.
            given: observed relations.
        """
        weight = self.implication_weights(x)
        if not len(weight):
            return NOTHING, NOTHING
        on = (given.r > 0) & (given.i != given.j)
        found = kernels.implied(weight, n, given.a[on], given.i[on], given.j[on])
        shift, apart = np.ascontiguousarray(found.transpose(0, 3, 1, 2))
        return shift, apart

    def implication_weights(self, x: Floats, beta: float = 1.0) -> Floats:
        """Return how much each feature of the observed relations changes each logit, (F, A).

        The result is empty for a machine without implications. See `training/machines/triway.py`
        for the features.
        """
        del x, beta
        return NOTHING.reshape(0, 0)

    def log_odds(self, between: Between) -> Floats:
        """Return the log-odds of all relations between the classes, (A, n, n).

        An observed relation changes its own logit ℓ_e(m) by about slope_e σ_e². The method
        subtracts this change, which is correct to first order.
        """
        mean, spread = between.mean, between.spread
        if len(between.slopes):
            mean = mean - between.slopes * spread * spread / np.float32(3)
        if len(between.shift):
            mean = mean + between.shift
        return to_log_odds(mean, spread)

    def without_itself(
        self, context: Context, a: Places, i: Places, j: Places, slopes: Floats, shift: Floats
    ) -> Floats:
        """Return the log-odds of some relations, (E,), without their effect on themselves.

        Unlike `log_odds`, the method removes slope_e U_e from y, which is exact.

        Args:
            context: context of the scene.
            a: (E,) indices of the relations.
            i, j: (E,) indices of their subject and object class in the scene.
            slopes: (E,) slopes of the relations.
            shift: (A, n, n) value `shift` of `Between`, or empty.
        """
        units = self.select(a, context.ends(i, j))
        mean, spread = kernels.normal_without_itself(
            context.y, self.rows(units), units.base, slopes[units.place]
        )
        if len(shift):
            mean += shift[a, i, j][units.place]
        found = np.full(len(a), NO_UNIT)
        found[units.place] = to_log_odds(mean, spread)
        return found

    @abstractmethod
    def log_odds_apart(self, context: Context, between: Between, i: Places, j: Places) -> Floats:
        """Return the log-odds of the relations of some pairs, (2, A, P).

        The observed relations of a pair do not count as evidence for the pair itself.

        Args:
            context: context of the scene.
            between: logits between the classes of the scene.
            i, j: (P,) indices of the two classes of each pair in the scene. Part 0 of the result
                is the direction from i to j, and part 1 is the direction from j to i.
        """

    def placement_log_odds(
        self, context: Context, candidates: Places, anchors: Places, only: int | None = None
    ) -> tuple[Floats, Floats]:
        """Return the log-odds of relations between absent candidate classes and anchor classes.

        The method treats each candidate as present.

        Args:
            context: context of the scene.
            candidates: (N,) indices of the candidate classes.
            anchors: (m,) indices of the anchor classes in the scene.
            only: index of one relation (R = 1), or None for all relations (R = A).

        Returns:
            Log-odds with the candidate as subject, (N, R, m), and with the anchor as subject,
            (N, R, m).
        """
        m = len(anchors)
        shape = len(candidates), 2 * m
        i, j = np.empty(shape, np.int64), np.empty(shape, np.int64)
        log_i, log_j = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        p_i, p_j = np.ones(shape, np.float32), np.ones(shape, np.float32)
        i[:, :m] = j[:, m:] = candidates[:, None]
        j[:, :m] = i[:, m:] = context.classes[anchors]
        log_j[:, :m] = log_i[:, m:] = context.log_counts[anchors]
        p_j[:, :m] = p_i[:, m:] = context.presence[anchors]
        both = Ends(i, j, log_i, log_j, p_i, p_j)
        means = sigmoid(context.y + self._W[candidates])
        found = to_log_odds(*self.normal(means, both, only))
        return found[:, :, :m], found[:, :, m:]

    def shares(self, context: Context) -> Floats:
        """Return the contribution of each class and its relations to y, (n, H1)."""
        found: Floats = context.presence[:, None] * self._W[context.classes]
        given, units = context.given, context.units
        if given is not None and units is not None:
            i, j = given.i[units.place], given.j[units.place]
            keys = np.stack([i, np.where(i == j, -1, j)])
            found += self._sums(units, keys, context.object_slopes, len(context.classes))
        return found

    def common(self, context: Context) -> tuple[Floats, Places]:
        """Return the contribution of the observed relations of each pair of classes to y.

        Returns:
            (P, H1) contributions, and (n, n) row of each pair of classes in the contributions. The
            row is -1 for a pair without observed relations.
        """
        n = len(context.classes)
        given, units = context.given, context.units
        index = np.full((n, n), -1)
        if given is None or units is None:
            return np.zeros((0, self._W.shape[1]), np.float32), index
        i, j = given.i[units.place], given.j[units.place]
        keys = np.where(i == j, -1, np.minimum(i, j) * n + np.maximum(i, j))
        filled = np.zeros(n * n, np.bool_)
        filled[keys[keys >= 0]] = True
        pairs = np.flatnonzero(filled)
        index.reshape(-1)[pairs] = np.arange(len(pairs))
        rows = np.where(keys < 0, -1, index.reshape(-1)[keys])
        found = self._sums(units, rows, context.object_slopes, len(pairs))
        return found, np.maximum(index, index.T)

    def _sums(self, units: Units, keys: Places, slopes: Floats, size: int) -> Floats:
        """Sum slope_e U_e over the units of each key, (size, H1). Ignore units with key -1.

        Args:
            units: E relation units.
            keys: (E,) key of each unit, or (2, E) for two keys per unit.
            slopes: (E,) slopes of the units.
            size: number of keys.
        """
        if not len(self.G):
            summed: Floats = kernels.accumulate(keys.reshape(-1), slopes, units.z, size)
            return summed
        A, K, H1 = self.G.shape
        keys = np.where(keys < 0, -1, keys * A + units.a).reshape(-1)
        factors = kernels.accumulate(keys, slopes, units.z, size * A).reshape(size, A * K)
        found: Floats = factors @ self.G.reshape(A * K, H1)
        return found


class FreeUnits(RelationUnits):
    """One unit for each triple (relation, subject class, object class) of the training scenes.

    ℓ_t = d_t + g_t v_i + g'_t v_j + U_t·h1

    Other triples have no unit, so they do not act as evidence. Their log-odds are `NO_UNIT`.

    Args:
        weights: weights of the machine.
        U: (T, H1) weights between units and h1.
        g: (T, 2) weights of the presence of both ends. None means zeros.
    """

    def __init__(self, weights: Weights, U: Floats, g: Floats | None = None) -> None:
        super().__init__(weights)
        self.G = NOTHING
        self._U, self._d, self._g = U, weights["d"], g
        self._table, index = _pair_table(weights)
        self._index = np.full((len(self._table[1]) + 1, self._A), -1, np.int32)
        self._index[index] = np.arange(len(U))

    def select(self, a: Places, ends: Ends) -> Units:
        """See `RelationUnits`."""
        rows = self._index[kernels.pair_rows(*self._table, ends.i * self._V + ends.j), a]
        place = np.flatnonzero(rows >= 0)
        rows = rows[place]
        base = self._d[rows]
        if self._g is not None:
            base = base + self._g[rows, 0] * ends.p_i[place] + self._g[rows, 1] * ends.p_j[place]
        return Units(place, a[place], base.astype(np.float32), self._U[rows])

    def normal(
        self, means: Floats, ends: Ends, only: int | None = None, *, known: bool = False
    ) -> tuple[Floats, Floats]:
        """See `RelationUnits`."""
        del known  # the formula gives variance 0 for means of 0 and 1
        asked = _asked(self._A, only)
        shape = len(means), asked.stop - asked.start, ends.i.shape[1]
        b, a, p = (part.reshape(-1) for part in np.indices(shape))
        units = self.select(asked.start + a, Ends(*(end[b, p] for end in ends)))
        mean, spread = np.full(shape, NEVER), np.zeros(shape, np.float32)
        U, place = units.z, units.place
        if len(means) == 1:
            m = means[0]
            logits, variance = U @ m, (U * U) @ (m * (1 - m))
        else:
            m = means[b[place]]
            logits = np.einsum("eh,eh->e", U, m)
            m *= 1 - m
            variance = np.einsum("eh,eh->e", U * U, m)
        mean.reshape(-1)[place] = units.base + logits
        spread.reshape(-1)[place] = np.sqrt(3 * variance)
        return mean, spread

    def log_odds_apart(self, context: Context, between: Between, i: Places, j: Places) -> Floats:
        """See `RelationUnits`. The result is exact."""
        del between
        ends = context.ends(np.stack([i, j], 1), np.stack([j, i], 1))
        y = np.tile(context.y, (len(i), 1))
        given, units, n = context.given, context.units, len(context.classes)
        if given is not None and units is not None:
            keys = given.i[units.place] * n + given.j[units.place]
            pulls = kernels.accumulate(keys, context.slopes, units.z, n * n)
            y -= pulls[i * n + j] + np.where((i != j)[:, None], pulls[j * n + i], 0)
        found = to_log_odds(*self.normal(sigmoid(y), ends))
        return np.ascontiguousarray(found.transpose(2, 1, 0))


class SharedUnits(RelationUnits):
    """A unit for every triple, with shared weights and a sparse residual; see `Triway`.

    The factors are z_e = (S_i * O_j, 1), and U_e = G[a]'z_e. The rows of G[a] are the rows of M[a],
    followed by P[a]. The variance of a logit is q'C q. The vector q = Y[a] z_e has the coordinates
    of U_e in the directions F_a of largest variance, and C = F_a diag(m (1 - m)) F_a'.
    """

    def __init__(self, weights: Weights) -> None:
        super().__init__(weights)
        A = self._A
        ones = np.ones((self._V, 1), np.float32)
        table, index = _pair_table(weights)
        residual = np.zeros((len(table[1]) + 1, A), np.float32)
        residual[index] = weights["residual"]
        self._w = SharedArrays(
            np.concatenate([weights["S"], ones], 1),
            np.concatenate([weights["O"], ones], 1),
            np.ascontiguousarray(weights["s"].T),
            np.ascontiguousarray(weights["o"].T),
            weights["n"],
            *table,
            residual,
        )
        self.G = np.concatenate([weights["M"], weights["P"][:, None]], 1)
        self._g = np.concatenate([weights["R"], weights["d"][:, None]], 1)
        F, self._Y = _directions(weights)
        self._F = F.reshape(-1, F.shape[2])
        # Products of two directions give the lower half of C. Entries off the diagonal are doubled.
        p, q = np.tril_indices(F.shape[1])
        self._FF = _columns(F[:, p] * F[:, q] * np.where(p == q, 1, 2)[:, None])
        self._GT = _columns(self.G)
        self._B = weights["B"] if weights.spec.G else None
        if self._B is not None:
            gamma = weights["gamma"].swapaxes(1, 2).copy()
            # A relation does not imply itself.
            gamma[:, range(A), range(A)] = 0
            self._gamma = gamma.reshape(len(gamma), -1)

    def select(self, a: Places, ends: Ends) -> Units:
        """See `RelationUnits`."""
        base, z = kernels.unit_terms(self._w, self._g, a, ends)
        return Units(np.arange(len(a)), a, base, z)

    def normal(
        self, means: Floats, ends: Ends, only: int | None = None, *, known: bool = False
    ) -> tuple[Floats, Floats]:
        """See `RelationUnits`."""
        asked, (B, P) = _asked(self._A, only), ends.i.shape
        Y = self._Y[asked]
        width = -(-P // _WHOLE) * _WHOLE
        z = np.zeros((B, Y.shape[2], width), np.float32)
        mean = np.zeros((B, len(Y), width), np.float32)
        kernels.pair_terms(self._w, asked.start, ends, z, mean)
        mean += (self._of(asked, means, self._GT) + self._g[asked]) @ z
        if known:
            return mean[:, :, :P], np.zeros((B, len(Y), P), np.float32)
        q = (Y.reshape(-1, Y.shape[2]) @ z).reshape(B, *Y.shape[:2], width)
        spread = kernels.spreads(self._of(asked, means * (1 - means), self._FF), q)
        return mean[:, :, :P], spread[:, :, :P]

    def _of(self, asked: slice, rows: Floats, columns: Floats) -> Floats:
        """Return the products of rows (B, H1) with the n columns of each relation, (B, R, n)."""
        n = columns.shape[1] // self._A
        found: Floats = rows @ columns[:, asked.start * n : asked.stop * n]
        return found.reshape(len(rows), -1, n)

    def implication_weights(self, x: Floats, beta: float = 1.0) -> Floats:
        """See `RelationUnits`.

        The weights are beta (gamma_0 + sum_q z_q gamma_q) with z = B sigmoid(beta x).
        """
        if self._B is None:
            return super().implication_weights(x, beta)
        scale = np.append(np.float32(1), self._B @ sigmoid(beta * x))
        weight: Floats = (np.float32(beta) * scale) @ self._gamma
        return weight.reshape(-1, self._A)

    def log_odds_apart(self, context: Context, between: Between, i: Places, j: Places) -> Floats:
        """See `RelationUnits`. The result is correct to first order.

        The observed units e' of the pair, in both directions, change ℓ_e(m) by
        sum_e' slope_e' cov(ℓ_e, ℓ_e'), where cov = sum_k U_ek U_e'k m_k (1 - m_k).
        """
        A, P = self._A, len(i)
        start, end = np.concatenate([i, j]), np.concatenate([j, i])
        mean, spread = between.mean[:, start, end], between.spread[:, start, end]
        if len(between.slopes):
            m, classes = sigmoid(context.y), context.classes
            z = self._w.S[classes[start]] * self._w.O[classes[end]]
            # q has the shape (2, P, A, r). The first axis is the direction within a pair.
            q = (z @ self._Y.reshape(len(self._F), -1).T).reshape(2, P, A, -1)
            slopes = between.slopes[:, start, end].T.reshape(2, P, A, 1).copy()
            # For a class with itself, both directions are the same unit.
            slopes[1, i == j] = 0
            pull = (slopes * q).sum(0).reshape(P, -1)
            back = (pull @ self._F) * (m * (1 - m)) @ self._F.T
            mean -= (q * back.reshape(P, A, -1)).sum(3).reshape(2 * P, A).T
        if len(between.apart):
            mean += between.apart[:, start, end]
        found = to_log_odds(mean, spread).reshape(A, 2, P)
        return np.ascontiguousarray(found.swapaxes(0, 1))


@lru_cache(maxsize=128)
def all_pairs(n: int) -> tuple[Places, Places]:
    """Return the indices of the first and the second class of all pairs of n classes, (1, n²)."""
    every = np.arange(n)
    return np.repeat(every, n)[None], np.tile(every, n)[None]


def _columns(matrices: Floats) -> Floats:
    """Convert the n rows of each relation (A, n, H1) to columns (H1, A n), for faster products."""
    return np.ascontiguousarray(matrices.reshape(-1, matrices.shape[2]).T)


def _asked(relations: int, only: int | None) -> slice:
    """Return the slice of one relation, or of all relations for None. A slice avoids a copy."""
    return slice(0, relations) if only is None else slice(only, only + 1)


def _pair_table(weights: Weights) -> tuple[Table, tuple[Places, Places]]:
    """Build the look-up table of `pair_rows`, with each pair of classes that has a triple weight.

    Returns:
        The table (buckets and keys), and for each triple the row of its pair and its relation.
    """
    size = weights.spec.V**2
    triples = weights.triple_keys
    pairs = np.unique(triples % size)
    buckets = 1 << (2 * len(pairs)).bit_length()
    bucket = (pairs * kernels.SPREAD >> kernels.SHIFT) & (buckets - 1)
    order = np.argsort(bucket, kind="stable")
    row = np.empty_like(order)
    row[order] = np.arange(len(order))
    start = np.searchsorted(bucket[order], np.arange(buckets + 1))
    index = row[np.searchsorted(pairs, triples % size)], triples // size
    return (start.astype(np.int32), pairs[order].astype(np.int32)), index


def _directions(weights: Weights) -> tuple[Floats, Floats]:
    """Return F (A, r, H1) and Y (A, r, K + 1), see `SharedUnits`.

    F are the directions of largest variance of U_e·h1. Y gives the coordinates q = Y z of a unit
    with z = (S_i * O_j, 1). The frequencies of classes and the variance of h1 come from the stored
    scenes of the machine.
    """
    spec = weights.spec
    rows = np.concatenate([weights["P"][:, None], weights["M"]], 1).astype(np.float64)
    share, spread = np.ones(spec.V), np.full(spec.H1, 0.25)
    if spec.N:
        share = weights.scenes.mean(0).astype(np.float64)
        mean = sigmoid(weights["c1"] + weights.scenes @ weights["W"]).astype(np.float64)
        spread = (mean * (1 - mean)).mean(0)
    share = share / share.sum()
    ones = np.ones((spec.V, 1))
    left, right = (
        np.concatenate([ones, weights[name].astype(np.float64)], 1) for name in ("S", "O")
    )
    # E[z z'] of z = (1, S_i * O_j) for independent i and j, and its Cholesky factor.
    moment = (left.T @ (share[:, None] * left)) * (right.T @ (share[:, None] * right))
    scale = np.trace(moment) / len(moment)
    root = np.linalg.cholesky(moment + 1e-9 * scale * np.eye(len(moment)))
    covariance = root.T @ ((rows * spread) @ rows.transpose(0, 2, 1)) @ root
    values, vectors = np.linalg.eigh(covariance)
    left_out = np.cumsum(values.clip(min=0), axis=1)
    kept = max(1, int((left_out > _LEFT_OUT).sum(1).max()))
    vectors = vectors[:, :, -kept:]
    Y = np.linalg.solve(root.T, vectors).transpose(0, 2, 1)
    F = vectors.transpose(0, 2, 1) @ root.T @ rows
    return F.astype(np.float32), np.roll(Y, -1, axis=2).astype(np.float32)
