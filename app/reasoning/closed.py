"""The posterior of a scene in closed form, for machines that have one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.boltzmann.closed_form import ClosedForm, Given
from app.reasoning.present import present
from app.registry.artifact import Artifact
from app.scene.evidence import class_evidence
from app.scene.scene import Scene

Floats = NDArray[np.float32]
Places = NDArray[np.int64]


class ClosedPosterior:
    """See `Posterior`, and `app/boltzmann/closed_form.py` for the formulas."""

    def __init__(self, artifact: Artifact, closed: ClosedForm, scene: Scene) -> None:
        self.present = present(scene, artifact.machine.spec)
        self._closed, self._scorer = closed, artifact.scorer
        presence = self.present.presence.astype(np.float32)
        self._context = closed.context(
            self.present.classes,
            presence,
            np.log(self.present.counts).astype(np.float32),
            scene.room_type,
            _given(scene, presence, artifact.machine.spec.A),
        )

    @property
    def unit_count(self) -> int:
        """Those that are given."""
        return len(self._context.slopes)

    def absent_log_odds(self, absent: Places) -> Floats:
        """Exact where no relation is given."""
        return (self._closed.b + self._scorer.row_gain(self._context.y))[absent]

    def relation_log_odds(self) -> Floats:
        """Normal logits."""
        return self._closed.relation_log_odds(self._context)

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
        alone, _ = self._closed.leave_one_out(self._context, np.zeros(0, dtype=np.int64))
        return self._closed.b[self.present.classes] + alone

    def reasons(self, rows: Places) -> Floats:
        """Exact where no relation is given."""
        alone, pairs = self._closed.leave_one_out(self._context, rows)
        change = alone[rows, None] - pairs
        change[np.arange(len(rows)), rows] = 0.0
        return change


def _given(scene: Scene, presence: Floats, relations: int) -> Given | None:
    """The relations between classes that the scene states or shows, of those the machine knows."""
    if not (scene.relations or scene.relations_complete or scene.poses):
        return None
    found = class_evidence(scene)
    a, i, j = np.nonzero(found.observed[:relations])
    holds = found.holds[a, i, j].astype(np.float32)
    return Given(a, i, j, holds, presence[i] * presence[j])
