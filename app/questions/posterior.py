"""The posterior: log-odds of objects and relations, given a scene, and their calibration."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.inference import MachineSpec
from app.inference.posterior import ScenePosterior, context_of
from app.inference.relations import ObservedRelations
from app.registry.artifact import Artifact
from app.registry.description import CountSlope
from app.scene.scene import Scene, instance_evidence, pool_classes, pool_relations

Floats = NDArray[np.floating[Any]]
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


class Posterior(ScenePosterior):
    """Log-odds of objects and relations given a scene and a published model.

    Attributes:
        present: the classes of the scene.
        listed: number of distinct classes of the scene, without structural classes.

    Raises:
        ValueError: the machine does not know the class of an object, the room type or the profile.
    """

    def __init__(self, artifact: Artifact, scene: Scene) -> None:
        self.present = listing = present(scene, artifact.spec)
        is_structure = artifact.vocabulary.structure[listing.classes]
        self.listed = len(listing.classes) - int(np.count_nonzero(is_structure))
        observed = given_relations(scene, listing, artifact.spec.A)
        context = context_of(
            artifact.weights,
            *(listing.classes, listing.presence, listing.log_counts, scene.room_type, observed),
        )
        units, room = artifact.relation_units, scene.room_type
        super().__init__(artifact.objects, units, context, scene.profile, room)


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
    log_odds: Floats = entry.intercept + entry.log_count * np.log(n) + entry.slope * z
    return log_odds
