"""The contract of `/missing`: what else should be here, and where?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from scene_client.schemas.answers import Answer, Because, Reply
from scene_client.schemas.requests import (
    Body,
    Finite,
    Label,
    Name,
    Probability,
    RelationName,
    Request,
    SceneFields,
    SceneRequest,
    SomeObjects,
)


class Anchor(Request):
    """A place: in ``relation`` to ``object`` ("on-top" of the "desk")."""

    relation: RelationName
    object: Name


class MissingOptions(Request):
    """What `/missing` is asked beside the scene."""

    coverage: Annotated[
        Probability | None,
        Field(
            description="probability that an object which is there is listed: 1 where the whole "
            "scene is seen, so that an unlisted class counts as absent; 0 where unlisted classes "
            "say nothing; left out: the model's own",
        ),
    ] = None
    top_k: Annotated[
        int, Field(ge=1, description="how many objects at most; not above the vocabulary")
    ] = 10
    candidates: Annotated[
        list[Label] | None,
        Field(min_length=1, max_length=4096, description="only these labels"),
    ] = None
    at: Annotated[Anchor | None, Field(description="what is missing at this place?")] = None


class MissingRequest(MissingOptions, SceneRequest):
    """What else should be here, and where?"""

    objects: SomeObjects


@dataclass(slots=True)
class Vector:
    """Metres along the axes of ``frame_id``."""

    x: float
    y: float
    z: float


@dataclass(slots=True)
class Offset:
    """From the centre of a placement's object to that of the missing one: add it to a position.

    Along the axes of `frame_id`; where the request names none, away from the viewer, to the left
    and up. `std`: a robot that looks within 1.8 of them in the plane, or 2.15 in space, finds four
    of five. `scenes`: training scenes that showed the two classes so; 0: the offset is what is
    usual for the relation and for either class.
    """

    mean: Vector
    std: Vector
    scenes: int


class Placement(Reply):
    """Where a missing object would stand: in `relation` to the object with this id."""

    relation: RelationName
    object: str
    probability: Probability
    offset: Annotated[
        Offset | None,
        Field(
            description="how far from it, in metres; absent where training saw no poses, and for "
            "left, right, front and behind in a map, odom or world frame without a viewpoint"
        ),
    ] = None


class MissingObject(Reply):
    """A class that is not listed.

    `probability`: the object is there although it was not listed, given `coverage`. `log_odds`: of
    its presence, before calibration.
    """

    label: str
    probability: Probability
    log_odds: Finite
    placements: list[Placement]
    because: Annotated[
        list[Because],
        Field(
            description="objects that change its log-odds most, strongest first, at most 3; the "
            "first 32 entries have them"
        ),
    ]


class MissingAnswer(Answer):
    """Unlisted classes, likeliest first; their probabilities do not sum to one."""

    coverage: Annotated[
        Probability | None,
        Field(description="probability that a present object is listed, as it was in force"),
    ] = None
    missing: list[MissingObject]


class MissingFields(SceneFields, total=False):
    """The fields of `MissingRequest`; ``at`` may be ``("on-top", "desk")``."""

    coverage: float
    top_k: int
    candidates: Iterable[str]
    at: Anchor | Body | tuple[RelationName, str]
