"""The question `relations`: which relations hold between objects, and which are unexpected?

Disagreements: each pair of objects with an observed relation is judged a second time, with all
relations between their two classes unobserved, in both directions. Otherwise an observation would
be evidence for itself: if left is observed, front is observed to be off. The pair is a disagreement
if the likeliest of the eight relations is unobserved and has a probability of at least `EXPECTED`.

The model has relation units between classes. If a class has several instances, a relation of any
instance counts as observed. Example: one chair is to the left of the table, and another one to the
right. Then both left and right count as observed for each chair.
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
"""Smallest probability of an expected relation.

If all relations of a pair are unlikely, the likeliest one is a weak expectation.
"""


class RelationAnswer(NamedTuple):
    """`relation` from `subject` to `object`, which are positions in the scene.

    Attributes:
        probability: probability that the relation holds, given that both objects are present.
        observed: whether the relation was stated or derived from poses.
    """

    subject: int
    relation: str
    object: int
    probability: float
    observed: bool = False


class Disagreement(NamedTuple):
    """Two objects with another relation than the rest of the scene suggests, see the module.

    Attributes:
        subject, object: positions in the scene.
        observed: observed relations from subject to object.
        expected: the likeliest relation, judged without the observed relations of the pair.
        probability: probability of `expected`.
        observed_probability: probability of the likeliest observed relation.
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
    """The likeliest relations between the objects of a scene, and its disagreements.

    Observed relations are evidence for other relations. Each relation is judged as if it were
    unobserved itself. Structure (floor, wall) is left out unless `pairs` contains it.

    Args:
        top_k: maximum number of relations, and of disagreements.
        min_probability: smallest probability of a relation, and of a disagreement's `expected`.
        pairs: ordered pairs (subject, object) to answer, as positions in `scene.objects`.
        include_opposites: also list opposite relations, such as right(y, x) for left(x, y).

    Returns:
        The relations, likeliest first. The disagreements, ordered by the ratio of `probability` to
        `observed_probability`, largest first. Ties are ordered by position.

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
    # Relation A + a is the opposite of relation a.
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
    """The requested ordered pairs of objects, as a mask (N, N)."""
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
    """The disagreements of a scene, largest probability ratio first, ties by position.

    The subject of a disagreement is the subject of its first observed relation, in the order of
    `CANONICAL`. Relations without a unit in the machine are never expected.

    Args:
        given: the posterior of the scene.
        asked: (N, N) bool, the ordered pairs to answer; a pair counts in either order.
        top_k: maximum number of disagreements.
        min_probability: smallest probability of an expected relation.
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
