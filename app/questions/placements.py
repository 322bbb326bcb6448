"""Likely places of missing objects: their relations to listed objects, and their offsets.

A placement is a relation between a candidate, a class that may be missing, and a listed object,
called the anchor. An offset is the distance vector between the centres of both.
"""

from collections.abc import Iterator
from itertools import repeat
from typing import Any, Final, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference.elementary import NO_UNIT
from app.model.scene_model import SceneModel
from app.model.statistics import UNOBSERVED, offsets_of_missing, rotated
from app.questions.answer import Fields, best, significant
from app.questions.posterior import Posterior, exclusive, relation_probability
from app.questions.spots import move_to_free_spots
from app.scene.scene import Scene, boxes_of
from app.scene.spatial_relations import (
    ABOVE,
    INSIDE,
    ON_TOP,
    RELATIONS,
    SUPPORTS,
    canonicalise,
    opposite,
)
from app.scene.vocabulary import do_not_fit
from scene_client.frames import Axes

Indices = NDArray[np.int64]

PLACES: Final = 3  # maximum number of placements in the answer for one class

LEAST_SHARE: Final = 0.75  # least probability of a placement, as a share of the first placement
LEAST_LIKELY: Final = 0.05  # least probability of a placement
LEAST_OF_EVERY: Final = 0.01  # least probability of a placement of `every_placement`
_SEEN_FROM_ANCHORS: Final = tuple(map(opposite, RELATIONS))


class Place(NamedTuple):
    """A place in canonical form."""

    relation: int  # canonical
    anchor: int  # index in `Scene.objects`
    outgoing: bool  # whether the missing object is the subject, and not the anchor

    @classmethod
    def of(cls, name: str, anchor: int) -> Self:
        """Return the place with the relation ``name`` from the missing object to the anchor."""
        relation, subject, _ = canonicalise("missing", name, "anchor")
        return cls(relation, anchor, subject == "missing")


def place_log_p(
    posterior: Posterior, candidates: Int[Indices, "N"], place: Place
) -> Float[NDArray[np.floating[Any]], "N"]:
    """Return log p(relation to the anchor | candidate is present), not calibrated."""
    anchor = posterior.present.row[[place.anchor]]
    forward, backward = posterior.units.placement_log_odds(
        posterior.context, candidates, anchor, place.relation
    )
    log_odds = (forward if place.outgoing else backward)[:, 0, 0]
    return -np.logaddexp(np.float32(0.0), -log_odds)


