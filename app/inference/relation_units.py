"""Relation units: the logits of relations given the hidden units, and their log-odds.

A relation e is a triple (relation a, subject class i, object class j). r_e is 1 if the relation
holds, else 0. Its probability is p(r_e = 1) = E[sigmoid(ℓ_e(h1))] with ℓ_e(h1) = base_e + U_e·h1.
The logit ℓ_e is a sum of many small independent terms, one for each hidden unit k of h1. This
module treats the logit as a normal variable with

    mean base_e + U_e·m   and variance   σ_e² = sum_u [sum_z U_euz² m_uz - (sum_z U_euz m_uz)²]

where m_uz is the probability of state z of hidden unit u (its first state has the weight 0).
`app.inference.elementary` computes the mean of sigmoid(ℓ_e). The variant of the machine defines
base and U. Each unit of `FreeUnits` has its own row of U. `SharedUnits` computes U from factors.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.compiling import compiled, compiled_in_any_order
from app.inference.elementary import to_log_odds
from app.inference.implications import implication_shifts
from app.inference.weights import Weights, state_means
from app.scene.spatial_relations import HOLDS

Means = Float[NDArray, "B H1"]
"""B different means of h1."""
Moments = tuple[Float[NDArray, "B R P"], Float[NDArray, "B R P"]]
"""Means and √3 σ of the logits of R relations for P pairs; σ is the standard deviation."""

NEVER: Final = np.float32(-1e4)
"""Logit of a relation for which the machine has no unit. Such a relation never holds."""

# Bucket of a pair in a hash table: (key * _SPREAD) >> _SHIFT, modulo the number of buckets.
_SPREAD, _SHIFT = 2654435761, 16

# Number of float32 in a vector register. Rows of whole registers are faster.
_VECTOR: Final = 8

MOST_PAIRS: Final = 65_536
"""Maximum number of pairs of classes in one computation: those of 256 classes."""
# Maximum number of candidates in one computation.
_MOST_MEANS: Final = 256

# Maximum variance of a logit, averaged over units, that `_directions` may neglect. Neglecting a
# variance changes a probability by about 1/20 of this variance. The model `places-triway` keeps 6
# of 33 directions.
_LEFT_OUT: Final = 1.6e-2


@dataclass(frozen=True, slots=True)
class ObservedRelations:
    """E observed relations between the n classes of a scene."""

    a: Int[NDArray, " E"]  # relation (left, on top, ...)
    i: Int[NDArray, " E"]  # subject class, from 0 to n - 1
    j: Int[NDArray, " E"]  # object class, from 0 to n - 1
    r: Float[NDArray, " E"]  # probability of the relation


@dataclass(frozen=True, slots=True)
class EncodedScene:
    """The n distinct classes of a scene, their effect on h1, and observed relations."""

    classes: Int[NDArray, " n"]
    presence: Float[NDArray, " n"]  # probability that each class is present
    log_counts: Float[NDArray, " n"]  # log of the number of instances
    x: Float[NDArray, " H1"]  # logits of h1 given the classes and the room type
    contributions: Float[NDArray, "n H1"]  # of each class to x
    observed: ObservedRelations | None

    def weighted(self, presence: Float[NDArray, " n"]) -> "EncodedScene":
        """Return the scene with another presence of its classes, which is above 0 here."""
        contributions = self.contributions * (presence / self.presence)[:, None]
        x = self.x + (contributions - self.contributions).sum(0)
        return replace(self, presence=presence, x=x, contributions=contributions)


def encode(
    weights: Weights,
    classes: Int[NDArray, " n"],
    presence: Float[NDArray, " n"],
    log_counts: Float[NDArray, " n"],
    room: int | None = None,
    observed: ObservedRelations | None = None,
) -> EncodedScene:
    """Compute the logits of h1 given the classes of a scene and its room type."""
    contributions = presence[:, None] * weights["W"][classes]
    x = weights.room_bias(room) + contributions.sum(0)
    return EncodedScene(classes, presence, log_counts, x, contributions, observed)


class Pairs(NamedTuple):
    """Ordered pairs of classes; see `EncodedScene`."""

    classes: Int[NDArray, " n"]
    log_counts: Float[NDArray, " n"]
    presence: Float[NDArray, " n"]
    i: Int[NDArray, "B P"]  # position of the subject class in `classes`
    j: Int[NDArray, "B P"]  # position of the object class in `classes`


@lru_cache(maxsize=128)
def all_pairs(n: int) -> tuple[Int[NDArray, "1 P"], Int[NDArray, "1 P"]]:
    """Return the first and the second positions of all P = n² ordered pairs of n classes."""
    positions = np.arange(n)
    return np.repeat(positions, n)[None], np.tile(positions, n)[None]


class RelationLogits(NamedTuple):
    """The logits of all relations between the n classes of a scene."""

    mean: Float[NDArray, "A n n"]  # given the classes alone
    spread: Float[NDArray, "A n n"]  # √3 σ; σ is the standard deviation
    shift: Float[NDArray, "A n n"]  # change by the observed relations that hold
    shift_by_others: Float[NDArray, "A n n"]  # without the relations of the same two classes


class RelationUnits(ABC):
    """The relation units of a machine."""

    def __init__(self, weights: Weights) -> None:
        self._W, self._A, self._V = weights["W"], weights.spec.A, weights.spec.V
        self._all = slice(0, self._A)  # relations
        self._states = weights.spec.states

    @abstractmethod
    def moments(
        self, means: Means, pairs: Pairs, chosen: slice, *, sampled: bool = False
    ) -> Moments:
        """Return moments of the chosen relations: `NEVER` without a unit, σ = 0 if `sampled`."""

    def logits(self, scene: EncodedScene) -> RelationLogits:
        """Return the logits of all relations between the classes of a scene."""
        n, observed = len(scene.classes), scene.observed
        pairs = Pairs(scene.classes, scene.log_counts, scene.presence, *all_pairs(n))
        mean, spread = (
            part.reshape(self._A, n, n)
            for part in self.moments(state_means(scene.x[None], self._states), pairs, self._all)
        )
        weight = None if observed is None else self.implication_weights(scene.x)
        if observed is None or weight is None:
            shift = np.zeros_like(mean)
            return RelationLogits(mean, spread, shift, shift)
        r = np.zeros(mean.shape, np.bool_)
        r[observed.a, observed.i, observed.j] = (observed.r >= HOLDS) & (observed.i != observed.j)
        shift = np.ascontiguousarray(implication_shifts(weight, r).transpose(2, 0, 1))
        # The first 2A features are the relations of the same two classes, in both directions.
        steps = np.concatenate([r, r.swapaxes(1, 2)]).reshape(2 * self._A, n * n)
        of_pair = weight[: 2 * self._A].T @ steps
        return RelationLogits(mean, spread, shift, shift - of_pair.reshape(shift.shape))

    def implication_weights(
        self, x: Float[NDArray, " H1"], beta: float = 1.0
    ) -> Float[NDArray, "F A"] | None:
        """Return how much each of F features of the relations that hold changes a logit.

        The features of a pair are its relations, paths over a third class, and how many relations
        each class has. The result is None for machines in which relations do not change each
        other's logits directly. beta is 1 / temperature.
        """
        return None

    def log_odds(
        self, logits: RelationLogits, *, leave_out_pair: bool = False
    ) -> Float[NDArray, "A n n"]:
        """Return the log-odds of all relations, or without the evidence of the same pair."""
        shift = logits.shift_by_others if leave_out_pair else logits.shift
        return to_log_odds(logits.mean + shift, logits.spread)

    def placement_log_odds(
        self,
        scene: EncodedScene,
        candidates: Int[NDArray, " N"],
        anchors: Int[NDArray, " m"],
        only: int | None = None,
    ) -> tuple[Float[NDArray, "N R m"], Float[NDArray, "N R m"]]:
        """Return the log-odds of relations between absent candidate classes and anchor classes.

        The candidate is the subject in the first result, the anchor in the second. Each candidate
        counts as present. `anchors` are positions among the classes of the scene. The computation
        in blocks of candidates bounds the memory.
        """
        m = len(anchors)
        size = min(_MOST_MEANS, max(1, MOST_PAIRS // (2 * m)))
        blocks = [
            self._of_candidates(scene, candidates[start : start + size], anchors, only)
            for start in range(0, max(len(candidates), 1), size)
        ]
        log_odds = np.concatenate(blocks) if len(blocks) > 1 else blocks[0]
        return log_odds[:, :, :m], log_odds[:, :, m:]

    def _of_candidates(
        self,
        scene: EncodedScene,
        candidates: Int[NDArray, " N"],
        anchors: Int[NDArray, " m"],
        only: int | None,
    ) -> Float[NDArray, "N R 2*m"]:
        """Return the log-odds of `placement_log_odds`, with the candidates as subjects first."""
        N, m = len(candidates), len(anchors)
        # Classes 0 to N - 1 of the pairs are the candidates, and the next m are the anchors.
        i, j = np.empty((N, 2 * m), np.int64), np.empty((N, 2 * m), np.int64)
        i[:, :m] = j[:, m:] = np.arange(N)[:, None]
        j[:, :m] = i[:, m:] = np.arange(N, N + m)
        pairs = Pairs(
            np.concatenate([candidates, scene.classes[anchors]]),
            np.concatenate([np.zeros(N, np.float32), scene.log_counts[anchors]]),
            np.concatenate([np.ones(N, np.float32), scene.presence[anchors]]),
            *(i, j),
        )
        means = state_means(scene.x + self._W[candidates], self._states)
        chosen = self._all if only is None else slice(only, only + 1)
        return to_log_odds(*self.moments(means, pairs, chosen))


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
        self._index = np.full((len(self._table.keys) + 1, self._A), -1, np.int32)
        self._index[index] = np.arange(len(self._U))

    def moments(
        self, means: Means, pairs: Pairs, chosen: slice, *, sampled: bool = False
    ) -> Moments:
        """Return means and √3 σ of logits by the module's formulas; for states of h1, σ is 0."""
        shape = len(means), chosen.stop - chosen.start, pairs.i.shape[1]
        # Row b of the means, relation a and pair p of each entry of the result.
        b, a, p = (indices.reshape(-1) for indices in np.indices(shape))
        i, j = pairs.i[b, p], pairs.j[b, p]
        rows = _pair_rows(self._table, pairs.classes[i] * self._V + pairs.classes[j])
        units = self._index[rows, chosen.start + a].astype(np.int64)
        existing = np.flatnonzero(units >= 0)
        units, b = units[existing], b[existing]
        base = self._d[units]
        if self._g is not None:
            v_i, v_j = pairs.presence[i[existing]], pairs.presence[j[existing]]
            base = base + self._g[units, 0] * v_i + self._g[units, 1] * v_j
        terms = self._by_unit(self._U[units])
        m = self._by_unit(means)[b if len(means) > 1 else np.zeros(1, np.int64)]
        weighted = terms * m
        by_unit = weighted.sum(2)
        variance = ((weighted * terms).sum(2) - by_unit * by_unit).sum(1)
        mean, spread = np.full(shape, NEVER), np.zeros(shape, np.float32)
        mean.reshape(-1)[existing] = base + by_unit.sum(1)
        spread.reshape(-1)[existing] = np.sqrt(3 * np.maximum(variance, 0))
        return mean, spread

    def _by_unit(self, rows: Float[NDArray, "N H1"]) -> Float[NDArray, "N units states-1"]:
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
        A, ones = self._A, np.ones((self._V, 1), np.float32)
        table, index = _pair_table(weights)
        residual = np.zeros((len(table.keys) + 1, A), np.float32)
        residual[index] = weights["residual"]
        self._w = _SharedArrays(
            S=np.concatenate([weights["S"], ones], 1),
            O=np.concatenate([weights["O"], ones], 1),
            s=np.ascontiguousarray(weights["s"].T),
            o=np.ascontiguousarray(weights["o"].T),
            n=weights["n"],
            table=table,
            residual=residual,
        )
        # Weights of the factors z in base, as U_e = G[a]'z for h1.
        self._g = np.concatenate([weights["R"], weights["d"][:, None]], 1)
        F, self._Y = _directions(weights)
        # (units, states - 1, A r): a matrix product sums over the states of each unit.
        self._F = _columns(F).reshape(-1, self._states - 1, A * F.shape[1])
        # Products of two directions give the lower half of C. Entries off the diagonal are doubled.
        p, q = np.tril_indices(F.shape[1])
        twice = np.where(p == q, np.float32(1), np.float32(2))  # int64 would give float64 products
        self._FF = _columns(F[:, p] * F[:, q] * twice[:, None])
        self._GT = _columns(np.concatenate([weights["M"], weights["P"][:, None]], 1))
        self._B = weights["B"] if weights.spec.G else None
        if self._B is not None:
            gamma = weights["gamma"].swapaxes(1, 2).copy()
            # A relation does not imply itself.
            gamma[:, range(A), range(A)] = 0
            self._gamma = gamma.reshape(len(gamma), -1)

    def moments(
        self, means: Means, pairs: Pairs, chosen: slice, *, sampled: bool = False
    ) -> Moments:
        """Return means and √3 σ of logits from factors, for B means, R relations, r directions."""
        # States of h1 have no variance, and σ is 0 without directions.
        Y = self._Y[chosen, :0] if sampled else self._Y[chosen]
        B, (R, r, _) = len(means), Y.shape
        # cov(h1) is diag(m) - m m' within each hidden unit, and 0 between units. C is the lower
        # half of F diag(m) F', and f is F m of each unit. `_shared_moments` subtracts f f' from C.
        # U has the coefficients (B, R, k) of z in the mean logits.
        U, C = (
            (means @ columns[:, chosen].reshape(len(columns), -1)).reshape(B, R, -1)
            for columns in (self._GT, self._FF)
        )
        U += self._g[chosen]
        by_unit = means.reshape(B, -1, self._states - 1).transpose(1, 0, 2)
        f = by_unit @ self._F[:, :, chosen.start * r : chosen.stop * r]
        f = f.reshape(len(f), B, R, r)
        return _shared_moments(self._w, chosen.start, pairs, U, Y, C, f)

    def implication_weights(
        self, x: Float[NDArray, " H1"], beta: float = 1.0
    ) -> Float[NDArray, "F A"] | None:
        """Return beta (gamma_0 + sum_q z_q gamma_q) with z = B m(beta x)."""
        if self._B is None:
            return None
        scale = np.append(np.float32(1), self._B @ state_means(beta * x, self._states))
        return ((np.float32(beta) * scale) @ self._gamma).reshape(-1, self._A)


