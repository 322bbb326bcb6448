"""Probabilities of relations: p(r_e = 1) = E[sigmoid(ℓ_e(h1))] with ℓ_e(h1) = base_e + U_e·h1.

A relation e is a triple (relation a, subject class i, object class j). r_e is 1 if the relation
holds, else 0. The logit ℓ_e is a sum of many small independent terms, one for each hidden unit k of
h1. This module treats the logit as a normal variable with

    mean base_e + U_e·m   and variance   σ_e² = sum_u [sum_z U_euz² m_uz - (sum_z U_euz m_uz)²]

where m_uz is the probability of state z of hidden unit u (its first state has the weight 0).
Quadrature gives the mean of sigmoid(ℓ_e). For the quadrature errors, see
docs/decisions/inference.md. The variant of the machine defines base and U. Each unit of `FreeUnits`
has its own row of U. `SharedUnits` computes U from factors. All variants share the other code.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled, compiled_in_any_order
from app.inference.implications import implication_shifts
from app.inference.quadrature import to_log_odds
from app.inference.weights import Weights, state_means

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

NEVER: Final = np.float32(-1e4)
"""Logit of a relation for which the machine has no unit. Such a relation never holds."""

Table = tuple[NDArray[np.int32], NDArray[np.int32]]

NO_VALUES: Final[Floats] = np.zeros((0, 0, 0), dtype=np.float32)

# Constants of a hash table: bucket of a pair = (key * _SPREAD) >> _SHIFT, modulo the table size.
_SPREAD, _SHIFT = 2654435761, 16

# Number of float32 in a vector register. Rows of whole registers are faster.
_VECTOR: Final = 8

# Maximum variance of a logit, averaged over units, that `_directions` may neglect. Neglecting a
# variance changes a probability by about 1/20 of this variance. The model `places-triway` keeps 6
# of 33 directions.
_LEFT_OUT: Final = 1.6e-2


@dataclass(frozen=True, slots=True)
class ObservedRelations:
    """E observed relations between the n classes of a scene. Each relation holds or does not hold.

    Attributes:
        a: (E,) number of the relation (left, on top, ...) of each unit.
        i, j: (E,) indices of the subject classes and of the object classes, from 0 to n - 1.
        r: (E,) 1 if the relation holds, else 0.
    """

    a: Indices
    i: Indices
    j: Indices
    r: Floats


@dataclass(frozen=True, slots=True)
class Context:
    """The hidden units of a scene, given its objects, and the observed relations of the scene.

    Attributes:
        classes: (n,) int64, distinct indices of the classes in the scene.
        presence: (n,) probability that each class is present.
        log_counts: (n,) log of the number of instances of each class.
        x: (H1,) logits of h1 given the objects.
        shares: (n, H1) contribution of each class to x.
        observed: observed relations, or None if the scene has no observed relations.
    """

    classes: Indices
    presence: Floats
    log_counts: Floats
    x: Floats
    shares: Floats
    observed: ObservedRelations | None


class SharedArrays(NamedTuple):
    """Weights of a Triway's units for the compiled kernels.

    Attributes:
        S, O: (V, K + 1) factors of each class as subject and as object. The last column is 1.
        s, o: (V, A) weights of each class as subject and as object of each relation.
        n: (A, 2) weights of the log number of instances of subject and object class.
        start, key: look-up table of `_pair_rows`.
        residual: (pairs + 1, A) residual weight w' of each pair of classes and each relation. The
            last row is 0.
    """

    S: Floats
    O: Floats  # noqa: E741
    s: Floats
    o: Floats
    n: Floats
    start: NDArray[np.int32]
    key: NDArray[np.int32]
    residual: Floats


class Ends(NamedTuple):
    """Subject and object classes of some pairs. All arrays have the same shape.

    Attributes:
        i, j: class indices of the subjects and of the objects.
        log_i, log_j: log of the number of instances of each class in i and in j.
        p_i, p_j: probability that each class in i and in j is present.
    """

    i: Indices
    j: Indices
    log_i: Floats
    log_j: Floats
    p_i: Floats
    p_j: Floats


def context_of(
    weights: Weights,
    classes: Indices,
    presence: Floats,
    log_counts: Floats,
    room: int | None = None,
    observed: ObservedRelations | None = None,
) -> Context:
    """Compute the logits of h1 given the objects and the room type.

    Args:
        classes: (n,) indices of the distinct classes of the scene.
        presence: (n,) probability that each class is present.
        log_counts: (n,) log of the number of instances of each class.
        room: index of the room type, or None if the room type is unknown.
        observed: observed relations, or None if the scene has no observed relations.
    """
    shares = presence[:, None] * weights["W"][classes]
    x = weights.room_bias(room) + shares.sum(0)
    return Context(classes, presence, log_counts, x, shares, observed)


def ends_of(classes: Indices, presence: Floats, log_counts: Floats, i: Indices, j: Indices) -> Ends:
    """Return the `Ends` of pairs (i, j). i and j are indices into the other arrays."""
    n, p = log_counts, presence
    return Ends(classes[i], classes[j], n[i], n[j], p[i], p[j])


class Between(NamedTuple):
    """The logits of all A relations between n classes, and the effects of observed relations.

    If the scene has no observed relations, `shift` and `apart` are empty.

    Attributes:
        mean: (A, n, n) means of the logits.
        spread: (A, n, n) √3 σ, where σ is the standard deviation of each logit.
        shift: (A, n, n) change of each logit by the observed relations that hold.
        apart: (A, n, n) the same change without the observed relations between the two classes of
            the logit.
    """

    mean: Floats
    spread: Floats
    shift: Floats
    apart: Floats


class RelationUnits(ABC):
    """The relation units of a machine."""

    def __init__(self, weights: Weights) -> None:
        self._W, self._A, self._V = weights["W"], weights.spec.A, weights.spec.V
        self._states = weights.spec.states

    @abstractmethod
    def normal(
        self, means: Floats, ends: Ends, only: int | None = None, *, certain: bool = False
    ) -> tuple[Floats, Floats]:
        """Return the means and √3 σ of the logits of R relations for P pairs, both (B, R, P).

        σ is the standard deviation of a logit. B is the number of different means of h1. A relation
        without a unit has the mean `NEVER`.

        Args:
            means: (B, H1) means of h1.
            ends: subject and object class of each pair, (B, P).
            only: index of one relation (R = 1), or None for all relations (R = A).
            certain: True if all means of h1 are 0 or 1. The variance of the logits is then 0.
        """

    def between(self, context: Context) -> Between:
        """Return the logits of all relations between the classes of a scene."""
        n, observed = len(context.classes), context.observed
        listed = context.classes, context.presence, context.log_counts
        means = state_means(context.x[None], self._states)
        mean, spread = self.normal(means, ends_of(*listed, *all_pairs(n)))
        weight = NO_VALUES if observed is None else self.implication_weights(context.x)
        shift = apart = NO_VALUES
        if observed is not None and len(weight):
            on = (observed.r > 0) & (observed.i != observed.j)
            units = observed.a[on], observed.i[on], observed.j[on]
            shifts = implication_shifts(weight, n, *units)
            shift, apart = (np.ascontiguousarray(change.transpose(2, 0, 1)) for change in shifts)
        shape = self._A, n, n
        return Between(mean.reshape(shape), spread.reshape(shape), shift, apart)

    def implication_weights(self, x: Floats, beta: float = 1.0) -> Floats:
        """Return how much each of F features of the observed relations changes a logit, (F, A).

        `training/machines/triway.py` defines the features. The result is empty for machines in
        which relations do not change each other's logits directly. x (H1,) are the logits of h1
        given the objects, and beta is 1 / temperature.
        """
        return NO_VALUES.reshape(0, 0)

    def log_odds(self, between: Between, *, apart: bool = False) -> Floats:
        """Return the log-odds of all relations between the n classes of a scene, (A, n, n).

        With `apart`, the observed relations of a pair are not evidence for its other relations.
        """
        change = between.apart if apart else between.shift
        mean = between.mean + change if len(change) else between.mean
        return to_log_odds(mean, between.spread)

    def placement_log_odds(
        self, context: Context, candidates: Indices, anchors: Indices, only: int | None = None
    ) -> tuple[Floats, Floats]:
        """Return the log-odds of relations between absent candidate classes and anchor classes.

        The method computes the log-odds of each candidate as if the candidate were present.

        Args:
            context: hidden units of the scene.
            candidates: (N,) indices of the candidate classes.
            anchors: (m,) indices of the anchor classes in the scene.
            only: index of one relation (R = 1), or None for all relations (R = A).

        Returns:
            Log-odds (N, R, m) with the candidate as subject, and log-odds (N, R, m) with the
            anchor as subject.
        """
        m, scene = len(anchors), (context.classes, context.log_counts, context.presence)
        ends = _placement_ends(candidates, *(part[anchors] for part in scene))
        means = state_means(context.x + self._W[candidates], self._states)
        log_odds = to_log_odds(*self.normal(means, ends, only))
        return log_odds[:, :, :m], log_odds[:, :, m:]


class FreeUnits(RelationUnits):
    """One unit for each triple (relation, subject class, object class) of the training scenes.

    The logit of unit t is ℓ_t = d_t + g_t v_i + g'_t v_j + U_t·h1. Triples that do not occur in the
    training scenes have no unit. Such triples are not evidence, and their log-odds are `NO_UNIT`.
    The variant RBM has no g and g'.
    """

    def __init__(self, weights: Weights) -> None:
        super().__init__(weights)
        self._U, self._d, self._g = weights["U"], weights["d"], weights.arrays.get("g")
        self._table, index = _pair_table(weights)
        # The unit of each pair and relation, or -1. The last row is for pairs outside the table.
        self._index = np.full((len(self._table[1]) + 1, self._A), -1, np.int32)
        self._index[index] = np.arange(len(self._U))

    def normal(
        self, means: Floats, ends: Ends, only: int | None = None, *, certain: bool = False
    ) -> tuple[Floats, Floats]:
        """See `RelationUnits`. The formula gives variance 0 for means of 0 and 1."""
        chosen = _chosen_relations(self._A, only)
        shape = len(means), chosen.stop - chosen.start, ends.i.shape[1]
        # Row b of the means, relation a and pair p of each entry of the result.
        b, a, p = (indices.reshape(-1) for indices in np.indices(shape))
        rows = _pair_rows(*self._table, ends.i[b, p] * self._V + ends.j[b, p])
        units = self._index[rows, chosen.start + a].astype(np.int64)
        kept = np.flatnonzero(units >= 0)
        units, b, p = units[kept], b[kept], p[kept]
        base = self._d[units]
        if self._g is not None:
            g = self._g[units]
            base = base + g[:, 0] * ends.p_i[b, p] + g[:, 1] * ends.p_j[b, p]
        terms = self._by_unit(self._U[units])
        m = self._by_unit(means)[b if len(means) > 1 else np.zeros(1, np.int64)]
        weighted = terms * m
        by_unit = weighted.sum(2)
        variance = ((weighted * terms).sum(2) - by_unit * by_unit).sum(1)
        mean, spread = np.full(shape, NEVER), np.zeros(shape, np.float32)
        mean.reshape(-1)[kept] = base + by_unit.sum(1)
        spread.reshape(-1)[kept] = np.sqrt(3 * np.maximum(variance, 0))
        return mean, spread

    def _by_unit(self, rows: Floats) -> Floats:
        others = self._states - 1
        return rows.reshape(len(rows), rows.shape[1] // others, others)


class SharedUnits(RelationUnits):
    """One unit for every triple (relation a, subject class i, object class j); see `Triway`.

    The units share weights. A sparse residual adds a weight for some triples. The factors are
    z_e = (S_i * O_j, 1), and the weights are U_e = G[a]'z_e. The rows of G[a] are the rows of M[a],
    followed by P[a]. The variance of a logit is q'C q, with C = F_a cov(h1) F_a'. The rows of F_a
    are the directions with the largest variance. The vector q = Y[a] z_e has the coordinates
    of U_e in these directions.
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
        self._G = np.concatenate([weights["M"], weights["P"][:, None]], 1)
        self._g = np.concatenate([weights["R"], weights["d"][:, None]], 1)
        F, self._Y = _directions(weights)
        # (units, states - 1, A r): a matrix product sums over the states of each unit.
        self._F = _columns(F).reshape(-1, self._states - 1, A * F.shape[1])
        # Products of two directions give the lower half of C. Entries off the diagonal are doubled.
        p, q = np.tril_indices(F.shape[1])
        twice = np.where(p == q, np.float32(1), np.float32(2))  # int64 would give float64 products
        self._FF = _columns(F[:, p] * F[:, q] * twice[:, None])
        self._GT = _columns(self._G)
        self._B = weights["B"] if weights.spec.G else None
        if self._B is not None:
            gamma = weights["gamma"].swapaxes(1, 2).copy()
            # A relation does not imply itself.
            gamma[:, range(A), range(A)] = 0
            self._gamma = gamma.reshape(len(gamma), -1)

    def normal(
        self, means: Floats, ends: Ends, only: int | None = None, *, certain: bool = False
    ) -> tuple[Floats, Floats]:
        """See `RelationUnits`."""
        chosen = _chosen_relations(self._A, only)
        Y = self._Y[chosen, :0] if certain else self._Y[chosen]
        U = self._products(chosen, means, self._GT) + self._g[chosen]
        # The covariance of h1 is diag(m) - m m' within each hidden unit, and 0 between units.
        C, (R, r, _) = self._products(chosen, means, self._FF), Y.shape
        by_unit = means.reshape(len(means), -1, self._states - 1).transpose(1, 0, 2)
        f = by_unit @ self._F[:, :, chosen.start * r : chosen.stop * r]
        f = f.reshape(len(f), len(means), R, r)
        return _normal_logits(self._w, chosen.start, ends, U, Y, C, f)

    def _products(self, chosen: slice, rows: Floats, columns: Floats) -> Floats:
        """Return the product of the rows (B, H1) with n columns of each chosen relation, (B, R, n).

        `_columns` returns the columns (H1, A n) of all relations.
        """
        n = columns.shape[1] // self._A
        products: Floats = rows @ columns[:, chosen.start * n : chosen.stop * n]
        return products.reshape(len(rows), -1, n)

    def implication_weights(self, x: Floats, beta: float = 1.0) -> Floats:
        """See `RelationUnits`.

        The weights are beta (gamma_0 + sum_q z_q gamma_q) with z = B m(beta x).
        """
        if self._B is None:
            return super().implication_weights(x, beta)
        scale = np.append(np.float32(1), self._B @ state_means(beta * x, self._states))
        weight: Floats = (np.float32(beta) * scale) @ self._gamma
        return weight.reshape(-1, self._A)


