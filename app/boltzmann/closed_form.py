"""Log-odds of a scene's objects and relations in closed form, compiled.

For a Triway machine of one wide layer in the local form. Without given relations p(h1 | v) is
factorial, with means m = sigmoid(x), x = c1 + Q[t] + v'W; given some, it is taken as at its
mean field,

    y = x + sum_{e given} slope_e U_e,   slope_e = g_e (r_e - sigmoid(ℓ_e(m))),   m = sigmoid(y)

with g_e the presence of both ends. So in either case

    object     log-odds_i = b_i + sum_k [softplus(y_k + W_ik) - softplus(y_k)]
    relation   p(r_e = 1) = E[sigmoid(ℓ_e(h1))],  ℓ_e(h1) = ℓ_e(m) + sum_k U_ek (h1_k - m_k)

What is judged is taken out of y first: its own slope for a given relation, and W_i with the slopes
of all its relations for an object that is present, the other slopes held.

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
from app.boltzmann.mean_field import SWEEPS
from app.boltzmann.scoring import group_size
from app.boltzmann.triway import Triway

Floats = NDArray[np.float32]
Places = NDArray[np.int64]

LEAST_UNITS = 64
"""Fewer hidden units make no normal logit."""

# Of the variance of the logits, how much the directions F_a leave out.
_LEFT_OUT = 1e-3
_NOTHING = np.zeros((0, 0, 0), dtype=np.float32)


class Weights(NamedTuple):
    """Weights of the relation part, as the compiled loops take them.

    Attributes:
        S, O: (V, K).  R: (A, K).  M: (A, K, H1).  P: (A, H1).  d: (A,).  s, o: (A, V).  n: (A, 2).
        start: (A·V + 1,) where the residuals of each (a, i) begin in
        column, residual: (T,) their j and w'.
        F: (A, r, H1) directions of U.
        Y0: (A, r), and Y: (A, r, K): the coordinates y = Y0 + Y (S_i * O_j) in them.
    """

    S: Floats
    O: Floats  # noqa: E741
    R: Floats
    M: Floats
    P: Floats
    d: Floats
    s: Floats
    o: Floats
    n: Floats
    start: Places
    column: Places
    residual: Floats
    F: Floats
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
        y: (H1,) given the relations as well.
        given: the relations; None where there are none.
        slopes: (E,).
    """

    classes: Places
    presence: Floats
    log_counts: Floats
    x: Floats
    y: Floats
    given: Given | None
    slopes: Floats


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
        self._weights = _weights(machine)
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
    ) -> Context:
        """The context of a scene.

        Args:
            room: index of the room type; None where it is not known.
        """
        bias = self.c1 if room is None or not len(self.Q) else self.c1 + self.Q[room]
        x = object_kernels.hidden_logits(bias, self.W, classes, presence)
        if given is None or not len(given.a):
            return Context(classes, presence, log_counts, x, x, None, _NOTHING.reshape(0))
        y, slopes = given_kernels.fixed_point(
            x, self._weights, classes, log_counts, *_lists(given), given.r, given.g, SWEEPS
        )
        return Context(classes, presence, log_counts, x, y, given, slopes)

    def relation_log_odds(self, context: Context) -> Floats:
        """Log-odds of all relations between the classes, each without itself, (A, n, n)."""
        shift = self._implied(context)
        found: Floats = relation_kernels.relation_log_odds(
            context.y, self._weights, context.classes, context.log_counts, shift
        )
        if context.given is not None:
            a, i, j = _lists(context.given)
            found[a, i, j] = given_kernels.without_itself(
                context.y,
                self._weights,
                context.classes,
                context.log_counts,
                *(a, i, j),
                context.slopes,
                shift if len(shift) else np.zeros_like(found),
            )
        return found

    def _implied(self, context: Context) -> Floats:
        given = context.given
        if given is None or self._gamma is None or self._B is None:
            return _NOTHING
        mean = 1.0 / (1.0 + np.exp(-np.clip(context.x, -80.0, 80.0)))
        z = np.concatenate([np.ones(1, dtype=np.float32), self._B @ mean])
        found: Floats = given_kernels.implied(
            self._gamma, z, len(context.classes), *_lists(given), given.r
        )
        return found

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
            context.y,
            self.W,
            self._weights,
            candidates,
            context.classes[anchor : anchor + 1],
            relation,
            np.zeros(1, dtype=np.float32),
            context.log_counts[anchor : anchor + 1],
            outgoing,
        )
        return found

    def leave_one_out(self, context: Context, rows: Places) -> tuple[Floats, Floats]:
        """What the rest of a scene does for the log-odds of each of its classes.

        Args:
            rows: (N,) places of classes.

        Returns:
            (n,) the gain of each class given all others; (N, n) the gain of the classes in `rows`
            where one further class is left out. Its diagonal means nothing.
        """
        W = self.W[context.classes]
        share, common = context.presence[:, None] * W, _NOTHING
        if context.given is not None:
            units = (
                *(self._weights, context.classes, context.log_counts),
                *_lists(context.given),
                context.slopes,
            )
            share = share + given_kernels.shares(*units)
            if len(rows):
                # Relations between the two go out with either, so they must not go out twice.
                common = given_kernels.common_shares(*units, rows)
        alone, pairs = object_kernels.leave_one_out(context.y, W, share, rows, common, self._group)
        return alone, pairs


def _lists(given: Given) -> tuple[Places, Places, Places]:
    return given.a, given.i, given.j


def _array(tensor: Any) -> NDArray[Any]:
    return np.array(tensor.detach().numpy(), order="C")


def _weights(machine: Triway) -> Weights:
    A, V = machine.spec.A, machine.spec.V
    F, Y = _directions(machine)
    keys = machine.triple_keys.numpy()
    return Weights(
        S=_array(machine.S),
        O=_array(machine.O),
        R=_array(machine.R),
        M=_array(machine.M),
        P=_array(machine.P),
        d=_array(machine.d),
        s=_array(machine.s),
        o=_array(machine.o),
        n=_array(machine.n),
        start=np.searchsorted(keys, np.arange(A * V + 1) * V),
        column=keys % V,
        residual=_array(machine.residual),
        F=F,
        Y0=np.ascontiguousarray(Y[:, :, 0]),
        Y=np.ascontiguousarray(Y[:, :, 1:]),
    )


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
    left_out = np.cumsum(values.clip(min=0), axis=1) / values.clip(min=1e-30).sum(1, keepdims=True)
    kept = max(1, int((left_out > _LEFT_OUT).sum(1).max()))
    vectors = vectors[:, :, -kept:]
    Y = np.linalg.solve(root.T, vectors).transpose(0, 2, 1)
    F = vectors.transpose(0, 2, 1) @ root.T @ rows
    return F.astype(np.float32), Y.astype(np.float32)
