"""The posterior given a scene: log-odds of objects, room types and relations, in closed form.

v are the object units, and h1 is the first hidden layer. Given v, the units of h1 are independent,
with the logits x (`weights`). The answers are:

    object     log-odds_i = b_i + ..., see `objects`
    relation   p(r_e = 1) = E[sigmoid(ℓ_e(h1))], see `relations`

The log-odds of a listed class are computed at x without its contribution: its row of W, and its
effect through the second layer. Observed relations do not change the logits of h1: their effect on
objects and on other relations through h1 was not measurable (docs/decisions/evidence.md). They
change other relations by implications only.
"""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from app.inference.objects import ObjectScorer
from app.inference.relations import (
    Between,
    Context,
    ObservedRelations,
    RelationUnits,
    to_log_odds,
)
from app.inference.weights import Weights

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Indices = NDArray[np.int64]


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
    if weights.spec.H2:
        # The effect of a class through the second layer is J m2 for the whole scene minus J m2 for
        # the scene without this class.
        bases = np.concatenate([x[None], x - shares]).astype(np.float32)
        logits, _ = weights.with_second_layer(bases)
        through = (logits - bases).astype(np.float32)
        x, shares = logits[0].astype(np.float32), shares + through[0] - through[1:]
    return Context(classes, presence, log_counts, x, shares, observed)


class ScenePosterior:
    """Log-odds of objects and relations given the logits of h1 (`Context`), in closed form.

    Shapes contain V (classes of the vocabulary), A (canonical relations), n (classes of the scene)
    and H1 (states of the first hidden layer). The log-odds of objects are exact for a machine with
    one hidden layer. The logits of relations are approximated by normal variables. The smallest
    log-odds of a relation is `NO_UNIT`.

    Args:
        profile: index of the data source whose base rates apply, or None.
        room: index of the room type, or None. It is the room type of the context.
    """

    def __init__(
        self,
        objects: ObjectScorer,
        units: RelationUnits,
        context: Context,
        profile: int | None = None,
        room: int | None = None,
    ) -> None:
        self.context = context
        self._objects, self._units, self._profile, self._room = objects, units, profile, room
        self._scene = context.classes, context.presence

    def absent_log_odds(self, absent: Indices, coverage: float) -> Floats:
        """Return the log-odds that each of N unlisted classes is present, (N,).

        Args:
            absent: (N,) indices of the unlisted classes.
            coverage: listed share of the classes of the scene.
        """
        x, profile = self.context.x, self._profile
        log_odds = self._objects.absent(x, *self._scene, profile, coverage, self._room)
        of_absent: Floats = log_odds[absent]
        return of_absent

    def given_rest(self, *, explained: bool = False) -> tuple[Floats, Floats]:
        """See `ObjectScorer.given_rest`."""
        return self._objects.given_rest(
            self.context, self._profile, self._room, explained=explained
        )

    def reasons_for_absent(self, candidates: Indices) -> Floats:
        """See `ObjectScorer.reasons_for_absent`."""
        return self._objects.reasons_for_absent(self.context, self._profile, candidates)

    def room_log_p(self) -> Doubles:
        """Return log p(t | objects) of each room type t, (C,), in a scene of unknown room type."""
        classes, presence = self._scene
        x = self.context.x[None]
        log_p: Doubles = self._objects.room_log_p(x, classes, presence[None], self._profile)[0]
        return log_p

    def room_reasons(self) -> Doubles:
        """Return how much each class changes the log-odds of each room type, (C, n).

        An entry is the log-odds of the room type given all n classes, minus its log-odds given the
        scene without the class.
        """
        classes, presence = self._scene
        # Row k has the logits of h1 and the presence of the classes in the scene without class k.
        x = self.context.x - self.context.shares
        presence_without = presence * (1 - np.eye(len(classes), dtype=np.float32))
        log_p_without = self._objects.room_log_p(x, classes, presence_without, self._profile)
        change: Doubles = (_log_odds(self.room_log_p()) - _log_odds(log_p_without)).T
        return change

    def relation_log_odds(self) -> Floats:
        """Return the log-odds of every relation between the classes of the scene, (A, n, n).

        The observation of a relation is not evidence for the same relation.
        """
        return self._units.log_odds(self._between)

    def alone_log_odds(self) -> Floats:
        """Return the log-odds of every relation given the objects alone, (A, n, n)."""
        return to_log_odds(self._between.mean, self._between.spread)

    def relation_change(self) -> Floats:
        """Return the change of every logit by observed relations of other pairs, (A, n, n)."""
        change = self._between.apart
        return change if len(change) else np.zeros_like(self._between.mean)

    def log_odds_apart(self, i: Indices, j: Indices) -> tuple[Floats, Floats]:
        """Return the log-odds (A, P) of all relations from classes i to j, and (A, P) from j to i.

        The observed relations of a pair are not evidence for the relations of the same pair.

        Args:
            i, j: (P,) indices of the two classes of each pair in the scene.
        """
        log_odds = self._units.log_odds(self._between, apart=True)
        # The compiled functions of the questions need contiguous arrays.
        forward, backward = np.ascontiguousarray(log_odds[:, [i, j], [j, i]].swapaxes(0, 1))
        return forward, backward

    def placement_log_odds(
        self, candidates: Indices, anchors: Indices, only: int | None = None
    ) -> tuple[Floats, Floats]:
        """See `RelationUnits.placement_log_odds`."""
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

    @cached_property
    def _between(self) -> Between:
        return self._units.between(self.context)


def _log_odds(log_p: Doubles) -> Doubles:
    """Return log p - log(1 - p). A p of nearly 1 counts as 1 - 1e-12."""
    log_odds: Doubles = log_p - np.log(-np.expm1(np.minimum(log_p, -1e-12)))
    return log_odds