class StandIns(RelationUnits):
    """The relation units of a model with further classes, in which known classes stand in for them.

    Args:
        weights: weights with the further classes.
        units: relation units of the known classes.
        stand_in: (V,) known class that stands in for each class.
    """

    def __init__(self, weights: Weights, units: RelationUnits, stand_in: Indices) -> None:
        super().__init__(weights)
        self._units, self._stand_in = units, stand_in

    def normal(
        self, means: Floats, ends: Ends, only: int | None = None, *, certain: bool = False
    ) -> tuple[Floats, Floats]:
        """See `RelationUnits`."""
        i, j = self._stand_in[ends.i], self._stand_in[ends.j]
        return self._units.normal(means, ends._replace(i=i, j=j), only, certain=certain)

    def implication_weights(self, x: Floats, beta: float = 1.0) -> Floats:
        """See `RelationUnits`."""
        return self._units.implication_weights(x, beta)


def relation_units(weights: Weights) -> RelationUnits:
    """Return the relation units of a machine."""
    return SharedUnits(weights) if weights.spec.kind.factorised else FreeUnits(weights)


@lru_cache(maxsize=128)
def all_pairs(n: int) -> tuple[Indices, Indices]:
    """Return all n² pairs of n classes: the indices of first and second classes, each (1, n²)."""
    indices = np.arange(n)
    return np.repeat(indices, n)[None], np.tile(indices, n)[None]


