"""Requests of the HTTP contract.

Requests are strict: no coercion ("1" is not 1, true is not 1), no unknown fields, no NaN, no
infinity, every text and list bounded. What needs a model's vocabulary or the whole scene to judge
(unknown labels, ambiguous names, contradictions) is judged where the scene is read.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Generic, Literal, Self, TypeAlias, TypedDict, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    WrapValidator,
    model_validator,
)
from pydantic_core import PydanticCustomError

MAX_BATCH = 256
MAX_SEED = 2**63 - 1
MAX_RELATIONS = 65536
"""No setting allows more, and a million wrong ones would take seconds to name."""

UnknownLabels = Literal["error", "ignore", "nearest"]
RelationName = Literal["left", "right", "front", "behind", "on-top", "under", "above", "below"]


def _plain_text(value: str) -> str:
    if not value.strip() or not value.isprintable():
        raise PydanticCustomError("plain_text", "must be printable text and not blank")
    return value


Finite = Annotated[float, Field(allow_inf_nan=False)]
Metres = Annotated[float, Field(ge=-1e8, le=1e8, allow_inf_nan=False)]
Extent = Annotated[float, Field(gt=0, le=1e4, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
UnitNumber = Annotated[int, Field(ge=0, le=2**31 - 1)]
Label = Annotated[str, Field(min_length=1, max_length=100), AfterValidator(_plain_text)]
Name = Annotated[str, Field(min_length=1, max_length=128), AfterValidator(_plain_text)]
ModelSpec = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_plain_text)]


Body: TypeAlias = Mapping[str, Any]
"""Any part of a request, as in the HTTP contract."""


class Request(BaseModel):
    """Part of a request: strict, and closed to fields it does not know."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


# ------------------------------------------------------------------------------------ a scene


class Position(Request):
    """A point in metres, in the axes of ``frame_id`` (REP-103: x forward, y left, z up)."""

    x: Metres
    y: Metres
    z: Metres


class Size(Request):
    """Extents of a box in metres along its own axes, before ``orientation`` turns it."""

    x: Extent
    y: Extent
    z: Extent


class Quaternion(Request):
    """A rotation as a unit quaternion, in the order of geometry_msgs/Quaternion."""

    x: Finite
    y: Finite
    z: Finite
    w: Finite

    @model_validator(mode="after")
    def _unit(self) -> Self:
        # tf2 tolerates the same deviation; an all-zero quaternion (an unset message) is refused.
        if abs(math.hypot(self.x, self.y, self.z, self.w) - 1) > 0.01:
            raise PydanticCustomError("unit_quaternion", "must be a unit quaternion (length 1)")
        return self


class Viewpoint(Request):
    """Where the robot stands in ``frame_id`` and where it looks (radians from x towards y)."""

    x: Metres
    y: Metres
    yaw: Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False)]


class Stamp(Request):
    """A time as builtin_interfaces/Time."""

    sec: Annotated[int, Field(ge=-(2**31), le=2**31 - 1)]
    nanosec: Annotated[int, Field(ge=0, le=999_999_999)]


class Detection(Request):
    """One object as a detector reports it."""

    id: Annotated[
        Name | None,
        Field(
            description="its name in this scene; without one the label serves, numbered if needed"
        ),
    ] = None
    label: Annotated[Label, Field(description="any spelling the model's vocabulary accepts")]
    confidence: Annotated[
        float,
        Field(gt=0, le=1, allow_inf_nan=False, description="soft evidence that it is there"),
    ] = 1.0
    position: Annotated[Position | None, Field(description="centre of its box")] = None
    size: Annotated[
        Size | None, Field(description="left out: the typical size of its class, where known")
    ] = None
    orientation: Annotated[Quaternion | None, Field(description="turns the box")] = None


def _kind_of_object(value: object) -> str | None:
    if isinstance(value, str):
        return OBJECT_TAGS[0]
    return OBJECT_TAGS[1] if isinstance(value, dict | Detection) else None


