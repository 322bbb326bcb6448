"""Requests of the HTTP contract.

Requests are strict: no coercion ("1" is not 1, true is not 1), no unknown fields, no NaN and no
infinity. Every text and list has a maximum length. Checks that need a model's vocabulary or the
whole scene happen where the scene is read: unknown labels, ambiguous names and contradictions.
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
"""Upper bound of the service's setting; listing a million invalid ones would take seconds."""

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
    """Part of a request; unknown fields and type coercion are not allowed."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


# ------------------------------------------------------------------------------------ a scene


class Position(Request):
    """A point in metres, in the axes of ``frame_id`` (REP-103: x forward, y left, z up)."""

    x: Metres
    y: Metres
    z: Metres


class Size(Request):
    """Extents of a box in metres along its own axes, before the rotation by ``orientation``."""

    x: Extent
    y: Extent
    z: Extent


class Quaternion(Request):
    """A rotation as a unit quaternion, with the fields of geometry_msgs/Quaternion."""

    x: Finite
    y: Finite
    z: Finite
    w: Finite

    @model_validator(mode="after")
    def _unit(self) -> Self:
        # tf2 allows the same deviation; an all-zero quaternion (an unset message) is refused.
        if abs(math.hypot(self.x, self.y, self.z, self.w) - 1) > 0.01:
            raise PydanticCustomError("unit_quaternion", "must be a unit quaternion (length 1)")
        return self


class Viewpoint(Request):
    """Position of the robot in ``frame_id``, and its direction of view in radians (x towards y)."""

    x: Metres
    y: Metres
    yaw: Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False)]


class Stamp(Request):
    """A time with the fields of builtin_interfaces/Time."""

    sec: Annotated[int, Field(ge=-(2**31), le=2**31 - 1)]
    nanosec: Annotated[int, Field(ge=0, le=999_999_999)]


class Detection(Request):
    """One object, as a detector reports it."""

    id: Annotated[
        Name | None,
        Field(description="id of the object in this scene; default: the label, numbered if needed"),
    ] = None
    label: Annotated[Label, Field(description="any spelling that the model's vocabulary accepts")]
    confidence: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            allow_inf_nan=False,
            description="confidence that the object is present (soft evidence)",
        ),
    ] = 1.0
    position: Annotated[Position | None, Field(description="centre of the object's box")] = None
    size: Annotated[
        Size | None, Field(description="default: the typical size of the class, if known")
    ] = None
    orientation: Annotated[Quaternion | None, Field(description="rotation of the object's box")] = (
        None
    )


def _kind_of_object(value: object) -> str | None:
    if isinstance(value, str):
        return OBJECT_TAGS[0]
    return OBJECT_TAGS[1] if isinstance(value, dict | Detection) else None


# Names of the union's members in pydantic's error locations. Their space distinguishes them from
# field names when a location becomes a JSON pointer.
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
    """``subject`` has the ``relation`` to ``object``; both are an id or an unambiguous label."""

    subject: Name
    relation: RelationName
    object: Name


class SceneRequest(Request):
    """The scene that the robot observes, and the model to ask."""

    objects: Annotated[
        list[SceneObject],
        Field(max_length=256, description="labels or detections, at most 256"),
    ]
    relations: Annotated[
        list[Relation] | None,
        Field(
            max_length=MAX_RELATIONS,
            # With this many relations, a list of all errors would need a hundred times the memory
            # of the request.
            fail_fast=True,
            description="relations that hold. Relations that are not listed are unobserved, "
            "unless `relations_complete` is true. Without this field, relations are derived from "
            "positions. With an empty list, no relation is stated and none is derived",
        ),
    ] = None
    relations_complete: Annotated[
        bool, Field(description="if true, relations that are not listed do not hold")
    ] = False
    room_type: Annotated[Label | None, Field(description="one of the model's room types")] = None
    frame_id: Annotated[
        str | None,
        Field(max_length=256, description="as in std_msgs/Header; the answer repeats it"),
    ] = None
    stamp: Annotated[
        Stamp | None, Field(description="as in std_msgs/Header; the answer repeats it")
    ] = None
    viewpoint: Annotated[
        Viewpoint | None,
        Field(description="default: the origin of the frame, view along x"),
    ] = None
    model: Annotated[ModelSpec, Field(description="an alias, `name` or `name@version`")] = "default"
    seed: Annotated[
        int | None,
        Field(
            ge=0, le=MAX_SEED, description="random seed of `/generate`; other questions ignore it"
        ),
    ] = None
    unknown_labels: Annotated[
        UnknownLabels,
        Field(
            description="treatment of labels that the model does not know: refuse them, leave "
            "them out of the answer, or use the nearest class (`mapped`). A label without a "
            "similar class is refused"
        ),
    ] = "error"


class SceneFields(TypedDict, total=False):
    """The fields of `SceneRequest`; relations and pairs may be tuples of names."""

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
    """The new target of an alias."""

    model: Annotated[
        ModelSpec, Field(description="`name@version`, or `name` for the newest version")
    ]
    expected: Annotated[
        ModelSpec | None,
        Field(
            description="required current target of the alias, as in GET /models. null: the alias "
            "must not exist yet. Default: any target"
        ),
    ] = None


class AliasFields(TypedDict, total=False):
    """The fields of `AliasRequest` except the model."""

    expected: str | None


RequestT = TypeVar("RequestT", bound=SceneRequest)


def _as_it_came(value: Any, _validate: object) -> Any:
    return value


class BatchRequest(Request, Generic[RequestT]):
    """Scenes to answer in order. An invalid scene affects only its own entry of the answer."""

    # The schema describes RequestT, and the value stays raw: validation here would refuse the
    # batch.
    scenes: Annotated[
        list[Annotated[RequestT, WrapValidator(_as_it_came)]],
        Field(min_length=1, max_length=MAX_BATCH),
    ]
