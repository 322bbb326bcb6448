"""The posterior given a scene: log-odds of objects, room types and relations; their calibration.

v are the object units, and h1 are the hidden units. Given v, the units of h1 are independent, with
the logits x (`app.inference.weights`). The answers are in closed form:

    object     log-odds_i = b_i + ..., see `app.inference.objects`
    relation   p(r_e = 1) = E[sigmoid(ℓ_e(h1))], see `app.inference.relation_units`

The log-odds of a listed class are computed at x without its contribution, which is its row of W.
Observed relations do not change the logits of h1: their effect on objects and on other relations
through h1 was not measurable (docs/decisions/relations.md). They change other relations by
implications only.
"""

import math
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.compiling import compiled, inlined
from app.inference import MachineSpec
from app.inference.elementary import logistic, to_log_odds
from app.inference.relation_units import ObservedRelations, RelationLogits, encode
from app.model.calibration import LEAST_COVERAGE, Calibration, CountSlope, CoverageFit
from app.model.scene_model import SceneModel
from app.scene.scene import Scene, pool_classes

Floats = NDArray[np.floating[Any]]
Singles = NDArray[np.float32]
Doubles = NDArray[np.float64]
Indices = NDArray[np.int64]

_NO_ROWS: Final = np.zeros(0, np.int64)

LEAST_CHANGE: Final = math.log(3)
"""Minimum change of log-odds by a reason: substantial evidence is a Bayes factor of at least 3."""


class Present(NamedTuple):
    """The n distinct classes of a scene of N objects. Models compute log-odds for classes."""

    classes: Int[Indices, "n"]  # ascending
    counts: Int[Indices, "n"]  # objects of each class
    row: Int[Indices, "N"]  # index in `classes` of each object's class
    first: Int[Indices, "n"]  # first object of each class in `Scene.objects`
    confidence: Float[Doubles, "N"]  # of each object
    presence: Float[Singles, "n"]  # probability that at least one instance is present
    log_counts: Float[Singles, "n"]
    observed: ObservedRelations | None  # between the classes; None: without observations


def present(scene: Scene, spec: MachineSpec) -> Present:
    """Group the objects of a scene, and its observed relations, by class.

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
    class_indices = np.array(indices, dtype=np.int64)
    classes, first, row, counts, presence = pool_classes(class_indices, confidence)
    log_counts = np.log(counts).astype(np.float32)
    columns = None
    if scene.relations is not None:
        columns = scene.relations.of_classes(row, len(classes), spec.A)
    observed = None if columns is None else ObservedRelations(*columns)
    single = presence.astype(np.float32)
    return Present(classes, counts, row, first, confidence, single, log_counts, observed)


class Posterior:
    """Log-odds of objects and relations given a scene and a published model.

    Shapes contain V (classes of the vocabulary), A (canonical relations) and n (classes of the
    scene). With a profile and without observed relations, the log-odds of objects are exact.
    Without a profile, they have the mean base rates of the sources (docs/models.md, An unknown
    source). The logits of relations are approximated by normal variables. The smallest log-odds of
    a relation is `NO_UNIT`. `listed` is the number of classes of the scene without structure.

    Raises:
        ValueError: the machine does not know the class of an object, the room type or the profile.
    """

    def __init__(self, model: SceneModel, scene: Scene) -> None:
        self.present = listing = present(scene, model.spec)
        is_structure = model.vocabulary.structure[listing.classes]
        self.listed = len(listing.classes) - int(np.count_nonzero(is_structure))
        self.context = encode(
            model.weights,
            listing.classes,
            listing.presence,
            listing.log_counts,
            room=scene.room_type,
            observed=listing.observed,
        )
        self._objects, self.units = model.objects, model.relation_units
        self._profile, self._room = scene.profile, scene.room_type

    def weight(self, presence: Float[Floats, "n"]) -> None:
        """Replace the presence of the listed classes, before relations are asked."""
        single = presence.astype(np.float32)
        self.present = self.present._replace(presence=single)
        self.context = self.context.weighted(single)

    def absent_log_odds(self, absent: Int[Indices, "N"], coverage: float) -> Float[Floats, "N"]:
        """Return the log-odds of unlisted classes, if the list has this share of the classes."""
        log_odds = self._objects.absent(
            self.context.x,
            self.present.classes,
            self.present.presence,
            profile=self._profile,
            coverage=coverage,
            room=self._room,
        )
        return log_odds[absent]

    def given_rest(
        self, *, explained: bool = False
    ) -> tuple[Float[Floats, "n"], Float[Floats, "n n"]]:
        """Return the log-odds of each listed class given the others, and their changes by each."""
        return self._objects.given_rest(
            self.context, self._profile, self._room, explained=explained
        )

    def room_log_p(self, without: Int[Indices, "m"] = _NO_ROWS) -> Float[Doubles, "1+m C"]:
        """Return log p(t | objects) of each room type t in a scene of unknown room type.

        The first row is for all objects. The others leave out the class of a row of `present` each.
        """
        x = np.repeat(self.context.x[None], 1 + len(without), axis=0)
        x[1:] -= self.context.contributions[without]
        presence = np.repeat(self.present.presence[None], len(x), axis=0)
        presence[np.arange(1, len(x)), without] = 0.0
        return self._objects.room_log_p(x, self.present.classes, presence, self._profile)

    def relation_log_odds(self) -> Float[Floats, "A n n"]:
        """Return the log-odds of every relation of the scene's classes, without its observation."""
        return self.units.log_odds(self._between)

    def alone_log_odds(self) -> Float[Floats, "A n n"]:
        """Return the log-odds of every relation given the objects alone."""
        return to_log_odds(self._between.mean, self._between.spread)

    def relation_change(self) -> Float[Floats, "A n n"]:
        """Return the change of every logit by observed relations of other pairs."""
        return self._between.shift_by_others

    def pair_log_odds(self) -> Float[Floats, "A n n"]:
        """Return the log-odds of every relation without the evidence of its pair of classes."""
        return self.units.log_odds(self._between, leave_out_pair=True)

    @cached_property
    def _between(self) -> RelationLogits:
        return self.units.logits(self.context)


