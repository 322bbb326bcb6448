"""Messages of ``GET /stream`` as pydantic models. The service and its clients use the same models.

The validation of messages from clients is as strict as the validation of requests. docs/stream.md
describes the protocol.
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
"""Maximum sequence number of a message. A double represents every integer up to it exactly."""

Seq = Annotated[
    int,
    Field(
        ge=1,
        le=MAX_SEQ,
        description="sequence number of the message; it must grow with each message",
    ),
]

# --------------------------------------------------------------------------------- from clients


class Ask(Request):
    """The questions that the service answers on a stream, with the options of their routes."""

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
    """A whole scene that replaces the previous scene of the stream."""

    type: Literal["scene"]
    seq: Seq


class Update(SceneMessage):
    """Added, changed and removed objects. An object replaces an earlier object with the same id.

    Other fields of the message, such as `room_type`, replace their earlier values.
    """

    type: Literal["update"]
    seq: Seq
    remove: list[Name] = Field(
        default_factory=list,
        max_length=256,
        description="ids of objects to remove, together with their relations",
    )


class Ping(Request):
    """A message that keeps an idle stream open. The service answers with a `pong`."""

    type: Literal["ping"]


Command = Open | Whole | Update | Ping
COMMANDS: Final[dict[str, type[Command]]] = {
    "open": Open,
    "scene": Whole,
    "update": Update,
    "ping": Ping,
}

# If a message of type `scene` does not contain one of these fields, the earlier value stays.
_KEPT: Final = frozenset({"model", "unknown_labels", "ask", "timeout_ms"})
_FIELDS: Final = frozenset(SceneMessage.model_fields) - {"objects", "seed"}


@dataclass(frozen=True, slots=True)
class MergedScene:
    """The scene that results from several messages. Service and client each keep a copy.

    Attributes:
        objects: dictionary from ids to objects, in the order in which the objects arrived.
        fields: dictionary from the names of all other fields of the scene to their values.
    """

    objects: Mapping[str, str | Detection] = field(default_factory=dict)
    fields: Mapping[str, Any] = field(default_factory=dict)

    def after(self, message: SceneMessage) -> MergedScene:
        """Return a copy of the scene that also contains the changes of a message.

        The method ignores ids in `remove` that the scene does not contain.
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
    """Return the id of an object. An object without an id has its label as id."""
    return thing if isinstance(thing, str) else thing.id or thing.label


# ------------------------------------------------------------------------------ from the service


class StreamLimits(Reply):
    """Limits of the service on the messages and scenes of a stream."""

    max_message_bytes: int
    max_objects: int
    max_relations: int
    timeout_ms: Annotated[int, Field(description="default timeout in milliseconds")]
    idle_seconds: Annotated[
        float, Field(description="seconds without a message until the stream closes")
    ]


class Opened(Reply):
    """The service has accepted the opening message, so the stream is open."""

    type: Literal["opened"] = "opened"
    seq: Annotated[int, Field(description="sequence number of the opening message, always 0")] = 0
    request_id: str
    limits: StreamLimits


class AnswerMessage(Reply):
    """The answers about the newest scene. Each answer has the schema of its question's route."""

    type: Literal["answer"] = "answer"
    seq: Annotated[
        int,
        Field(
            description="sequence number of the newest message in the scene; 0: the opening message"
        ),
    ]
    superseded: Annotated[
        int, Field(description="number of earlier messages without an answer of their own")
    ]
    missing: MissingAnswer | None = None
    outliers: OutliersAnswer | None = None
    relations: RelationsAnswer | None = None
    problems: dict[str, Problem] = Field(
        default_factory=dict, description="maps each question without an answer to its problem"
    )


class ProblemMessage(Reply):
    """The service refused a message. The scene of the stream is unchanged."""

    type: Literal["problem"] = "problem"
    seq: Annotated[
        int | None,
        Field(description="sequence number of the refused message, if it has a valid one"),
    ] = None
    problem: Problem


class Pong(Reply):
    """The answer to a message of type `ping`."""

    type: Literal["pong"] = "pong"


Event = Opened | AnswerMessage | ProblemMessage | Pong
EVENTS: Final[dict[str, type[Event]]] = {
    "opened": Opened,
    "answer": AnswerMessage,
    "problem": ProblemMessage,
    "pong": Pong,
}
