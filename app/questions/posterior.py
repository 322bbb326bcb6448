"""The posterior given a scene: log-odds of objects, room types and relations; their calibration.

v are the object units, and h1 are the hidden units. Given v, the units of h1 are independent, with
the logits x (`app.inference.weights`). The answers are in closed form:

    object     log-odds_i = b_i + ..., see `app.inference.objects`
    relation   p(r_e = 1) = E[sigmoid(ℓ_e(h1))], see `app.inference.relation_units`

The log-odds of a listed class are computed at x without its contribution, which is its row of W.
Observed relations do not change the logits of h1: their effect on objects and on other relations
through h1 was not measurable (docs/decisions/evidence.md). They change other relations by
implications only.
"""

import math
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled, inlined
from app.inference import MachineSpec
from app.inference.elementary import logistic
from app.inference.quadrature import to_log_odds
from app.inference.relation_units import ObservedRelations, RelationLogits, encode
from app.registry.artifact import Artifact
from app.registry.description import LEAST_COVERAGE, Calibration, CountSlope, CoverageFit
from app.scene.scene import Scene, instance_evidence, pool_classes
from app.scene.spatial_relations import pool_relations

Floats = NDArray[np.floating[Any]]
Doubles = NDArray[np.float64]
Indices = NDArray[np.int64]

LEAST_CHANGE: Final = math.log(3)
"""Minimum change of log-odds by a reason: substantial evidence is a Bayes factor of at least 3."""


class Present(NamedTuple):
    """The n distinct classes of a scene of N objects.

    Models compute log-odds for classes, but answers list objects.

    Attributes:
        classes: (n,) int64, class indices in ascending order.
        counts: (n,) int64, number of objects of each class.
        row: (N,) int64, index into `classes` of each object's class.
        first: (n,) int64, index of the first object of each class in `Scene.objects`.
        presence: (n,) float32, probability that at least one instance of the class is present.
        log_counts: (n,) float32, log of `counts`.
    """

    classes: Indices
    counts: Indices
    row: Indices
    first: Indices
    presence: NDArray[np.float32]
    log_counts: NDArray[np.float32]


def present(scene: Scene, spec: MachineSpec) -> Present:
    """Group the objects of a scene by class.

    Raises:
        ValueError: the machine does not know the class of an object, the room type or the profile.
    """
    indices = [thing.class_index for thing in scene.objects]
    for thing, index in zip(scene.objects, indices, strict=True):
        if index is None or index >= spec.V:
            raise ValueError(
                f"class_index of {thing.id!r} is {index}, but must be below V = {spec.V}"
            )
    if scene.room_type is not None and spec.C and not 0 <= scene.room_type < spec.C:
        raise ValueError(f"room_type is {scene.room_type}, but must be from 0 to {spec.C - 1}")
    if scene.profile is not None and not 0 <= scene.profile < spec.profiles:
        raise ValueError(f"profile is {scene.profile}, but must be below {spec.profiles}")
    confidence = np.array([thing.confidence for thing in scene.objects], dtype=np.float64)
    classes, first, row, counts, presence = pool_classes(
        np.array(indices, dtype=np.int64), confidence
    )
    log_counts = np.log(counts).astype(np.float32)
    return Present(classes, counts, row, first, presence.astype(np.float32), log_counts)


def given_relations(scene: Scene, present: Present, relations: int) -> ObservedRelations | None:
    """Return the observed relations between the classes of a scene.

    The result is None if the scene has neither relations nor poses.

    Args:
        relations: number of canonical relations that the machine knows.
    """
    if not relations_given(scene):
        return None
    n = len(present.classes)
    holds, observed = pool_relations(present.row, n, *instance_evidence(scene))
    # The arrays are contiguous. For another layout, numba would compile the loops again.
    units = observed[:relations].reshape(-1).nonzero()[0]
    a, pair = np.divmod(units, n * n)
    return ObservedRelations(a, *np.divmod(pair, n), holds.reshape(-1)[units].astype(np.float32))


def relations_given(scene: Scene) -> bool:
    """Return whether the scene has observed relations, either stated or derived from poses."""
    return bool(scene.relations or scene.relations_complete or scene.poses)