def placements(
    model: SceneModel,
    posterior: Posterior,
    scene: Scene,
    candidates: Int[Indices, "N"],  # absent classes
    axes: Axes,  # see `viewer_axes`
    at: Place | None = None,  # the requested place, which comes first in each result
    *,
    has_viewer: bool = True,  # whether the viewing direction is known
    every: bool = False,  # all places on, in and under objects: see `every_placement`
) -> list[list[Fields]]:
    """Return the likeliest relations of each candidate to the listed objects, likeliest first.

    The candidate is subject or object of the relation. Structural classes (floor, wall) are never
    anchors. If a class has several instances, the first instance is the anchor. If an object stands
    on or in another object, no candidate holds it. A further place has at least `LEAST_SHARE` of
    the probability of the first place. Without a place of probability `LEAST_LIKELY`, the list is
    empty. An offset needs an anchor with a position. `scene_client.schemas.Placement` defines the
    fields.
    """
    present = posterior.present
    anchors = (~model.vocabulary.structure[present.classes]).nonzero()[0]
    if not len(anchors):
        return [[] for _ in candidates]
    forward, backward = posterior.units.placement_log_odds(posterior.context, candidates, anchors)
    A, objects, stand_in = forward.shape[1], present.first[anchors], model.vocabulary.stand_in
    classes, candidates = stand_in[present.classes[anchors]], stand_in[candidates]
    first = -1  # number of the requested place in `_likeliest_places`; -1 without a request
    if A > ON_TOP and scene.triples:
        supported = supported_objects(model, posterior, scene)
        columns = [k for k, number in enumerate(objects.tolist()) if number in supported]
        for a in SUPPORTS:
            if a < A:
                backward[:, a, columns] = NO_UNIT
    if at is not None:
        # If the anchor is structural, no column matches it.
        for column in (anchors == present.row[at.anchor]).nonzero()[0].tolist():
            first = ((0 if at.outgoing else A) + at.relation) * len(anchors) + column
            objects[column] = at.anchor
    things = [scene.objects[number] for number in objects.tolist()]
    sizes = model.vocabulary.sizes
    has_sizes = any(thing.size is not None for thing in scene.objects)
    boxes = boxes_of(scene.objects, sizes) if has_sizes else None
    of_things = sizes[classes] if boxes is None else boxes[1][objects]
    smaller = _smaller_anchors(sizes[candidates], of_things)
    for a in range(ON_TOP, A):
        backward[:, a][smaller] = NO_UNIT
        if a != ABOVE:
            forward[:, a][smaller] = NO_UNIT
    if A > INSIDE:
        candidates_too_large, things_too_large = do_not_fit(sizes[candidates], of_things)
        forward[:, INSIDE][candidates_too_large] = NO_UNIT
        backward[:, INSIDE][things_too_large] = NO_UNIT
    limits = PLACES, first, LEAST_SHARE, LEAST_LIKELY
    if every:
        limits = 2 * A * len(anchors), first, 0.0, LEAST_OF_EVERY
        for a in range(A):
            if a not in SUPPORTS:
                forward[:, a] = NO_UNIT
            if a != ON_TOP:
                backward[:, a] = NO_UNIT
    slopes, log_counts = model.relation_slopes.placement, present.log_counts[anchors]
    rows, relations, outgoing, columns, p = _likeliest_places(
        slopes, forward, backward, log_counts, *limits
    )
    offsets: Iterator[Fields | None] = repeat(None)
    if model.offsets is not None and any(thing.position is not None for thing in things):
        places = relations, candidates[rows]
        mean, std, scenes = offsets_of_missing(
            model.offsets.tables, *places, classes[columns], outgoing, has_viewer
        )
        if boxes is not None:
            anchors = objects[columns]
            move_to_free_spots(
                model, scene, present, boxes, *places, outgoing, anchors, mean, std, scenes
            )
        mean, std = rotated(mean, std, np.array(axes))
        offsets = _offset_fields(mean, std, scenes)
    entries: list[list[Fields]] = [[] for _ in candidates]
    arrays = rows.tolist(), relations.tolist(), outgoing.tolist(), columns.tolist()
    for row, relation, is_subject, column, probability, offset in zip(
        *arrays, significant(p), offsets, strict=False
    ):
        thing = things[column]
        name = (RELATIONS if is_subject else _SEEN_FROM_ANCHORS)[relation]
        entry: Fields = {"relation": name, "object": thing.id, "probability": probability}
        if offset is not None and thing.position is not None:
            entry["offset"] = offset
        entries[row].append(entry)
    return entries


def every_placement(
    model: SceneModel,
    posterior: Posterior,
    scene: Scene,
    candidate: int,
    axes: Axes,
    *,
    has_viewer: bool = True,
) -> list[tuple[float, list[Fields]]]:
    """Return all places of an absent class on, in and under classes, likeliest first.

    Each place has its probability, at least `LEAST_OF_EVERY`, and the fields of the place at each
    object of the class. Only the first object has an offset.
    """
    present, found = posterior.present, list[tuple[float, list[Fields]]]()
    names = {scene.objects[k].id: row for row, k in enumerate(present.first.tolist())}
    (places,) = placements(
        model, posterior, scene, np.array([candidate]), axes, has_viewer=has_viewer, every=True
    )
    for place in places:
        row, p = names[place["object"]], place.pop("probability")
        others = [scene.objects[k].id for k in np.flatnonzero(present.row == row).tolist()]
        others.remove(place["object"])
        found.append((p, [place, *({"relation": place["relation"], "object": x} for x in others)]))
    return found


