"""Where an absent object would stand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.reasoning.answers import Placement
from app.reasoning.calibration import exclusive, relation_probability
from app.reasoning.posterior import Posterior
from app.registry.description import PairSlope
from app.scene.relations import RELATIONS, opposite

PLACES = 3
"""How many placements an answer lists."""


def placements(
    given: Posterior,
    candidates: NDArray[np.int64],
    structure: NDArray[np.bool_],
    entries: tuple[PairSlope, ...],
) -> list[tuple[Placement, ...]]:
    """The likeliest relations of each candidate to what is present, best first.

    All relations in both directions, to all but structure; instances of a class are spoken of by
    the first.

    Args:
        candidates: (N,) absent classes.
        structure: (V,).
        entries: calibration of the relations.
    """
    present = given.present
    anchors = np.flatnonzero(~structure[present.classes])
    if not len(anchors):
        return [()] * len(candidates)
    forward, backward = given.placement_log_odds(candidates, anchors)
    relations = forward.shape[1]
    log_counts = np.log(present.counts[anchors]).astype(forward.dtype)[None]
    classes = len(present.classes) + 1
    both = exclusive(
        # One instance of the candidate: (N, A, 1, m).
        relation_probability(entries, forward[:, :, None], log_counts, classes),
        relation_probability(entries, backward[:, :, None], log_counts, classes),
    )
    p = np.concatenate(both, axis=1).reshape(len(candidates), -1)
    index = np.argsort(-p, axis=1, kind="stable")[:, :PLACES]
    names = RELATIONS[:relations]
    names = names + tuple(map(opposite, names))
    first = present.first[anchors].tolist()
    return [
        tuple(
            Placement(names[place // len(first)], first[place % len(first)], probability)
            for place, probability in zip(places, probabilities, strict=True)
        )
        for places, probabilities in zip(
            index.tolist(), np.take_along_axis(p, index, axis=1).tolist(), strict=True
        )
    ]
