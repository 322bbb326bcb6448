"""A model's probabilities for the rest of a scene, given its observed part."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.inference import MachineSpec
from app.inference.posterior import Pull
from app.inference.relations import Between, Given
from app.registry.artifact import Artifact
from app.registry.description import EvidenceWeights
from app.scene.evidence import instance_evidence, pool_classes, pooled
from app.scene.scene import Scene

Floats = NDArray[np.floating[Any]]
Places = NDArray[np.int64]

FULL: Final = 0.999
"""Coverage from which on every class that is there counts as listed."""


class Present(NamedTuple):
    """The n distinct classes of a scene of N objects: models speak of these, answers of objects.

    Attributes:
        classes: (n,) int64, ascending.
        counts: (n,) int64, instances of each.
        row: (N,) int64, for each object the place of its class in `classes`.
        first: (n,) int64, position of the first object of each class.
        presence: (n,) float32, probability that at least one instance of the class is there.
        log_counts: (n,) float32.
    """

    classes: Places
    counts: Places
    row: Places
    first: Places
    presence: NDArray[np.float32]
    log_counts: NDArray[np.float32]


def present(scene: Scene, spec: MachineSpec) -> Present:
    """The classes of a scene.

    Raises:
        ValueError: an object outside the machine's classes, or a room type it does not have.
    """
    V, indices = spec.V, [thing.class_index for thing in scene.objects]
    for place, index in enumerate(indices):
        if index is None or index >= V:
            name = scene.objects[place].id
            raise ValueError(f"class_index of {name!r} is {index}, must be below V = {V}")
    if scene.room_type is not None and spec.C and not 0 <= scene.room_type < spec.C:
        raise ValueError(f"room_type is {scene.room_type}, must be below C = {spec.C}")
    confidence = np.array([thing.confidence for thing in scene.objects], dtype=np.float64)
    classes, first, row, counts, presence = pool_classes(
        np.array(indices, dtype=np.int64), confidence
    )
    log_counts = np.log(counts).astype(np.float32)
    return Present(classes, counts, row, first, presence.astype(np.float32), log_counts)


def given_relations(scene: Scene, present: Present, relations: int) -> Given | None:
    """What is observed, by class; None where the scene says nothing of relations.

    Args:
        relations: how many the machine knows.
    """
    if not relations_given(scene) and scene.poses is None:
        return None
    on, seen = pooled(present.row, len(present.classes), *instance_evidence(scene))
    # Contiguous, however many: for other layouts the loops would be compiled again.
    a, i, j = np.stack(np.nonzero(seen[:relations]))
    gate = present.presence[i] * present.presence[j]
    return Given(a, i, j, on[a, i, j].astype(np.float32), gate)


def relations_given(scene: Scene) -> bool:
    """Whether the scene says anything of how its objects stand to each other."""
    return bool(scene.relations or scene.relations_complete or scene.poses)


def pull_of(scene: Scene, weights: EvidenceWeights) -> Pull:
    """How strongly the relations of a scene act on the context."""
    if scene.poses is None:
        return Pull(weights.relations_on_objects, weights.relations_on_relations)
    return Pull(weights.poses_on_objects, weights.poses_on_relations)


class Posterior:
    """Log-odds given a scene; formulas in `app/inference/posterior.py`.

    Shapes: V classes, A canonical relations, n classes present. Without given relations objects are
    exact with one layer; the logits of relations count as normal. No log-odds of a relation is
    below `NO_UNIT`.

    Attributes:
        present: the classes of the scene.

    Raises:
        ValueError: an object outside the machine's classes, or a room type it does not have.
    """

    def __init__(self, artifact: Artifact, scene: Scene) -> None:
        self.present = present(scene, artifact.spec)
        self._artifact, self._closed, self._room = artifact, artifact.closed_form, scene.room_type
        self._context = self._closed.context(
            *(self.present.classes, self.present.presence, self.present.log_counts),
            scene.room_type,
            given_relations(scene, self.present, artifact.spec.A),
            pull_of(scene, artifact.calibration.evidence),
        )

    @property
    def unit_count(self) -> int:
        """Relations that are given: a judgement of one class goes through all of them."""
        return len(self._context.slopes)

    def absent_log_odds(self, absent: Places) -> Floats:
        """Presence of absent classes (N,), each with all its relations unobserved, (N,)."""
        found: Floats = self._closed.b + self._artifact.scorer.gain(self._context.object_y)
        return found[absent]

    def absent_posterior(self, absent: Places, coverage: float) -> Floats:
        """The same where a class which is present is listed with probability `coverage`, (N,)."""
        return with_unlisted(
            *(self._artifact, self.absent_log_odds(absent), absent, self._context.object_y),
            *(self.present, self._room, coverage),
        )

    def relation_log_odds(self) -> Floats:
        """Every relation between the classes present, each without itself, (A, n, n)."""
        return self._closed.relation_log_odds(self._context, self._between)

    def unit_log_odds(self, relation: Places, subject: Places, object_: Places) -> Floats:
        """The same of some relations (E,), from and to places in `present.classes`, (E,)."""
        return self._closed.unit_log_odds(self._context, relation, subject, object_)

    def log_odds_apart(self, one: Places, other: Places) -> tuple[Floats, Floats]:
        """Relations of pairs of classes (P,) without all that is known of how the two stand.

        Args:
            one, other: places in `present.classes`.

        Returns:
            (A, P) of the one to the other, and of the other to the one.
        """
        forward, backward = self._closed.units.log_odds_apart(
            self._context, self._between, one, other
        )
        return forward, backward

    def placement_log_odds(self, candidates: Places, anchors: Places) -> tuple[Floats, Floats]:
        """Relations of absent classes (N,), were they there, to places (m,) in `present.classes`.

        What the observed relations imply for those of a candidate is left out.

        Returns:
            (N, A, m) of the candidate to an anchor, and of the anchor to the candidate.
        """
        return self._closed.units.placement_log_odds(self._context, candidates, anchors)

    def placed_log_p(
        self, candidates: Places, relation: int, anchor: int, *, outgoing: bool
    ) -> Floats:
        """log p(the candidate stands so to the anchor | it is there, evidence), (N,).

        Args:
            relation: canonical; from the candidate to the anchor if `outgoing`, else back.
            anchor: place in `present.classes`.
        """
        log_odds = self._closed.placed_log_odds(
            self._context, candidates, relation, anchor, outgoing
        )
        return -np.logaddexp(np.float32(0.0), -log_odds)

    def log_odds_given_rest(self) -> Floats:
        """Each present class given the scene without it and its relations, (n,)."""
        found: Floats = self._closed.b[self.present.classes] + self._gains
        return found

    def reasons(self, rows: Places) -> Floats:
        """How the log-odds of classes given the rest change by each other class, (N, n).

        With the class, minus without it and its relations. 0 for the class itself.

        Args:
            rows: (N,) places in `present.classes`.
        """
        return self._closed.reasons(self._context, self._shares, self._gains, rows)

    def reasons_for_absent(self, candidates: Places) -> Floats:
        """How the log-odds of absent classes (N,) change by each class that is there, (N, n).

        With the class, minus without it and its relations.
        """
        return self._closed.reasons_for_absent(self._context, self._shares, candidates)

    @cached_property
    def _between(self) -> Between:
        return self._closed.units.between(self._context)

    @cached_property
    def _shares(self) -> NDArray[np.float32]:
        return self._closed.shares(self._context)

    @cached_property
    def _gains(self) -> NDArray[np.float32]:
        return self._closed.gains_given_rest(self._context, self._shares)


def posterior(artifact: Artifact, scene: Scene) -> Posterior:
    """The posterior of a scene, by the artifact's oracle if it has one."""
    found: Posterior = (artifact.oracle or Posterior)(artifact, scene)
    return found


