"""The HTTP contract of `/rooms`: which room is this?"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated

from pydantic import Field

from scene_client.schemas.answers import Answer, Because, Reply
from scene_client.schemas.requests import (
    Detail,
    Label,
    Probability,
    SceneFields,
    SceneRequest,
    SomeObjects,
)


class RoomsRequest(SceneRequest):
    """Which room is this, or where is such an object?"""

    objects: SomeObjects
    top_k: Annotated[int, Field(ge=1, le=4096)] = 5
    """maximum number of room types in the answer"""
    candidates: Annotated[
        list[Label] | None, Field(min_length=1, max_length=4096, fail_fast=True)
    ] = None
    """the possible room types, such as the rooms of a flat. Their probabilities sum to one. Names
    of one room type share one entry of the answer"""
    detail: Detail = "full"
    """`scores` leaves `because` out of the answer"""


class RoomType(Reply):
    """A room type, and the probability that the scene is a room of this type."""

    room_type: str
    probability: Probability
    listed_as: list[str] | None = None
    """names of this room type in `candidates`. They share the probability. Absent if `room_type` is
    the only name"""
    because: list[Because] = []
    """objects that change the odds of the room type by a factor of at least 3, largest change
    first, at most 3"""


class RoomsAnswer(Answer):
    """Room types, most probable first. The probabilities of all types sum to one.

    The list is empty, with a warning, if the model has no room types.
    """

    room_types: list[RoomType]


class RoomsFields(SceneFields, total=False):
    """The fields of `RoomsRequest`."""

    top_k: int
    candidates: Iterable[str]
    detail: Detail
