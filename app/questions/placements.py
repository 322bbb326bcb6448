"""Likely places of missing objects: their relations to listed objects, and their offsets.

A placement is a relation between a candidate, a class that may be missing, and a listed object,
called the anchor. An offset is the distance vector between the centres of both.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference.relations import NO_UNIT
from app.questions.answer import Fields, significant
from app.questions.posterior import Posterior, placement_log_p
from app.questions.ranking import likeliest_places
from app.registry.artifact import Artifact
from app.registry.offsets import UNOBSERVED, Offsets, look_up
from app.scene.geometry import Axes
from app.scene.relations import CANONICAL, FRONT, LEFT, ON_TOP, RELATIONS, canonicalise, opposite
from app.scene.scene import Scene

PLACES: Final = 3
"""Maximum number of placements in the answer for one class."""

LEAST_SHARE: Final = 0.75  # least probability of a placement, as a share of the first placement
_SEEN_FROM_ANCHORS: Final = tuple(map(opposite, RELATIONS))
_UNTURNED: Final = np.eye(3)
_PER_METRE: Final = 1000.0  # offsets are rounded to millimetres


class Place(NamedTuple):
    """A place in canonical form.

    Attributes:
        relation: index of a canonical relation.
        anchor: index of the anchor in `Scene.objects`.
        outgoing: True if the missing object is the relation's subject, False if the anchor is.
    """

    relation: int
    anchor: int
    outgoing: bool

    @classmethod
    def of(cls, scene: Scene, relations: int, name: str, anchor: int) -> Place:
        """Return the place with the relation ``name`` from the missing object to the anchor.

        Args:
            scene: the listed objects.
            relations: number of canonical relations that the model knows.
            name: name of the relation.
            anchor: index of the anchor.

        Raises:
            ValueError: the model does not know the relation, or the anchor is outside the scene.
        """
        if not 0 <= anchor < len(scene.objects):
            raise ValueError(
                f"anchor {anchor} is not the index of one of the {len(scene.objects)} objects"
            )
        relation, subject, _ = canonicalise("missing", name, "anchor")
        if relation >= relations:
            raise ValueError(
                f"the model does not know the relation {name!r}; it knows only "
                f"{CANONICAL[:relations]} and their opposites"
            )
        return cls(relation, anchor, subject == "missing")


def place_log_p(
    artifact: Artifact, posterior: Posterior, candidates: NDArray[np.int64], place: Place
) -> NDArray[np.floating[Any]]:
    """Return the calibrated log p(relation to the anchor | candidate is present), (N,)."""
    relation, anchor, outgoing = place
    present = posterior.present
    row = int(present.row[anchor])
    return placement_log_p(
        artifact.relation_slopes.asked_place[relation],
        posterior.placed_log_p(candidates, relation, row, outgoing=outgoing),
        *(float(present.log_counts[row]), len(present.classes) + 1),
    )


def placements(
    artifact: Artifact,
    posterior: Posterior,
    scene: Scene,
    candidates: NDArray[np.int64],
    axes: Axes | None,
    at: Place | None = None,
) -> list[list[Fields]]:
    """Return the likeliest relations of each candidate to the listed objects, likeliest first.

    The candidate is subject or object of the relation. Structural classes (floor, wall) are never
    anchors. If a class has several instances, the first instance is the anchor. If an object stands
    on top of another object, candidates are never placed under the upper object. A further place
    has at least `LEAST_SHARE` of the probability of the first place. An offset needs an anchor
    with a position.

    Args:
        artifact: the model.
        posterior: posterior of the scene.
        scene: the scene.
        candidates: (N,) indices of absent classes.
        axes: viewer's axes, or None; see `offsets_of`.
        at: the place in the request, or None. It comes first in each result,
            even if other places are likelier.

    Returns:
        For each candidate, the fields of `scene_client.schemas.Placement`.
    """
    present = posterior.present
    anchors = np.flatnonzero(~artifact.vocabulary.structure[present.classes])
    if not len(anchors):
        return [[] for _ in candidates]
    forward, backward = posterior.placement_log_odds(candidates, anchors)
    A, objects, first = forward.shape[1], present.first[anchors], -1
    if A > ON_TOP and scene.relations:
        upper = [subject for relation, subject, _ in scene.relations if relation == ON_TOP]
        backward[:, ON_TOP, np.isin(objects, upper)] = NO_UNIT
    if at is not None:
        relation, anchor, to_anchor = at
        for column in np.flatnonzero(anchors == present.row[anchor]).tolist():
            first = ((0 if to_anchor else A) + relation) * len(anchors) + column
            objects[column] = anchor
    which, relations, outgoing, columns, p = likeliest_places(
        *(artifact.relation_slopes.placement, forward, backward, present.log_counts[anchors]),
        *(len(present.classes) + 1, PLACES, first),
    )
    each = len(which) // len(candidates)
    if first >= 0 and at is not None:
        p[::each] = np.exp(place_log_p(artifact, posterior, candidates, at))
    likely = np.flatnonzero(p >= LEAST_SHARE * np.repeat(p[::each], each))
    which, relations, outgoing, columns = (
        values[likely] for values in (which, relations, outgoing, columns)
    )
    numbers, objects = objects[columns].tolist(), objects[columns]
    offsets: Iterator[Fields | None] = iter([None] * len(likely))
    if artifact.offsets is not None and any(
        scene.objects[number].position is not None for number in numbers
    ):
        ends = candidates[which], present.classes[anchors[columns]]
        offsets = _offset_fields(*offsets_of(artifact.offsets, relations, *ends, outgoing, axes))
    listed: list[list[Fields]] = [[] for _ in candidates]
    for one, relation, out, number, probability, offset in zip(
        *(which.tolist(), relations.tolist(), outgoing.tolist(), numbers),
        *(significant(p[likely]), offsets),
        strict=True,
    ):
        thing = scene.objects[number]
        name = (RELATIONS if out else _SEEN_FROM_ANCHORS)[relation]
        entry: Fields = {"relation": name, "object": thing.id, "probability": probability}
        if offset is not None and thing.position is not None:
            entry["offset"] = offset
        listed[one].append(entry)
    return listed


def _offset_fields(
    mean: NDArray[np.float64], std: NDArray[np.float64], scenes: NDArray[np.int64]
) -> Iterator[Fields | None]:
    """Yield the fields of `scene_client.schemas.Offset`, or None for an unknown offset."""
    numbers = iter(significant(np.concatenate([mean, std], axis=1).reshape(-1)))
    for count, *vectors in zip(scenes.tolist(), *[numbers] * 6, strict=True):
        x, y, z, dx, dy, dz = vectors
        yield (
            None
            if count == UNOBSERVED
            else {
                "mean": {"x": x, "y": y, "z": z},
                "std": {"x": dx, "y": dy, "z": dz},
                "scenes": count,
            }
        )


def offsets_of(
    offsets: Offsets,
    relation: NDArray[np.int64],
    missing: NDArray[np.int64],
    anchor: NDArray[np.int64],
    outgoing: NDArray[np.bool_],
    axes: Axes | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Return the offset from each of n anchors to its missing object, in metres.

    Args:
        offsets: offsets of the model.
        relation: (n,) indices of canonical relations.
        missing: (n,) class indices of the missing objects.
        anchor: (n,) class indices of the anchors.
        outgoing: (n,) bool, True if the missing object is the relation's subject.
        axes: viewer's axes in the frame of the offsets. None means that the viewing direction is
            unknown. The relations left and front then have no offset. The means of other offsets
            are then vertical.

    Returns:
        Mean (n, 3) and standard deviation (n, 3) along x, y and z. Then the number of training
        scenes that contain the two classes in this relation, (n,). It is `UNOBSERVED` for an
        unknown offset.
    """
    ends = (relation, missing, anchor, outgoing)
    turn = _UNTURNED if axes is None else np.array(axes)
    mean, std, scenes = _lay(offsets.tables, *ends, turn, axes is not None)
    return mean, std, scenes


