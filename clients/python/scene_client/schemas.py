"""Requests and answers of the HTTP contract: plain pydantic, shared by the service and its clients.

Requests are strict: no coercion ("1" is not 1, true is not 1), no unknown fields, no NaN, no
infinity, every text and list bounded. What needs a model's vocabulary or the whole scene to judge
(unknown labels, ambiguous names, contradictions) is judged where the scene is read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
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


class Reply(BaseModel):
    """Part of an answer."""

    model_config = ConfigDict(frozen=True)


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
    min_probability: Annotated[
        float, Field(ge=0, le=1, allow_inf_nan=False, description="leave out what is less likely")
    ] = 0.0
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

    objects: Annotated[list[SceneObject], Field(min_length=1, max_length=256)]


class MissingOptions(Request):
    """What `/missing` is asked beside the scene."""

    coverage: Annotated[
        float | None,
        Field(
            ge=0,
            le=1,
            allow_inf_nan=False,
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

    objects: Annotated[list[SceneObject], Field(min_length=1, max_length=256)]


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
        float | None,
        Field(
            ge=0,
            le=1,
            allow_inf_nan=False,
            description="an object is an outlier from this probability on; left out: the model's "
            "threshold for `sensitivity`",
        ),
    ] = None


class OutliersRequest(OutliersOptions, SceneRequest):
    """What does not belong here, or stands in the wrong place?"""

    objects: Annotated[list[SceneObject], Field(min_length=1, max_length=256)]


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
        dict[
            Name, Annotated[list[Annotated[int, Field(ge=0, le=2**31 - 1)]], Field(max_length=4096)]
        ]
        | None,
        Field(max_length=8, description="layer name to the numbers of its units that are on"),
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


# ----------------------------------------------------------------------------------- answers


class ModelReference(Reply):
    """Which model answered."""

    name: str
    version: str
    variant: Annotated[str, Field(description="rbm, gbm or triway")]
    digest: Annotated[str, Field(description="sha256 over the artifact")]


@dataclass(slots=True)
class ObservedRelation:
    """A relation between two objects (by id) that their positions show."""

    # No model: a scene of a dozen objects shows some fifty, and a model takes ten times as long.
    subject: str
    relation: RelationName
    object: str


class Mapped(Reply):
    """A label that the model does not know, and the class that stands for it."""

    model_config = ConfigDict(frozen=True, populate_by_name=True, serialize_by_alias=True)

    label: Annotated[str, Field(description="as given: of an object, a candidate, or the room")]
    class_: Annotated[str, Field(alias="class", description="the canonical label")]
    similarity: Annotated[
        float, Field(ge=0, le=1, description="of the names, by spelling and common words")
    ]


class SceneWarning(Reply):
    """Something in the scene that is probably a mistake. The scene is answered all the same."""

    code: Annotated[
        Literal["implausible-position", "implausible-size", "flat-scene", "unknown-sizes"],
        Field(
            description="a position beyond 100 m (are these millimetres?); a side below 1 mm or "
            "above 20 m; one depth for all objects in an optical frame; vertical relations that "
            "are unobserved because sizes are unknown"
        ),
    ]
    message: str
    objects: Annotated[list[str], Field(description="ids of the objects concerned")]


class Answer(Reply):
    """What every answer carries."""

    model: ModelReference
    request_id: Annotated[str, Field(description="of the X-Request-Id header, or drawn")]
    frame_id: Annotated[str | None, Field(description="as given")] = None
    stamp: Annotated[Stamp | None, Field(description="as given")] = None
    ignored: Annotated[
        list[str],
        Field(
            description="with `unknown_labels: ignore`: ids of the objects, and the candidates and "
            "room type, that this model does not know and the answer left out"
        ),
    ] = []
    mapped: Annotated[
        list[Mapped],
        Field(
            description="with `unknown_labels: nearest`: labels this model does not know, and the "
            "class that each was taken for"
        ),
    ] = []
    warnings: Annotated[
        list[SceneWarning], Field(description="probable mistakes in the scene")
    ] = []
    observed_relations: Annotated[
        list[ObservedRelation] | None,
        Field(description="derived from positions; absent if none were given"),
    ] = None


class ScoredRelation(Reply):
    """A relation between two objects (by id) and its probability."""

    subject: str
    relation: RelationName
    object: str
    probability: Probability


@dataclass(slots=True)
class Disagreement:
    """Two objects (by id) that stand otherwise than the rest of the scene makes one expect.

    `observed`: relations of `subject` to `object` that were stated or derived. `expected`: the
    likeliest relation without all that is known of how the two stand, with its `probability`;
    `observed_probability`: of the likeliest observed one.
    """

    # No model either: half of the observed relations may be in it.
    subject: str
    object: str
    observed: list[RelationName]
    expected: RelationName
    probability: Probability
    observed_probability: Probability


class ExpectedRelation(ScoredRelation):
    """A relation and the probability that it holds, given that both objects are in the scene."""

    observed: Annotated[bool, Field(description="the request states it, or positions show it")] = (
        False
    )


class RelationsAnswer(Answer):
    """Relations, best first.

    `probability`: the relation holds between the two, given that both are in the scene.
    """

    relations: list[ExpectedRelation]
    disagreements: Annotated[
        list[Disagreement],
        Field(
            description="where another relation than what was stated or observed is expected: "
            "from the rest of the scene alone it has a probability of at least one half; largest "
            "ratio of the probabilities first, at most `top_k`"
        ),
    ]


# No models: an answer holds thirty of them, and a model takes ten times as long.
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


@dataclass(slots=True)
class Because:
    """How much the presence of one object (by id) changes the log-odds of another."""

    # No model here either: an answer holds some thirty.
    object: str
    log_odds_change: Finite


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


class Outlier(Reply):
    """How badly one object fits.

    `probability`: it does not belong, where half of the scenes hold an intruder. `log_odds`: of its
    class being present, given the rest of the scene.
    """

    object: str
    label: str
    probability: Probability
    log_odds: Finite
    is_outlier: bool
    because: Annotated[
        list[Because],
        Field(
            description="objects that support the verdict, strongest first, at most 3: of an "
            "outlier those that make it unlikely, of any other those that make it likely"
        ),
    ]
    usually_with: Annotated[
        list[str],
        Field(description="of an outlier: absent classes that would make it likely, at most 3"),
    ] = []


class MisplacedRelation(ScoredRelation):
    """A relation as the request spelled it, and the probability that it is false."""

    is_misplaced: Annotated[
        bool, Field(description="the probability reaches the threshold for `sensitivity`")
    ] = False


class OutliersAnswer(Answer):
    """Every object, least fitting first, and every relation given or observed, least likely first.

    In `misplaced`, `probability`: the relation is false.
    """

    threshold: Annotated[
        Probability | None,
        Field(description="probability from which an object is an outlier, as it was in force"),
    ] = None
    outliers: list[Outlier]
    misplaced: list[MisplacedRelation]


class GeneratedScene(Reply):
    """A drawn scene: labels, relations between labels, and the context that was active."""

    objects: list[str]
    relations: list[Relation]
    log_score: Finite
    context: Annotated[
        dict[str, list[int]], Field(description="layer name to the numbers of its active units")
    ]


class GenerateAnswer(Answer):
    """Scenes that contain the evidence; the same `seed` draws the same ones again."""

    seed: int
    scenes: list[GeneratedScene]


# ---------------------------------------------------------------------------------- problems


class FieldError(Reply):
    """One thing that is wrong with a request."""

    pointer: Annotated[
        str,
        Field(description="JSON pointer into the body, as a URI fragment (RFC 6901, section 6)"),
    ]
    message: str
    suggestions: Annotated[list[str], Field(description="nearest known names, best first")] = []


class Failure(Reply):
    """Something in the store that cannot be used, and why."""

    subject: Annotated[str, Field(description="`name@version`, an alias, or `store`")]
    reason: Annotated[str, Field(description="a stable code")]
    detail: str


class Problem(Reply):
    """Problem details (RFC 9457), media type `application/problem+json`."""

    type: Annotated[str, Field(description="stable path of the problem's page; branch on it")]
    title: str
    status: int
    detail: str
    instance: Annotated[str, Field(description="the problem's page, the request id as fragment")]
    request_id: str
    errors: Annotated[
        list[FieldError] | None, Field(description="what is wrong, and where; at most 100 entries")
    ] = None
    failures: Annotated[
        list[Failure] | None, Field(description="what a refresh refused, and why")
    ] = None


AnswerT = TypeVar("AnswerT", bound=Answer)


class BatchEntry(Reply, Generic[AnswerT]):
    """The outcome of one scene: a `result`, or the `problem` it would have met alone."""

    status: int
    result: AnswerT | None = None
    problem: Problem | None = None


class BatchAnswer(Reply, Generic[AnswerT]):
    """One entry a scene, in order."""

    request_id: str
    results: list[BatchEntry[AnswerT]]


# ------------------------------------------------------------------------------------ models


class Metric(Reply):
    """One figure measured on held-out scenes, with its 95 % interval over n units."""

    task: str
    source: str
    metric: str
    value: Finite
    low: Finite
    high: Finite
    n: int


class TrainingSource(Reply):
    """Scenes that a model was trained on, and their terms."""

    source: str
    scenes: int
    digest: str
    terms: str
    research_only: bool


class VersionSummary(Reply):
    """One version of a model: usable, or refused with the reason."""

    version: str
    status: Literal["ready", "refused"]
    aliases: Annotated[list[str], Field(description="aliases that lead to this version")]
    variant: str | None = None
    digest: str | None = None
    reason: Annotated[str | None, Field(description="why it was refused: a stable code")] = None
    detail: Annotated[str | None, Field(description="the same in words")] = None


class ModelSummary(Reply):
    """A model and its versions, newest first."""

    name: str
    versions: list[VersionSummary]


class ModelList(Reply):
    """What the service has, and the aliases that lead to it."""

    models: list[ModelSummary]
    aliases: Annotated[
        dict[str, str], Field(description="alias to `name@version`, or to `name` for its newest")
    ]
    failures: Annotated[
        list[Failure], Field(description="what of the store cannot be used, and why")
    ] = []
    generation: Annotated[
        str,
        Field(description="the same in all replicas that serve the same versions and aliases"),
    ] = ""


class VersionDetails(VersionSummary):
    """All there is to know about one version; a refused one has no more than its summary."""

    name: str
    created: datetime | None = None
    parameters: Annotated[int | None, Field(description="how many weights it has")] = None
    metrics: list[Metric] = []
    data: Annotated[list[TrainingSource], Field(description="what it was trained on")] = []
    terms: Annotated[str | None, Field(description="licence of the weights")] = None
    card: Annotated[str | None, Field(description="the model card, in Markdown")] = None


class VocabularyEntry(Reply):
    """One class of objects. Structure (walls, floors, vague names) is accepted, never proposed."""

    label: str
    aliases: list[str]
    structure: bool
    size: Annotated[
        Size | None,
        Field(description="typical extents in metres, taken where a detection brings none"),
    ] = None


class VocabularyAnswer(Reply):
    """The words of a model. Case, separators and plurals never matter."""

    model: ModelReference
    objects: list[VocabularyEntry]
    relations: list[RelationName]
    room_types: list[str]


class WeightedLabel(Reply):
    """An object or room type and its weight to a hidden unit."""

    label: str
    weight: Finite


class WeightedRelation(Reply):
    """A relation between two classes and its weight to a hidden unit."""

    subject: str
    relation: RelationName
    object: str
    weight: Finite


class ContextUnit(Reply):
    """A hidden unit by the objects, relations and room types it goes with, strongest first."""

    unit: int
    name: Annotated[str, Field(description="its first objects and relation, for people to read")]
    objects: list[WeightedLabel]
    relations: Annotated[
        list[WeightedRelation],
        Field(
            description="of those that the model saw in training; their weights are beyond the "
            "mean over the layer"
        ),
    ]
    room_types: list[WeightedLabel]


class ContextsAnswer(Reply):
    """The hidden units of a model, layer by layer."""

    model: ModelReference
    layers: dict[str, list[ContextUnit]]


class RefreshAnswer(Reply):
    """What a refresh changed."""

    request_id: str
    default: Annotated[ModelReference, Field(description="the model that `default` leads to")]
    added: Annotated[list[str], Field(description="`name@version` that now answer and did not")]
    removed: Annotated[list[str], Field(description="`name@version` that no longer answer")]
    failures: Annotated[
        list[Failure], Field(description="what could not be used before, and still cannot")
    ] = []


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


class AliasAnswer(Reply):
    """Where an alias leads now, and where it led before."""

    request_id: str
    alias: str
    model: str
    previous: str | None = None


# ------------------------------------------------------------------------------------ health


class Health(Reply):
    """The service's own spelling of health."""

    status: Literal["live", "ready"]


class ServerMetadata(Reply):
    """Open Inference Protocol: the server."""

    name: str
    version: str
    extensions: list[str]


class ServerLive(Reply):
    """Open Inference Protocol: the process answers."""

    live: bool


class ServerReady(Reply):
    """Open Inference Protocol: the default model answers."""

    ready: bool


class ModelReady(Reply):
    """Open Inference Protocol: this model answers."""

    name: str
    ready: bool


class TensorMetadata(Reply):
    """Open Inference Protocol: a tensor. The questions of this service are not put in tensors."""

    name: str
    datatype: str
    shape: list[int]


class ModelMetadata(Reply):
    """Open Inference Protocol: a model. It is asked through `/relations` and its siblings."""

    name: str
    versions: list[str]
    platform: str
    inputs: list[TensorMetadata] = []
    outputs: list[TensorMetadata] = []
