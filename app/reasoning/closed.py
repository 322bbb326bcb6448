"""The posterior of a scene in closed form, for machines that have one."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from app.boltzmann.closed_form import Between, ClosedForm, WithoutEach
from app.reasoning.given import given_relations, pull_of
from app.reasoning.present import present
from app.reasoning.unlisted import with_unlisted
from app.registry.artifact import Artifact
from app.scene.scene import Scene

Floats = NDArray[np.float32]
Places = NDArray[np.int64]


class ClosedPosterior:
    """See `Posterior`, and `app/boltzmann/closed_form.py` for the formulas."""

    def __init__(self, artifact: Artifact, closed: ClosedForm, scene: Scene) -> None:
        self.present = present(scene, artifact.machine.spec)
        self._artifact, self._closed, self._room = artifact, closed, scene.room_type
        self._context = closed.context(
            *(self.present.classes, self.present.presence, self.present.log_counts),
            scene.room_type,
            given_relations(scene, self.present, artifact.machine.spec.A),
            pull_of(scene, artifact.calibration.evidence),
        )

    @property
    def unit_count(self) -> int:
        """Those that are given."""
        return len(self._context.slopes)

    def absent_log_odds(self, absent: Places) -> Floats:
        """Exact where no relation is given."""
        return (self._closed.b + self._artifact.scorer.row_gain(self._context.object_y))[absent]

    def absent_posterior(self, absent: Places, coverage: float) -> Floats:
        """See `with_unlisted`."""
        found: Floats = with_unlisted(
            *(self._artifact, self.absent_log_odds(absent), absent, self._context.object_y),
            *(self.present, self._room, coverage),
        )
        return found

    def relation_log_odds(self) -> Floats:
        """Normal logits."""
        return self._closed.relation_log_odds(self._context, self._between)

    def unit_log_odds(self, relation: Places, subject: Places, object_: Places) -> Floats:
        """Normal logits."""
        return self._closed.unit_log_odds(self._context, relation, subject, object_)

    def log_odds_apart(self, one: Places, other: Places) -> tuple[Floats, Floats]:
        """Normal logits; what is known of the pair is taken out to first order."""
        forward, backward = self._closed.log_odds_apart(self._context, self._between, one, other)
        return forward, backward

    def placement_log_odds(self, candidates: Places, anchors: Places) -> tuple[Floats, Floats]:
        """Normal logits."""
        return self._closed.placement_log_odds(self._context, candidates, anchors)

    def placed_log_p(
        self, candidates: Places, relation: int, anchor: int, *, outgoing: bool
    ) -> Floats:
        """Normal logits."""
        log_odds = self._closed.placed_log_odds(
            self._context, candidates, relation, anchor, outgoing
        )
        return -np.logaddexp(np.float32(0.0), -log_odds)

    def log_odds_given_rest(self) -> Floats:
        """Exact where no relation is given."""
        return self._closed.b[self.present.classes] + self._without_each.gain

    def reasons(self, rows: Places) -> Floats:
        """Exact where no relation is given."""
        return self._closed.reasons(self._context, self._without_each, rows)

    def reasons_for_absent(self, candidates: Places) -> Floats:
        """Exact where no relation is given."""
        return self._closed.reasons_for_absent(self._context, candidates)

    @cached_property
    def _between(self) -> Between:
        return self._closed.between(self._context)

    @cached_property
    def _without_each(self) -> WithoutEach:
        return self._closed.without_each(self._context)
