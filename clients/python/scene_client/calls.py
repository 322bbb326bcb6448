"""Conversion of method arguments to an HTTP request, and of the response to an answer."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from itertools import compress
from random import random
from typing import Any, Final, Generic, TypeAlias, TypeVar
from urllib.parse import quote

from pydantic import BaseModel, ValidationError

from scene_client import schemas
from scene_client.errors import (
    AnswerError,
    DeadlineError,
    InvalidRequestError,
    ProblemError,
    UnreachableError,
    problem_of,
)
from scene_client.validation import field_errors

FIRST_PAUSE: Final = 0.05
LONGEST_PAUSE: Final = 2.0
"""Maximum pause in seconds between two attempts, without the time in a Retry-After header.

The pause is random. Its upper limit starts at `FIRST_PAUSE` and doubles with each attempt.
"""

T = TypeVar("T", bound=BaseModel)
AnswerT = TypeVar("AnswerT", bound=schemas.Answer)
RequestT = TypeVar("RequestT", bound=schemas.SceneRequest)
FormT = TypeVar("FormT", bound=schemas.Request)

Scene: TypeAlias = Iterable[str | schemas.Detection | schemas.Body] | RequestT | schemas.Body
"""A list of objects (labels, `Detection` objects or dictionaries), or a whole request."""


@dataclass(frozen=True, slots=True)
class Call(Generic[T]):
    """One HTTP request to the service, and the class of its answer.

    Attributes:
        method: HTTP method.
        path: URL-encoded path of the route.
        answer: class of the answer.
        body: body of the request as JSON text. None means a request without a body.
        scenes: the observed scenes, for a recorder.
    """

    method: str
    path: str
    answer: type[T]
    body: str | None = None
    scenes: tuple[schemas.SceneRequest, ...] = ()

    def read(self, status: int, headers: Mapping[str, str], body: bytes) -> T:
        """Return the answer that a response contains.

        Raises:
            ProblemError: the service answered with a problem.
            DeadlineError: the deadline passed in the service.
            AnswerError: the client cannot read the answer.
        """
        if status != HTTPStatus.OK:
            problem = problem_of(status, headers, body, self.body)
            if status == HTTPStatus.GATEWAY_TIMEOUT:
                raise DeadlineError(problem.detail or problem.title, problem.request_id)
            raise problem
        try:
            # A newer service may send fields that the schemas of this client do not contain.
            return self.answer.model_validate_json(body, extra="ignore")
        except ValidationError as error:
            raise AnswerError(
                f"The answer of {self.path} does not match the schema {self.answer.__name__} "
                f"({error.error_count()} errors). Check the address of the service."
            ) from None

    def answered(self, answer: T) -> Iterable[schemas.SceneRequest]:
        """Return the scenes that an answer is about, without those that the service refused."""
        if isinstance(answer, schemas.BatchAnswer):
            return compress(self.scenes, [one.result is not None for one in answer.results])
        return self.scenes

    def retry_pause(self, error: ProblemError | UnreachableError, attempt: int) -> float | None:
        """Return the pause before a retry in seconds, or None if the client must not retry.

        Args:
            error: error of the last attempt.
            attempt: number of the last attempt. The first attempt has number 0.
        """
        pause: float = min(LONGEST_PAUSE, FIRST_PAUSE * 2**attempt) * random()  # noqa: S311 # nosec B311
        if isinstance(error, ProblemError):
            # The random pause spreads the retries of many clients over time.
            return pause + (error.retry_after or 0.0) if error.status in (429, 503) else None
        return pause


def model_path(*names: str) -> str:
    """Return the path ``/models/...`` with these names as URL-encoded segments.

    Raises:
        InvalidRequestError: a name is empty or contains only dots.
    """
    # In a URL, the segments "." and ".." refer to folders, so they cannot be names.
    if any(not name or set(name) <= {"."} for name in names):
        raise InvalidRequestError.about("a name must not be empty, and must not contain only dots")
    return "/".join(["/models", *(quote(name, safe="") for name in names)])


# -------------------------------------------------------------------------------------- questions


@dataclass(frozen=True, slots=True)
class Question(Generic[RequestT, AnswerT]):
    """The route of a question, with the classes of its request and its answer."""

    path: str
    form: type[RequestT]
    answer: type[AnswerT]
    is_observed: bool = True  # the objects of a request are a scene that the robot sees

    def call(self, scene: Any, fields: Mapping[str, Any], model: str | None) -> Call[AnswerT]:
        """Build the question about one scene.

        Args:
            scene: list of objects, or a whole request as a ``form`` or a dictionary.
            fields: other fields of the request, if ``scene`` is a list of objects.
            model: model for requests without the field ``model``.

        Raises:
            InvalidRequestError: the request is invalid.
        """
        request = _request(self.form, scene, fields, model)
        scenes = (request,) if self.is_observed else ()
        return Call("POST", self.path, self.answer, _json(request), scenes=scenes)

    def batch(self, scenes: Iterable[Any], model: str | None) -> Call[schemas.BatchAnswer[AnswerT]]:
        """Build the question about many scenes. `call` describes the arguments.

        Raises:
            InvalidRequestError: the batch or the request about one of its scenes is invalid.
        """
        requests = tuple(
            _request(self.form, scene, {}, model, ("scenes", index))
            for index, scene in enumerate(scenes)
        )
        _check_size(requests)
        answers = schemas.BatchAnswer[self.answer]  # type: ignore[name-defined]
        body = f'{{"scenes":[{",".join(map(_json, requests))}]}}'
        return Call("POST", f"{self.path}/batch", answers, body, scenes=requests)


RELATIONS: Final = Question("/relations", schemas.RelationsRequest, schemas.RelationsAnswer)
MISSING: Final = Question("/missing", schemas.MissingRequest, schemas.MissingAnswer)
OUTLIERS: Final = Question("/outliers", schemas.OutliersRequest, schemas.OutliersAnswer)
ROOMS: Final = Question("/rooms", schemas.RoomsRequest, schemas.RoomsAnswer)
GENERATE: Final = Question("/generate", schemas.GenerateRequest, schemas.GenerateAnswer, False)


def where(
    label: str, rooms: Iterable[Any], fields: Mapping[str, Any], model: str | None
) -> Call[schemas.WhereAnswer]:
    """Build the question where a thing is.

    Raises:
        InvalidRequestError: the request is invalid.
    """
    request = _where({"label": label, "rooms": rooms, **fields}, model)
    return Call("POST", "/where", schemas.WhereAnswer, _json(request))


def where_batch(
    requests: Iterable[Any], model: str | None
) -> Call[schemas.BatchAnswer[schemas.WhereAnswer]]:
    """Build many questions where a thing is.

    Raises:
        InvalidRequestError: the batch or one of its requests is invalid.
    """
    checked = [
        _where(dict(_json_value(one)), model, ("scenes", k)) for k, one in enumerate(requests)
    ]
    _check_size(checked)
    body = f'{{"scenes":[{",".join(map(_json, checked))}]}}'
    return Call("POST", "/where/batch", schemas.BatchAnswer[schemas.WhereAnswer], body)


def _where(
    fields: dict[str, Any], model: str | None, at: tuple[str | int, ...] = ()
) -> schemas.WhereRequest:
    if model is not None:
        fields.setdefault("model", model)
    members = {name: _json_value(value) for name, value in fields.items()}
    return validated(schemas.WhereRequest, members, at)


def _check_size(requests: Sequence[object]) -> None:
    """Refuse an empty or too long batch."""
    if not 1 <= len(requests) <= schemas.MAX_BATCH:
        message = f"a batch must contain from 1 to {schemas.MAX_BATCH} scenes"
        raise InvalidRequestError.about(message, "#/scenes")


def _json(request: BaseModel) -> str:
    # The body does not contain unset fields, because an older service may refuse unknown fields.
    return request.model_dump_json(exclude_unset=True)


def _request(
    kind: type[RequestT],
    scene: Any,
    fields: Mapping[str, Any],
    model: str | None,
    at: tuple[str | int, ...] = (),
) -> RequestT:
    """Return the validated request; see `Question.call`. ``at`` is its location in the body."""
    if isinstance(scene, schemas.SceneRequest | Mapping):
        if fields:
            names = ", ".join(fields)
            message = f"these fields must be members of the whole request: {names}"
            raise InvalidRequestError.about(message)
        members = _json_value(scene)
    else:
        members = {"objects": scene, **fields}
    if model is not None:
        members.setdefault("model", model)
    return validated(kind, {name: _json_value(value) for name, value in members.items()}, at)


def _json_value(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(exclude_unset=True)
    if isinstance(value, Mapping):
        return {name: _json_value(entry) for name, entry in value.items()}
    if isinstance(value, Iterable) and not isinstance(value, str):
        return [_json_value(entry) for entry in value]
    return value


def validated(kind: type[FormT], fields: dict[str, Any], at: tuple[str | int, ...] = ()) -> FormT:
    """Return the request, or the part of it at the location ``at``, with these fields.

    Raises:
        InvalidRequestError: the request is invalid.
    """
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        raise InvalidRequestError(field_errors(error, fields, kind, at=at)) from None
