"""Log-odds of a scene's objects and relations in closed form, compiled.

For a Triway machine of one wide layer in the local form. Without given relations p(h1 | v) is
factorial, with means m = sigmoid(x), x = c1 + Q[t] + v'W; given some, it is taken as at its
mean field,

    y = x + sum_{e given} slope_e U_e,   slope_e = g_e (r_e - sigmoid(ℓ_e(m))),   m = sigmoid(y)

with g_e the presence of both ends. Where given relations must count for less, their pull is scaled:
y = x + ω (y - x) and ω slope_e take the place of y and slope_e, with an ω for questions about
objects and another for those about relations (`Pull`). So in any case

    object     log-odds_i = b_i + sum_k [softplus(y_k + W_ik) - softplus(y_k)]
    relation   p(r_e = 1) = E[sigmoid(ℓ_e(h1))],  ℓ_e(h1) = ℓ_e(m) + sum_k U_ek (h1_k - m_k)

What is judged is taken out of y first: its own slope for a given relation, and W_i with the slopes
of all its relations for an object that is present, the other slopes held. A slope that is small
is taken out to first order: ℓ_e(m) changes by slope_e σ_e², with σ_e² as below.

The logit is a sum of many small independent terms, taken as normal with variance

    σ_e² = sum_k U_ek² m_k (1 - m_k) = q_e' C_a q_e,   C_a = F_a diag(m (1 - m)) F_a'

and the mean of its sigmoid by quadrature. U_e lies in the span of P[a] and the rows of M[a]; q_e
are its coordinates in the directions F_a that hold all but a thousandth of its variance on scenes
of the machine's own. Errors are measured in docs/decisions/estimators.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.boltzmann import given_kernels, object_kernels, relation_kernels
from app.boltzmann.fantasies import unpack_scenes
from app.boltzmann.machine import BoltzmannMachine
from app.boltzmann.matrix_kernels import ROWS
from app.boltzmann.mean_field import FULL, SWEEPS, Pull
from app.boltzmann.scoring import group_size
from app.boltzmann.triway import Triway

Floats = NDArray[np.float32]
Places = NDArray[np.int64]

LEAST_UNITS = 64
"""Fewer hidden units make no normal logit."""

# Of the variance of a logit on average, how much the directions F_a leave out. A probability
# changes by a twentieth of what its variance loses. Of the 33 directions of `indoor-triway` 11
# are kept: all would take twice the time of /relations, and change p by .005 at most.
_LEFT_OUT = 4e-3
# Slopes up to which what a given relation says of itself is taken out to first order
# (docs/decisions/compiled-loops.md).
_GENTLE = 0.5
_NOTHING = np.zeros((0, 0, 0), dtype=np.float32)
_NO_UNITS = _NOTHING.reshape(0), _NOTHING.reshape(0, 0)
_NONE = np.zeros((0, 0), dtype=np.bool_)


class Weights(NamedTuple):
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


@dataclass(frozen=True, slots=True)
class Given:
    """Relations that are given, on or off: E units between the n classes of a scene.

    Attributes:
        a: (E,) relation.
        i, j: (E,) places of subject and object class in the scene.
        r: (E,) 1 where it holds, else 0.
        g: (E,) presence of both ends.
    """

    a: Places
    i: Places
    j: Places
    r: Floats
    g: Floats


@dataclass(frozen=True, slots=True)
class Context:
    """What is known of the context of a scene.

    Attributes:
        classes: (n,) int64, distinct.
        presence: (n,).
        log_counts: (n,) log of the instances of each.
        x: (H1,) logits of h1 given the objects.
        y: (H1,) given the relations as well, as questions about relations see it.
        given: the relations; None where there are none.
        slopes: (E,) as questions about relations see them.
        z: (E, K + 1) the factors (S_i * O_j, 1) of the given units, filled up as the loops need it.
        object_y, object_slopes: y and slopes as questions about objects see them.
    """

    classes: Places
    presence: Floats
    log_counts: Floats
    x: Floats
    y: Floats
    given: Given | None
    slopes: Floats
    z: Floats
    object_y: Floats
    object_slopes: Floats


class WithoutEach(NamedTuple):
    """What each class gains from the rest of a scene, and what further questions of it need.

    Attributes:
        gain: (n,) of each class given all others.
        off: (H,) sigmoid(-y), filled up as the loops need it.
        rest: (n, H) sigmoid(y) e^-share of each class, the share being what it adds to y.
        fall: (n, H) e^-share.
        growth: (n, H) e^W.
    """

    gain: Floats
    off: Floats
    rest: Floats
    fall: Floats
    growth: Floats


class Between(NamedTuple):
    """What the relations that are given say of those between the n classes; empty where none is.

    Attributes:
        slopes: (A, n, n), 0 where nothing is given.
        shift: (A, n, n) what they imply for each; apart: without those of the pair itself.
    """

    slopes: Floats
    shift: Floats
    apart: Floats


class ClosedForm:
    """What a machine of that kind says of scenes.

    The same scene gives the same bits, whatever is asked before, after or beside it.

    Args:
        machine: its weights are copied; later changes to them are not seen.

    Raises:
        ValueError: a machine of another kind; see `fits`.
    """

    def __init__(self, machine: BoltzmannMachine) -> None:
        if not isinstance(machine, Triway) or not self.fits(machine):
            raise ValueError("a closed form needs a local Triway of one wide layer in float32")
        self._group = group_size(machine.W)
        names = ("W", "b", "c1", "Q")
        self.W, self.b, self.c1, self.Q = (_array(getattr(machine, name)) for name in names)
        self._weights, self._F = _weights(machine)
        self._gamma = self._B = None
        if machine.spec.G:
            self._gamma, self._B = _array(machine.gamma), _array(machine.B)

    @staticmethod
    def fits(machine: BoltzmannMachine) -> bool:
        """Whether the machine is one of those that this module is for."""
        spec = machine.spec
        return (
            isinstance(machine, Triway)
            and spec.form == "local"
            and spec.H2 == 0
            and spec.H1 >= LEAST_UNITS
            and str(machine.W.dtype) == "torch.float32"
            and group_size(machine.W) > 0
        )

    def context(
        self,
        classes: Places,
        presence: Floats,
        log_counts: Floats,
        room: int | None = None,
        given: Given | None = None,
        pull: Pull = FULL,
    ) -> Context:
        """The context of a scene.

        Args:
            room: index of the room type; None where it is not known.
            pull: how strongly the given relations act.
        """
        bias = self.c1 if room is None or not len(self.Q) else self.c1 + self.Q[room]
        x = object_kernels.hidden_logits(bias, self.W, classes, presence)
        if given is None or not len(given.a):
            slopes, z = _NO_UNITS
            return Context(classes, presence, log_counts, x, x, None, slopes, z, x, slopes)
        y, slopes, z = given_kernels.fixed_point(
            x, self._weights, classes, log_counts, *_lists(given), given.r, given.g, SWEEPS
        )
        object_y, object_slopes = _scaled(pull.objects, x, y, slopes)
        y, slopes = _scaled(pull.relations, x, y, slopes)
        return Context(
            classes, presence, log_counts, x, y, given, slopes, z, object_y, object_slopes
        )

    def between(self, context: Context) -> Between:
        """What `relation_log_odds` and `log_odds_apart` need."""
        given = context.given
        if given is None:
            return Between(_NOTHING, _NOTHING, _NOTHING)
        n = len(context.classes)
        slopes = np.zeros((len(self._weights.g), n, n), dtype=np.float32)
        slopes[given.a, given.i, given.j] = context.slopes
        return Between(slopes, *self._implied(context))

    def relation_log_odds(self, context: Context, between: Between | None = None) -> Floats:
        """Log-odds of all relations between the classes, each without itself, (A, n, n)."""
        slopes, shift, _ = self.between(context) if between is None else between
        found: Floats = relation_kernels.relation_log_odds(
            context.y, self._weights, context.classes, context.log_counts, slopes, shift
        )
        given = context.given
        if given is not None:
            steep = np.flatnonzero(np.abs(context.slopes) > _GENTLE)
            a, i, j = given.a[steep], given.i[steep], given.j[steep]
            found[a, i, j] = self._without_itself(context, a, i, j, context.slopes[steep], shift)
        return found

    def log_odds_apart(self, context: Context, between: Between, i: Places, j: Places) -> Floats:
        """The same of pairs of classes, without all that is given of the pair, (2, A, P).

        Args:
            i, j: (P,) places; the relations from i to j come first, then those back.
        """
        found: Floats = relation_kernels.log_odds_apart(
            *(context.y, self._weights, self._F, context.classes, context.log_counts),
            *(between.slopes, between.apart, i, j),
        )
        return found

    def unit_log_odds(self, context: Context, a: Places, i: Places, j: Places) -> Floats:
        """The same of some units (E,), relations a from places i to places j."""
        given = context.given
        if given is None:
            slopes = np.zeros(len(a), dtype=np.float32)
        else:
            size = len(context.classes), len(self._weights.g)
            slopes = given_kernels.find_slopes(*size, *_lists(given), context.slopes, a, i, j)
        shift, _ = self._implied(context)
        return self._without_itself(context, a, i, j, slopes, shift)

    def _without_itself(
        self, context: Context, a: Places, i: Places, j: Places, slopes: Floats, shift: Floats
    ) -> Floats:
        found: Floats = given_kernels.without_itself(
            *(context.y, self._weights, context.classes, context.log_counts),
            *(a, i, j, slopes, shift),
        )
        return found

    def _implied(self, context: Context) -> tuple[Floats, Floats]:
        given = context.given
        if given is None or self._gamma is None or self._B is None:
            return _NOTHING, _NOTHING
        shift, apart = given_kernels.implied(
            self._gamma, self._B, context.x, len(context.classes), *_lists(given), given.r
        )
        return shift, apart

    def placement_log_odds(
        self, context: Context, candidates: Places, anchors: Places
    ) -> tuple[Floats, Floats]:
        """The same of each absent candidate, were it there: to the anchors and from them.

        Args:
            candidates: (N,) absent classes.
            anchors: (m,) places of present ones.

        Returns:
            (N, A, m) of relations from the candidate to an anchor, and of those back.
        """
        classes, log_counts = context.classes[anchors], context.log_counts[anchors]
        forward, backward = relation_kernels.placement_log_odds(
            context.y, self.W, self._weights, candidates, classes, log_counts
        )
        return forward, backward

    def placed_log_odds(
        self, context: Context, candidates: Places, relation: int, anchor: int, outgoing: bool
    ) -> Floats:
        """One relation of many absent candidates, were they there, to one class, (N,).

        Args:
            anchor: place of the class.
            outgoing: from the candidate to the anchor; otherwise back.
        """
        found: Floats = relation_kernels.placed_log_odds(
            *(context.y, self.W, self._weights, candidates),
            *(context.classes[anchor], relation, context.log_counts[anchor], outgoing),
        )
        return found

    def without_each(self, context: Context) -> WithoutEach:
        """What the rest of a scene does for the log-odds of each of its classes."""
        return WithoutEach(
            *object_kernels.without_each(
                context.object_y, self.W, context.classes, self._shares(context), self._group
            )
        )

    def _shares(self, context: Context) -> Floats:
        """What each class and its relations add to y, (n, H1)."""
        classes = context.classes
        share: Floats
        if context.given is None:
            share = context.presence[:, None] * self.W[classes]
        else:
            share = given_kernels.shares(
                *(self._weights.G, self.W, classes, context.presence, context.z),
                *(*_lists(context.given), context.object_slopes),
            )
        return share

    def reasons(self, context: Context, each: WithoutEach, rows: Places) -> Floats:
        """How the gain of the classes in `rows` (N,) changes by each other class, (N, n)."""
        common, filled = _NOTHING, _NONE
        if context.given is not None:
            common, filled = given_kernels.common_growth(
                *(self._weights.G, len(context.classes), context.z),
                *(*_lists(context.given), context.object_slopes, rows),
            )
        found: Floats = object_kernels.reasons(*each, rows, common, filled, self._group)
        return found

    def reasons_for_absent(self, context: Context, candidates: Places) -> Floats:
        """The same of absent classes (N,): what each present one does for them, (N, n)."""
        found: Floats = object_kernels.reasons_for_absent(
            context.object_y, self.W, candidates, self._shares(context), self._group
        )
        return found


def _scaled(pull: float, x: Floats, y: Floats, slopes: Floats) -> tuple[Floats, Floats]:
    """x + pull (y - x) and pull slopes; to the bit x at 0, and y and slopes at 1."""
    if pull >= 1:
        return y, slopes
    weight = np.float32(pull)
    return x + weight * (y - x), weight * slopes


def _lists(given: Given) -> tuple[Places, Places, Places]:
    return given.a, given.i, given.j


def _array(tensor: Any) -> NDArray[Any]:
    return np.array(tensor.detach().numpy(), order="C")


def _weights(machine: Triway) -> tuple[Weights, Floats]:
    """The weights, and the directions of all relations as rows, filled up too."""
    A, V = machine.spec.A, machine.spec.V
    F, Y = _directions(machine)
    r = F.shape[1]
    p, q = np.tril_indices(r)
    triples = machine.triple_keys.numpy()
    pairs = np.unique(triples % (V * V))
    buckets = 1 << (2 * len(pairs)).bit_length()
    bucket = (pairs * relation_kernels.SPREAD >> relation_kernels.SHIFT) & (buckets - 1)
    order = np.argsort(bucket, kind="stable")
    row = np.empty_like(order)
    row[order] = np.arange(len(order))
    residual = np.zeros((len(pairs) + 1, A), dtype=np.float32)
    place = row[np.searchsorted(pairs, triples % (V * V))]
    residual[place, triples // (V * V)] = _array(machine.residual)
    weights = Weights(
        S=_array(machine.S),
        O=_array(machine.O),
        s=_array(machine.s.T),
        o=_array(machine.o.T),
        n=_array(machine.n),
        start=np.searchsorted(bucket[order], np.arange(buckets + 1)),
        key=pairs[order],
        residual=residual,
        G=_filled(np.concatenate([_array(machine.M), _array(machine.P)[:, None]], 1)),
        g=_filled(np.concatenate([_array(machine.R), _array(machine.d)[:, None]], 1)),
        FF=_filled(F[:, p] * F[:, q]),
        Y0=np.ascontiguousarray(Y[:, :, 0]),
        Y=np.ascontiguousarray(Y[:, :, 1:]),
    )
    return weights, _filled(F.reshape(1, A * r, -1))[0]


def _filled(rows: Floats) -> Floats:
    """(A, R, ...) with zeros after the R rows."""
    return np.pad(rows, [(0, 0), (0, -rows.shape[1] % ROWS)] + [(0, 0)] * (rows.ndim - 2))


def _directions(machine: Triway) -> tuple[Floats, Floats]:
    """F (A, r, H1), and Y (A, r, 1 + K) with y = Y (1, S_i * O_j).

    Directions of largest variance of U_e h1, over pairs of classes as often as the machine's
    fantasies have them, and with h1 as it is in these.
    """
    spec = machine.spec
    S, O = (_array(weights).astype(np.float64) for weights in (machine.S, machine.O))  # noqa: E741
    rows = np.concatenate([_array(machine.P)[:, None], _array(machine.M)], 1).astype(np.float64)
    share, spread = np.ones(spec.V), np.full(spec.H1, 0.25)
    if spec.N:
        scenes = unpack_scenes(machine.fantasies, spec.V)
        share = scenes.mean(0).double().numpy()
        mean = (machine.c1 + scenes @ machine.W).sigmoid().double().numpy()
        spread = (mean * (1 - mean)).mean(0)
    share = share / share.sum()
    ones = np.ones((spec.V, 1))
    left, right = (np.concatenate([ones, factors], 1) for factors in (S, O))
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
