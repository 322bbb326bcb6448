"""All errors that the service answers with. One class defines one problem type (RFC 9457).

The docstring of a class is the page of the problem type: its first line is the title. Everything
else derives from `ERRORS`: the pages, the error responses in the OpenAPI document, and the tests.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final, Literal, Self

from starlette.exceptions import HTTPException

from scene_client.schemas import FieldError, Problem
from scene_client.validation import MAX_ERRORS, pointer

Location = tuple[str | int, ...]
"""Path to a value in a request: field names and list indices, from the root of the request."""

Step = Literal[
    "admission",  # all routes except health checks and metrics
    "body",  # routes that read a JSON body
    "file",  # the route that reads files of other programs
    "host",  # the check of the Host header, if SCENE_ALLOWED_HOSTS is not *
    "key",  # the check of the API key, if SCENE_API_KEY is set
    "model",  # routes that use a loaded model
    "models",  # routes that list or use the models
    "name",  # routes that find a model by its name
    "readiness",  # readiness checks
    "recording",  # the route that writes confirmed scenes
    "route",  # all routes
    "scene",  # routes that answer a question about one scene
    "word",  # routes with a label in their path
    "http",  # errors of Starlette: `HTTPException` with the same status
]
"""A step of a request. The steps of a route determine the errors in its documentation."""

_MOST_NAMED: Final = 50  # names in the message of an error

ERRORS: Final[dict[str, type["ServiceError"]]] = {}
"""All problem types by slug, in the order of this module."""


def some_of(names: Iterable[str]) -> str:
    """Return the first 50 names in alphabetical order, as text for a message."""
    ordered = sorted(names)
    text = ", ".join(ordered[:_MOST_NAMED]) or "none"
    return f"{text} and {len(ordered) - _MOST_NAMED} more" if len(ordered) > _MOST_NAMED else text


@dataclass(frozen=True, slots=True)
class LocatedError:
    """One error in a request."""

    location: Location  # of the invalid value
    message: str  # without a copy of the input
    suggestions: tuple[str, ...] = ()  # names similar to an unknown name, most similar name first


class ServiceError(HTTPException):
    """Base class of all errors that the service answers with.

    A subclass without a slug has the problem type of its base class. Clients receive ``detail``, by
    default the title, and the first `MAX_ERRORS` of ``errors``.
    """

    slug: ClassVar[str]  # stable name, which clients can compare
    status: ClassVar[int]
    title: ClassVar[str]
    explanation: ClassVar[str]  # cause and remedy, for the page
    uri: ClassVar[str]  # the member `type` of the problem document (RFC 9457, section 3.1.1)
    steps: ClassVar[tuple[Step, ...]]  # the steps that may raise the error
    example: ClassVar[tuple[FieldError, ...]] = ()  # for the OpenAPI document

    def __init_subclass__(
        cls, *, slug: str = "", status: int = 500, steps: tuple[Step, ...] = ()
    ) -> None:
        """Derive title and page of a subclass with a slug from its docstring, and register it."""
        super().__init_subclass__()
        if slug:
            title, _, explanation = (cls.__doc__ or slug).partition("\n")
            cls.title, cls.explanation = title.removesuffix("."), " ".join(explanation.split())
            cls.slug, cls.status, cls.steps, cls.uri = slug, status, steps, f"/problems/{slug}"
            ERRORS[slug] = cls

    def __init__(
        self,
        detail: str = "",
        *,
        errors: Sequence[FieldError] = (),
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(self.status, detail or f"{self.title}.", headers)
        self.errors = list(errors[:MAX_ERRORS])

    def __str__(self) -> str:
        return self.detail

    def describe(self, request_id: str) -> Problem:
        """Return the problem document that the client receives."""
        return Problem(
            type=self.uri,
            title=self.title,
            status=self.status,
            detail=self.detail,
            instance=f"{self.uri}#{request_id}",
            request_id=request_id,
            errors=self.errors or None,
        )


class RequestError(ServiceError):
    """The request does not match the schema or the model, or is contradictory.

    `locate` converts the ``located`` errors to `errors`. The default detail is their number.
    """

    _hint: ClassVar[str] = ""

    def __init__(
        self,
        located: Sequence[LocatedError] = (),
        *,
        errors: Sequence[FieldError] = (),
        detail: str = "",
    ) -> None:
        self.located = located[:MAX_ERRORS]
        count = len(self.located) + len(errors)
        most = "at least " * (count >= MAX_ERRORS)
        counted = f"The request has {most}{count} error{'' if count == 1 else 's'}"
        super().__init__(detail or f"{counted}, listed in `errors`.{self._hint}", errors=errors)

    def below(self, at: Location) -> Self:
        """Return the error about a scene at a location of the request.

        Other locations than those of objects are of fields that all scenes share.
        """
        of_objects = [
            replace(one, location=(*at, *one.location)) if one.location[:1] == ("objects",) else one
            for one in self.located
        ]
        return type(self)(of_objects)

    def locate(self, body: Any, at: Location = ()) -> None:
        """Convert the located errors to `errors` with JSON pointers. A second call has no effect.

        ``body`` is the scene as the client sent it; see `pointer`. ``at`` is its place in a batch.
        """
        self.errors += [
            FieldError(
                pointer=pointer(at) + pointer(error.location, body)[1:],
                message=error.message,
                suggestions=list(error.suggestions),
            )
            for error in self.located
        ]
        self.located = ()


def _example(place: str, message: str, *suggestions: str) -> tuple[FieldError, ...]:
    return (FieldError(pointer=place, message=message, suggestions=list(suggestions)),)


class NotJSONError(ServiceError, slug="not-json", status=400, steps=("body",)):
    """The body is not acceptable JSON.

    The body must be one JSON value in UTF-8 without a byte order mark. The service refuses NaN,
    Infinity, lone surrogates, duplicate member names in an object and nesting deeper than 200. In a
    body of at most 16 KiB, `errors` points at each NaN and Infinity.
    """


class BadRequestError(ServiceError, slug="bad-request", status=400, steps=("admission", "http")):
    """The request could not be read.

    Either the connection closed before the body was complete, or X-Request-Timeout-Ms is invalid.
    This header must be a whole number of milliseconds, from 1 to SCENE_MAX_REQUEST_TIMEOUT_MS.
    """


class DisconnectedError(BadRequestError):
    """The client has closed its connection."""


class UnauthorizedError(ServiceError, slug="unauthorized", status=401, steps=("key",)):
    """A valid key is required.

    If SCENE_API_KEY is set, requests need that key in the header X-API-Key or Authorization:
    Bearer. Health checks and HTML pages need no key.
    """


class NotFoundError(ServiceError, slug="not-found", status=404, steps=("http",)):
    """The service has no route at this path.

    /openapi.json lists the routes, unless SCENE_DOCS is off.
    """


class UnknownModelError(ServiceError, slug="model-not-found", status=404, steps=("name",)):
    """The model or version does not exist.

    Name a model by an alias, by its name or as name@version. GET /models lists all three.
    """


class ModelReplacedError(RequestError, slug="model-replaced", status=404, steps=("name",)):
    """Another model replaces this model.

    The model belongs to an earlier release. `errors` suggests the new model of this release. Read
    its terms of use and its vocabulary before you change the name in your requests.
    """

    example = _example("#/model", "places-triway replaces this model", "places-triway")


class MethodNotAllowedError(ServiceError, slug="method-not-allowed", status=405, steps=("http",)):
    """This route does not accept this method.

    The Allow header lists the methods of the route.
    """


class RequestTimeoutError(ServiceError, slug="request-timeout", status=408, steps=("body",)):
    """The request did not arrive in time.

    The body of a request must arrive within SCENE_CLIENT_TIMEOUT seconds after its headers. Send
    the request again on a new connection.
    """


class BodyTooLargeError(ServiceError, slug="body-too-large", status=413, steps=("body", "http")):
    """The body is too large.

    Send fewer scenes in one request. SCENE_MAX_SCENE_BYTES limits the body of a question about one
    scene, and SCENE_MAX_BODY_BYTES all bodies. Both limits also apply to chunked bodies.
    """


class UnsupportedMediaTypeError(
    ServiceError, slug="unsupported-media-type", status=415, steps=("body",)
):
    """The body is not declared as JSON.

    Send Content-Type: application/json, without a charset other than utf-8 and without
    Content-Encoding.
    """


class InvalidRequestError(RequestError, slug="invalid-request", status=422, steps=("body", "word")):
    """The request is not valid for this route.

    The body does not match the schema of this route. The `pointer` of an error is a JSON pointer
    into the body. `suggestions` lists the nearest valid names. A label in a path has at most 100
    characters.
    """

    example = _example("#/objects/1/confidence", "must be greater than 0")


class UnreadableFileError(RequestError, slug="unreadable-file", status=422, steps=("file",)):
    """The file contains no scene that can be read.

    docs/clients.md lists the formats. POST /scenes reads files with at most 32,768 lines, lists,
    objects, elements or attributes; the command `scene` reads larger files. Numeric class ids need
    the field `label_map`.
    """


class NotRecordedError(ServiceError, slug="not-recorded", status=503, steps=("recording",)):
    """The service could not write the scene to its recording.

    The file of SCENE_RECORDING cannot be written, or another program has locked it. The log of the
    service states the reason. The scene is not recorded, so send it again.
    """


class UnknownLabelsError(RequestError, slug="unknown-labels", status=422, steps=("scene",)):
    """The model does not know some labels or room types.

    GET /models/{name}/vocabulary lists every known label. With `unknown_labels` set to `ignore`,
    the service ignores unknown labels and lists them in `ignored`. With `nearest`, it maps misspelt
    labels and phrases to a class and lists them in `mapped`. It refuses a label that could be
    several classes. With `nearest-or-ignore`, it ignores such a label. With `by-meaning`, it
    predicts the weights of the label from its word vector. All four ignore an unknown room type,
    but POST /generate always refuses it.
    """

    example = _example("#/objects/1", "the model does not know this label", "nightstand")
    _hint = (
        " GET /models/{name}/vocabulary lists the known names. With `unknown_labels` set to "
        "`ignore`, the service leaves unknown names out, except the room type of POST /generate. "
        "`nearest-or-ignore` corrects them first, and `by-meaning` reads them by word vectors. "
        "`python -m training adapt` adds the names of your home to a model. For a model of your "
        "own, add synonyms to vocabulary.json, or new classes with `init --update`."
    )


class ContradictionError(RequestError, slug="contradictory-evidence", status=422, steps=("scene",)):
    """The scene contradicts itself.

    An object has a relation to itself, a pair has both a relation and its opposite (left and
    right), or objects hold each other in a circle: a box on a book, and the book in the box. Or the
    scene declares `up`, although its frame is optical, so that its y axis points down.
    """

    example = _example(
        "#/relations/1", "this relation contradicts an earlier relation of the same two objects"
    )


class RareRoomTypeError(RequestError, slug="rare-room-type", status=422, steps=("scene",)):
    """The model has too few training scenes of this room type to sample such a room.

    The field `rare_room_types` of GET /models/{name}/vocabulary lists these room types. Leave the
    room type out, or choose another one.
    """

    example = _example(
        "#/room_type",
        "the model has too few training scenes of this room type to sample such a room",
    )


class AnswerTooLargeError(RequestError, slug="answer-too-large", status=422, steps=("scene",)):
    """The answer would be too large.

    The answer would exceed SCENE_MAX_ANSWER_BYTES. `errors` points at the parameter to lower. All
    scenes of a batch share one limit, and a batch stops at the first answer beyond it. Send the
    refused scenes in another request.
    """


class HostRefusedError(ServiceError, slug="host-refused", status=421, steps=("host",)):
    """The service does not answer to this host name.

    The Host header must contain an IP address or one of the names in SCENE_ALLOWED_HOSTS. The
    default names are localhost, the host name of the machine, and this name with .local. Health
    checks accept every host name.
    """


class BodiesFullError(ServiceError, slug="bodies-full", status=503, steps=("body",)):
    """The service holds too many bytes of request bodies and answers.

    All requests in progress share SCENE_HELD_BODY_BYTES for their bodies and for large answers. One
    client holds at most a quarter. Send the request again after the time in Retry-After.
    """


class InternalError(ServiceError, slug="internal-error", status=500, steps=("route",)):
    """The service failed.

    This is a defect. The log of the service contains the request id and the details.
    """


class NotReadyError(ServiceError, slug="not-ready", status=503, steps=("models", "readiness")):
    """The service is not ready.

    Either the service is still starting, or its default model is not usable. GET /models gives the
    reason. Send the request again after the time in Retry-After.
    """


class ModelUnavailableError(ServiceError, slug="model-unavailable", status=503, steps=("model",)):
    """This model is not usable.

    The version is in the store, but the service refused to load it. `detail` and GET /models give
    the reason.
    """


class DrainingError(ServiceError, slug="draining", status=503, steps=("readiness",)):
    """The service is shutting down.

    Use another instance, or send the request again after the time in Retry-After.
    """


class QueueFullError(ServiceError, slug="queue-full", status=429, steps=("admission",)):
    """Too many requests are waiting.

    The queue of requests (SCENE_QUEUE_REQUESTS), of batches and large scenes (SCENE_QUEUE_ROWS) or
    of drawn scenes is full. One client holds at most a quarter of a queue. Send the request again
    after the time in Retry-After.
    """


class DeadlinePassedError(ServiceError, slug="deadline-passed", status=504, steps=("admission",)):
    """The deadline passed.

    The answer was not complete within the time limit of the request. X-Request-Timeout-Ms sets this
    limit. The default is SCENE_REQUEST_TIMEOUT_MS.
    """
