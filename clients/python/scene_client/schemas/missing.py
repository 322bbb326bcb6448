"""The HTTP contract of `/missing`: what else should be here, and where?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from scene_client.schemas.answers import Answer, Because, Reply
from scene_client.schemas.requests import (
    Body,
    Detail,
    Finite,
    Id,
    Label,
    OrArray,
    Probability,
    RelationName,
    Request,
    SceneFields,
    SceneRequest,
    SomeObjects,
)


class Anchor(Request):
    """A place: the relation to an object of the scene, such as "on-top" and "desk"."""

    relation: RelationName
    object: Id


class MissingRequest(SceneRequest):
    """What else should be here, and where?"""

    objects: SomeObjects
    coverage: Probability | None = None
    """share of the real scene's classes that the request lists. With 1, at most one class is
    missing. Values below 0.15 mean 0.15. Without it, the share is unknown, and the probabilities
    are right on average over lists of any share"""
    top_k: Annotated[int, Field(ge=1)] = 10
    """maximum number of classes in the answer"""
    candidates: Annotated[
        list[Label] | None, Field(min_length=1, max_length=4096, fail_fast=True)
    ] = None
    """limit the answer to classes with these labels. The list `more` then contains them at any
    probability"""
    at: Annotated[Anchor, OrArray()] | None = None
    """limit the answer to objects missing at this place; not at floor, wall or ceiling"""
    detail: Detail = "full"
    """`scores` leaves `placements` and `because` out of the answer"""


@dataclass(slots=True)
class Vector:
    """A vector in metres, in the axes of ``frame_id``."""

    x: float
    y: float
    z: float


@dataclass(slots=True)
class Offset:
    """Offset from the centre of the placement's `object` to the centre of the missing object.

    The expected position of the missing object is `mean` plus the position of `object`. The axes
    are the axes of `frame_id`. Without a frame, x points away from the viewer, y to the left and z
    up. `std` is the standard deviation on each axis. 80 % of the missing objects are within 1.8
    standard deviations in the plane, or within 2.15 in space. `scenes` is the number of training
    scenes with this relation between the two classes. If `scenes` is 0, the offset is estimated
    from the relation and from each class separately.

    If the request states the size of `object`, `mean` is a free spot for a missing object of the
    typical size, with the yaw of `object`. It overlaps no other box. On top, it touches the top
    face of `object`, or the seat of a bed, a sofa or a chair. Inside, it is between bottom and top
    of `object`. Otherwise it stands on the floor or on a box, or hangs at the usual height. Below
    an object that it supports, it reaches from the floor to this object. For on-top, inside, above
    and their opposites, `std` is at most what the surface leaves to the centre.
    """

    mean: Vector
    std: Vector
    scenes: int


class Placement(Reply):
    """A likely place of a missing object: its `relation` to the object with the id `object`."""

    relation: RelationName
    object: str
    probability: Probability
    offset: Offset | None = None
    """offset from `object` in metres. The offset is absent if `object` has no position, or if the
    training scenes have no poses. It is also absent for left, right, front and behind in a map,
    odom or world frame without a viewpoint. If the request states the size of `object` and no spot
    is free, the offset is absent too. Then the place is as probable, but an arm has no room there:
    take the next place with an offset"""


class MissingObject(Reply):
    """A class that the request does not list.

    `probability` is the probability that an object of the class is in the scene, given `coverage`.
    With `at`, the object must also stand at this place: the probability is that of the class,
    multiplied by that of its first placement. `log_odds` is ln(p / (1 - p)) of the probability p.
    """

    label: str
    """class of the vocabulary"""
    listed_as: str | None = None
    """first entry of `candidates` that names the class; absent if it equals `label`"""
    probability: Probability
    log_odds: Finite
    placements: list[Placement] = []
    """the likeliest place, and at most 2 further places that are at least 3/4 as probable. With
    `at`, the requested place comes first. Its probability is the factor of `probability`"""
    because: list[Because] = []
    """objects that change the odds by a factor of at least 3, largest change first, at most 3. Only
    the first 32 classes of the answer have reasons"""


class MoreInstances(Reply):
    """A class that the request lists, and that probably has more instances in the scene.

    The statistics are those of training scenes. Listed objects count as present, whatever their
    confidence. In the shipped models, the number 12 stands for 12 or more. A class has no entry if
    too few training scenes contain as many objects as the request lists.
    """

    label: str
    """class of the vocabulary"""
    listed_as: str | None = None
    """label of the first object of the class in the request; absent if it equals `label`"""
    listed_count: Annotated[int, Field(ge=1)]
    """number of listed objects of the class"""
    expected_count: Finite
    """expected number of objects of the class, including the listed objects"""
    low: Annotated[int, Field(ge=1)]
    """lower limit of an 80 % interval of the number"""
    high: Annotated[int, Field(ge=1)]
    """upper limit of the interval"""
    probability: Probability
    """probability that the scene has more than the listed objects"""


class MissingAnswer(Answer):
    """Unlisted classes, most probable first. Their probabilities do not sum to one."""

    coverage: Probability | None = None
    """`coverage` of the request. Without one, it is the share whose base rates the model uses for
    an unknown share, and a request that states this number gets other probabilities"""
    missing: list[MissingObject]
    more: list[MoreInstances] = []
    """listed classes with probably more instances than listed, most probable first. Without
    `candidates`, their probability is at least 0.5. The list is empty with `at`, and for models
    without statistics of counts. Classes and numbers of objects with too little data are left
    out"""


class MissingFields(SceneFields, total=False):
    """The fields of `MissingRequest`. ``at`` may be a tuple, such as ``("on-top", "desk")``."""

    coverage: float
    top_k: int
    candidates: Iterable[str]
    at: Anchor | Body | tuple[RelationName, str]
    detail: Detail
