"""The relation part of a Triway machine, answered by compiled loops.

Every pair of classes has units; w and U come from shared factors (`boltzmann.triway`). U_e lies in
the span of P[a] and the rows of M[a]. So the variance of a logit is a small quadratic form,

    sum_k U_ek² m_k (1 - m_k) = q_e' C_a q_e,   C_a = F_a diag(m (1 - m)) F_a'

with q_e the coordinates of U_e in the directions F_a that hold nearly all of its variance on
scenes of the machine's own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.inference import given_kernels, relation_kernels
from app.inference.matrix_kernels import ROWS
from app.inference.mean_field import SWEEPS, sigmoid
from app.inference.relation_part import NOTHING, Between, Context, Given
from app.inference.weights import Weights

Floats = NDArray[np.float32]
Places = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Of the variance of a logit on average, how much the directions F_a leave out. A probability
# changes by a twentieth of what its variance loses. Of the 33 directions of `indoor-triway` 11
# are kept: all would take twice the time of /relations, and change p by .005 at most.
_LEFT_OUT = 4e-3


class Arrays(NamedTuple):
    """Weights of the relation part, as the compiled loops take them.

    Rows are filled up with zeros to whole multiples of `ROWS`.

    Attributes:
        S, O: (V, K).  s, o: (V, A).  n: (A, 2).
        start: (B + 1,) where each bucket of pairs begins in
        key, residual: (T,) the pairs, i V + j, and (T + 1, A) their w'; the last row is 0.
        G: (A, K + 1, H1) the rows of M, then P: U_e = G' (S_i * O_j, 1).
        g: (A, K + 1), R and d: what is added to G m.
        FF: (A, r (r + 1) / 2, H1) products of directions of U, of p and each q up to p: the lower
            half of C is FF m (1 - m).
        Y0: (A, r), and Y: (A, r, K): the coordinates q = Y0 + Y (S_i * O_j) in the directions.
    """

    S: Floats
    O: Floats  # noqa: E741
    s: Floats
    o: Floats
    n: Floats
    start: Places
    key: Places
    residual: Floats
    G: Floats
    g: Floats
    FF: Floats
    Y0: Floats
    Y: Floats


class SharedRelations:
    """See `RelationPart`."""

    def __init__(self, weights: Weights) -> None:
        self._W = weights["W"]
        self._arrays, self._F = _arrays(weights)
        self._gamma = self._B = None
        if weights.spec.G:
            self._gamma, self._B = weights["gamma"], weights["B"]

    def fixed_point(
        self, x: Floats, classes: Places, presence: Floats, log_counts: Floats, given: Given
    ) -> tuple[Floats, Floats, Floats]:
        """See `RelationPart`; the third are the factors z (E, K + 1) of the units."""
        del presence  # it is in the gates
        y, slopes, z = given_kernels.fixed_point(
            x, self._arrays, classes, log_counts, *given.units, given.r, given.g, SWEEPS
        )
        return y, slopes, z

    def log_odds(self, context: Context, between: Between) -> Floats:
        """See `RelationPart`."""
        found: Floats = relation_kernels.relation_log_odds(
            *(context.y, self._arrays, context.classes, context.log_counts),
            *(between.slopes, between.shift),
        )
        return found

    def log_odds_apart(self, context: Context, between: Between, i: Places, j: Places) -> Floats:
        """See `RelationPart`; to first order."""
        found: Floats = relation_kernels.log_odds_apart(
            *(context.y, self._arrays, self._F, context.classes, context.log_counts),
            *(between.slopes, between.apart, i, j),
        )
        return found

    def without_itself(
        self, context: Context, units: tuple[Places, Places, Places], slopes: Floats, shift: Floats
    ) -> Floats:
        """See `RelationPart`."""
        found: Floats = given_kernels.without_itself(
            *(context.y, self._arrays, context.classes, context.log_counts),
            *(*units, slopes, shift),
        )
        return found

    def implied(self, context: Context) -> tuple[Floats, Floats]:
        """See `RelationPart`."""
        given = context.given
        if given is None or self._gamma is None or self._B is None:
            return NOTHING, NOTHING
        shift, apart = given_kernels.implied(
            self._gamma, self._B, context.x, len(context.classes), *given.units, given.r
        )
        return shift, apart

    def placement_log_odds(
        self, context: Context, candidates: Places, anchors: Places
    ) -> tuple[Floats, Floats]:
        """See `RelationPart`."""
        classes, log_counts = context.classes[anchors], context.log_counts[anchors]
        forward, backward = relation_kernels.placement_log_odds(
            context.y, self._W, self._arrays, candidates, classes, log_counts
        )
        return forward, backward

    def placed_log_odds(
        self, context: Context, candidates: Places, relation: int, anchor: int, outgoing: bool
    ) -> Floats:
        """See `RelationPart`."""
        found: Floats = relation_kernels.placed_log_odds(
            *(context.y, self._W, self._arrays, candidates),
            *(context.classes[anchor], relation, context.log_counts[anchor], outgoing),
        )
        return found

    def shares(self, context: Context, given: Given) -> Floats:
        """See `RelationPart`."""
        found: Floats = given_kernels.shares(
            *(self._arrays.G, self._W, context.classes, context.presence, context.units),
            *(*given.units, context.object_slopes),
        )
        return found

    def common_growth(self, context: Context, given: Given, rows: Places) -> tuple[Floats, Mask]:
        """See `RelationPart`."""
        common, filled = given_kernels.common_growth(
            *(self._arrays.G, len(context.classes), context.units),
            *(*given.units, context.object_slopes, rows),
        )
        return common, filled


def _arrays(weights: Weights) -> tuple[Arrays, Floats]:
    """The arrays, and the directions of all relations as rows, filled up too."""
    A, V = weights.spec.A, weights.spec.V
    F, Y = _directions(weights)
    r = F.shape[1]
    p, q = np.tril_indices(r)
    triples = weights.triple_keys
    pairs = np.unique(triples % (V * V))
    buckets = 1 << (2 * len(pairs)).bit_length()
    bucket = (pairs * relation_kernels.SPREAD >> relation_kernels.SHIFT) & (buckets - 1)
    order = np.argsort(bucket, kind="stable")
    row = np.empty_like(order)
    row[order] = np.arange(len(order))
    residual = np.zeros((len(pairs) + 1, A), dtype=np.float32)
    place = row[np.searchsorted(pairs, triples % (V * V))]
    residual[place, triples // (V * V)] = weights["residual"]
    arrays = Arrays(
        S=weights["S"],
        O=weights["O"],
        s=np.ascontiguousarray(weights["s"].T),
        o=np.ascontiguousarray(weights["o"].T),
        n=weights["n"],
        start=np.searchsorted(bucket[order], np.arange(buckets + 1)),
        key=pairs[order],
        residual=residual,
        G=_filled(np.concatenate([weights["M"], weights["P"][:, None]], 1)),
        g=_filled(np.concatenate([weights["R"], weights["d"][:, None]], 1)),
        FF=_filled(F[:, p] * F[:, q]),
        Y0=np.ascontiguousarray(Y[:, :, 0]),
        Y=np.ascontiguousarray(Y[:, :, 1:]),
    )
    return arrays, _filled(F.reshape(1, A * r, -1))[0]


def _filled(rows: Floats) -> Floats:
    """(A, R, ...) with zeros after the R rows."""
    return np.pad(rows, [(0, 0), (0, -rows.shape[1] % ROWS)] + [(0, 0)] * (rows.ndim - 2))


def _directions(weights: Weights) -> tuple[Floats, Floats]:
    """F (A, r, H1), and Y (A, r, 1 + K) with q = Y (1, S_i * O_j).

    Directions of largest variance of U_e h1, over pairs of classes as often as the machine's
    stored scenes have them, and with h1 as it is in these.
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
    # E[z z'] of z = (1, S_i * O_j) for independent i and j, and its root.
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
    return F.astype(np.float32), Y.astype(np.float32)
