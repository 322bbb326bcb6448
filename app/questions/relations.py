"""The question `relations`: which relations hold between objects, and which are unexpected?

A disagreement is a pair of objects whose observed relation is not the relation that the rest of the
scene suggests. To find disagreements, the module judges each pair with an observed relation a
second time. It then treats all relations between the two classes as unobserved, in both directions.
Otherwise an observation would be evidence for itself: if left is observed, the model also knows
that front does not hold. The pair is a disagreement if the likeliest of the eight relations is
unobserved and has a probability of at least `EXPECTED`.

The model has relation units between classes. If a class has several instances, a relation of any
instance counts as observed for all instances. Example: one chair is to the left of the table, and
another chair is to the right. Then left and right both count as observed for each chair.
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
"""Minimum probability of the expected relation of a disagreement.

If all relations of a pair are unlikely, the likeliest relation is not a meaningful expectation.
"""


class RelationAnswer(NamedTuple):
    """A relation between two objects and its probability.

    Attributes:
        subject, object: indices in `Scene.objects`.
        relation: name of the relation from subject to object.
        probability: probability that the relation holds, given that both objects are present.
        observed: True if the request states the relation, or if poses imply it.
    """

    subject: int
    relation: str
    object: int
    probability: float
    observed: bool = False


class Disagreement(NamedTuple):
    """A pair of objects whose observed relation the rest of the scene does not suggest.

    Attributes:
        subject, object: indices in `Scene.objects`.
        observed: names of the observed relations from subject to object.
        expected: name of the likeliest relation, without the observed relations of the pair as
            evidence.
        probability: probability of the relation `expected`.
        observed_probability: probability of the likeliest observed relation of the pair.
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
    """Return the likeliest relations between the objects of a scene, and its disagreements.

    Observed relations are evidence for other relations, but an observed relation is not evidence
    for itself. Structural classes (floor, wall) are left out unless `pairs` contains them.

    Args:
        artifact: the model.
        scene: the objects, their observed relations and the room type.
        top_k: maximum number of relations in the answer. The same limit applies to disagreements.
        min_probability: minimum probability of a relation in the answer. The same limit applies to
            the expected relation of a disagreement.
        pairs: ordered pairs (subject, object) to judge, as indices in `scene.objects`. None means
            all pairs.
        include_opposites: whether the answer also lists opposite relations, such as right(y, x) for
            left(x, y).

    Returns:
        The relations, likeliest first. Then the disagreements, with the largest ratio of
        `probability` to `observed_probability` first. Entries with equal values are ordered by
        their indices.

    Raises:
        ValueError: top_k is below 1, the probability is outside [0, 1], or a pair does not consist
            of two different objects of the scene.
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
    """Return a bool mask (N subjects, N objects) of the ordered pairs to judge."""
    size = len(present.row)
    if pairs is None:
        things = ~artifact.vocabulary.structure[present.classes][present.row]
        return things[:, None] & things & ~np.eye(size, dtype=np.bool_)
    asked = np.zeros((size, size), dtype=np.bool_)
    for subject, object_ in pairs:
        if subject == object_ or not (0 <= subject < size and 0 <= object_ < size):
            raise ValueError(
                f"pair ({subject}, {object_}) must have the indices of two different objects; the "
                f"scene has {size} objects"
            )
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
    """Return the disagreements of a scene.

    Disagreements with the largest ratio of `probability` to `observed_probability` come first. If a
    pair has several observed relations, the first of them in `CANONICAL` defines the subject of the
    disagreement. A relation is never expected if the machine has no unit for it. ``asked`` is
    (N, N) bool. The function judges a pair of objects if one of its two orders is True.
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