class StandIns(RelationUnits):
    """Relation units of a model with further classes. Each class uses those of its `stand_in`."""

    def __init__(
        self, weights: Weights, units: RelationUnits, stand_in: Int[NDArray, " V"]
    ) -> None:
        super().__init__(weights)
        self._units, self._stand_in = units, stand_in

    def moments(
        self, means: Means, pairs: Pairs, chosen: slice, *, sampled: bool = False
    ) -> Moments:
        """Return means and √3 σ of the logits of the stand-ins."""
        pairs = pairs._replace(classes=self._stand_in[pairs.classes])
        return self._units.moments(means, pairs, chosen, sampled=sampled)

    def implication_weights(
        self, x: Float[NDArray, " H1"], beta: float = 1.0
    ) -> Float[NDArray, "F A"] | None:
        """Return the weights of the other classes' relation units."""
        return self._units.implication_weights(x, beta)


def relation_units(weights: Weights) -> RelationUnits:
    """Return the relation units of a machine."""
    return SharedUnits(weights) if weights.spec.kind.factorised else FreeUnits(weights)


def _columns(matrices: Float[NDArray, "A n H1"]) -> Float[NDArray, "H1 A n"]:
    """Convert the n rows of each relation to columns. Matrix products with columns are faster."""
    return np.ascontiguousarray(matrices.transpose(2, 0, 1))


