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
