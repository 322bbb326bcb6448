"""Schemas of the parts that all answers share, and of problems."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Generic, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from scene_client.schemas.requests import Finite, Probability, RelationName, Stamp


class Reply(BaseModel):
    """Base class of all parts of an answer."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)


# ---------------------------------------------------------------------------------- problems


class FieldError(Reply):
    """One error in a request."""

    pointer: str
    """JSON pointer into the body, as a URI fragment (RFC 6901, section 6)"""
    message: str
    suggestions: list[str] = []
    """similar known names, best first"""


class Failure(Reply):
    """An unusable version or alias of the model store, with the reason."""

    subject: str
    """name of the unusable entry: `name@version`, an alias, or `store`"""
    reason: str
    """stable code of the reason"""
    detail: str


class Problem(Reply):
    """Problem details (RFC 9457), media type `application/problem+json`."""

    type: str
    """path of the problem type's page, which never changes"""
    title: str
    status: int
    detail: str
    instance: str
    """path of the problem's page with the request id as fragment"""
    request_id: str
    errors: list[FieldError] | None = None
    """errors in the request, at most 100"""


# ----------------------------------------------------------------------------------- answers


class ModelReference(Reply):
    """The model that answered."""

    name: str
    version: str
    variant: str
    """rbm, gbm or triway"""
    digest: str
    """SHA-256 digest of the model's manifest"""


@dataclass(slots=True)
class ObservedRelation:
    """A relation between two objects, derived from their positions. Objects are named by id."""

    # `ObservedRelation` is a dataclass, because the creation of a pydantic model takes ten times as
    # long. A scene of twelve objects has about fifty derived relations.
    subject: str
    relation: RelationName
    object: str


Rule = Literal[
    "alias", "phrase", "qualifier", "alternative", "article", "instance", "prompt",
    "spelling", "head", "meaning",
]  # fmt: skip
"""how the service reads a label that is not a label of the vocabulary"""


class Mapped(Reply):
    """A label that the service has read as a class or room type with another name."""

    model_config = ConfigDict(frozen=True, populate_by_name=True, serialize_by_alias=True)

    label: str
    """label of an object or candidate, or room type"""
    class_: Annotated[str, Field(alias="class")]
    """canonical label of the class, or room type of the model. With the rule `meaning`, the label
    is a word of its own, and this class only stands in for it; see `rule`"""
    similarity: Annotated[float, Field(ge=0, le=1)]
    """similarity of the label and the class. 1 means that the rule is certain"""
    rule: Rule
    """how the service read the label. Certain rules: alias (`hall`), phrase (`bottle of milk`),
    qualifier (`mouse_(computer_equipment)`, `table_large`), alternative (`sofa/couch`), article
    (`a chair`), instance (`chair_12`, `/World/Mug_2`), prompt (`a photo of a chair`). Guesses:
    spelling (`nigthstand`), head (`office table`). `meaning`: the model predicts the weights of the
    word (`ottoman`) from the classes of similar words. Its relations and places are those of
    `class`, the nearest of them.
    Such an object is never an outlier"""


WarningCode = Literal[
    "convention", "implausible-position", "implausible-size", "flat-scene", "unknown-sizes",
    "not-judged", "several-rooms",
]  # fmt: skip


@dataclass(slots=True)
class RoomPart:
    """The objects of a scene that are probably in one room, named by id."""

    room_type: str
    objects: list[str]


class SceneWarning(Reply):
    """A probable mistake in the scene, or a limit of the model. The service still answers."""

    code: WarningCode
    """convention: the boxes probably follow another convention than the scene declares; `declare`
    names it. implausible-position: an object is more than 100 m from the viewer. implausible-size:
    all sides of an object are below 1 mm, or one is above 20 m. flat-scene: all objects have the
    same depth in an optical frame. unknown-sizes: vertical relations of an object are unobserved,
    because its size is unknown. not-judged: the model has too few training scenes to judge objects
    or relations, and the list is empty; or too few of them show the class of an object, and the
    object is no outlier; or the scene lists a single class, and no object is an outlier.
    several-rooms: the objects are probably from several rooms, which `rooms` names. The answers are
    about one room, so ask about each room in a request of its own"""
    message: str
    objects: list[str]
    """ids of the objects that the warning concerns; empty for the whole scene"""
    declare: dict[str, str] | None = None
    """for `convention`: the fields of a request that declare the likeliest convention, such as
    `{"up": "y"}`; empty if no field does"""
    rooms: list[RoomPart] | None = None
    """for `several-rooms`: the objects of each room"""


class LabelProbability(Reply):
    """A label of the vocabulary, and the probability that the object has it."""

    label: str
    probability: Probability


class Resolved(Reply):
    """The label of an object with `alternatives`, as the other objects of the scene decide.

    The answer uses the first label. Its confidence is the sum of the confidences of all labels, at
    most 1, multiplied by its probability.
    """

    object: str
    room: str | None = None
    """id of the room of the object, in an answer of `/where`"""
    labels: list[LabelProbability]
    """known labels of the object, likeliest first. The probabilities sum to 1"""


class Answer(Reply):
    """Base class of the answers, with the fields that every answer has."""

    model: ModelReference
    request_id: str
    """id of the request: its X-Request-Id header, or a random id"""
    frame_id: str | None = None
    """`frame_id` of the request"""
    stamp: Stamp | None = None
    """`stamp` of the request"""
    ignored: list[str] = []
    """ids of the objects, candidates and room type that the model does not know. The answer ignores
    them. Room types need another `unknown_labels` than `error`, and objects need `ignore`,
    `nearest-or-ignore` or `by-meaning`"""
    mapped: list[Mapped] = []
    """each label that the vocabulary does not list, and each alias of a candidate or room type. The
    class replaces the label. Aliases of objects are not listed, because answers name objects by id.
    Guesses need `nearest`, `nearest-or-ignore` or `by-meaning` as `unknown_labels`"""
    warnings: list[SceneWarning] = []
    """probable mistakes in the scene"""
    observed_relations: list[ObservedRelation] | None = None
    """relations derived from positions; absent without positions"""
    resolved: list[Resolved] | None = None
    """objects with `alternatives`; absent without any"""


class ScoredRelation(Reply):
    """A relation between two objects and its probability. Objects are named by id."""

    subject: str
    relation: RelationName
    object: str
    probability: Probability


@dataclass(slots=True)
class Because:
    """Effect of an object on an entry of the answer.

    `log_odds_change` is the change of the entry's log-odds by the presence of the object with the
    id `object`.
    """

    # `Because` is a dataclass for speed, because an answer contains about thirty `Because` objects.
    object: str
    log_odds_change: Finite


AnswerT = TypeVar("AnswerT", bound=Answer)


class BatchEntry(Reply, Generic[AnswerT]):
    """The outcome of one scene: either a `result` or a `problem`."""

    # The search for docstrings of attributes would take 20 ms for each `BatchEntry[X]`.
    model_config = ConfigDict(use_attribute_docstrings=False)

    status: int
    result: AnswerT | None = None
    problem: Problem | None = None


class BatchAnswer(Reply, Generic[AnswerT]):
    """Answer to a batch: one entry for each scene, in the order of the scenes in the request."""

    model_config = BatchEntry.model_config

    request_id: str
    results: list[BatchEntry[AnswerT]]