def _directions(weights: Weights) -> tuple[Float[NDArray, "A r H1"], Float[NDArray, "A r K+1"]]:
    """Return F and Y; see `SharedUnits`.

    The rows of F[a] are the r directions in which U_e·h1 has the largest variance. Y[a] converts
    the factors z = (S_i * O_j, 1) of a unit to its coordinates q = Y[a] z in these directions. The
    frequencies of classes and the variance of h1 come from the machine's stored samples.
    """
    spec = weights.spec
    rows = np.concatenate([weights["P"][:, None], weights["M"]], 1).astype(np.float64)
    frequency, means = np.ones(spec.V), np.full((1, spec.H1), 1 / spec.states)
    if spec.N:
        frequency = weights.chain_samples.mean(0).astype(np.float64) + 1e-6
        means = weights.sample_means
    share = (frequency / frequency.sum())[:, None]
    ones = np.ones((spec.V, 1))
    S, O = (  # noqa: E741
        np.concatenate([ones, weights[name].astype(np.float64)], 1) for name in ("S", "O")
    )
    # moment is E[z z'] of z = (1, S_i * O_j) for independent i and j. root is its Cholesky factor.
    # As U_e = rows[a]'z, the eigenvalues of root' rows[a] cov(h1) rows[a]' root are variances.
    moment = (S.T @ (share * S)) * (O.T @ (share * O))
    scale = np.trace(moment) / len(moment)
    root = np.linalg.cholesky(moment + 1e-9 * scale * np.eye(len(moment)))
    of_h1 = _mean_covariance(means.astype(np.float64), spec.states)
    covariance = root.T @ (rows @ of_h1 @ rows.transpose(0, 2, 1)) @ root
    values, vectors = np.linalg.eigh(covariance)
    # The values ascend, so left_out is the variance that a cut behind each direction neglects.
    left_out = np.cumsum(values.clip(min=0), axis=1)
    r = max(1, int((left_out > _LEFT_OUT).sum(1).max()))
    vectors = vectors[:, :, -r:]
    Y = np.linalg.solve(root.T, vectors).transpose(0, 2, 1)
    F = vectors.transpose(0, 2, 1) @ root.T @ rows
    # The factor 1 is the first one above, but the last one in z.
    Y = np.ascontiguousarray(np.roll(Y, -1, axis=2), np.float32)
    return F.astype(np.float32), Y


