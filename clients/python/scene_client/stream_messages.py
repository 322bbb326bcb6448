"""Messages of ``GET /stream`` as pydantic models. The service and its clients use the same models.

The messages of clients have the strict validation of requests. docs/stream.md describes the
protocol.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from scene_client.schemas import (
    Detection,
    MissingAnswer,
    MissingOptions,
    Name,
    OutliersAnswer,
    OutliersOptions,
    Problem,
    RelationsAnswer,
    RelationsOptions,
    Reply,
    Request,
    SceneObject,
    SceneRequest,
)

MAX_SEQ: Final = 2**53 - 1
"""Maximum number of a message. JSON readers that use doubles read it exactly."""

Seq = Annotated[
    int,
    Field(ge=1, le=MAX_SEQ, description="number of the message; it must grow with each message"),
]

# --------------------------------------------------------------------------------- from clients


class Ask(Request):
    """The questions to answer. Each question has the options of its route."""

    missing: MissingOptions | None = None
    outliers: OutliersOptions | None = None
    relations: RelationsOptions | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.missing is None and self.outliers is None and self.relations is None:
            raise PydanticCustomError("nothing_asked", "must ask at least one question")
        return self


class SceneMessage(SceneRequest):
    """Base class of the messages with fields of a scene.

    An object without an id has its label as id.
    """

    objects: list[SceneObject] = Field(default_factory=list, max_length=256)
    ask: Annotated[
        Ask | None, Field(description="the questions; null means missing and outliers")
    ] = None
    timeout_ms: Annotated[
        int | None,
        Field(ge=1, le=600_000, description="time limit of each answer in milliseconds"),
    ] = None


class Open(SceneMessage):
    """The first message of a stream. It may contain the scene."""

    type: Literal["open"]


class Whole(SceneMessage):
    """A whole scene that replaces the previous one."""

    type: Literal["scene"]
    seq: Seq


class Update(SceneMessage):
    """Added, changed and removed objects. An object replaces an earlier object with the same id.

    The fields of the message replace earlier values.
    """

    type: Literal["update"]
    seq: Seq
    remove: list[Name] = Field(
        default_factory=list,
        max_length=256,
        description="ids of removed objects; the service removes their relations too",
    )


class Ping(Request):
    """A request for a `pong`. It keeps an idle stream open."""

    type: Literal["ping"]


Command = Open | Whole | Update | Ping
COMMANDS: Final[dict[str, type[Command]]] = {
    "open": Open,
    "scene": Whole,
    "update": Update,
    "ping": Ping,
}

# If a message of type `scene` does not contain these fields, their earlier values stay.
_KEPT: Final = frozenset({"model", "unknown_labels", "ask", "timeout_ms"})
_FIELDS: Final = frozenset(SceneMessage.model_fields) - {"objects", "seed"}


@dataclass(frozen=True, slots=True)
class MergedScene:
    """The scene that results from several messages. Service and client each keep a copy.

    Attributes:
        objects: maps ids to objects, in the order of their arrival.
        fields: maps the names of all other fields of the messages to their values.
    """

    objects: Mapping[str, str | Detection] = field(default_factory=dict)
    fields: Mapping[str, Any] = field(default_factory=dict)

    def after(self, message: SceneMessage) -> MergedScene:
        """Return a copy of the scene with a message merged into it.

        The method ignores unknown ids in `remove`.
        """
        objects, fields = dict(self.objects), dict(self.fields)
        if isinstance(message, Whole):
            objects = {}
            fields = {name: value for name, value in fields.items() if name in _KEPT}
        elif isinstance(message, Update) and message.remove:
            removed = set(message.remove)
            objects = {name: thing for name, thing in objects.items() if name not in removed}
            if fields.get("relations"):
                fields["relations"] = [
                    relation
                    for relation in fields["relations"]
                    if relation.subject not in removed and relation.object not in removed
                ]
        objects |= {object_id(thing): thing for thing in message.objects}
        fields |= {name: getattr(message, name) for name in message.model_fields_set & _FIELDS}
        return MergedScene(objects, fields)


def object_id(thing: str | Detection) -> str:
    """Return the id of an object, or its label if it has no id."""
    return thing if isinstance(thing, str) else thing.id or thing.label


# ------------------------------------------------------------------------------ from the service


class StreamLimits(Reply):
    """Limits of a stream."""

    max_message_bytes: int
    max_objects: int
    max_relations: int
    timeout_ms: Annotated[int, Field(description="default timeout in milliseconds")]
    idle_seconds: Annotated[
        float, Field(description="seconds without a message until the stream closes")
    ]


class Opened(Reply):
    """The stream is open."""

    type: Literal["opened"] = "opened"
    seq: Annotated[int, Field(description="always 0, the number of the opening message")] = 0
    request_id: str
    limits: StreamLimits


class AnswerMessage(Reply):
    """The answers about the newest scene. Each answer has the form of its route's answer."""

    type: Literal["answer"] = "answer"
    seq: Annotated[
        int,
        Field(description="number of the newest message that the answer covers; 0 for the opening"),
    ]
    superseded: Annotated[
        int, Field(description="number of earlier messages that the answer covers too")
    ]
    missing: MissingAnswer | None = None
    outliers: OutliersAnswer | None = None
    relations: RelationsAnswer | None = None
    problems: dict[str, Problem] = Field(
        default_factory=dict, description="maps each question without an answer to its problem"
    )


class ProblemMessage(Reply):
    """The service refused a message. The scene is unchanged."""

    type: Literal["problem"] = "problem"
    seq: Annotated[
        int | None, Field(description="number of the refused message, if it has one")
    ] = None
    problem: Problem


class Pong(Reply):
    """The answer to a ping."""

    type: Literal["pong"] = "pong"


Event = Opened | AnswerMessage | ProblemMessage | Pong
EVENTS: Final[dict[str, type[Event]]] = {
    "opened": Opened,
    "answer": AnswerMessage,
    "problem": ProblemMessage,
    "pong": Pong,
}
