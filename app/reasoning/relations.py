"""How do these objects stand to each other?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from app.reasoning.answers import RelationAnswer
from app.reasoning.calibration import exclusive, relation_probability, relation_slopes
from app.reasoning.posterior import posterior, relations_given
from app.reasoning.ranking import best
from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL, OPPOSITES
from app.scene.scene import Scene


def relations(
    artifact: Artifact,
    scene: Scene,
    *,
    top_k: int = 20,
    min_probability: float = 0.0,
    pairs: Sequence[tuple[int, int]] | None = None,
    include_opposites: bool = False,
) -> tuple[RelationAnswer, ...]:
    """The likeliest relations between the objects of a scene, best first, ties by position.

    Relations that the scene states are evidence for the others; each is judged without itself.
    Structure (floor, wall) stands in no relation unless `pairs` asks for it.

    Args:
        top_k: at most so many.
        min_probability: leave out what is less likely.
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
    given = posterior(artifact, scene)
    asked = _asked(artifact, scene, pairs)
    if not asked.any():
        return ()
    log_odds = given.relation_log_odds()
    log_counts = np.log(given.present.counts).astype(log_odds.dtype)
    entries = relation_slopes(artifact.calibration, given=relations_given(scene))
    p = relation_probability(entries, log_odds, log_counts[:, None] + log_counts, len(log_counts))
    p, backward = exclusive(p, p.swapaxes(1, 2))
    names = CANONICAL[: len(p)]
    if include_opposites:
        p = np.concatenate([p, backward])
        names = names + tuple(OPPOSITES[name] for name in names)
    row = given.present.row
    # (N, N, relations): the flat order is that of positions, so a stable sort breaks ties by it.
    grid = p[:, row[:, None], row].transpose(1, 2, 0)
    usable = asked[..., None] & (grid >= min_probability)
    where = best(grid.ravel(), usable.ravel(), top_k)
    subject, object_, relation = np.unravel_index(where, grid.shape)
    return tuple(
        RelationAnswer(x, names[a], y, probability)
        for x, y, a, probability in zip(
            subject.tolist(),
            object_.tolist(),
            relation.tolist(),
            grid.ravel()[where].tolist(),
            strict=True,
        )
    )


def _asked(
    artifact: Artifact, scene: Scene, pairs: Sequence[tuple[int, int]] | None
) -> NDArray[np.bool_]:
    """(N, N) which ordered pairs to answer."""
    size = len(scene.objects)
    if pairs is None:
        structure = artifact.vocabulary.structure
        thing = np.array([not structure[entry.class_index] for entry in scene.objects], dtype=bool)
        usable: NDArray[np.bool_] = thing[:, None] & thing & ~np.eye(size, dtype=np.bool_)
        return usable
    asked = np.zeros((size, size), dtype=np.bool_)
    for subject, object_ in pairs:
        if subject == object_ or not (0 <= subject < size and 0 <= object_ < size):
            raise ValueError(f"pair ({subject}, {object_}) must name two of the {size} objects")
        asked[subject, object_] = True
    return asked
