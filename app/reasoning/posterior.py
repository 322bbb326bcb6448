"""What a model believes about the rest of a scene, given what is known of it."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.inference.closed_form import WithoutEach
from app.inference.relation_part import Between
from app.reasoning.given import given_relations, pull_of
from app.reasoning.present import present
from app.reasoning.unlisted import with_unlisted
from app.registry.artifact import Artifact
from app.scene.scene import Scene

Floats = NDArray[np.floating[Any]]
Places = NDArray[np.int64]


class Posterior:
    """Log-odds given a scene; formulas in `app/inference/closed_form.py`.

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
        forward, backward = self._closed.log_odds_apart(self._context, self._between, one, other)
        return forward, backward

    def placement_log_odds(self, candidates: Places, anchors: Places) -> tuple[Floats, Floats]:
        """Relations of absent classes (N,), were they there, to places (m,) in `present.classes`.

        What the observed relations imply for those of a candidate is left out.

        Returns:
            (N, A, m) of the candidate to an anchor, and of the anchor to the candidate.
        """
        return self._closed.placement_log_odds(self._context, candidates, anchors)

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
        found: Floats = self._closed.b[self.present.classes] + self._without_each.gain
        return found

    def reasons(self, rows: Places) -> Floats:
        """How the log-odds of classes given the rest change by each other class, (N, n).

        With the class, minus without it and its relations. 0 for the class itself.

        Args:
            rows: (N,) places in `present.classes`.
        """
        return self._closed.reasons(self._context, self._without_each, rows)

    def reasons_for_absent(self, candidates: Places) -> Floats:
        """How the log-odds of absent classes (N,) change by each class that is there, (N, n).

        With the class, minus without it and its relations.
        """
        return self._closed.reasons_for_absent(self._context, candidates)

    @cached_property
    def _between(self) -> Between:
        return self._closed.between(self._context)

    @cached_property
    def _without_each(self) -> WithoutEach:
        return self._closed.without_each(self._context)


def posterior(artifact: Artifact, scene: Scene) -> Posterior:
    """The posterior of a scene, by the artifact's oracle if it has one."""
    found: Posterior = (artifact.oracle or Posterior)(artifact, scene)
    return found


def relations_given(scene: Scene) -> bool:
    """Whether the scene says anything of how its objects stand to each other."""
    return bool(scene.relations or scene.relations_complete or scene.poses)