def _columns(matrices: Floats) -> Floats:
    """Convert the n rows of each relation (A, n, H1) to columns (H1, A n).

    Matrix products with the columns are faster.
    """
    return np.ascontiguousarray(matrices.reshape(-1, matrices.shape[2]).T)


def _chosen_relations(relations: int, only: int | None) -> slice:
    """Return a slice that selects the relation `only`, or all relations if `only` is None.

    Indexing with a slice does not copy the array.
    """
    return slice(0, relations) if only is None else slice(only, only + 1)


def _pair_table(weights: Weights) -> tuple[Table, tuple[Indices, Indices]]:
    """Build the hash table of `_pair_rows`.

    Its keys are the pairs of classes of the T stored triples. The keys are sorted by bucket. Bucket
    k consists of the rows from start[k] to start[k + 1].

    Returns:
        The hash table (start, keys), and two indices of the T triples: the row of the triple's pair
        in the table, (T,), and the relation, (T,).
    """
    # A triple (a, i, j) has the key (a V + i) V + j. The key of its pair is i V + j.
    relation, pair_of_triple = np.divmod(weights.triple_keys, weights.spec.V**2)
    pairs, pair_index = np.unique(pair_of_triple, return_inverse=True)
    buckets = 1 << (2 * len(pairs)).bit_length()
    bucket = (pairs * _SPREAD >> _SHIFT) & (buckets - 1)
    order = np.argsort(bucket, kind="stable")
    row_of_pair = np.empty_like(order)
    row_of_pair[order] = np.arange(len(order))
    start = np.searchsorted(bucket[order], np.arange(buckets + 1))
    table = start.astype(np.int32), pairs[order].astype(np.int32)
    return table, (row_of_pair[pair_index], relation)