def with_unlisted(
    artifact: Artifact,
    log_odds: Floats,
    absent: Places,
    y: NDArray[np.float32],
    present: Present,
    room: int | None,
    coverage: float,
    closed: Floats | None = None,
) -> Floats:
    """Mix the log-odds of absent classes with those of the partial posterior, (N,).

    (1 - λ) (closed + log(1 - c)) + λ partial, with λ the calibration's `coverage_weight`. The
    closed form counts all other unlisted classes as absent and has no sampling error. It stands
    alone for machines without stored samples, and from a coverage of `FULL` on, which counts as
    `FULL`: at 1 no class could be there unlisted.

    Args:
        log_odds: (N,) of the absent classes, unlisted ones absent.
        y: (H1,) logits of h1 in the closed form.
        coverage: probability that a class which is present is listed.
        closed: (N,) the closed form at y, where `log_odds` are a better estimate: what the
            partial posterior changes is added to these.
    """
    completions, weight = artifact.completions, artifact.calibration.coverage_weight
    unlisted = math.log1p(-min(coverage, FULL))
    found: Floats = log_odds + unlisted
    if completions is None or coverage >= FULL or weight == 0:
        return found
    partial = completions.log_odds(y, present.classes, present.presence, coverage, room)[absent]
    base = (log_odds if closed is None else closed) + unlisted
    found += np.float32(weight) * (partial - base)
    return found
