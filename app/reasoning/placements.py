"""Where an absent object would stand."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.inference.relation_kernels import NO_UNIT
from app.reasoning.answers import Offset, Placement, entries
from app.reasoning.calibration import placement_log_p
from app.reasoning.listing import likeliest_places
from app.reasoning.offsets import offsets_of
from app.reasoning.posterior import Posterior
from app.registry.artifact import Artifact
from app.scene.frames import Axes
from app.scene.relations import ON_TOP, RELATIONS, opposite

PLACES = 3
"""How many placements an answer lists."""

_SEEN_FROM_ANCHORS = tuple(map(opposite, RELATIONS))


def place_log_p(
    artifact: Artifact,
    given: Posterior,
    candidates: NDArray[np.int64],
    relation: int,
    anchor: int,
    *,
    outgoing: bool,
) -> NDArray[np.floating[Any]]:
    """Calibrated log p(the candidate stands so to the anchor | it is there), (N,).

    Args:
        candidates: (N,) absent classes.
        relation: canonical; from the candidate to the anchor if `outgoing`, else back.
        anchor: place in the classes that are present.
    """
    return placement_log_p(
        artifact.relation_slopes.asked_place[relation],
        given.placed_log_p(candidates, relation, anchor, outgoing=outgoing),
        *(float(given.present.log_counts[anchor]), len(given.present.classes) + 1),
    )


def placements(
    artifact: Artifact,
    given: Posterior,
    candidates: NDArray[np.int64],
    axes: Axes | None,
    at: tuple[int, int, bool] | None = None,
    stated: Collection[tuple[int, int, int]] = (),
) -> list[tuple[Placement, ...]]:
    """The likeliest relations of each candidate to what is present, best first.

    All relations in both directions, to all but structure; instances of a class are spoken of by
    the first. No placement puts a candidate under an object that stands on another.

    Args:
        candidates: (N,) absent classes.
        axes: what offsets are answered in, see `offsets_of`.
        at: canonical relation, object, and whether the missing thing is its subject: the place that
            was asked about comes first, spoken of by that object. Structure is no place of its own.
        stated: canonical relations between the objects of the scene.
    """
    present = given.present
    anchors = np.flatnonzero(~artifact.vocabulary.structure[present.classes])
    if not len(anchors):
        return [()] * len(candidates)
    forward, backward = given.placement_log_odds(candidates, anchors)
    A, first, asked = forward.shape[1], present.first[anchors].tolist(), -1
    if A > ON_TOP and stated:
        standing = {subject for relation, subject, _ in stated if relation == ON_TOP}
        backward[:, ON_TOP, [thing in standing for thing in first]] = NO_UNIT
    asked_p: NDArray[np.floating[Any]] | None = None
    if at is not None:
        relation, object_, to_it = at
        (found,) = np.nonzero(anchors == present.row[object_])
        if len(found):
            asked = ((0 if to_it else A) + relation) * len(first) + int(found[0])
            row = int(anchors[found[0]])
            asked_p = np.exp(
                place_log_p(artifact, given, candidates, relation, row, outgoing=to_it)
            )
            first[found[0]] = object_
    which, relations, outgoing, anchor, probabilities = likeliest_places(
        *(artifact.relation_slopes.placement, forward, backward, present.log_counts[anchors]),
        *(len(present.classes) + 1, PLACES, asked),
    )
    if asked_p is not None:
        probabilities[:: len(which) // len(candidates)] = asked_p
    offsets: Sequence[Offset | None] = [None] * len(which)
    if artifact.offsets is not None:
        ends = candidates[which], present.classes[anchors[anchor]]
        offsets = offsets_of(artifact.offsets, relations, *ends, outgoing, axes)
    named = zip(relations.tolist(), outgoing.tolist(), strict=True)
    listed = entries(
        Placement,
        [(RELATIONS if out else _SEEN_FROM_ANCHORS)[number] for number, out in named],
        [first[number] for number in anchor.tolist()],
        probabilities.tolist(),
        offsets,
    )
    each = len(listed) // len(candidates)
    return [tuple(listed[k : k + each]) for k in range(0, len(listed), each)]