def log_odds_of(log_p: Float[Doubles, "..."]) -> Float[Doubles, "..."]:
    """Return log p - log(1 - p). A p of nearly 1 counts as 1 - 1e-12."""
    return log_p - np.log(-np.expm1(np.minimum(log_p, -1e-12)))


# --------------------------------------------------------------------------------- calibration
#
# Validation scenes determine the coefficients, which are fields of `Calibration`.


def calibrated(
    entry: CountSlope, z: Float[Floats, "N"], n: int | Int[NDArray[np.integer[Any]], "N"]
) -> Float[Floats, "N"]:
    """Return the calibrated log-odds of logits z by the formula of `CountSlope`."""
    return entry.intercept + entry.log_count * np.log(n) + entry.slope * z


def calibrated_missing(
    calibration: Calibration, z: Float[Floats, "N"], n: int, coverage: float | None
) -> Float[Floats, "N"]:
    """Return the calibrated log-odds of presence from logits z, for a list of n classes."""
    n = max(1, n)
    if coverage is None:
        return calibrated(calibration.missing, z, n)
    return calibrated_at_coverage(calibration.covered, z, n, coverage)


def calibrated_at_coverage(
    entry: CoverageFit,
    z: Float[Floats, "N"],
    n: int | Int[NDArray[np.integer[Any]], "N"],
    coverage: float | Float[Floats, "N"],
) -> Float[Floats, "N"]:
    """Return calibrated log-odds from logits z, for n listed classes with this share (coverage)."""
    log_n, log_s = np.log(n), np.log(np.maximum(coverage, LEAST_COVERAGE))
    change = entry.log_share * log_s + entry.both * log_n * log_s
    last = entry.last * (np.asarray(coverage) == 1)
    return entry.intercept + entry.slope * z + entry.log_count * log_n + change + last


@compiled
def relation_probability(
    slopes: Float[NDArray, "A 3"],  # table of `RelationSlopes`
    log_odds: Float[NDArray, "B A N"],  # between classes; B is 1 without candidates
    log_count: Float[NDArray, " N"],  # of the pairs of objects with these two classes
) -> Float[NDArray, "B A N"]:
    """Return the probability of each relation between N pairs of objects, for B candidates."""
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
    """Scale p(a(x,y)) and p(a(y,x)) to a sum of at most 1: a relation holds in one direction."""
    total = np.maximum(forward + backward, np.float32(1.0))
    return forward / total, backward / total