def _mean_covariance(means: Float[NDArray, "N H1"], states: int) -> Float[NDArray, "H1 H1"]:
    """Return the mean of cov(h1) over N scenes, given the means of h1."""
    units = means.shape[1] // (states - 1)
    same_unit = np.kron(np.eye(units), np.ones((states - 1, states - 1)))
    covariance = np.diag(means.mean(0)) - means.T @ means / len(means)
    return covariance * same_unit


class _PairTable(NamedTuple):
    """Hash table of pairs of classes, whose rows are sorted by bucket."""

    start: Int[NDArray, " buckets+1"]  # first row of each bucket, and the end of the last
    keys: Int[NDArray, " pairs"]  # i V + j of the pair (i, j) of each row


def _pair_table(
    weights: Weights,
) -> tuple[_PairTable, tuple[Int[NDArray, " T"], Int[NDArray, " T"]]]:
    """Return the table of the pairs of the T stored triples; row and relation of each triple."""
    # A triple (a, i, j) has the key (a V + i) V + j. The key of its pair is i V + j.
    relation, pair_of_triple = np.divmod(weights.triple_keys, weights.spec.V**2)
    pairs, pair_index = np.unique(pair_of_triple, return_inverse=True)
    buckets = 1 << (2 * len(pairs)).bit_length()  # a power of 2, more than twice the pairs
    bucket = (pairs * _SPREAD >> _SHIFT) & (buckets - 1)
    order = np.argsort(bucket, kind="stable")
    row_of_pair = np.empty_like(order)
    row_of_pair[order] = np.arange(len(order))
    start = np.searchsorted(bucket[order], np.arange(buckets + 1))
    table = _PairTable(start.astype(np.int32), pairs[order].astype(np.int32))
    return table, (row_of_pair[pair_index], relation)


