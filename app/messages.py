"""Messages of ``GET /stream``: plain pydantic, shared by the service and its clients.

What a client sends is as strict as a request; docs/stream.md says how messages follow each other.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from app.schemas import (
    Mapped,
    MissingOptions,
    ModelReference,
    Name,
    OutliersOptions,
    Problem,
    RelationsOptions,
    Reply,
    Request,
    SceneObject,
    SceneRequest,
    SceneWarning,
    Stamp,
)

MAX_SEQ: Final = 2**53 - 1
"""Every JSON reader keeps such a number as it is: a double holds it exactly."""

Seq = Annotated[int, Field(ge=1, le=MAX_SEQ, description="greater than that of any message before")]
SessionId = Annotated[str, Field(min_length=1, max_length=64, pattern="^[A-Za-z0-9_-]+$")]


# --------------------------------------------------------------------------------- from clients


class Ask(Request):
    """Which questions are answered, each with what a request to its route may say."""

    missing: MissingOptions | None = None
    outliers: OutliersOptions | None = None
    relations: RelationsOptions | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.missing is None and self.outliers is None and self.relations is None:
            raise PydanticCustomError("nothing_asked", "must ask at least one question")
        return self


class SceneMessage(SceneRequest):
    """What a scene message, an update and an opening have in common: fields of a scene.

    An object without an id has its label for one; relations are kept by the ids they name.
    """

    objects: list[SceneObject] = Field(default_factory=list, max_length=256)
    ask: Annotated[Ask | None, Field(description="left out: as before")] = None
    timeout_ms: Annotated[
        int | None,
        Field(ge=1, le=600_000, description="an answer not begun by then is not computed"),
    ] = None


class Open(SceneMessage):
    """The first message: a new session, or one that is taken up again."""

    type: Literal["open"]
    session: Annotated[SessionId | None, Field(description="id of a session to resume")] = None


class Whole(SceneMessage):
    """A whole scene in place of the one before; `model`, `ask` and so on stay unless given."""

    type: Literal["scene"]
    seq: Seq


class Update(SceneMessage):
    """Objects added, moved or changed (each by its id, as a whole) and removed; fields that are
    given replace those before, and null takes them back."""

    type: Literal["update"]
    seq: Seq
    remove: list[Name] = Field(
        default_factory=list, max_length=256, description="ids; their relations go with them"
    )


class Get(Request):
    """Asks for whole answers about the scene as it is."""

    type: Literal["get"]


class Ping(Request):
    """Asks for a sign of life, and counts as one."""

    type: Literal["ping"]


class Close(Request):
    """The end: the session is forgotten."""

    type: Literal["close"]


Command = Open | Whole | Update | Get | Ping | Close
COMMANDS: Final[dict[str, type[Command]]] = {
    "open": Open,
    "scene": Whole,
    "update": Update,
    "get": Get,
    "ping": Ping,
    "close": Close,
}


# ------------------------------------------------------------------------------ from the service


class StreamLimits(Reply):
    """What the service allows a stream."""

    max_message_bytes: int
    max_objects: int
    max_relations: int
    timeout_ms: Annotated[int, Field(description="where the client names none")]
    idle_seconds: Annotated[float, Field(description="without a message the stream is closed")]
    resume_seconds: Annotated[float, Field(description="a session is kept so long without one")]


class Opened(Reply):
    """The session is there."""

    type: Literal["opened"] = "opened"
    session: Annotated[str, Field(description="its id: who knows it may resume it")]
    resumed: bool
    seq: Annotated[int, Field(description="of the newest message that the session took; 0: none")]
    revision: Annotated[int, Field(description="how many answers the session has given")]
    request_id: str
    limits: StreamLimits


class ListChanges(Reply):
    """How one list of an answer became another.

    Entries are told apart by their texts: an outlier by object and label, a relation by subject,
    relation and object. Take away what is `gone`, put what is `changed` in the place of the entry
    with its texts, append what `appeared`, and read off the result by `order`.
    """

    gone: Annotated[list[dict[str, str]] | None, Field(description="the texts of entries")] = None
    changed: list[dict[str, Any]] | None = None
    appeared: list[dict[str, Any]] | None = None
    order: Annotated[
        list[int] | None, Field(description="place k is taken by entry order[k]; absent: as it is")
    ] = None


class Alarms(Reply):
    """Objects by id that are outliers and were none, and those that were and no longer are."""

    raised: list[str] = Field(default_factory=list)
    cleared: list[str] = Field(default_factory=list)


class AnswerMessage(Reply):
    """What has changed since the answer before."""

    type: Literal["answer"] = "answer"
    seq: Annotated[int, Field(description="the newest message that it covers; 0: the opening")]
    superseded: Annotated[int, Field(description="how many messages before that it covers as well")]
    revision: Annotated[int, Field(description="number of the answer; counts from 1")]
    full: Annotated[
        bool, Field(description="the changes start from nothing: forget all answers before")
    ]
    model: ModelReference
    frame_id: str | None = None
    stamp: Stamp | None = None
    ignored: list[str] = Field(default_factory=list)
    mapped: list[Mapped] = Field(default_factory=list)
    warnings: list[SceneWarning] = Field(default_factory=list)
    coverage: Annotated[float | None, Field(description="as in the answer of `/missing`")] = None
    threshold: Annotated[float | None, Field(description="as in the answer of `/outliers`")] = None
    changes: Annotated[
        dict[str, ListChanges], Field(description="lists by their names in the answers of POST")
    ]
    dropped: list[str] = Field(default_factory=list, description="lists that are no longer there")
    alarms: Alarms = Alarms()
    problems: dict[str, Problem] = Field(
        default_factory=dict, description="questions that could not be answered, and why"
    )


class ProblemMessage(Reply):
    """A message was refused, which changes nothing; or its answer could not be given."""

    type: Literal["problem"] = "problem"
    seq: Annotated[int | None, Field(description="of the message, where it has one")] = None
    retry_after: Annotated[int | None, Field(description="seconds")] = None
    problem: Problem


class Pong(Reply):
    """The answer to a ping."""

    type: Literal["pong"] = "pong"


class Closed(Reply):
    """The answer to a close."""

    type: Literal["closed"] = "closed"


Event = Opened | AnswerMessage | ProblemMessage | Pong | Closed
EVENTS: Final[dict[str, type[Event]]] = {
    "opened": Opened,
    "answer": AnswerMessage,
    "problem": ProblemMessage,
    "pong": Pong,
    "closed": Closed,
}
