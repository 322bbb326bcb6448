"""Answers of the four questions, and problems."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Generic, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from scene_client.schemas.requests import Finite, Probability, Relation, RelationName, Stamp


class Reply(BaseModel):
    """Part of an answer."""

    model_config = ConfigDict(frozen=True)


# ---------------------------------------------------------------------------------- problems


class FieldError(Reply):
    """One error in a request."""

    pointer: Annotated[
        str,
        Field(description="JSON pointer into the body, as a URI fragment (RFC 6901, section 6)"),
    ]
    message: str
    suggestions: Annotated[list[str], Field(description="similar known names, best first")] = []


class Failure(Reply):
    """An entry of the model store that cannot be used, and the reason."""

    subject: Annotated[str, Field(description="`name@version`, an alias, or `store`")]
    reason: Annotated[str, Field(description="a stable code of the reason")]
    detail: str


class Problem(Reply):
    """Problem details (RFC 9457), media type `application/problem+json`."""

    type: Annotated[str, Field(description="stable path of the problem's page; branch on it")]
    title: str
    status: int
    detail: str
    instance: Annotated[
        str, Field(description="path of the problem's page with the request id as fragment")
    ]
    request_id: str
    errors: Annotated[
        list[FieldError] | None, Field(description="errors with their places, at most 100")
    ] = None
    failures: Annotated[
        list[Failure] | None,
        Field(description="entries of the store that a refresh refused, with reasons"),
    ] = None


# ----------------------------------------------------------------------------------- answers


class ModelReference(Reply):
    """The model that answered."""

    name: str
    version: str
    variant: Annotated[str, Field(description="rbm, gbm or triway")]
    digest: Annotated[str, Field(description="sha256 over the artifact")]


@dataclass(slots=True)
class ObservedRelation:
    """A relation between two objects (by id), derived from their positions."""

    # A dataclass: a scene of a dozen objects has some fifty of these, and a pydantic model takes
    # ten times as long.
    subject: str
    relation: RelationName
    object: str


class Mapped(Reply):
    """A label that the model does not know, and the class that replaces it."""

    model_config = ConfigDict(frozen=True, populate_by_name=True, serialize_by_alias=True)

    label: Annotated[
        str, Field(description="the label in the request: of an object, a candidate or the room")
    ]
    class_: Annotated[str, Field(alias="class", description="canonical label of the class")]
    similarity: Annotated[
        float,
        Field(ge=0, le=1, description="similarity of the names, by spelling and common words"),
    ]


class SceneWarning(Reply):
    """A probable mistake in the scene. The scene is answered nevertheless."""

    code: Annotated[
        Literal["implausible-position", "implausible-size", "flat-scene", "unknown-sizes"],
        Field(
            description="implausible-position: beyond 100 m, perhaps in millimetres. "
            "implausible-size: a side below 1 mm or above 20 m. flat-scene: equal depth of all "
            "objects in an optical frame. unknown-sizes: vertical relations are unobserved "
            "because sizes are unknown"
        ),
    ]
    message: str
    objects: Annotated[list[str], Field(description="ids of the objects of the warning")]


class Answer(Reply):
    """Fields that every answer has."""

    model: ModelReference
    request_id: Annotated[
        str, Field(description="value of the X-Request-Id header, or a random id")
    ]
    frame_id: Annotated[str | None, Field(description="as in the request")] = None
    stamp: Annotated[Stamp | None, Field(description="as in the request")] = None
    ignored: Annotated[
        list[str],
        Field(
            description="with `unknown_labels: ignore`: ids of objects, candidates and the room "
            "type that the model does not know; the answer leaves them out"
        ),
    ] = []
    mapped: Annotated[
        list[Mapped],
        Field(
            description="with `unknown_labels: nearest`: labels that the model does not know, "
            "with the class that replaces each"
        ),
    ] = []
    warnings: Annotated[
        list[SceneWarning], Field(description="probable mistakes in the scene")
    ] = []
    observed_relations: Annotated[
        list[ObservedRelation] | None,
        Field(description="relations derived from positions; absent without positions"),
    ] = None


class ScoredRelation(Reply):
    """A relation between two objects (by id) and its probability."""

    subject: str
    relation: RelationName
    object: str
    probability: Probability


@dataclass(slots=True)
class Disagreement:
    """Two objects (by id) whose observed relation differs from the expected one.

    `observed`: stated or derived relations of `subject` to `object`. `expected`: the likeliest
    relation given the rest of the scene, without any observed relation of the two objects.
    `probability`: probability of `expected`. `observed_probability`: probability of the likeliest
    observed relation.
    """

    # A dataclass too, because half of the observed relations may appear here.
    subject: str
    object: str
    observed: list[RelationName]
    expected: RelationName
    probability: Probability
    observed_probability: Probability


class ExpectedRelation(ScoredRelation):
    """A relation and the probability that it holds, given that both objects are in the scene."""

    observed: Annotated[
        bool, Field(description="the request states the relation, or positions show it")
    ] = False


class RelationsAnswer(Answer):
    """Relations, best first.

    `probability`: the relation holds between the two objects, given that both are in the scene.
    """

    relations: list[ExpectedRelation]
    disagreements: Annotated[
        list[Disagreement],
        Field(
            description="pairs whose stated or derived relation differs from the expected one. The "
            "expected relation has a probability of at least one half given the rest of the scene. "
            "Largest ratio of the probabilities first, at most `top_k`"
        ),
    ]


# Dataclasses: an answer has thirty of these, and a pydantic model takes ten times as long.
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


@dataclass(slots=True)
class Because:
    """The change of an object's log-odds by the presence of another object (by id)."""

    # A dataclass too: an answer has some thirty of these.
    object: str
    log_odds_change: Finite


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