def _directions(weights: Weights) -> tuple[Floats, Floats]:
    """Return F (A, r, H1) and Y (A, r, K + 1); see `SharedUnits`.

    The rows of F[a] are the r directions in which U_e·h1 has the largest variance. Y[a] converts
    the factors z = (S_i * O_j, 1) of a unit to its coordinates q = Y[a] z in these directions. The
    frequencies of classes and the variance of h1 come from the machine's stored samples.
    """
    spec = weights.spec
    rows = np.concatenate([weights["P"][:, None], weights["M"]], 1).astype(np.float64)
    frequency, means = np.ones(spec.V), np.full((1, spec.H1), 1 / spec.states)
    if spec.N:
        frequency = weights.scenes.mean(0).astype(np.float64) + 1e-6
        means = weights.scene_means
    p = (frequency / frequency.sum())[:, None]
    ones = np.ones((spec.V, 1))
    S, O = (  # noqa: E741
        np.concatenate([ones, weights[name].astype(np.float64)], 1) for name in ("S", "O")
    )
    # moment is E[z z'] of z = (1, S_i * O_j) for independent i and j. root is its Cholesky factor.
    moment = (S.T @ (p * S)) * (O.T @ (p * O))
    scale = np.trace(moment) / len(moment)
    root = np.linalg.cholesky(moment + 1e-9 * scale * np.eye(len(moment)))
    of_h1 = _mean_covariance(means.astype(np.float64), spec.states)
    covariance = root.T @ (rows @ of_h1 @ rows.transpose(0, 2, 1)) @ root
    values, vectors = np.linalg.eigh(covariance)
    left_out = np.cumsum(values.clip(min=0), axis=1)
    kept = max(1, int((left_out > _LEFT_OUT).sum(1).max()))
    vectors = vectors[:, :, -kept:]
    Y = np.linalg.solve(root.T, vectors).transpose(0, 2, 1)
    F = vectors.transpose(0, 2, 1) @ root.T @ rows
    Y = np.ascontiguousarray(np.roll(Y, -1, axis=2), np.float32)
    return F.astype(np.float32), Y