class Posterior:
    """Log-odds of objects and relations given a scene and a published model.

    Shapes contain V (classes of the vocabulary), A (canonical relations) and n (classes of the
    scene). With a profile and without observed relations, the log-odds of objects are exact.
    Without a profile, they have the mean base rates of the sources (docs/models.md, An unknown
    source). The logits of relations are approximated by normal variables. The smallest log-odds of
    a relation is `NO_UNIT`.

    Attributes:
        present: the classes of the scene.
        listed: number of distinct classes of the scene, without structural classes.
        context: hidden units of the scene, given its objects.

    Raises:
        ValueError: the machine does not know the class of an object, the room type or the profile.
    """

    def __init__(self, artifact: Artifact, scene: Scene) -> None:
        self.present = listing = present(scene, artifact.spec)
        is_structure = artifact.vocabulary.structure[listing.classes]
        self.listed = len(listing.classes) - int(np.count_nonzero(is_structure))
        observed = given_relations(scene, listing, artifact.spec.A)
        self.context = encode(
            artifact.weights,
            *(listing.classes, listing.presence, listing.log_counts, scene.room_type, observed),
        )
        self._objects, self._units = artifact.objects, artifact.relation_units
        self._profile, self._room = scene.profile, scene.room_type

    def absent_log_odds(self, absent: Indices, coverage: float) -> Floats:
        """Return the log-odds that each of N unlisted classes is present, (N,).

        Args:
            absent: (N,) indices of the unlisted classes.
            coverage: listed share of the classes of the scene.
        """
        listed = self.present.classes, self.present.presence
        arguments = self.context.x, *listed, self._profile, coverage, self._room
        return self._objects.absent(*arguments)[absent]

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
        return self._room_log_p(self.context.x[None], self.present.presence[None])[0]

    def _room_log_p(self, x: Floats, presence: Floats) -> Doubles:
        return self._objects.room_log_p(x, self.present.classes, presence, self._profile)

    def room_reasons(self) -> Doubles:
        """Return how much each class changes the log-odds of each room type, (C, n).

        An entry is the log-odds of the room type given all n classes, minus its log-odds given the
        scene without the class.
        """
        # Row k has the logits of h1 and the presence of the classes in the scene without class k.
        x, presence = self.context.x - self.context.contributions, self.present.presence
        without = self._room_log_p(x, presence * (1 - np.eye(len(presence), dtype=np.float32)))
        return (log_odds_of(self.room_log_p()) - log_odds_of(without)).T

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
        return self._between.shift_by_others

    def log_odds_apart(self, i: Indices, j: Indices) -> tuple[Floats, Floats]:
        """Return the log-odds (A, P) of all relations from classes i to j, and (A, P) from j to i.

        The observed relations of a pair are not evidence for the relations of the same pair.

        Args:
            i, j: (P,) indices of the two classes of each pair in the scene.
        """
        log_odds = self._units.log_odds(self._between, leave_out_pair=True)
        # The compiled functions of the questions need contiguous arrays.
        forward, backward = np.ascontiguousarray(log_odds[:, [i, j], [j, i]].swapaxes(0, 1))
        return forward, backward

    def placement_log_odds(
        self, candidates: Indices, anchors: Indices, only: int | None = None
    ) -> tuple[Floats, Floats]:
        """See `RelationUnits.placement_log_odds`."""
        return self._units.placement_log_odds(self.context, candidates, anchors, only)

    @cached_property
    def _between(self) -> RelationLogits:
        return self._units.logits(self.context)


def log_odds_of(log_p: Doubles) -> Doubles:
    """Return log p - log(1 - p). A p of nearly 1 counts as 1 - 1e-12."""
    return log_p - np.log(-np.expm1(np.minimum(log_p, -1e-12)))


# --------------------------------------------------------------------------------- calibration
#
# Validation scenes determine the coefficients, which are fields of `Calibration`.


def calibrated(entry: CountSlope, z: Floats, n: int | NDArray[np.integer[Any]]) -> Floats:
    """Return the calibrated log-odds of N logits, (N,); see `CountSlope` for the formula.

    Args:
        entry: calibration of a question.
        z: (N,) logits.
        n: number n of the formula, or an array (N,) with a number for each logit.
    """
    return entry.intercept + entry.log_count * np.log(n) + entry.slope * z


def calibrated_missing(
    calibration: Calibration, z: Floats, n: int, coverage: float | None
) -> Floats:
    """Return the calibrated log-odds that N unlisted classes are present, (N,).

    Args:
        z: (N,) log-odds of the classes at the coverage.
        n: number of listed classes without structure.
        coverage: share of the scene that the request states; None if it states none.
    """
    n = max(1, n)
    if coverage is None:
        return calibrated(calibration.missing, z, n)
    return calibrated_at_coverage(calibration.covered, z, n, coverage)


def calibrated_at_coverage(
    entry: CoverageFit,
    z: Floats,
    n: int | NDArray[np.integer[Any]],
    coverage: float | NDArray[np.floating[Any]],
) -> Floats:
    """Return the calibrated log-odds of N logits, (N,); see `CoverageFit` for the formula."""
    log_n, log_s = np.log(n), np.log(np.maximum(coverage, LEAST_COVERAGE))
    change = entry.log_share * log_s + entry.both * log_n * log_s
    last = entry.last * (np.asarray(coverage) == 1)
    return entry.intercept + entry.slope * z + entry.log_count * log_n + change + last


@compiled
def relation_probability(slopes, log_odds, log_count):
    """Return the probability that each relation holds between two objects, (B, A, N).

    The shape is (B candidate classes, A relations, N pairs of classes). B is 1 without candidates.

    Args:
        slopes: (A, 3) table of `RelationSlopes`.
        log_odds: (B, A, N) log-odds of the relation between classes.
        log_count: (N,) log of the number of object pairs with these two classes.
    """
    p = np.empty_like(log_odds)
    for a in range(p.shape[1]):
        intercept, slope, weight = slopes[a, 0], slopes[a, 1], slopes[a, 2]
        for b in range(len(p)):
            row, logits = log_odds[b, a], p[b, a]
            for j in range(len(row)):
                logits[j] = intercept + slope * row[j] + weight * log_count[j]
    # One loop over all rows is faster than one loop per row, because a row may be short.
    flat = p.reshape(-1)
    for e in range(len(flat)):
        flat[e] = logistic(np.float32(flat[e]))
    return p


@inlined
def exclusive(forward, backward):
    """Scale p(a(x,y)) and p(a(y,x)) so that their sum is at most 1.

    The reason is that a relation a cannot hold in both directions between the same two objects.
    """
    total = np.maximum(forward + backward, np.float32(1.0))
    return forward / total, backward / total
