"""What a model believes about the rest of a scene, given what is known of it.

The questions are asked of a posterior; how its numbers come about is its own affair.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from app.reasoning.closed import ClosedPosterior
from app.reasoning.drawn import DrawnPosterior
from app.reasoning.present import Present
from app.registry.artifact import Artifact
from app.scene.scene import Scene

Floats = NDArray[np.floating[Any]]
Places = NDArray[np.int64]


class Posterior(Protocol):
    """Log-odds given a scene.

    Shapes: V classes, A canonical relations, n classes present. No log-odds of a relation is below
    `units.NO_UNIT`.

    Attributes:
        present: the classes of the scene.
        unit_count: relation units that a judgement of one class goes through.
    """

    present: Present

    @property
    def unit_count(self) -> int:
        """See above."""

    def absent_log_odds(self, absent: Places) -> Floats:
        """Presence of absent classes (N,), each with all its relations unobserved, (N,)."""

    def absent_posterior(self, absent: Places, coverage: float) -> Floats:
        """The same where a class which is present is listed with probability `coverage`, (N,)."""

    def relation_log_odds(self) -> Floats:
        """Every relation between the classes present, each without itself, (A, n, n)."""

    def unit_log_odds(self, relation: Places, subject: Places, object_: Places) -> Floats:
        """The same of some relations (E,), from and to places in `present.classes`, (E,)."""

    def log_odds_apart(self, one: Places, other: Places) -> tuple[Floats, Floats]:
        """Relations of pairs of classes (P,) without all that is known of how the two stand.

        Args:
            one, other: places in `present.classes`.

        Returns:
            (A, P) of the one to the other, and of the other to the one.
        """

    def placement_log_odds(self, candidates: Places, anchors: Places) -> tuple[Floats, Floats]:
        """Relations of absent classes (N,), were they there, to places (m,) in `present.classes`.

        What the observed relations imply for those of a candidate is left out.

        Returns:
            (N, A, m) of the candidate to an anchor, and of the anchor to the candidate.
        """

    def placed_log_p(
        self, candidates: Places, relation: int, anchor: int, *, outgoing: bool
    ) -> Floats:
        """log p(the candidate stands so to the anchor | it is there, evidence), (N,).

        Args:
            relation: canonical; from the candidate to the anchor if `outgoing`, else back.
            anchor: place in `present.classes`.
        """

    def log_odds_given_rest(self) -> Floats:
        """Each present class given the scene without it and its relations, (n,)."""

    def reasons(self, rows: Places) -> Floats:
        """How the log-odds of classes given the rest change by each other class, (N, n).

        With the class, minus without it and its relations; with the context at its mean field on
        both sides. 0 for the class itself.

        Args:
            rows: (N,) places in `present.classes`.
        """

    def reasons_for_absent(self, candidates: Places) -> Floats:
        """How the log-odds of absent classes (N,) change by each class that is there, (N, n).

        With the class, minus without it and its relations; with the context at its mean field on
        both sides.
        """


def relations_given(scene: Scene) -> bool:
    """Whether the scene says anything of how its objects stand to each other."""
    return bool(scene.relations or scene.relations_complete or scene.poses)


def posterior(artifact: Artifact, scene: Scene) -> Posterior:
    """The posterior of a scene: in closed form where there is one.

    Raises:
        ValueError: an object outside the machine's classes, or a room type it does not have.
    """
    closed = artifact.closed_form
    if closed is None:
        return DrawnPosterior(artifact, scene)
    return ClosedPosterior(artifact, closed, scene)
