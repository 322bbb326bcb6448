"""How do these objects stand to each other?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from app.reasoning.answers import Disagreement, RelationAnswer, entries
from app.reasoning.disagreements import disagreements
from app.reasoning.listing import likeliest_relations, pairs_of_things
from app.reasoning.posterior import posterior, relations_given
from app.reasoning.present import Present
from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL, OPPOSITES, canonicalise
from app.scene.scene import Scene


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

    And where they were observed to stand otherwise than the rest of the scene makes one expect: see
    `disagreements`.

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
    log_odds = given.relation_log_odds()
    found = likeliest_relations(
        slopes.given if relations_given(scene) else slopes.alone,
        *(log_odds, present.log_counts, present.row, asked),
        *(min_probability, include_opposites, top_k),
    )
    names = CANONICAL[: len(log_odds)]
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
    return tuple(answers), disagreements(
        artifact, scene, given, asked, top_k=top_k, min_probability=min_probability
    )


def _asked(
    artifact: Artifact, present: Present, pairs: Sequence[tuple[int, int]] | None
) -> NDArray[np.bool_]:
    """(N, N) which ordered pairs to answer."""
    asked: NDArray[np.bool_]
    if pairs is None:
        structure = artifact.vocabulary.structure
        asked = pairs_of_things(structure, present.classes, present.row)
        return asked
    size = len(present.row)
    asked = np.zeros((size, size), dtype=np.bool_)
    for subject, object_ in pairs:
        if subject == object_ or not (0 <= subject < size and 0 <= object_ < size):
            raise ValueError(f"pair ({subject}, {object_}) must name two of the {size} objects")
        asked[subject, object_] = True
    return asked