# Names of the union's members as pydantic reports them in error locations. They hold a space, so
# they are told apart from field names when a location becomes a JSON pointer.
OBJECT_TAGS = ("a label", "a detection")

SceneObject = Annotated[
    Annotated[Label, Tag("a label")] | Annotated[Detection, Tag("a detection")],
    Discriminator(
        _kind_of_object,
        custom_error_type="object_kind",
        custom_error_message="must be a label or an object with a label",
    ),
]


SomeObjects = Annotated[list[SceneObject], Field(min_length=1, max_length=256)]


class Relation(Request):
    """``subject`` stands in ``relation`` to ``object``; both name an id or an unambiguous label."""

    subject: Name
    relation: RelationName
    object: Name


class SceneRequest(Request):
    """What the robot sees, and which model to ask."""

    objects: Annotated[
        list[SceneObject],
        Field(max_length=256, description="labels or detections; at most 256"),
    ]
    relations: Annotated[
        list[Relation] | None,
        Field(
            max_length=MAX_RELATIONS,
            # Of so many, each wrong in many ways: a list of all faults would take a hundred times
            # the memory of the request.
            fail_fast=True,
            description="relations that hold; relations not listed are unobserved, unless "
            "`relations_complete`. Left out, they are derived from positions; an empty list says "
            "that none is known and derives none",
        ),
    ] = None
    relations_complete: Annotated[
        bool, Field(description="relations that are not listed do not hold")
    ] = False
    room_type: Annotated[Label | None, Field(description="one of the model's room types")] = None
    frame_id: Annotated[
        str | None, Field(max_length=256, description="as in std_msgs/Header; echoed")
    ] = None
    stamp: Annotated[Stamp | None, Field(description="as in std_msgs/Header; echoed")] = None
    viewpoint: Annotated[
        Viewpoint | None,
        Field(description="left out: at the origin of the frame, looking along x"),
    ] = None
    model: Annotated[ModelSpec, Field(description="an alias, `name` or `name@version`")] = "default"
    seed: Annotated[
        int | None,
        Field(ge=0, le=MAX_SEED, description="only `/generate` draws; the others ignore it"),
    ] = None
    unknown_labels: Annotated[
        UnknownLabels,
        Field(
            description="labels the model does not know: refuse them, answer without them, or map "
            "each to the nearest class (`mapped`); a label that is like none is refused"
        ),
    ] = "error"


class SceneFields(TypedDict, total=False):
    """The fields of `SceneRequest`; relations and pairs may be plain tuples of names."""

    relations: Iterable[Relation | Body | tuple[str, RelationName, str]]
    relations_complete: bool
    room_type: str
    frame_id: str
    stamp: Stamp | Body
    viewpoint: Viewpoint | Body
    model: str
    seed: int
    unknown_labels: UnknownLabels


class AliasRequest(Request):
    """Where an alias shall lead."""

    model: Annotated[ModelSpec, Field(description="`name@version`, or `name` for its newest")]
    expected: Annotated[
        ModelSpec | None,
        Field(
            description="where the alias must lead now, as GET /models shows it; null: it must not "
            "exist; left out: wherever it leads"
        ),
    ] = None


class AliasFields(TypedDict, total=False):
    """The fields of `AliasRequest` beside the model."""

    expected: str | None


RequestT = TypeVar("RequestT", bound=SceneRequest)


def _as_it_came(value: Any, _validate: object) -> Any:
    return value


class BatchRequest(Request, Generic[RequestT]):
    """Scenes to answer in order. Each is judged alone: a bad one spoils only its own entry."""

    # Described as RequestT and left as it came: validating here would refuse the whole batch.
    scenes: Annotated[
        list[Annotated[RequestT, WrapValidator(_as_it_came)]],
        Field(min_length=1, max_length=MAX_BATCH),
    ]
