"""Log-odds of a scene's objects and relations in closed form.

For machines in the local form. Without given relations p(h1 | v) is factorial, with means

    m = sigmoid(x),   x = c1 + Q[t] + v'W + J m2

A second layer is held at its mean field m2 given the objects. With given relations, h1 is held at
its mean field,

    y = x + sum_{e given} slope_e U_e,   slope_e = g_e (r_e - sigmoid(ℓ_e(m))),   m = sigmoid(y)

with g_e the presence of both ends. Where given relations must count for less, their pull is scaled:
y = x + ω (y - x) and ω slope_e take the place of y and slope_e, with an ω for questions about
objects and another for those about relations (`Pull`). So in any case

    object     log-odds_i = b_i + sum_k [softplus(y_k + W_ik) - softplus(y_k)]
    relation   p(r_e = 1) = E[sigmoid(ℓ_e(h1))],  ℓ_e(h1) = ℓ_e(m) + sum_k U_ek (h1_k - m_k)

The closed form takes the judged unit out of y first. For a given relation that is its own slope.
For a present object it is W_i, the slopes of all its relations, and its part in the second layer.
The other slopes stay. A small slope is taken out to first order: ℓ_e(m) changes by slope_e σ_e²,
with σ_e² as below.

The logit is a sum of many small independent terms, taken as normal with variance

    σ_e² = sum_k U_ek² m_k (1 - m_k)

and the mean of its sigmoid by quadrature. Errors are measured in docs/decisions/inference.md.
Which units there are, with ℓ_e and U_e, is the variant's: `shared_relations`, `listed_relations`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.inference import given_kernels, object_kernels
from app.inference.listed_relations import ListedRelations
from app.inference.mean_field import with_second_layer
from app.inference.relation_part import NOTHING, Between, Context, Given, RelationPart
from app.inference.scoring import group_size
from app.inference.shared_relations import SharedRelations
from app.inference.weights import Weights

Floats = NDArray[np.float32]
Places = NDArray[np.int64]

# Slopes up to which what a given relation says of itself is taken out to first order
# (docs/decisions/inference.md).
_GENTLE = 0.5
_NO_UNITS = NOTHING.reshape(0), NOTHING.reshape(0, 0)
_NONE = np.zeros((0, 0), dtype=np.bool_)


class Pull(NamedTuple):
    """How strongly observed relations act on the context, from 0 to 1, by kind of question."""

    objects: float = 1.0
    relations: float = 1.0


FULL = Pull()


class WithoutEach(NamedTuple):
    """What each class gains from the rest of a scene, and what further questions of it need.

    Attributes:
        gain: (n,) of each class given all others.
        off: (H,) sigmoid(-y), filled up as the loops need it.
        rest: (n, H) sigmoid(y) e^-share of each class, for its share of y.
        fall: (n, H) e^-share.
        growth: (n, H) e^W.
    """

    gain: Floats
    off: Floats
    rest: Floats
    fall: Floats
    growth: Floats


class ClosedForm:
    """What a machine says of scenes.

    The same scene gives the same bits, independent of other questions.

    Raises:
        ValueError: a machine of another kind; see `fits`.
    """

    def __init__(self, weights: Weights) -> None:
        if not self.fits(weights):
            raise ValueError("a closed form needs the local form and moderate weights in float32")
        self._weights = weights
        self._group = group_size(weights["W"])
        self.W, self.b, self.c1, self.Q = (weights[name] for name in ("W", "b", "c1", "Q"))
        shared = weights.spec.variant == "triway"
        self._part: RelationPart = (SharedRelations if shared else ListedRelations)(weights)

    @staticmethod
    def fits(weights: Weights) -> bool:
        """Whether the machine is one of those that this module is for."""
        return (
            weights.spec.form == "local"
            and weights["W"].dtype == np.float32
            and group_size(weights["W"]) > 0
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
        x, through = self._second_layer(x, classes, presence)
        if given is None or not len(given.a):
            slopes, units = _NO_UNITS
            return Context(
                *(classes, presence, log_counts, x, x, None, slopes, units, x, slopes, through)
            )
        y, slopes, units = self._part.fixed_point(x, classes, presence, log_counts, given)
        object_y, object_slopes = _scaled(pull.objects, x, y, slopes)
        y, slopes = _scaled(pull.relations, x, y, slopes)
        return Context(
            *(classes, presence, log_counts, x, y, given, slopes, units),
            *(object_y, object_slopes, through),
        )

    def _second_layer(
        self, base: Floats, classes: Places, presence: Floats
    ) -> tuple[Floats, Floats | None]:
        """x, and what each class adds to it through the second layer, if there is one."""
        if not self._weights.spec.H2:
            return base, None
        without = base - presence[:, None] * self.W[classes]
        bases = np.concatenate([base[None], without]).astype(np.float32)
        x, _ = with_second_layer(self._weights, bases)
        pulled = (x - bases).astype(np.float32)
        return x[0].astype(np.float32), pulled[0] - pulled[1:]

    def between(self, context: Context) -> Between:
        """What `relation_log_odds` and `log_odds_apart` need."""
        given = context.given
        if given is None:
            return Between(NOTHING, NOTHING, NOTHING)
        n = len(context.classes)
        slopes = np.zeros((self._weights.spec.A, n, n), dtype=np.float32)
        slopes[given.units] = context.slopes
        return Between(slopes, *self._part.implied(context))

    def relation_log_odds(self, context: Context, between: Between | None = None) -> Floats:
        """Log-odds of all relations between the classes, each without itself, (A, n, n)."""
        between = self.between(context) if between is None else between
        found = self._part.log_odds(context, between)
        given = context.given
        if given is not None:
            steep = np.flatnonzero(np.abs(context.slopes) > _GENTLE)
            units = given.a[steep], given.i[steep], given.j[steep]
            found[units] = self._part.without_itself(
                context, units, context.slopes[steep], between.shift
            )
        return found

    def log_odds_apart(self, context: Context, between: Between, i: Places, j: Places) -> Floats:
        """The same of pairs of classes, without all that is given of the pair, (2, A, P).

        Args:
            i, j: (P,) places; the relations from i to j come first, then those back.
        """
        return self._part.log_odds_apart(context, between, i, j)

    def unit_log_odds(self, context: Context, a: Places, i: Places, j: Places) -> Floats:
        """The same of some units (E,), relations a from places i to places j."""
        given = context.given
        if given is None:
            slopes = np.zeros(len(a), dtype=np.float32)
        else:
            size = len(context.classes), self._weights.spec.A
            slopes = given_kernels.find_slopes(*size, *given.units, context.slopes, a, i, j)
        shift, _ = self._part.implied(context)
        return self._part.without_itself(context, (a, i, j), slopes, shift)

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
        return self._part.placement_log_odds(context, candidates, anchors)

    def placed_log_odds(
        self, context: Context, candidates: Places, relation: int, anchor: int, outgoing: bool
    ) -> Floats:
        """One relation of many absent candidates, were they there, to one class, (N,).

        Args:
            anchor: place of the class.
            outgoing: from the candidate to the anchor; otherwise back.
        """
        return self._part.placed_log_odds(context, candidates, relation, anchor, outgoing)

    def without_each(self, context: Context) -> WithoutEach:
        """What the rest of a scene does for the log-odds of each of its classes."""
        return WithoutEach(
            *object_kernels.without_each(
                context.object_y, self.W, context.classes, self._shares(context), self._group
            )
        )

    def _shares(self, context: Context) -> Floats:
        """What each class and its relations add to y, (n, H1)."""
        if context.given is None:
            share: Floats = context.presence[:, None] * self.W[context.classes]
        else:
            share = self._part.shares(context, context.given)
        return share if context.through is None else share + context.through

    def reasons(self, context: Context, each: WithoutEach, rows: Places) -> Floats:
        """How the gain of the classes in `rows` (N,) changes by each other class, (N, n)."""
        common, filled = NOTHING, _NONE
        if context.given is not None:
            common, filled = self._part.common_growth(context, context.given, rows)
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
