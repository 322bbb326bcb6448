"""Schemas of the requests to the service.

Validation is strict: it refuses values of another type ("1" or true in place of 1), unknown fields,
NaN and infinity. Every text and list has a maximum length. The service checks unknown labels,
ambiguous names and contradictions later, because these checks need the vocabulary of the model.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Generic, Literal, TypeAlias, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    Tag,
    WrapValidator,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import PydanticCustomError
from pydantic_core.core_schema import CoreSchema, no_info_before_validator_function
from typing_extensions import Self, TypedDict

from scene_client.frames import BoxOrigin, Extents, QuaternionOrder, Units, Up

MAX_BATCH = 256
MAX_LABEL = 100
"""Maximum length of a label in characters."""
MAX_SEED = 2**63 - 1
_MAX_ID = 2**53
MAX_RELATIONS = 65536
"""Upper limit of the setting ``SCENE_MAX_RELATIONS``.

The validation of a million invalid relations would take seconds.
"""

UnknownLabels = Literal["error", "ignore", "nearest", "nearest-or-ignore", "by-meaning"]
Detail = Literal["scores", "full"]
RelationName = Literal[
    "left", "right", "front", "behind", "on-top", "under", "above", "below", "inside", "contains"
]


def plain_text(value: str) -> str:
    """Return a printable text that is not blank. Other texts raise a validation error."""
    if not value.strip() or not value.isprintable():
        raise PydanticCustomError("plain_text", "must be printable text, and must not be blank")
    return value


def _as_text(value: Any) -> Any:
    # In JSON, 7.0 is a whole number too.
    is_id = type(value) in (int, float) and 0 <= value <= _MAX_ID and value == int(value)
    return str(int(value)) if is_id else value


Finite = Annotated[float, Field(allow_inf_nan=False)]
Coordinate = Annotated[float, Field(ge=-1e8, le=1e8, allow_inf_nan=False)]
Extent = Annotated[float, Field(ge=0, le=1e7, allow_inf_nan=False)]
Angle = Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Label = Annotated[str, Field(min_length=1, max_length=MAX_LABEL), AfterValidator(plain_text)]
Name = Annotated[str, Field(min_length=1, max_length=128), AfterValidator(plain_text)]
Id = Annotated[
    Name,
    BeforeValidator(
        _as_text, json_schema_input_type=Name | Annotated[int, Field(ge=0, le=_MAX_ID)]
    ),
]
"""An id or a label. A whole number is the id with its digits, as in training scenes."""
Unused = Annotated[str | None, Field(max_length=256)]
ModelSpec = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(plain_text)]


Body: TypeAlias = Mapping[str, Any]
"""A JSON object of a request, as a dictionary."""


class Request(BaseModel):
    """Base class of all parts of a request. Validation refuses unknown fields and wrong types."""

    model_config = ConfigDict(
        strict=True, extra="forbid", frozen=True, use_attribute_docstrings=True
    )


class OrArray:
    """Annotation of an object that a request may also state as an array of its values.

    For example, `["lamp", "on-top", "desk"]` stands for a `Relation`.
    """

    def __get_pydantic_core_schema__(
        self, source: type[BaseModel], handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return a schema that converts an array of the values to an object."""
        names = tuple(source.model_fields)

        def spelt_out(value: Any) -> Any:
            if isinstance(value, list | tuple) and len(value) == len(names):
                return dict(zip(names, value, strict=True))
            return value

        return no_info_before_validator_function(spelt_out, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Return a JSON schema with both forms.

        Each value of the array fits one of the members, because generators of clients and function
        calling do not read `prefixItems`, which would state the order.
        """
        spelt_out = handler(schema)
        members = handler.resolve_ref_schema(spelt_out)["properties"]
        kinds: list[JsonSchemaValue] = []
        for member in members.values():
            kind = {key: value for key, value in member.items() if key != "title"}
            if kind not in kinds:
                kinds.append(kind)
        array = {
            "type": "array",
            "description": ", ".join(members),
            "items": kinds[0] if len(kinds) == 1 else {"anyOf": kinds},
            "minItems": len(members),
            "maxItems": len(members),
        }
        return {"anyOf": [spelt_out, array]}


# ------------------------------------------------------------------------------------ a scene


class Position(Request):
    """A point in `units`, in the axes of ``frame_id`` (REP-103: x forward, y left, z up)."""

    x: Coordinate
    y: Coordinate
    z: Coordinate


class Size(Request):
    """Extents of a box in `units` along its own axes, without the rotation by ``orientation``.

    A box may be flat. If all extents are below 1 mm, the size is unknown.
    """

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
        # tf2 allows the same deviation from length 1. A ROS message whose orientation is unset has
        # an all-zero quaternion.
        if abs(math.hypot(self.x, self.y, self.z, self.w) - 1) > 0.01:
            raise PydanticCustomError(
                "unit_quaternion",
                "must be a unit quaternion (length 1). Leave an unknown orientation out",
            )
        return self


class Viewpoint(Request):
    """Position of the robot in ``frame_id`` and its viewing direction `yaw` in radians.

    `x` and `y` are in `units`, along the body axes of the frame: x ahead and y left. If the y axis
    of the frame points up, x is along its -z axis, and y along its -x axis. `yaw` is the angle from
    x towards y.
    """

    x: Coordinate
    y: Coordinate
    yaw: Angle


class Stamp(Request):
    """A time with the fields of builtin_interfaces/Time."""

    sec: Annotated[int, Field(ge=-(2**31), le=2**31 - 1)]
    nanosec: Annotated[int, Field(ge=0, le=999_999_999)]


class LabelGuess(Request):
    """Another label that a detector gives an object."""

    label: Label
    confidence: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]
    """probability of this label"""


class Detection(Request):
    """One detected object."""

    id: Id | None = None
    """id of the object in this scene; default: its label, followed by a number if several objects
    have this label"""
    label: Label
    """label in any spelling that the vocabulary accepts"""
    confidence: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 1.0
    """confidence of the detector in object and label, as a probability"""
    alternatives: Annotated[list[LabelGuess], Field(max_length=8)] = []
    """other labels that the detector gives this object. The other objects of the scene decide among
    the labels; the answer lists the decision in `resolved`"""
    position: Annotated[Position, OrArray()] | None = None
    """centre of the object's box, or its `box_origin`"""
    size: Annotated[Size, OrArray()] | None = None
    """default: the typical size of the class, if known"""
    orientation: Annotated[Quaternion, OrArray()] | None = None
    """rotation of the object's box"""
    yaw: Angle | None = None
    """rotation about the z axis in radians, instead of `orientation`; with `up` "y", about the y
    axis"""
    position_std: Extent | None = None
    """standard deviation of each coordinate of `position` in `units`; default: 5 cm. Relations and
    wrong places of boxes are probabilities under these errors"""
    size_std: Extent | None = None
    """standard deviation of each extent of `size` in `units`. Only the height counts. Default: 10 %
    of the height, or without `size`, the spread of the class"""
    supported_by: Id | None = None
    """id of the object under this object: the relation on-top. Unused if the service derives
    relations from the positions of all objects"""

    @model_validator(mode="after")
    def _one_rotation(self) -> Self:
        if self.yaw is not None and self.orientation is not None:
            raise PydanticCustomError("two_rotations", "must have either orientation or yaw")
        return self


def _kind_of_object(value: object) -> str | None:
    if isinstance(value, str):
        return OBJECT_TAGS[0]
    return OBJECT_TAGS[1] if isinstance(value, dict | Detection) else None


# pydantic puts these tags of the union's members into error locations. The tags contain a space, so
# `validation.pointer` can distinguish tags from field names.
OBJECT_TAGS = ("a label", "a detection")


def _state_any_of(schema: dict[str, Any]) -> None:
    """Convert `oneOf` of a schema to `anyOf`, because function calling does not support `oneOf`."""
    schema["anyOf"] = schema.pop("oneOf")


SceneObject = Annotated[
    Annotated[Label, Tag("a label")] | Annotated[Detection, Tag("a detection")],
    Discriminator(
        _kind_of_object,
        custom_error_type="object_kind",
        custom_error_message="must be a label or a JSON object with the field `label`",
    ),
    Field(json_schema_extra=_state_any_of),
]


SomeObjects = Annotated[list[SceneObject], Field(min_length=1, max_length=256, fail_fast=True)]


class Relation(Request):
    """A relation from `subject` to `object`. Each object is an id or an unambiguous label."""

    subject: Id
    relation: RelationName
    object: Id


class SceneRequest(Request):
    """A request: the scene that the robot observes, and the model that answers."""

    # Validation stops at the first invalid object. `validation.field_errors` then repeats it.
    objects: Annotated[list[SceneObject], Field(max_length=256, fail_fast=True)]
    """labels or detections, at most 256"""
    relations: Annotated[
        list[Annotated[Relation, OrArray()]] | None,
        # Validation stops at the first invalid relation. A list of all errors would need a hundred
        # times the memory of the request.
        Field(max_length=MAX_RELATIONS, fail_fast=True),
    ] = None
    """relations that hold in the scene. Unlisted relations are unobserved, unless
    `relations_complete` is true. Without this field, the service derives relations from positions.
    An empty list turns this derivation off"""
    relations_complete: bool = False
    """whether every relation that `relations` does not list is false"""
    room_type: Label | None = None
    """one of the model's room types"""
    profile: Name | None = None
    """name of a data source of the model. Its base rates of the classes apply. Without it, the
    model infers the source from the listed objects"""
    frame_id: Annotated[str | None, Field(max_length=256)] = None
    """name of the frame of all positions, as in std_msgs/Header. The answer contains the same
    name"""
    up: Up | None = None
    """axis of the frame that points up, in all positions, sizes and rotations. Default: z, or -y in
    a frame whose name ends in `_optical`, which must not declare `up`. With "y", the frame must be
    right-handed: x right, y up, z towards the viewer"""
    units: Units = "m"
    """unit of positions, sizes and the viewpoint. Lengths in answers are in metres"""
    extents: Extents = "full"
    """whether a size has the whole sides of a box, or half of each side"""
    box_origin: BoxOrigin = "centre"
    """the point of the box at `position`: its centre, the middle of its bottom, or the corner with
    the smallest x, y and z of the box before its rotation. Without a size, the typical size of the
    class leads to the centre"""
    quaternion_order: QuaternionOrder = "xyzw"
    """order of the numbers of each orientation. With "wxyz", the first number is w, also if it has
    the name x"""
    stamp: Stamp | None = None
    """time of the scene, as in std_msgs/Header; copied to the answer"""
    viewpoint: Viewpoint | None = None
    """pose of the viewer; by default, the viewer is at the origin of the frame and looks along x"""
    model: ModelSpec = "default"
    """an alias, `name` or `name@version`"""
    seed: Annotated[int | None, Field(ge=0, le=MAX_SEED)] = None
    """random seed of `/generate`; unused by other questions"""
    unknown_labels: UnknownLabels = "error"
    """treatment of labels that the model does not know. `error` refuses the request. `ignore`
    leaves these objects out of the scene. `nearest` corrects misspelt words and reads phrases by
    their last words (see `mapped`); it refuses a label that could be several classes.
    `nearest-or-ignore` leaves such a label out. `by-meaning` reads it as a word whose weights the
    model predicts from its word vector, and leaves out a label without a vector. All but `error`
    leave out an unknown room type, but `/generate` always refuses it"""

    scene_id: Unused = None
    """id of a training scene. Without `frame_id` and `viewer_frame`, its positions are in the frame
    `map`"""
    source: Unused = None
    """field of a training scene; unused by the service"""
    group: Unused = None
    """field of a training scene; unused by the service"""
    confirmed: bool = False
    """field of a training scene; unused by the service"""
    viewer_frame: bool = False
    """whether the axes of a training scene are those of the viewer"""

    @model_validator(mode="before")
    @classmethod
    def _frame_of_training_scene(cls, value: Any) -> Any:
        is_annotated = isinstance(value, dict) and value.get("scene_id") is not None
        if is_annotated and not value.get("viewer_frame") and value.get("frame_id") is None:
            return value | {"frame_id": "map"}
        return value


class SceneFields(TypedDict, total=False):
    """The fields of `SceneRequest` as keyword arguments.

    A relation may be a tuple (subject, relation, object).
    """

    relations: Iterable[Relation | Body | tuple[str, RelationName, str]]
    relations_complete: bool
    room_type: str
    profile: str
    frame_id: str
    up: Up
    units: Units
    extents: Extents
    box_origin: BoxOrigin
    quaternion_order: QuaternionOrder
    stamp: Stamp | Body
    viewpoint: Viewpoint | Body
    model: str
    seed: int
    unknown_labels: UnknownLabels


RequestT = TypeVar("RequestT", bound=Request)


def _as_it_came(value: Any, _validate: object) -> Any:
    return value


class BatchRequest(Request, Generic[RequestT]):
    """A batch of scenes. The answer has one entry for each scene, in the order of the scenes."""

    # The search for docstrings of attributes would take 20 ms for each `BatchRequest[X]`.
    model_config = ConfigDict(use_attribute_docstrings=False)

    # The JSON schema shows RequestT, but the service validates each scene later. Otherwise one
    # invalid scene would make the whole batch invalid.
    scenes: Annotated[
        list[Annotated[RequestT, WrapValidator(_as_it_came)]],
        Field(min_length=1, max_length=MAX_BATCH),
    ]