def _mean_covariance(means: NDArray[np.float64], states: int) -> NDArray[np.float64]:
    """Return the mean over N scenes of cov(h1), (H1, H1), given the means of h1, (N, H1)."""
    units = means.shape[1] // (states - 1)
    same_unit = np.kron(np.eye(units), np.ones((states - 1, states - 1)))
    covariance: NDArray[np.float64] = np.diag(means.mean(0)) - means.T @ means / len(means)
    return covariance * same_unit


@compiled
def _pair_rows(start, keys, pairs):
    """Return the row of each pair of classes in the table of residual weights, (E,).

    Args:
        start: first row of each bucket of the hash table.
        keys: keys of the pairs in the table. A pair (i, j) of V classes has the key i V + j.
        pairs: (E,) keys to look up. A key outside the table gets the last row, which is zero.
    """
    # Buckets are faster than binary search, because the processor cannot predict its branches.
    rows = np.empty(len(pairs), np.int64)
    for e in range(len(pairs)):
        pair = pairs[e]
        bucket = (pair * _SPREAD >> _SHIFT) & (len(start) - 2)
        rows[e] = len(keys)
        for row in range(start[bucket], start[bucket + 1]):
            if keys[row] == pair:
                rows[e] = row
    return rows


@compiled
def _placement_ends(candidates, classes, log_counts, presence):
    """Return the `Ends` of N candidate classes and m anchor classes, (N, 2 m) each.

    In the first m columns, the candidate is the subject. In the others, the anchor is. Candidates
    are present, with one instance.
    """
    N, m = len(candidates), len(classes)
    i, j = np.empty((N, 2 * m), np.int64), np.empty((N, 2 * m), np.int64)
    log_i, log_j = np.empty((N, 2 * m), np.float32), np.empty((N, 2 * m), np.float32)
    p_i, p_j = np.empty((N, 2 * m), np.float32), np.empty((N, 2 * m), np.float32)
    for c in range(N):
        for k in range(m):
            i[c, k] = j[c, m + k] = candidates[c]
            j[c, k] = i[c, m + k] = classes[k]
            log_i[c, k] = log_j[c, m + k] = np.float32(0.0)
            log_j[c, k] = log_i[c, m + k] = log_counts[k]
            p_i[c, k] = p_j[c, m + k] = np.float32(1.0)
            p_j[c, k] = p_i[c, m + k] = presence[k]
    return Ends(i, j, log_i, log_j, p_i, p_j)


