"""The posterior given a scene: log-odds of objects, relations and unlisted classes.

The machine must have the local form: each relation unit is normalised separately. v are the object
units, h1 are the hidden units of the first layer, and x are the logits of h1 given the objects.
Without observed relations, the units of h1 are independent given v. Their means m are:

    m = sigmoid(x),   x = c1 + Q[t] + v'W + J m2

t is the room type. m2 are the mean-field means of a second layer, given the objects.

Observed relations e change the logits of h1 from x to y = x + sum_e slope_e U_e. U_e are the
weights between relation e and h1. `RelationUnits.fixed_point` computes y and the slopes by a
mean-field iteration. `Pull` can reduce this effect by a factor ω: x + ω (y - x) replaces y, and
ω slope_e replaces slope_e. Questions about objects and questions about relations have different
factors ω. The answers are:

    object     log-odds_i = b_i + sum_k [softplus(y_k + W_ik) - softplus(y_k)]
    relation   p(r_e = 1) = E[sigmoid(ℓ_e(h1))], see `relations`

The contribution of the judged unit is first subtracted from y. An observed relation e contributes
slope_e U_e. A present object i contributes W_i, the terms slope_e U_e of all its relations, and its
effect through the second layer. The slopes of other relations are not computed again.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.inference import objects
from app.inference.objects import group_size
from app.inference.relations import Between, Context, ObservedRelations, ends_of, relation_units
from app.inference.weights import Weights

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Maximum |slope| of an observed relation for which a first-order formula subtracts the effect of
# the relation on its own logit (docs/decisions/inference.md).
_GENTLE = 0.5
_NO_SLOPES = np.zeros(0, dtype=np.float32)


class Pull(NamedTuple):
    """Factors ω from 0 to 1 that reduce the effect of observed relations on h1.

    Attributes:
        objects: factor ω for questions about objects.
        relations: factor ω for questions about relations.
    """

    objects: float = 1.0
    relations: float = 1.0


FULL = Pull()


class ClosedForm:
    """A machine prepared for log-odds in closed form. `ScenePosterior` computes them for one scene.

    The same scene always gives bit-identical log-odds, whatever the other requests.

    Raises:
        ValueError: the closed form does not apply to the machine; see `supports`.
    """

    def __init__(self, weights: Weights) -> None:
        if not self.supports(weights):
            raise ValueError(
                "the closed form requires a machine in the local form with float32 weights W "
                "between -64 and 64"
            )
        self._weights = weights
        self.W, self.b = weights["W"], weights["b"]
        self._c1, self._Q = weights["c1"], weights["Q"]
        self.units = relation_units(weights)
        self.group = group_size(self.W)

    @staticmethod
    def supports(weights: Weights) -> bool:
        """Return whether the machine has the local form and its W is float32 between -64 and 64."""
        return (
            weights.spec.is_local
            and weights["W"].dtype == np.float32
            and group_size(weights["W"]) > 0
        )

    def context(
        self,
        classes: Indices,
        presence: Floats,
        log_counts: Floats,
        room: int | None = None,
        observed: ObservedRelations | None = None,
        pull: Pull = FULL,
    ) -> Context:
        """Compute the logits of h1 given the objects, the room type and the observed relations.

        Args:
            classes: (n,) indices of the distinct classes of the scene.
            presence: (n,) probability that each class is present.
            log_counts: (n,) log of the number of instances of each class.
            room: index of the room type, or None if the room type is unknown.
            observed: observed relations, or None if the scene has no observed relations.
            pull: factors that reduce the effect of the observed relations.
        """
        x: Floats = self._c1 + presence @ self.W[classes]
        if room is not None and len(self._Q):
            x += self._Q[room]
        through = None
        if self._weights.spec.H2:
            x, through = self._second_layer(x, classes, presence)
        scene = classes, presence, log_counts
        if observed is None or not len(observed.a):
            # Without observed relations, y and object_y are x, and there are no slopes.
            empty = _NO_SLOPES
            return Context(*scene, x, x, None, None, empty, x, empty, through)
        ends = ends_of(*scene, observed.i, observed.j)
        y, units, slopes = self.units.fixed_point(x, observed, ends)
        object_y, object_slopes = _scaled(pull.objects, x, y, slopes)
        y, slopes = _scaled(pull.relations, x, y, slopes)
        return Context(*scene, x, y, observed, units, slopes, object_y, object_slopes, through)

    def _second_layer(
        self, base: Floats, classes: Indices, presence: Floats
    ) -> tuple[Floats, Floats]:
        """Return x (H1,), and the effect of each class on x through the second layer (n, H1).

        ``base`` is x without the term J m2. The effect of a class is J m2 for the whole scene minus
        J m2 for the scene without this class.
        """
        base_without_class = base - presence[:, None] * self.W[classes]
        bases = np.concatenate([base[None], base_without_class]).astype(np.float32)
        x, _ = self._weights.with_second_layer(bases)
        second_layer_term = (x - bases).astype(np.float32)
        return x[0].astype(np.float32), second_layer_term[0] - second_layer_term[1:]


class ScenePosterior:
    """Log-odds of objects and relations given the logits of h1 (`Context`), in closed form.

    Shapes contain V (classes of the vocabulary), A (canonical relations), n (classes of the scene)
    and H1 (hidden units of the first layer). The log-odds of objects are exact for a machine with
    one hidden layer and a scene without observed relations. The logits of relations are
    approximated by normal variables. The smallest log-odds of a relation is `NO_UNIT`.
    """

    def __init__(self, closed: ClosedForm, context: Context) -> None:
        self.context = context
        self._closed, self._units = closed, closed.units

    @property
    def unit_count(self) -> int:
        """Number of observed relation units. The time to judge one class grows with this number."""
        return len(self.context.slopes)

    def relation_log_odds(self) -> Floats:
        """Return the log-odds of every relation between the classes of the scene, (A, n, n).

        The observation of a relation is not evidence for the same relation. A first-order formula
        subtracts its effect; for relations with a large slope, the exact formula replaces it.
        """
        log_odds = self._units.log_odds(self._between)
        observed, units, slopes = self.context.observed, self.context.units, self.context.slopes
        if observed is not None and units is not None:
            steep = np.flatnonzero(np.abs(slopes) > _GENTLE)
            if len(steep):
                rows = units.kept[steep]
                triples = observed.a[rows], observed.i[rows], observed.j[rows]
                log_odds[triples] = self._units.log_odds_without_itself(
                    self.context, *triples, slopes[steep], self._between.shift
                )
        return log_odds

    def unit_log_odds(self, relation: Indices, subject: Indices, object_: Indices) -> Floats:
        """Return the log-odds of E relations, (E,).

        The observation of a relation is not evidence for the same relation.

        Args:
            relation, subject, object_: (E,) indices of canonical relations, and of their subject
                and object classes in the scene.
        """
        slopes, shift, _ = self._units.observed_effects(self.context)
        unit_slopes = np.zeros(len(relation), dtype=np.float32)
        if len(slopes):
            unit_slopes = slopes[relation, subject, object_]
        return self._units.log_odds_without_itself(
            self.context, relation, subject, object_, unit_slopes, shift
        )

    def log_odds_apart(self, i: Indices, j: Indices) -> tuple[Floats, Floats]:
        """Return the log-odds (A, P) of all relations from classes i to j, and (A, P) from j to i.

        `RelationUnits.log_odds_apart` describes the arguments.
        """
        forward, backward = self._units.log_odds_apart(self.context, self._between, i, j)
        return forward, backward

    def placement_log_odds(
        self, candidates: Indices, anchors: Indices, only: int | None = None
    ) -> tuple[Floats, Floats]:
        """Return the log-odds of relations between absent candidate classes and anchor classes.

        The observed relations change the result only through the hidden units h1.
        `RelationUnits.placement_log_odds` describes arguments and results.
        """
        return self._units.placement_log_odds(self.context, candidates, anchors, only)

    def placed_log_p(
        self, candidates: Indices, relation: int, anchor: int, *, outgoing: bool
    ) -> Floats:
        """Return log p(relation to the anchor | candidate is present, evidence), (N,).

        Args:
            candidates: (N,) indices of absent classes.
            relation: index of a canonical relation.
            anchor: index of the anchor's class in the scene.
            outgoing: True if the candidate is the relation's subject, False if the anchor is.
        """
        forward, backward = self.placement_log_odds(candidates, np.array([anchor]), relation)
        log_odds = (forward if outgoing else backward)[:, 0, 0]
        return -np.logaddexp(np.float32(0.0), -log_odds)

    def log_odds_given_rest(self) -> Floats:
        """Return the log-odds of each class given the scene without this class, (n,).

        The relations of the class are also left out.
        """
        return self._closed.b[self.context.classes] + self._gains

    def reasons(self, rows: Indices) -> Floats:
        """Return how much each class j changes `log_odds_given_rest` of each class i, (N, n).

        Each row is one of the N classes i of ``rows``. Each column is one of the n classes j of the
        scene. An entry is the log-odds of i with class j, minus the log-odds of i without class j
        and the relations of j. An entry with i = j is 0.

        Args:
            rows: (N,) indices of the classes i in the scene.
        """
        context, group = self.context, self._closed.group
        W = self._closed.W[context.classes]
        common, index = self._units.common(context)
        gains: Floats = objects.gains_without_others(
            context.object_y, self._shares, W, rows, common, index, group
        )
        change = self._gains[rows, None] - gains
        change[np.arange(len(rows)), rows] = 0
        return change

    def reasons_for_absent(self, candidates: Indices) -> Floats:
        """Return how much each class of the scene changes the log-odds of absent classes, (N, n).

        Each row is one of the N absent candidates. Each column is one of the n classes of the
        scene. An entry is the candidate's log-odds with the class of the scene, minus the
        candidate's log-odds without this class and its relations.
        """
        change: Floats = objects.reasons_for_absent(
            self.context.object_y, self._shares, self._closed.W[candidates], self._closed.group
        )
        return change

    @cached_property
    def _between(self) -> Between:
        return self._units.between(self.context)

    @cached_property
    def _shares(self) -> Floats:
        """The contribution of each class and its relations to y, (n, H1)."""
        share = self._units.shares(self.context)
        return share if self.context.through is None else share + self.context.through

    @cached_property
    def _gains(self) -> Floats:
        """The change of the log-odds of each class i from b_i by the rest of the scene, (n,)."""
        y, group = self.context.object_y, self._closed.group
        W = self._closed.W[self.context.classes]
        gains: Floats = objects.gains_without(y, self._shares, W, group)
        return gains


def _scaled(pull: float, x: Floats, y: Floats, slopes: Floats) -> tuple[Floats, Floats]:
    """Return x + pull (y - x), and slopes multiplied by ``pull``.

    If ``pull`` is 1, the function returns y and slopes unchanged.
    """
    if pull >= 1:
        return y, slopes
    weight = np.float32(pull)
    return x + weight * (y - x), weight * slopes
