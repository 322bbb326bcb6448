"""Answers of the four questions, and problems."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Generic, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from scene_client.schemas.requests import Finite, Probability, RelationName, Stamp


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


# No models: an answer holds thirty of them, and a model takes ten times as long.


@dataclass(slots=True)
class Because:
    """How much the presence of one object (by id) changes the log-odds of another."""

    # No model here either: an answer holds some thirty.
    object: str
    log_odds_change: Finite


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
