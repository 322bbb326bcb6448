"""The relation part of RBM and GBM: units for listed triples alone, each with a row of U.

    RBM  ℓ_t = d_t + U_t·h1
    GBM  ℓ_t = d_t + g_t v_i + g'_t v_j + U_t·h1

The product RBM's U is formed from its factors. Other triples have no unit: the model ignores them
as evidence, and gives them the log-odds `NO_UNIT`.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from app.inference.context_rows import context_rows
from app.inference.mean_field import SWEEPS, sigmoid
from app.inference.relation_kernels import NO_UNIT, to_log_odds
from app.inference.relation_part import NOTHING, Between, Context, Given
from app.inference.weights import Weights

Floats = NDArray[np.float32]
Places = NDArray[np.int64]
Mask = NDArray[np.bool_]

_DAMPING: Final = np.float32(0.8)
# The logit of a relation without a unit in drawn scenes, which is off at any temperature.
_NEVER: Final = np.float32(-1e4)
_THREE: Final = np.float32(3.0)


class ListedRelations:
    """See `RelationPart`."""

    def __init__(self, weights: Weights) -> None:
        self._spec = weights.spec
        self._W, self._keys = weights["W"], weights.triple_keys
        self._U, self._d = context_rows(weights), weights["d"]
        is_gbm = weights.spec.variant == "gbm"
        self._g = weights["g"] if is_gbm else np.zeros((weights.spec.T, 2), np.float32)

    def find(self, a: Places, i: Places, j: Places) -> tuple[Places, Places]:
        """Of units between classes i and j: those that exist, and their rows."""
        keys = (a * self._spec.V + i) * self._spec.V + j
        rows = np.searchsorted(self._keys, keys)
        there = np.flatnonzero(np.append(self._keys, -1)[rows] == keys)
        return there, rows[there]

    def base(self, rows: Places, v_i: Floats, v_j: Floats) -> Floats:
        """ℓ of units without the context's part."""
        base: Floats = self._d[rows] + self._g[rows, 0] * v_i + self._g[rows, 1] * v_j
        return base

    def rows(self, rows: Places) -> Floats:
        """U of units."""
        return self._U[rows]

    def logits(self, classes: Places, h1: Floats) -> Floats:
        """ℓ between present classes for h1 (H1,), (A, n, n)."""
        n = len(classes)
        a, i, j = _grid(self._spec.A, n)
        there, rows = self.find(a, classes[i], classes[j])
        one = np.ones(len(rows), np.float32)
        found = np.full(len(a), _NEVER, np.float32)
        found[there] = self.base(rows, one, one) + self._U[rows] @ h1
        return found.reshape(self._spec.A, n, n)

    def fixed_point(
        self, x: Floats, classes: Places, presence: Floats, log_counts: Floats, given: Given
    ) -> tuple[Floats, Floats, Floats]:
        """See `RelationPart`; the third are the rows U (E, H1) of the units."""
        del log_counts  # these variants do not see them
        there, rows = self.find(given.a, classes[given.i], classes[given.j])
        base = self.base(rows, presence[given.i[there]], presence[given.j[there]])
        own, r, gate = self._U[rows], given.r[there], given.g[there]
        y, slopes = x, np.zeros(len(rows), np.float32)
        for sweep in range(SWEEPS):
            kept = _DAMPING if sweep else np.float32(0.0)
            slope = gate * (r - sigmoid(base + own @ sigmoid(y)))
            slopes = (kept * slopes + (1 - kept) * slope).astype(np.float32)
            y = (x + slopes @ own).astype(np.float32)
        # What is given of other relations says nothing.
        all_slopes = np.zeros(len(given.a), np.float32)
        all_slopes[there] = slopes
        U = np.zeros((len(given.a), len(x)), np.float32)
        U[there] = own
        return y, all_slopes, U

    def log_odds(self, context: Context, between: Between) -> Floats:
        """See `RelationPart`."""
        units = _grid(self._spec.A, len(context.classes))
        slopes = between.slopes[units] if len(between.slopes) else None
        logits = self._between(context, units, context.y, slopes)
        return logits.reshape(self._spec.A, len(context.classes), -1)

    def _between(
        self,
        context: Context,
        units: tuple[Places, Places, Places],
        y: Floats,
        slopes: Floats | None = None,
    ) -> Floats:
        """Log-odds of units between the classes for y (H1,), or of each unit's own y (E, H1)."""
        a, i, j = units
        there, rows = self.find(a, context.classes[i], context.classes[j])
        i, j = i[there], j[there]
        base = self.base(rows, context.presence[i], context.presence[j])
        mean = sigmoid(y if y.ndim == 1 else y[there])
        logits, spread = self._normal(rows, base, mean)
        if slopes is not None:
            logits -= slopes[there] * spread * spread / _THREE
        found = np.full(len(a), NO_UNIT, np.float32)
        to_log_odds(logits, spread)
        found[there] = logits
        return found

    def _normal(self, rows: Places, base: Floats, mean: Floats) -> tuple[Floats, Floats]:
        """Mean and √3 σ of logits, for means of h1 (H1,) or (E, H1)."""
        U = self._U[rows]
        spread = mean * (1 - mean)
        if mean.ndim == 1:
            logits, variance = U @ mean, (U * U) @ spread
        else:
            logits, variance = (U * mean).sum(1), (U * U * spread).sum(1)
        return (
            (base + logits).astype(np.float32),
            np.sqrt(_THREE * variance).astype(np.float32),
        )

    def log_odds_apart(self, context: Context, between: Between, i: Places, j: Places) -> Floats:
        """See `RelationPart`; exactly."""
        A, P = self._spec.A, len(i)
        y = context.y
        pulls = np.zeros((P, len(y)), np.float32)
        if context.given is not None:
            n = len(context.classes)
            pull = context.slopes[:, None] * context.units
            pairs = _sums(context.given.i * n + context.given.j, pull, n * n)
            pulls = pairs[i * n + j] + np.where((i != j)[:, None], pairs[j * n + i], 0)
        found = np.empty((2, A, P), np.float32)
        for way, (start, end) in enumerate(((i, j), (j, i))):
            for a in range(A):
                units = np.full(P, a), start, end
                found[way, a] = self._between(context, units, y - pulls)
        return found

    def without_itself(
        self, context: Context, units: tuple[Places, Places, Places], slopes: Floats, shift: Floats
    ) -> Floats:
        """See `RelationPart`."""
        del shift  # relations imply nothing for others here
        a, i, j = units
        there, rows = self.find(a, context.classes[i], context.classes[j])
        y = np.tile(context.y, (len(a), 1))
        y[there] -= slopes[there, None] * self._U[rows]
        return self._between(context, units, y)

    def implied(self, context: Context) -> tuple[Floats, Floats]:
        """Nothing."""
        del context
        return NOTHING, NOTHING

    def placement_log_odds(
        self, context: Context, candidates: Places, anchors: Places
    ) -> tuple[Floats, Floats]:
        """See `RelationPart`."""
        shape = len(candidates), self._spec.A, len(anchors)
        n, a, m = (part.reshape(-1) for part in np.indices(shape))
        forward, backward = (
            self._placed(context, candidates[n], a, anchors[m], outgoing).reshape(shape)
            for outgoing in (True, False)
        )
        return forward, backward

    def placed_log_odds(
        self, context: Context, candidates: Places, relation: int, anchor: int, outgoing: bool
    ) -> Floats:
        """See `RelationPart`."""
        relations, anchors = (np.full(len(candidates), k) for k in (relation, anchor))
        return self._placed(context, candidates, relations, anchors, outgoing)

    def _placed(
        self,
        context: Context,
        candidates: Places,
        relations: Places,
        anchors: Places,
        outgoing: bool,
    ) -> Floats:
        """One relation of each candidate (E,) to one anchor, or back, (E,)."""
        ends = candidates, context.classes[anchors]
        presences = np.ones(len(candidates), np.float32), context.presence[anchors]
        if not outgoing:
            ends, presences = ends[::-1], presences[::-1]
        there, rows = self.find(relations, *ends)
        found = np.full(len(candidates), NO_UNIT, np.float32)
        mean = sigmoid(context.y + self._W[candidates[there]])
        base = self.base(rows, presences[0][there], presences[1][there])
        logits, spread = self._normal(rows, base, mean)
        to_log_odds(logits, spread)
        found[there] = logits
        return found

    def shares(self, context: Context, given: Given) -> Floats:
        """See `RelationPart`."""
        n = len(context.classes)
        pull = context.object_slopes[:, None] * context.units
        other = given.i != given.j
        found: Floats = context.presence[:, None] * self._W[context.classes]
        return found + _sums(given.i, pull, n) + _sums(given.j[other], pull[other], n)

    def common_growth(self, context: Context, given: Given, rows: Places) -> tuple[Floats, Mask]:
        """See `RelationPart`."""
        n = len(context.classes)
        other = given.i != given.j
        i, j = given.i[other], given.j[other]
        pull = (context.object_slopes[:, None] * context.units)[other]
        some = np.zeros((n, n), np.bool_)
        some[i, j] = some[j, i] = True
        both = np.concatenate([i * n + j, j * n + i]), np.concatenate([pull, pull])
        pulls = _sums(*both, n * n).reshape(n, n, -1)[rows]
        filled = some[rows]
        growth = np.empty(pulls.shape, np.float32)
        growth[filled] = np.exp(pulls[filled])
        return growth, filled


def _sums(keys: Places, rows: Floats, size: int) -> Floats:
    """Sums (size, H1) of the rows (E, H1) of each key."""
    found = np.zeros((size, rows.shape[1]), np.float32)
    if len(keys):
        order = np.argsort(keys, kind="stable")
        ordered = keys[order]
        starts = np.flatnonzero(np.diff(ordered, prepend=-1))
        found[ordered[starts]] = np.add.reduceat(rows[order], starts, axis=0)
    return found


def _grid(A: int, n: int) -> tuple[Places, Places, Places]:
    """All units between n places, flat."""
    a, i, j = (part.reshape(-1) for part in np.indices((A, n, n)))
    return a, i, j