@compiled
def _pair_rows(table: _PairTable, pairs: Int[NDArray, " P"]) -> Int[NDArray, " P"]:
    """Return the row of each key in the table, or the number of rows without such a key."""
    # Buckets are faster than binary search, because the processor cannot predict its branches.
    start, keys = table
    rows = np.empty(len(pairs), np.int64)
    for p in range(len(pairs)):
        pair = pairs[p]
        bucket = (pair * _SPREAD >> _SHIFT) & (len(start) - 2)
        rows[p] = len(keys)
        for row in range(start[bucket], start[bucket + 1]):
            if keys[row] == pair:
                rows[p] = row
    return rows


class _SharedArrays(NamedTuple):
    """Weights of `SharedUnits`; see `Triway`. The last column of S and O is 1."""

    S: Float[NDArray, "V K+1"]
    O: Float[NDArray, "V K+1"]  # noqa: E741
    s: Float[NDArray, "V A"]
    o: Float[NDArray, "V A"]
    n: Float[NDArray, "A 2"]
    table: _PairTable  # pairs of classes with a residual
    residual: Float[NDArray, "pairs+1 A"]  # w' of each pair and relation; the last row is 0


@compiled_in_any_order
def _shared_moments(
    w: _SharedArrays,
    first: int,
    pairs: Pairs,
    U: Float[NDArray, "B R K+1"],
    Y: Float[NDArray, "R r K+1"],
    C: Float[NDArray, "B R r*(r+1)/2"],
    f: Float[NDArray, "units B R r"],
) -> Moments:
    """Return the means and √3 σ of the logits of R relations for P pairs.

    The mean of a logit is base + U z, and its variance σ² is q'C q - sum_u (f_u'q)² with q = Y z.
    base are the terms that do not depend on the hidden units; see `SharedUnits`. σ is 0 if r is 0.
    `first` is the first of the R consecutive relations. C has the lower half of each symmetric
    r x r matrix, with doubled entries off the diagonal. It changes in place. The loops take the
    entries b of a batch, pairs p, relations c, directions d and e, and hidden units u.
    """
    # Local names are faster: each access through the tuple would change a reference count.
    S, O, s, o, n, residual = w.S, w.O, w.s, w.o, w.n, w.residual  # noqa: E741
    classes, log_counts = pairs.classes, pairs.log_counts
    (B, P), (R, r, K) = pairs.i.shape, Y.shape
    width = -(-P // _VECTOR) * _VECTOR
    z, q = np.zeros((K, B * width), np.float32), np.empty((r, B * width), np.float32)
    mean, spread = np.empty((B, R, P), np.float32), np.empty((B, R, P), np.float32)
    row, variance, keys = (
        np.empty(width, np.float32),
        np.empty(width, np.float32),
        np.empty(P, np.int64),
    )
    for b in range(B):
        subjects, objects = pairs.i[b], pairs.j[b]
        for p in range(P):
            keys[p] = classes[subjects[p]] * len(S) + classes[objects[p]]
        rows = _pair_rows(w.table, keys)
        for p in range(P):
            i, j = classes[subjects[p]], classes[objects[p]]
            log_i, log_j = log_counts[subjects[p]], log_counts[objects[p]]
            for k in range(K):
                z[k, b * width + p] = S[i, k] * O[j, k]
            for c in range(R):
                a = first + c
                of_counts = n[a, 0] * log_i + n[a, 1] * log_j
                mean[b, c, p] = s[i, a] + o[j, a] + of_counts + residual[rows[p], a]
    for c in range(R):
        for d in range(r):
            _weighted_sum(Y[c, d], z, 0, q[d])
        for b in range(B):
            _weighted_sum(U[b, c], z, b * width, row)
            for p in range(P):
                mean[b, c, p] += row[p]
            variance[:] = np.float32(0.0)
            lower, t = C[b, c], 0  # t is the start of row d in the half matrix
            for d in range(r):
                for u in range(len(f)):
                    f_d = f[u, b, c, d]
                    for e in range(d):
                        lower[t + e] -= (f_d + f_d) * f[u, b, c, e]
                    lower[t + d] -= f_d * f_d
                _weighted_sum(lower[t : t + d + 1], q, b * width, row)
                t, q_d = t + d + 1, q[d, b * width : (b + 1) * width]
                for p in range(width):
                    variance[p] += row[p] * q_d[p]
            for p in range(P):
                spread[b, c, p] = np.sqrt(np.float32(3.0) * max(variance[p], np.float32(0.0)))
    return mean, spread


@compiled_in_any_order
def _weighted_sum(
    weights: Float[NDArray, " K"],
    rows: Float[NDArray, "K columns"],
    start: int,
    total: Float[NDArray, " P"],
) -> None:
    """Write sum_k weights_k rows_k to total, for the P columns from the column start."""
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
