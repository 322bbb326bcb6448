"""Messages of ``GET /stream``: plain pydantic, shared by the service and its clients.

A client's messages are read as strictly as a request; docs/stream.md is the contract.
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
"""Every JSON reader keeps such a number as it is: a double holds it exactly."""

Seq = Annotated[int, Field(ge=1, le=MAX_SEQ, description="greater than in any message before")]

# --------------------------------------------------------------------------------- from clients


class Ask(Request):
    """The questions to answer, each with the options of its route."""

    missing: MissingOptions | None = None
    outliers: OutliersOptions | None = None
    relations: RelationsOptions | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.missing is None and self.outliers is None and self.relations is None:
            raise PydanticCustomError("nothing_asked", "must ask at least one question")
        return self


class SceneMessage(SceneRequest):
    """Fields of a scene; an object without an id has its label for one."""

    objects: list[SceneObject] = Field(default_factory=list, max_length=256)
    ask: Annotated[Ask | None, Field(description="null: missing and outliers")] = None
    timeout_ms: Annotated[
        int | None,
        Field(ge=1, le=600_000, description="an answer that has not begun by then is dropped"),
    ] = None


class Open(SceneMessage):
    """The first message; it may hold the scene."""

    type: Literal["open"]


class Whole(SceneMessage):
    """A whole scene in place of the one before."""

    type: Literal["scene"]
    seq: Seq


class Update(SceneMessage):
    """Objects added or replaced by id, and removed; fields that are given replace those before."""

    type: Literal["update"]
    seq: Seq
    remove: list[Name] = Field(
        default_factory=list, max_length=256, description="ids; their relations go with them"
    )


class Ping(Request):
    """Asks for a pong, and keeps a quiet stream open."""

    type: Literal["ping"]


Command = Open | Whole | Update | Ping
COMMANDS: Final[dict[str, type[Command]]] = {
    "open": Open,
    "scene": Whole,
    "update": Update,
    "ping": Ping,
}

# A whole scene leaves these as they are unless it names them.
_KEPT: Final = frozenset({"model", "unknown_labels", "ask", "timeout_ms"})
_FIELDS: Final = frozenset(SceneMessage.model_fields) - {"objects", "seed"}


@dataclass(frozen=True, slots=True)
class MergedScene:
    """A scene after some messages; the service and the client keep one each.

    Attributes:
        objects: by id, in the order in which they came.
        fields: the other fields of `SceneMessage`, as far as they were given.
    """

    objects: Mapping[str, str | Detection] = field(default_factory=dict)
    fields: Mapping[str, Any] = field(default_factory=dict)

    def after(self, message: SceneMessage) -> MergedScene:
        """The scene with a message merged into it; ids to remove may be unknown."""
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
    """Its own id, or its label."""
    return thing if isinstance(thing, str) else thing.id or thing.label


# ------------------------------------------------------------------------------ from the service


class StreamLimits(Reply):
    """Limits of a stream."""

    max_message_bytes: int
    max_objects: int
    max_relations: int
    timeout_ms: Annotated[int, Field(description="where the client names none")]
    idle_seconds: Annotated[float, Field(description="without a message the stream is closed")]


class Opened(Reply):
    """The stream is open."""

    type: Literal["opened"] = "opened"
    seq: Annotated[int, Field(description="0: no message is taken yet")] = 0
    request_id: str
    limits: StreamLimits


class AnswerMessage(Reply):
    """The answers about the newest scene, each as its route gives it."""

    type: Literal["answer"] = "answer"
    seq: Annotated[int, Field(description="the newest message that it covers; 0: the opening")]
    superseded: Annotated[int, Field(description="earlier messages without an answer of their own")]
    missing: MissingAnswer | None = None
    outliers: OutliersAnswer | None = None
    relations: RelationsAnswer | None = None
    problems: dict[str, Problem] = Field(
        default_factory=dict, description="by question: why it has no answer"
    )


class ProblemMessage(Reply):
    """A message was refused; the scene is as before."""

    type: Literal["problem"] = "problem"
    seq: Annotated[int | None, Field(description="of the message, where it has one")] = None
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