@compiled_in_any_order
def _normal_logits(w, first, ends, U, Y, C, f):
    """Return the means and √3 σ of the logits of R relations for P pairs in B batches, (B, R, P).

    The mean of a logit is base + U z, and its variance σ² is q'C q - sum_u (f_u'q)² with q = Y z.
    z are the factors of the pair, and base are the terms that do not depend on the hidden units;
    see `SharedUnits`.

    Args:
        w: weights of the units; see `SharedArrays`.
        first: index of the first of the R consecutive relations.
        ends: subject and object classes of the pairs, (B, P); see `Ends`.
        U: (B, R, K) weights of the factors.
        Y: (R, r, K) matrix Y of each relation. σ is 0 if r is 0.
        C: (B, R, r (r + 1) / 2) lower half of each symmetric r x r matrix C. Entries off the
            diagonal are doubled. The function subtracts the products of f from C, in place.
        f: (units u, B, R, r) vectors f_u.
    """
    # Local names are faster: each access through the tuple would change a reference count.
    S, O, s, o, n, residual = w.S, w.O, w.s, w.o, w.n, w.residual  # noqa: E741
    (B, P), (R, r, K) = ends.i.shape, Y.shape
    width = -(-P // _VECTOR) * _VECTOR
    z, q = np.zeros((K, B * width), np.float32), np.empty((r, B * width), np.float32)
    mean, spread = np.empty((B, R, P), np.float32), np.empty((B, R, P), np.float32)
    row, variance = np.empty(width, np.float32), np.empty(width, np.float32)
    for b in range(B):
        subjects, objects, log_i, log_j = ends.i[b], ends.j[b], ends.log_i[b], ends.log_j[b]
        pairs = _pair_rows(w.start, w.key, subjects * len(S) + objects)
        for p in range(P):
            i, j = subjects[p], objects[p]
            for k in range(K):
                z[k, b * width + p] = S[i, k] * O[j, k]
            for c in range(R):
                a = first + c
                of_counts = n[a, 0] * log_i[p] + n[a, 1] * log_j[p]
                mean[b, c, p] = s[i, a] + o[j, a] + of_counts + residual[pairs[p], a]
    for c in range(R):
        for d in range(r):
            _weighted_sum(Y[c, d], z, 0, q[d])
        for b in range(B):
            _weighted_sum(U[b, c], z, b * width, row)
            for p in range(P):
                mean[b, c, p] += row[p]
            lower, t = C[b, c], 0
            for u in range(len(f)):
                _subtract_product(f[u, b, c], lower)
            variance[:] = np.float32(0.0)
            for d in range(r):
                _weighted_sum(lower[t : t + d + 1], q, b * width, row)
                t, q_d = t + d + 1, q[d, b * width : (b + 1) * width]
                for p in range(width):
                    variance[p] += row[p] * q_d[p]
            for p in range(P):
                spread[b, c, p] = np.sqrt(np.float32(3.0) * max(variance[p], np.float32(0.0)))
    return mean, spread


@compiled_in_any_order
def _weighted_sum(weights, rows, start, total):
    """Write sum_k weights_k rows_k (P,) to total. P columns of the rows begin at column start."""
    K, P = len(weights), len(total)
    total[:] = np.float32(0.0)
    # Two rows at a time halve the reads and writes of the sum.
    for k in range(0, K - 1, 2):
        weight, row = weights[k], rows[k, start : start + P]
        next_weight, next_row = weights[k + 1], rows[k + 1, start : start + P]
        for p in range(P):
            total[p] += weight * row[p] + next_weight * next_row[p]
    if K % 2:
        weight, row = weights[K - 1], rows[K - 1, start : start + P]
        for p in range(P):
            total[p] += weight * row[p]


@compiled_in_any_order
def _subtract_product(f, lower):
    """Subtract f f' from a symmetric matrix, in place; see `_normal_logits` for its lower half."""
    t = 0
    for d in range(len(f)):
        double = f[d] + f[d]
        for e in range(d):
            lower[t + e] -= double * f[e]
        lower[t + d] -= f[d] * f[d]
        t += d + 1
