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
    """A place in a ``relation`` to an ``object``, such as "on-top" of the "desk"."""

    relation: RelationName
    object: Name


class MissingOptions(Request):
    """Options of `/missing`, besides the scene."""

    coverage: Annotated[
        Probability | None,
        Field(
            description="probability that a present object is listed. 1: the whole scene is seen, "
            "so unlisted classes count as absent. 0: unlisted classes give no evidence. Default: "
            "the model's own value",
        ),
    ] = None
    top_k: Annotated[
        int, Field(ge=1, description="maximum number of objects, up to the vocabulary's size")
    ] = 10
    candidates: Annotated[
        list[Label] | None,
        Field(min_length=1, max_length=4096, description="only classes with these labels"),
    ] = None
    at: Annotated[
        Anchor | None, Field(description="only objects that are missing at this place")
    ] = None


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
    """Offset from the centre of a placement's object to the centre of the missing object.

    Add it to the position of the placement's object. The axes are those of `frame_id`. Without a
    frame they point away from the viewer, to the left and up. `std`: standard deviations. Four of
    five objects are within 1.8 of them in the plane, or 2.15 in space. `scenes`: number of training
    scenes with this relation of the two classes. 0: the offset is the usual one of the relation and
    of either class.
    """

    mean: Vector
    std: Vector
    scenes: int


class Placement(Reply):
    """A likely place of a missing object: in `relation` to the object with this id."""

    relation: RelationName
    object: str
    probability: Probability
    offset: Annotated[
        Offset | None,
        Field(
            description="offset from the object in metres; absent if the training scenes have no "
            "poses. Also absent for left, right, front and behind in a map, odom or world frame "
            "without a viewpoint"
        ),
    ] = None


class MissingObject(Reply):
    """A class that is not listed.

    `probability`: an unlisted object of the class is present, given `coverage`. `log_odds`:
    log-odds of its presence, before calibration.
    """

    label: str
    probability: Probability
    log_odds: Finite
    placements: list[Placement]
    because: Annotated[
        list[Because],
        Field(
            description="objects that change the log-odds most, strongest first, at most 3. Only "
            "the first 32 entries have them"
        ),
    ]


class MissingAnswer(Answer):
    """Unlisted classes, likeliest first. Their probabilities do not sum to one."""

    coverage: Annotated[
        Probability | None,
        Field(description="applied probability that a present object is listed"),
    ] = None
    missing: list[MissingObject]


class MissingFields(SceneFields, total=False):
    """The fields of `MissingRequest`; ``at`` may be ``("on-top", "desk")``."""

    coverage: float
    top_k: int
    candidates: Iterable[str]
    at: Anchor | Body | tuple[RelationName, str]
