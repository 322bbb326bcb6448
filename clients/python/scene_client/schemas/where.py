"""The HTTP contract of `/where`: in which room is such a thing, and where in the room?"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any

from pydantic import Field, field_validator
from pydantic_core import PydanticCustomError
from typing_extensions import TypedDict

from scene_client.frames import BoxOrigin, Extents, QuaternionOrder, Units, Up
from scene_client.schemas.answers import Answer, Reply
from scene_client.schemas.missing import Offset
from scene_client.schemas.requests import (
    Body,
    Id,
    Label,
    ModelSpec,
    Name,
    Probability,
    RelationName,
    Request,
    SceneObject,
    Stamp,
    UnknownLabels,
    Viewpoint,
)

MAX_ROOMS = 32
"""Maximum number of rooms of a home."""
MAX_THINGS = 1024
"""Maximum number of objects of a home."""


class HomeRoom(Request):
    """One room of a home, and the objects that the robot has seen there."""

    id: Id
    """name of the room, such as `kitchen` or `bedroom_2`"""
    room_type: Label | None = None
    """one of the model's room types; default: the `id` if it names one, else unknown"""
    objects: Annotated[list[SceneObject], Field(max_length=256, fail_fast=True)] = []
    """labels or detections, at most 256"""
    coverage: Probability | None = None
    """share of the room's classes that `objects` lists; default: the value of the model"""


class Searched(Request):
    """A place where the robot has looked for the thing without success."""

    room: Id
    object: Id | None = None
    """id of the object on, in or near which the robot has looked; default: the whole room"""
    seen_share: Probability = 1.0
    """share of the place that the robot has seen"""


class WhereRequest(Request):
    """In which room is such a thing, and where in the room?"""

    label: Label
    """label of the wanted thing"""
    rooms: Annotated[list[HomeRoom], Field(min_length=1, max_length=MAX_ROOMS, fail_fast=True)]
    """the rooms of the home, at most 32, with at most 1,024 objects together"""
    searched: Annotated[list[Searched], Field(max_length=MAX_THINGS, fail_fast=True)] = []
    """places where the robot has looked for the thing without success"""
    top_k: Annotated[int, Field(ge=1, le=4096)] = 20
    """maximum number of places in the answer"""
    frame_id: Annotated[str | None, Field(max_length=256)] = None
    """name of the frame of all positions, as in the requests about one scene"""
    up: Up | None = None
    units: Units = "m"
    extents: Extents = "full"
    box_origin: BoxOrigin = "centre"
    quaternion_order: QuaternionOrder = "xyzw"
    """this and the fields above: conventions of the boxes, as in the requests about one scene"""
    viewpoint: Viewpoint | None = None
    """pose of the viewer. Without it, left, right, front and behind are not used in a map"""
    stamp: Stamp | None = None
    """time of the request; copied to the answer"""
    model: ModelSpec = "default"
    """an alias, `name` or `name@version`"""
    profile: Name | None = None
    """name of a data source of the model, whose base rates of the classes apply"""
    unknown_labels: UnknownLabels = "error"
    """treatment of labels that the model does not know, as in the requests about one scene. The
    `label` itself must be known, or be read by its spelling or its meaning"""

    @field_validator("rooms", mode="before")
    @classmethod
    def _count_objects(cls, rooms: Any) -> Any:
        """Refuse too many objects before their validation, which takes most of the time."""
        total = 0
        for room in rooms if isinstance(rooms, list) else ():
            listed = room.get("objects") if isinstance(room, dict) else None
            listed = room.objects if isinstance(room, HomeRoom) else listed
            total += len(listed) if isinstance(listed, list) else 0
        if total > MAX_THINGS:
            message = f"the rooms must have at most {MAX_THINGS} objects together"
            raise PydanticCustomError("too_many_objects", message)
        return rooms


class Spot(Reply):
    """A place where the thing may be.

    Without `object`, it is the rest of the room: any place that the answer does not name.
    """

    room: str
    """id of the room"""
    probability: Probability
    is_listed: bool = False
    """true if the request lists the thing itself"""
    relation: RelationName | None = None
    """relation of the thing to `object`"""
    object: str | None = None
    """id of an object of the room; for a listed thing, that of the thing itself"""
    offset: Offset | None = None
    """offset from `object` in metres, as in the placements of `/missing`"""


class RoomShare(Reply):
    """A room, and the probability that the thing is there."""

    room: str
    probability: Probability


class WhereAnswer(Answer):
    """The places of one thing, likeliest first, its rooms, and the probability of none of them.

    The answer assumes one thing of this label. The probabilities of all places and `not_here` sum
    to 1; so do those of all rooms and `not_here`. `places` has the `top_k` likeliest.
    """

    label: str
    """class of the thing in the vocabulary"""
    listed_as: str | None = None
    """label of the thing in the request; absent if it equals `label`"""
    places: list[Spot]
    rooms: list[RoomShare]
    not_here: Probability
    """probability that the thing is in no room of the request"""


class WhereFields(TypedDict, total=False):
    """The fields of `WhereRequest` without rooms and label, as keyword arguments."""

    searched: Iterable[Searched | Body]
    top_k: int
    frame_id: str
    up: Up
    units: Units
    extents: Extents
    box_origin: BoxOrigin
    quaternion_order: QuaternionOrder
    viewpoint: Viewpoint | Body
    stamp: Stamp | Body
    model: str
    profile: str
    unknown_labels: UnknownLabels