class Outlier(Reply):
    """How well one object fits the scene.

    `probability`: the object does not belong, if half of all scenes contain an intruder.
    `log_odds`: log-odds that its class is present, given the rest of the scene.
    """

    object: str
    label: str
    probability: Probability
    log_odds: Finite
    is_outlier: bool
    because: Annotated[
        list[Because],
        Field(
            description="objects that support the verdict, strongest first, at most 3. For an "
            "outlier, they make the object unlikely; for any other object, they make it likely"
        ),
    ]
    usually_with: Annotated[
        list[str],
        Field(description="for an outlier: absent classes that would make it likely, at most 3"),
    ] = []


class MisplacedRelation(ScoredRelation):
    """A relation as the request spells it, and the probability that it is false."""

    is_misplaced: Annotated[
        bool, Field(description="true if `probability` reaches the threshold of `sensitivity`")
    ] = False


class OutliersAnswer(Answer):
    """Objects, least fitting first, and stated or derived relations, least likely first.

    In `misplaced`, `probability` means that the relation is false.
    """

    threshold: Annotated[
        Probability | None,
        Field(description="applied probability from which an object is an outlier"),
    ] = None
    outliers: list[Outlier]
    misplaced: list[MisplacedRelation]


class GeneratedScene(Reply):
    """A sampled scene: labels, relations between labels, and the active context units."""

    objects: list[str]
    relations: list[Relation]
    log_score: Finite
    context: Annotated[
        dict[str, list[int]],
        Field(description="numbers of the active units, by the name of the layer"),
    ]


class GenerateAnswer(Answer):
    """Scenes that contain the given objects; an equal `seed` gives equal scenes."""

    seed: int
    scenes: list[GeneratedScene]


AnswerT = TypeVar("AnswerT", bound=Answer)


class BatchEntry(Reply, Generic[AnswerT]):
    """The outcome of one scene: a `result`, or the `problem` of the scene."""

    status: int
    result: AnswerT | None = None
    problem: Problem | None = None


class BatchAnswer(Reply, Generic[AnswerT]):
    """One entry for each scene, in the order of the request."""

    request_id: str
    results: list[BatchEntry[AnswerT]]
