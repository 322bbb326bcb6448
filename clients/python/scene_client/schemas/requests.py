"""Requests of the HTTP contract.

Requests are strict: no coercion ("1" is not 1, true is not 1), no unknown fields, no NaN, no
infinity, every text and list bounded. What needs a model's vocabulary or the whole scene to judge
(unknown labels, ambiguous names, contradictions) is judged where the scene is read.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Generic, Literal, Self, TypeVar

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
Sensitivity = Literal["low", "medium", "high"]
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


class Pair(Request):
    """Two objects, each by its id or an unambiguous label."""

    subject: Name
    object: Name


class Anchor(Request):
    """A place: in ``relation`` to ``object`` ("on-top" of the "desk")."""

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


class RelationsOptions(Request):
    """What `/relations` is asked beside the scene."""

    top_k: Annotated[int, Field(ge=1, le=4096, description="how many relations at most")] = 20
    min_probability: Annotated[Probability, Field(description="leave out what is less likely")] = (
        0.0
    )
    pairs: Annotated[
        list[Pair] | None,
        Field(
            min_length=1, max_length=4096, fail_fast=True, description="only these ordered pairs"
        ),
    ] = None
    include_opposites: Annotated[
        bool, Field(description="also report right, behind, under and below")
    ] = False


class RelationsRequest(RelationsOptions, SceneRequest):
    """How do these objects stand to each other?"""

    objects: SomeObjects


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


class OutliersOptions(Request):
    """What `/outliers` is asked beside the scene."""

    sensitivity: Annotated[
        Sensitivity,
        Field(
            description="how readily an alarm is raised: in about 2, 10 or 20 % of untouched "
            "scenes of the hardest large source, and of lists of few classes"
        ),
    ] = "medium"
    threshold: Annotated[
        Probability | None,
        Field(
            description="an object is an outlier from this probability on; left out: the model's "
            "threshold for `sensitivity`",
        ),
    ] = None


class OutliersRequest(OutliersOptions, SceneRequest):
    """What does not belong here, or stands in the wrong place?"""

    objects: SomeObjects


class GenerateRequest(SceneRequest):
    """What would a scene like this look like?"""

    objects: Annotated[
        list[SceneObject], Field(max_length=256, description="evidence; may be empty")
    ] = []
    count: Annotated[int, Field(ge=1, le=64, description="how many scenes")] = 1
    steps: Annotated[
        int | None, Field(ge=1, le=2000, description="Gibbs sweeps; left out: the model's own")
    ] = None
    temperature: Annotated[
        float,
        Field(ge=0.05, le=20, allow_inf_nan=False, description="above 1: more varied scenes"),
    ] = 1.0
    context: Annotated[
        dict[Name, Annotated[list[UnitNumber], Field(max_length=4096)]] | None,
        Field(max_length=8, description="layer name to the numbers of its units that are on"),
    ] = None


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
