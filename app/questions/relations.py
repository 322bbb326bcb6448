"""How do these objects stand to each other? Which observed relations does the model not expect?

Disagreements: a pair of objects of which some relation holds is judged once more as if nothing were
known of how the two stand: with every relation between their classes unobserved, on or off, in both
directions. Otherwise an observation would be evidence for itself: left holds, so front was seen
not to.
If the likeliest of the eight relations is then none of the observed ones, and likelier than not,
the two disagree.

Units are those of classes. So where classes have several instances, what any pair of these shows
counts as observed: one chair to the left and one to the right of the table are as expected as the
other way round, whichever of the two is likelier.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.questions.posterior import Posterior, Present, posterior, relations_given
from app.questions.ranking import disagreeing, entries, likeliest_relations, observed_pairs
from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL, OPPOSITES, canonicalise
from app.scene.scene import Scene

EXPECTED = 0.5
"""From this probability on a relation is expected: likelier than not.

Of two relations that are both unlikely, the likelier one says little.
"""


class RelationAnswer(NamedTuple):
    """`subject` stands in `relation` to `object`.

    Attributes:
        probability: that the relation holds, given that both are in the scene.
        observed: the scene states it, or its poses show it.
    """

    subject: int
    relation: str
    object: int
    probability: float
    observed: bool = False


class Disagreement(NamedTuple):
    """Two objects that stand otherwise than the rest of the scene makes one expect.

    Attributes:
        subject, object: which two.
        observed: relations of the one to the other that were stated or observed.
        expected: the likeliest relation, judged without all that is known of the pair.
        probability: of it, as that of a `RelationAnswer`.
        observed_probability: of the likeliest observed one.
    """

    subject: int
    object: int
    observed: tuple[str, ...]
    expected: str
    probability: float
    observed_probability: float


def relations(
    artifact: Artifact,
    scene: Scene,
    *,
    top_k: int = 20,
    min_probability: float = 0.0,
    pairs: Sequence[tuple[int, int]] | None = None,
    include_opposites: bool = False,
) -> tuple[tuple[RelationAnswer, ...], tuple[Disagreement, ...]]:
    """The likeliest relations between the objects of a scene, best first, ties by position.

    And the disagreements of the scene, see the module.

    Relations that the scene states are evidence for the others; each is judged without itself.
    Structure (floor, wall) stands in no relation unless `pairs` asks for it.

    Args:
        top_k: at most so many of both.
        min_probability: leave out what is less likely, or expected with less.
        pairs: only answers with this (subject, object), positions in `scene.objects`. The order of
            the two counts: the pair says nothing of how its object stands to its subject, but for
            the opposite relations.
        include_opposites: also spell each answer the other way round: right(y, x) for left(x, y).

    Raises:
        ValueError: top_k below 1, a probability outside [0, 1], or a pair that is not two objects.
    """
    if top_k < 1:
        raise ValueError(f"top_k must be at least 1, not {top_k}")
    if not 0 <= min_probability <= 1:
        raise ValueError(f"min_probability must be in [0, 1], not {min_probability}")
    if not scene.objects:
        return (), ()
    given = posterior(artifact, scene)
    present, slopes = given.present, artifact.relation_slopes
    asked = _asked(artifact, present, pairs)
    found = likeliest_relations(
        slopes.given if relations_given(scene) else slopes.alone,
        *(given.relation_log_odds(), present.log_counts, present.row, asked),
        *(min_probability, include_opposites, top_k),
    )
    # Relation A + a is a the other way round.
    names = CANONICAL[: artifact.spec.A]
    names += tuple([OPPOSITES[name] for name in names])
    subjects, objects, kinds, probabilities = (values.tolist() for values in found)
    kinds = [names[kind] for kind in kinds]
    stated = set(scene.relations or ())
    observed = (
        [
            canonicalise(subject, kind, object_) in stated
            for subject, kind, object_ in zip(subjects, kinds, objects, strict=True)
        ]
        if stated
        else [False] * len(kinds)
    )
    answers = entries(RelationAnswer, subjects, kinds, objects, probabilities, observed)
    return tuple(answers), _disagreements(
        artifact, scene, given, asked, top_k=top_k, min_probability=min_probability
    )


def _asked(
    artifact: Artifact, present: Present, pairs: Sequence[tuple[int, int]] | None
) -> NDArray[np.bool_]:
    """(N, N) which ordered pairs to answer."""
    size = len(present.row)
    if pairs is None:
        things = ~artifact.vocabulary.structure[present.classes][present.row]
        return things[:, None] & things & ~np.eye(size, dtype=np.bool_)
    asked = np.zeros((size, size), dtype=np.bool_)
    for subject, object_ in pairs:
        if subject == object_ or not (0 <= subject < size and 0 <= object_ < size):
            raise ValueError(f"pair ({subject}, {object_}) must name two of the {size} objects")
        asked[subject, object_] = True
    return asked


def _disagreements(
    artifact: Artifact,
    scene: Scene,
    given: Posterior,
    asked: NDArray[np.bool_],
    *,
    top_k: int,
    min_probability: float,
) -> tuple[Disagreement, ...]:
    """The pairs of which another relation than any observed one is expected, largest ratio first.

    Ties go by position. Each is spelled from the subject of its first observed relation, in the
    order of `CANONICAL`. A relation that the machine has no unit for is never expected.

    Args:
        given: the posterior of the scene.
        asked: (N, N) ordered pairs; a pair asked either way counts.
        top_k: at most so many.
        min_probability: relations of a lower probability are left out.
    """
    A = artifact.spec.A
    stated = [triple for triple in scene.relations or () if triple[0] < A]
    if not stated:
        return ()
    present = given.present
    subjects, objects, holds, of_classes = observed_pairs(
        np.array(stated), present.row, asked, len(present.classes), A
    )
    if not len(subjects):
        return ()
    one, other = present.row[subjects], present.row[objects]
    where, *found = disagreeing(
        *(artifact.relation_slopes.given, *given.log_odds_apart(one, other)),
        *(present.log_counts[one] + present.log_counts[other], len(present.classes)),
        *(holds, of_classes, max(min_probability, EXPECTED), top_k),
    )
    pairs = subjects[where], objects[where], holds[where]
    names = CANONICAL[:A] + tuple(OPPOSITES[name] for name in CANONICAL[:A])
    return tuple(
        [
            Disagreement(
                subject,
                object_,
                tuple([name for bit, name in enumerate(names) if held >> bit & 1]),
                names[expected],
                probability,
                observed,
            )
            for subject, object_, held, expected, probability, observed in zip(
                *(values.tolist() for values in (*pairs, *found)), strict=True
            )
        ]
    )
