"""The posterior given a scene: log-odds of objects, relations and unlisted classes.

The machine must have the local form. v are the object units, h1 the hidden units of the first
layer, and x their logits given the objects. Without observed relations p(h1 | v) is factorial, with
means m:

    m = sigmoid(x),   x = c1 + Q[t] + v'W + J m2

t is the room type. A second layer is fixed at its mean field m2 given the objects.

Observed relations e change the logits of h1 from x to their mean field y, see
`RelationUnits.fixed_point`. `Pull` can reduce this effect by a factor ω: x + ω (y - x) replaces y,
and ω slope_e replaces slope_e. Questions about objects and questions about relations have different
factors ω. Then

    object     log-odds_i = b_i + sum_k [softplus(y_k + W_ik) - softplus(y_k)]
    relation   p(r_e = 1) = E[sigmoid(ℓ_e(h1))], see `relations`

The judged unit is first subtracted from y. For an observed relation, this is its own slope. For a
present object it is W_i, the slopes of all its relations, and its effect through the second layer.
The slopes of other relations are not computed again.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.inference import objects
from app.inference.objects import group_size
from app.inference.relations import Between, Context, Ends, Given
from app.inference.weights import Weights

Floats = NDArray[np.float32]
Places = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Up to this slope, the effect of an observed relation on itself is subtracted to first order
# (docs/decisions/inference.md).
_GENTLE = 0.5
_NO_SLOPES = np.zeros(0, dtype=np.float32)


class Pull(NamedTuple):
    """Factors ω of the effect of observed relations on h1, from 0 to 1, by kind of question."""

    objects: float = 1.0
    relations: float = 1.0


FULL = Pull()


class ClosedForm:
    """A machine prepared for log-odds in closed form; `ScenePosterior` has these for one scene.

    The same scene always gives bit-identical log-odds. Other questions have no effect on them.

    Raises:
        ValueError: the machine does not fit this closed form; see `fits`.
    """

    def __init__(self, weights: Weights) -> None:
        if not self.fits(weights):
            raise ValueError("the closed form requires the local form and bounded float32 weights")
        self._weights = weights
        self.W, self.b = weights["W"], weights["b"]
        self._c1, self._Q = weights["c1"], weights["Q"]
        self.units = weights.spec.kind.units(weights)
        self.group = group_size(self.W)

    @staticmethod
    def fits(weights: Weights) -> bool:
        """Whether the machine has the local form and bounded float32 weights."""
        return (
            weights.spec.is_local
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
        """Logits of h1 given the objects, the room type and the given relations.

        Args:
            classes: (n,) distinct classes of the scene.
            presence: (n,) probability that each class is present.
            log_counts: (n,) log of the number of instances of each class.
            room: index of the room type; None if unknown.
            given: observed relations; None without any.
            pull: factors of the effect of the observed relations.
        """
        x: Floats = self._c1 + presence @ self.W[classes]
        if room is not None and len(self._Q):
            x += self._Q[room]
        through = None
        if self._weights.spec.H2:
            x, through = self._second_layer(x, classes, presence)
        scene = classes, presence, log_counts
        if given is None or not len(given.a):
            none = _NO_SLOPES
            return Context(*scene, x, x, None, None, none, x, none, through)
        i, j = given.i, given.j
        ends = Ends(
            *(classes[i], classes[j], log_counts[i], log_counts[j], presence[i], presence[j])
        )
        y, units, slopes = self.units.fixed_point(x, given, ends)
        object_y, object_slopes = _scaled(pull.objects, x, y, slopes)
        y, slopes = _scaled(pull.relations, x, y, slopes)
        return Context(*scene, x, y, given, units, slopes, object_y, object_slopes, through)

    def _second_layer(
        self, base: Floats, classes: Places, presence: Floats
    ) -> tuple[Floats, Floats]:
        """x, (H1,), and the effect of each class on x through the second layer, (n, H1)."""
        without = base - presence[:, None] * self.W[classes]
        bases = np.concatenate([base[None], without]).astype(np.float32)
        x, _ = self._weights.with_second_layer(bases)
        pulled = (x - bases).astype(np.float32)
        return x[0].astype(np.float32), pulled[0] - pulled[1:]


class ScenePosterior:
    """Log-odds of objects and relations given the context of a scene, in closed form.

    Shapes: V classes of the vocabulary, A canonical relations, n classes of the scene. The
    log-odds of objects are exact for one hidden layer and a scene without observed relations.
    Logits of relations are approximated by normal variables. `NO_UNIT` is the smallest log-odds of
    a relation.
    """

    def __init__(self, closed: ClosedForm, context: Context) -> None:
        self.context = context
        self._closed, self._units = closed, closed.units

    @property
    def unit_count(self) -> int:
        """Number of observed relation units; the cost of judging one class grows with it."""
        return len(self.context.slopes)

    def relation_log_odds(self) -> Floats:
        """Log-odds of every relation between the classes of the scene, (A, n, n).

        Each relation is judged as if it were unobserved itself.
        """
        found = self._units.log_odds(self._between)
        given, units, slopes = self.context.given, self.context.units, self.context.slopes
        if given is not None and units is not None:
            steep = np.flatnonzero(np.abs(slopes) > _GENTLE)
            if len(steep):
                where = units.place[steep]
                place = given.a[where], given.i[where], given.j[where]
                found[place] = self._units.without_itself(
                    self.context, *place, slopes[steep], self._between.shift
                )
        return found

    def unit_log_odds(self, relation: Places, subject: Places, object_: Places) -> Floats:
        """Log-odds of E relations, each judged as if it were unobserved itself, (E,).

        Args:
            relation: (E,) canonical relations.
            subject, object_: (E,) indices of the classes in the scene.
        """
        given, shift, _ = self._units.said(self.context)
        none = np.zeros(len(relation), dtype=np.float32)
        slopes = given[relation, subject, object_] if len(given) else none
        return self._units.without_itself(self.context, relation, subject, object_, slopes, shift)

    def log_odds_apart(self, one: Places, other: Places) -> tuple[Floats, Floats]:
        """Log-odds of all relations of P pairs, judged as if no relation of the pair were observed.

        Args:
            one, other: (P,) indices of the two classes in the scene.

        Returns:
            (A, P) from `one` to `other`, and (A, P) from `other` to `one`.
        """
        forward, backward = self._units.log_odds_apart(self.context, self._between, one, other)
        return forward, backward

    def placement_log_odds(
        self, candidates: Places, anchors: Places, only: int | None = None
    ) -> tuple[Floats, Floats]:
        """Log-odds of all relations of absent classes to anchors, if these classes were present.

        The effect of the observed relations on a candidate's relations is left out.

        Args:
            candidates: (N,) absent classes.
            anchors: (m,) indices of classes in the scene.
            only: the one canonical relation to judge; None for all.

        Returns:
            (N, A, m) from the candidates to the anchors, and (N, A, m) from the anchors back.
        """
        return self._units.placement_log_odds(self.context, candidates, anchors, only)

    def placed_log_p(
        self, candidates: Places, relation: int, anchor: int, *, outgoing: bool
    ) -> Floats:
        """log p(relation between candidate and anchor | candidate is present, evidence), (N,).

        Args:
            candidates: (N,) absent classes.
            relation: canonical relation.
            anchor: index of the anchor's class in the scene.
            outgoing: whether the candidate is the relation's subject; otherwise the anchor is.
        """
        both = self.placement_log_odds(candidates, np.array([anchor]), relation)
        log_odds = both[0 if outgoing else 1][:, 0, 0]
        return -np.logaddexp(np.float32(0.0), -log_odds)

    def log_odds_given_rest(self) -> Floats:
        """Leave-one-out log-odds of each class: given the scene without it, (n,).

        The relations of the class are left out, too.
        """
        return self._closed.b[self.context.classes] + self._gains

    def reasons(self, rows: Places) -> Floats:
        """How much each class of the scene changes the leave-one-out log-odds of others, (N, n).

        An entry is the log-odds with the changing class, minus the log-odds without this class and
        its relations. The entry of a class for itself is 0.

        Args:
            rows: (N,) indices of the explained classes in the scene.
        """
        context, closed = self.context, self._closed
        without: Floats = objects.gains_without_others(
            *(context.object_y, self._shares, closed.W[context.classes], rows),
            *(*self._units.common(context), closed.group),
        )
        change = self._gains[rows, None] - without
        change[np.arange(len(rows)), rows] = 0
        return change

    def reasons_for_absent(self, candidates: Places) -> Floats:
        """How much each class of the scene changes the log-odds of absent classes, (N, n).

        An entry is the log-odds with the class, minus the log-odds without it and its relations.
        """
        found: Floats = objects.reasons_for_absent(
            self.context.object_y, self._shares, self._closed.W[candidates], self._closed.group
        )
        return found

    @cached_property
    def _between(self) -> Between:
        return self._units.between(self.context)

    @cached_property
    def _shares(self) -> Floats:
        """The sum that each class and its relations add to y, (n, H1)."""
        share = self._units.shares(self.context)
        return share if self.context.through is None else share + self.context.through

    @cached_property
    def _gains(self) -> Floats:
        """The change of each class's log-odds b_i by the rest of the scene, (n,)."""
        found: Floats = objects.gains_without(
            *(self.context.object_y, self._shares, self._closed.W[self.context.classes]),
            self._closed.group,
        )
        return found


def _scaled(pull: float, x: Floats, y: Floats, slopes: Floats) -> tuple[Floats, Floats]:
    """x + pull (y - x), and pull slopes. A pull of 1 returns y and slopes unchanged."""
    if pull >= 1:
        return y, slopes
    weight = np.float32(pull)
    return x + weight * (y - x), weight * slopes