def _smaller_anchors(
    sizes: Float[NDArray[np.float64], "N 3"], anchors: Float[NDArray[np.float64], "m 3"]
) -> Bool[NDArray[np.bool_], "N m"]:
    """Return which of m anchors have a smaller footprint than which of N candidates.

    Nobody looks for a bed under a teddy bear, so a smaller anchor has no stacked placement.
    """
    # A comparison with NaN is False.
    smaller: Bool[NDArray[np.bool_], "N m"] = anchors[:, :2].prod(1) < sizes[:, :2].prod(1)[:, None]
    return smaller


def supported_objects(model: SceneModel, posterior: Posterior, scene: Scene) -> list[int]:
    """Return indices of objects on or in an object. A desk "on top of" a bin is on the floor."""
    places = model.places
    present = posterior.present
    classes = model.vocabulary.stand_in[present.classes][present.row].tolist()
    return [
        i
        for a, i, j in scene.triples
        if a == INSIDE
        or (a == ON_TOP and not (places and places.means_under(classes[i], classes[j])))
    ]


def _offset_fields(
    mean: Float[NDArray[np.float64], "n 3"],
    std: Float[NDArray[np.float64], "n 3"],
    scenes: Int[Indices, "n"],
) -> Iterator[Fields | None]:
    """Yield the fields of `scene_client.schemas.Offset`, or None for an unknown offset."""
    numbers = significant(np.concatenate([mean, std], axis=1).reshape(-1))
    for row, count in enumerate(scenes.tolist()):
        x, y, z, std_x, std_y, std_z = numbers[6 * row : 6 * row + 6]
        offset = {
            "mean": {"x": x, "y": y, "z": z},
            "std": {"x": std_x, "y": std_y, "z": std_z},
            "scenes": count,
        }
        yield None if count == UNOBSERVED else offset


@compiled
def _likeliest_places(
    slopes: Float[NDArray, "A 3"],  # table of `RelationSlopes`
    forward: Float[NDArray, "N A m"],  # log-odds of relations from candidates to anchors
    backward: Float[NDArray, "N A m"],  # log-odds of relations from anchors to candidates
    log_counts: Float[NDArray, " m"],  # of the instances of each anchor's class
    count: int,  # maximum number of places of a candidate
    first: int,  # number of a place that comes first at any probability, or -1
    share: float,  # minimum probability, as a share of the candidate's first place
    least: float,  # minimum probability
) -> tuple[
    Int[NDArray, " k"], Int[NDArray, " k"], Bool[NDArray, " k"], Int[NDArray, " k"],
    Float[NDArray, " k"],
]:  # fmt: skip
    """Return the likeliest places of each of N candidate classes, likeliest first.

    A place is a relation a to an anchor j, which is a class of the scene. The number of the place
    is (d A + a) m + j. The candidate is the relation's subject if d = 0, and the anchor is the
    subject if d = 1. The results are the candidate, in ascending order, the relation, True if the
    candidate is the subject, the anchor, and the probability.
    """
    N, A, m = forward.shape
    size = A * m
    to = relation_probability(slopes, forward, log_counts)
    back = relation_probability(slopes, backward, log_counts)
    p, usable = np.empty(2 * size, forward.dtype), np.ones(2 * size, np.bool_)
    most, begin, end = min(count, 2 * size), 0, 0
    if first >= 0:
        usable[first], begin = False, 1
    candidate, relation = np.empty(N * most, np.int64), np.empty(N * most, np.int64)
    outgoing, anchor = np.empty(N * most, np.bool_), np.empty(N * most, np.int64)
    probabilities = np.empty(N * most, np.float64)
    for c in range(N):
        p_to, p_back = to[c].reshape(-1), back[c].reshape(-1)
        for e in range(size):
            p[e], p[size + e] = exclusive(p_to[e], p_back[e])
        indices = best(p, usable, most - begin)
        enough = max(share * p[first if begin else indices[0]], least)
        for k in range(most):
            place = first if k < begin else indices[k - begin]
            if k < begin or p[place] >= enough:
                candidate[end], relation[end], anchor[end] = c, place // m % A, place % m
                outgoing[end], probabilities[end] = place < size, p[place]
                end += 1
    return candidate[:end], relation[:end], outgoing[:end], anchor[:end], probabilities[:end]
