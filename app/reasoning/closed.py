"""The posterior of a scene without given relations, in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.boltzmann.closed_form import ClosedForm
from app.reasoning.present import present
from app.registry.artifact import Artifact
from app.scene.scene import Scene

Floats = NDArray[np.float32]
Places = NDArray[np.int64]


class ClosedPosterior:
    """See `Posterior`, and `app/boltzmann/closed_form.py` for the formulas."""

    def __init__(self, artifact: Artifact, closed: ClosedForm, scene: Scene) -> None:
        self.scene = scene
        self.present = present(scene, artifact.machine.spec)
        self._closed = closed
        self._scorer = artifact.scorer
        self._b = closed.b
        self._presence = self.present.presence.astype(np.float32)
        self._log_counts = np.log(self.present.counts).astype(np.float32)
        self._x = closed.hidden_logits(self.present.classes, self._presence, scene.room_type)

    def absent_log_odds(self, absent: Places) -> Floats:
        """Exact."""
        return (self._b + self._scorer.row_gain(self._x))[absent]

    def relation_log_odds(self) -> Floats:
        """Normal logits."""
        return self._closed.relation_log_odds(self._x, self.present.classes, self._log_counts)

    def placement_log_odds(self, candidates: Places, anchors: Places) -> tuple[Floats, Floats]:
        """Normal logits."""
        classes, counts = self.present.classes[anchors], self._log_counts[anchors]
        return self._closed.placement_log_odds(self._x, candidates, classes, counts)

    def placed_log_p(
        self, candidates: Places, relation: int, anchor: int, *, outgoing: bool
    ) -> Floats:
        """Normal logits."""
        log_odds = self._closed.placed_log_odds(
            self._x,
            candidates,
            relation,
            int(self.present.classes[anchor]),
            self._log_counts[anchor],
            outgoing,
        )
        return -np.logaddexp(np.float32(0.0), -log_odds)

    def log_odds_given_rest(self) -> Floats:
        """Exact."""
        nobody = np.zeros(0, dtype=np.int64)
        alone, _ = self._leave_one_out(nobody)
        return self._b[self.present.classes] + alone

    def reasons(self, rows: Places) -> Floats:
        """Exact."""
        alone, pairs = self._leave_one_out(rows)
        change = alone[rows, None] - pairs
        change[np.arange(len(rows)), rows] = 0.0
        return change

    def _leave_one_out(self, rows: Places) -> tuple[Floats, Floats]:
        classes = self.present.classes
        share = self._presence[:, None] * self._closed.W[classes]
        return self._closed.leave_one_out(self._x, classes, share, rows)
