"""Where an absent object would stand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.reasoning.answers import Placement
from app.reasoning.listing import likeliest_places
from app.reasoning.posterior import Posterior
from app.registry.artifact import Artifact
from app.scene.relations import RELATIONS, opposite

PLACES = 3
"""How many placements an answer lists."""

_SEEN_FROM_ANCHORS = tuple(map(opposite, RELATIONS))


def placements(
    artifact: Artifact, given: Posterior, candidates: NDArray[np.int64]
) -> list[tuple[Placement, ...]]:
    """The likeliest relations of each candidate to what is present, best first.

    All relations in both directions, to all but structure; instances of a class are spoken of by
    the first.

    Args:
        candidates: (N,) absent classes.
    """
    present = given.present
    anchors = np.flatnonzero(~artifact.vocabulary.structure[present.classes])
    if not len(anchors):
        return [()] * len(candidates)
    forward, backward = given.placement_log_odds(candidates, anchors)
    A = forward.shape[1]
    places, probabilities = likeliest_places(
        *(artifact.relation_slopes.placement, forward, backward, present.log_counts[anchors]),
        *(len(present.classes) + 1, PLACES),
    )
    first = present.first[anchors].tolist()
    names = RELATIONS[:A] + _SEEN_FROM_ANCHORS[:A]
    return [
        tuple(
            [
                Placement(names[place // len(first)], first[place % len(first)], probability)
                for place, probability in zip(some, values, strict=True)
            ]
        )
        for some, values in zip(places.tolist(), probabilities.tolist(), strict=True)
    ]
