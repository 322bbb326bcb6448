"""The scene of a stream and its answers. docs/stream.md describes the protocol.

The service merges a valid message into the scene when the message arrives. An invalid message
leaves the scene unchanged. The service computes answers only for the newest scene, so a superseded
update costs no computation. This module does not use WebSockets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Set
from contextlib import contextmanager
from dataclasses import replace
from time import monotonic
from typing import Any, Final

from app.serving import answers
from app.serving.answers import Answer
from app.serving.errors import Location, Reason, RequestError, ServingError
from app.serving.metrics import Metrics
from app.serving.questions import QUESTIONS
from app.serving.reading import Faults, read_scene
from app.serving.request import Request
from scene_client.schemas import MissingOptions, OutliersOptions, SceneRequest
from scene_client.stream_messages import Ask, MergedScene, SceneMessage, Update, Whole, object_id

# Fields of a message that are not fields of a scene request.
_NOT_REQUESTED: Final = frozenset({"ask", "timeout_ms"})
_DEFAULT_ASK: Final = Ask(missing=MissingOptions(), outliers=OutliersOptions())
_BY_NAME: Final = {question.name: question for question in QUESTIONS}
_ASKED: Final = [_BY_NAME[name] for name in Ask.model_fields]


class StreamScene:
    """The scene of one stream and the number of unanswered messages.

    Attributes:
        seq: sequence number of the newest message that has changed the scene. It is 0 if only the
            message `open` has arrived.
        pending: number of accepted messages since the last answer.
    """

    def __init__(self) -> None:
        self.seq = 0
        self.pending = 0
        self._scene = MergedScene()

    @property
    def timeout_ms(self) -> int | None:
        """Time limit of each answer in milliseconds. None means that the client set no limit."""
        timeout: int | None = self._scene.fields.get("timeout_ms")
        return timeout

    def take(self, message: SceneMessage, request: Request) -> None:
        """Merge a message into the scene.

        Raises:
            RequestError: the message or the merged scene is invalid. The scene stays unchanged.
            UnknownModelError, ModelUnavailableError: see `Request.read`.
        """
        faults = Faults()
        if isinstance(message, Whole | Update) and message.seq <= self.seq:
            text = "`seq` must be greater than the `seq` of the newest accepted message"
            faults.add(Reason.INVALID, ("seq",), text)
        for place, name in enumerate(message.remove if isinstance(message, Update) else ()):
            if name not in self._scene.objects:
                text = "no object of the scene has this id"
                faults.add(Reason.INVALID, ("remove", place), text)
        places: dict[str, int] = {}
        for place, thing in enumerate(message.objects):
            if places.setdefault(object_id(thing), place) != place:
                faults.add(Reason.INVALID, ("objects", place, "id"), "another object has this id")
        scene = self._scene.after(message)
        if len(scene.objects) > request.limits.objects:
            text = f"the scene would have more than {request.limits.objects} objects"
            faults.add(Reason.INVALID, ("objects",), text)
        faults.raise_any()
        try:
            asked = _request(scene)
            model = request.models.resolve(asked.model)
            read_scene(asked, model.vocabulary, request.limits, may_be_empty=True, derive=False)
        except RequestError as error:
            raise _in_message(error, scene, places, message.model_fields_set) from None
        self._scene = scene
        if isinstance(message, Whole | Update):
            self.seq = message.seq
            self.pending += 1

    async def answer(self, request: Request) -> tuple[Answer, dict[str, ServingError]]:
        """Return the answer message about the newest scene, and the errors of failed questions.

        The second value maps the name of each failed question to its error.
        """
        seq, covered = self.seq, self.pending
        found, errors = await _answers(self._scene, request)
        self.pending -= covered
        message = {"type": "answer", "seq": seq, "superseded": max(0, covered - 1), **found}
        return message, errors


def _request(scene: MergedScene, form: type[SceneRequest] = SceneRequest, **given: Any) -> Any:
    """Return the merged scene as a request of the schema ``form``."""
    fields = {name: value for name, value in scene.fields.items() if name not in _NOT_REQUESTED}
    return form(objects=list(scene.objects.values()), **fields, **given)


def _in_message(
    error: RequestError, scene: MergedScene, places: Mapping[str, int], given: Set[str]
) -> RequestError:
    """Convert error locations in the merged scene to locations in the newest message.

    If the message does not contain the invalid value, the location starts with ``scene``.

    Args:
        error: the errors with locations in the merged scene.
        scene: the merged scene.
        places: dictionary from the id of each object in the message to the index of this object.
        given: names of the fields that the message contains.
    """
    names = list(scene.objects)

    def moved(location: Location) -> Location:
        if location[0] == "objects" and len(location) > 1:
            name = names[int(location[1])]
            if name in places:
                return ("objects", places[name], *location[2:])
            return ("scene", "objects", name, *location[2:])
        return location if location[0] in given else ("scene", *location)

    faults = [replace(fault, location=moved(fault.location)) for fault in error.faults]
    return RequestError(error.reason, faults)


async def _answers(
    scene: MergedScene, request: Request
) -> tuple[dict[str, Answer], dict[str, ServingError]]:
    """Return the answers and the errors of the questions.

    Both values are dictionaries from the name of a question. An answer has the form that the route
    of its question returns.
    """
    ask = scene.fields.get("ask") or _DEFAULT_ASK
    asked = [question for question in _ASKED if getattr(ask, question.name) is not None]
    names = [question.name for question in asked]
    bare = _request(scene)
    try:
        model, reading = request.read(bare, may_be_empty=True)
    except RequestError as error:  # the alias now points to a model with other classes
        return {}, dict.fromkeys(names, _in_message(error, scene, {}, frozenset()))
    except ServingError as error:
        return {}, dict.fromkeys(names, error)
    # All questions use the same parsed scene and the same deadline.
    request = replace(request, known=(model, reading), low_priority=True)
    found: dict[str, Answer] = {}
    errors: dict[str, ServingError] = {}
    for name, question in zip(names, asked, strict=True):
        if not reading.scene.objects:
            found[name] = answers.envelope(bare, request.id, model.reference, reading)
            found[name] |= question.empty_answer
            continue
        options = getattr(ask, name)
        given = {option: getattr(options, option) for option in options.model_fields_set}
        try:
            form = _request(scene, question.request, **given)
            found[name] = await question.answer(request, form)
        except RequestError as error:
            faults = [
                replace(fault, location=("ask", name, *fault.location)) for fault in error.faults
            ]
            errors[name] = RequestError(error.reason, faults)
        except ServingError as error:
            errors[name] = error
    return found, errors


class TokenBucket:
    """A rate limit: ``rate`` tokens per second on average, and at most ``burst`` tokens at once."""

    def __init__(self, rate: float, burst: float) -> None:
        self._rate = rate
        self._burst = burst
        self._tokens = burst
        self._at = monotonic()

    def take(self, count: float) -> float:
        """Take ``count`` tokens. Return the time in seconds until these tokens are available."""
        now = monotonic()
        self._tokens = min(self._burst, self._tokens + (now - self._at) * self._rate) - count
        self._at = now
        return max(0.0, -self._tokens / self._rate)


class Streams:
    """The open streams of the process.

    Args:
        limit: maximum number of open streams.
        metrics: metrics of the service.
    """

    def __init__(self, limit: int, metrics: Metrics) -> None:
        self.limit = limit
        self._metrics = metrics
        self._open: set[Callable[[], None]] = set()

    @property
    def is_full(self) -> bool:
        """Whether the number of open streams has reached its maximum."""
        return len(self._open) >= self.limit

    @contextmanager
    def place(self, end: Callable[[], None]) -> Iterator[None]:
        """Count a stream as open within the ``with`` block.

        Args:
            end: function that asks the stream to end. `drain` calls the function at most once.
        """
        self._open.add(end)
        self._metrics.streams(len(self._open))
        try:
            yield
        finally:
            self._open.discard(end)
            self._metrics.streams(len(self._open))

    def drain(self) -> None:
        """Ask every stream to end after the answer in progress."""
        for end in tuple(self._open):
            self._open.discard(end)
            end()