@compiled
def _lay(
    tables: tuple[NDArray[Any], ...],
    relation: NDArray[np.int64],
    missing: NDArray[np.int64],
    anchor: NDArray[np.int64],
    outgoing: NDArray[np.bool_],
    axes: NDArray[np.float64],
    looking: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Compute the mean (n, 3), standard deviation (n, 3) and number of scenes (n,) of n offsets.

    ``looking`` is False if the viewing direction is unknown. For the other arguments, see
    `offsets_of`.
    """
    subject, other = np.where(outgoing, missing, anchor), np.where(outgoing, anchor, missing)
    offset, scenes = look_up(tables, relation, subject, other)
    n = len(relation)
    mean, spread = np.zeros((n, 3)), np.zeros((n, 3))
    for k in range(n):
        if looking:
            for axis in range(3):
                toward, square = offset[k, axis], offset[k, 3 + axis] ** 2
                for to in range(3):
                    mean[k, to] += axes[axis, to] * toward
                    spread[k, to] += axes[axis, to] ** 2 * square
        else:
            if relation[k] == LEFT or relation[k] == FRONT:
                scenes[k] = UNOBSERVED
            mean[k, 2], spread[k, 2] = offset[k, 2], offset[k, 5] ** 2
            for axis in range(2):
                square = (offset[k, axis] ** 2 + offset[k, 3 + axis] ** 2) / 2
                spread[k, 0] += square
                spread[k, 1] += square
        for axis in range(3):
            value = mean[k, axis] if outgoing[k] else -mean[k, axis]
            # Adding 0.0 turns -0.0 into 0.0.
            mean[k, axis] = np.rint(value * _PER_METRE) / _PER_METRE + 0.0
            spread[k, axis] = (
                max(np.rint(math.sqrt(spread[k, axis]) * _PER_METRE), 1.0) / _PER_METRE
            )
    return mean, spread, scenes
