"""From a caller's arguments to the request that is sent, and from the response to the answer."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from random import random
from typing import Any, Final, Generic, TypeAlias, TypeVar
from urllib.parse import quote

import httpx
from pydantic import BaseModel, ValidationError

from scene_client.errors import (
    AnswerError,
    DeadlineError,
    InvalidRequestError,
    ProblemError,
    UnreachableError,
    problem_of,
)
from scene_client.schemas import (
    MAX_BATCH,
    AliasAnswer,
    AliasRequest,
    Answer,
    Body,
    Detection,
    FieldError,
    SceneRequest,
)
from scene_client.validation import field_errors

FIRST_PAUSE: Final = 0.05
LONGEST_PAUSE: Final = 2.0
"""Seconds between attempts where the service names none; they double from the first on."""

Objects: TypeAlias = Iterable[str | Detection | Body]
"""Labels, detections, or detections as in the HTTP contract."""


# ------------------------------------------------------------------------------------ one call

T = TypeVar("T", bound=BaseModel)
AnswerT = TypeVar("AnswerT", bound=Answer)
RequestT = TypeVar("RequestT", bound=SceneRequest)


@dataclass(frozen=True, slots=True)
class Call(Generic[T]):
    """One call of the HTTP contract.

    Attributes:
        method, path: with the path as it is sent.
        answer: class of the answer.
        body: JSON, if anything is sent.
        administers: it needs the admin key.
        repeatable: a second call changes nothing more than the first.
    """

    method: str
    path: str
    answer: type[T]
    body: str | None = None
    administers: bool = False
    repeatable: bool = True

    def read(self, status: int, headers: Mapping[str, str], body: bytes) -> T:
        """The answer in a response.

        Raises:
            ProblemError, DeadlineError, AnswerError: the response holds none.
        """
        if status != HTTPStatus.OK:
            problem = problem_of(status, headers, body)
            if status == HTTPStatus.GATEWAY_TIMEOUT:
                raise DeadlineError(problem.detail or problem.title, problem.request_id)
            raise problem
        try:
            # A newer service may say more than this client knows.
            return self.answer.model_validate_json(body, extra="ignore")
        except ValidationError as error:
            raise AnswerError(
                f"The answer of {self.path} is not {self.answer.__name__}: "
                f"{error.error_count()} faults. Is this the service's address?"
            ) from None

    def retry_pause(self, error: ProblemError | UnreachableError, attempt: int) -> float | None:
        """Seconds before a further attempt; None where it cannot help, or may do harm.

        Args:
            attempt: 0 for the first.
        """
        pause = min(LONGEST_PAUSE, FIRST_PAUSE * 2**attempt) * random()  # noqa: S311 # nosec B311
        if isinstance(error, ProblemError):
            # Never earlier than asked for, and not all clients at once.
            return pause + (error.retry_after or 0.0) if error.status in (429, 503) else None
        sent = not isinstance(error.__cause__, httpx.ConnectError)
        return pause if self.repeatable or not sent else None


def segment(name: str) -> str:
    """A name as one segment of a path.

    Raises:
        InvalidRequestError: no name is spelt so.
    """
    # Dots alone would be taken for a way up the path.
    if not name or set(name) <= {"."}:
        raise InvalidRequestError([FieldError(pointer="#", message="this is no name")])
    return quote(name, safe="")


# -------------------------------------------------------------------------------------- questions


def ask(
    path: str,
    form: type[RequestT],
    answer: type[AnswerT],
    scene: Any,
    fields: Mapping[str, Any],
    model: str | None = None,
) -> Call[AnswerT]:
    """One question about one scene.

    Args:
        path: the address of the question.
        form, answer: its schemas.
        scene: objects, a whole request, or its body as in the HTTP contract.
        fields: further fields, where ``scene`` is objects.
        model: asked where the request names none.

    Raises:
        InvalidRequestError: the service would refuse it.
    """
    return Call("POST", path, answer, _json(_request(form, scene, fields, model)))


def ask_each(
    path: str,
    form: type[SceneRequest],
    answer: type[T],
    scenes: Iterable[Any],
    model: str | None = None,
) -> Call[T]:
    """One question about many scenes, each as in `ask`; the answer is that of the batch.

    Raises:
        InvalidRequestError: the service would refuse one of them.
    """
    requests = [
        _json(_request(form, scene, {}, model, ("scenes", place)))
        for place, scene in enumerate(scenes)
    ]
    if not 1 <= len(requests) <= MAX_BATCH:
        message = f"must hold from 1 to {MAX_BATCH} scenes"
        raise InvalidRequestError([FieldError(pointer="#/scenes", message=message)])
    body = f'{{"scenes":[{",".join(requests)}]}}'
    return Call("POST", f"{path}/batch", answer, body)


def promote(alias: str, fields: Mapping[str, Any]) -> Call[AliasAnswer]:
    """Let an alias lead elsewhere.

    Raises:
        InvalidRequestError: the service would refuse it.
    """
    return Call(
        "PUT",
        f"/models/aliases/{segment(alias)}",
        AliasAnswer,
        _json(_validated(AliasRequest, dict(fields))),
        administers=True,
        # A repeated move would fail on its own `expected`.
        repeatable=False,
    )


def _json(request: BaseModel) -> str:
    # Fields that were not set are left out: an older service may not know them.
    return request.model_dump_json(exclude_unset=True)


def _request(
    kind: type[RequestT],
    scene: Any,
    fields: Mapping[str, Any],
    model: str | None,
    at: tuple[str | int, ...] = (),
) -> RequestT:
    if isinstance(scene, SceneRequest | Mapping):
        if fields:
            names = ", ".join(fields)
            message = f"stands beside a whole request, which has its own place for it: {names}"
            raise InvalidRequestError([FieldError(pointer="#", message=message)])
        given = _plain(scene)
    else:
        given = {"objects": scene, **fields}
    if model is not None:
        given.setdefault("model", model)
    spelt_out = {name: _spelt_out(name, value) for name, value in given.items()}
    return _validated(kind, spelt_out, at)


# The short forms: which members a tuple stands for.
_TUPLES: Final = {
    "relations": ("subject", "relation", "object"),
    "pairs": ("subject", "object"),
    "at": ("relation", "object"),
}


def _spelt_out(name: str, value: Any) -> Any:
    """A field's value as in the HTTP contract, as far as it can be read so."""
    members = _TUPLES.get(name, ())
    if name == "at":
        return _member(value, members)
    if isinstance(value, str | BaseModel | Mapping) or not isinstance(value, Iterable):
        return _plain(value)
    return [_member(entry, members) for entry in value]


def _member(value: Any, members: tuple[str, ...]) -> Any:
    if members and isinstance(value, tuple) and len(value) == len(members):
        return dict(zip(members, value, strict=True))
    return _plain(value)


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(exclude_unset=True)
    return dict(value) if isinstance(value, Mapping) else value


def _validated(kind: type[T], given: dict[str, Any], at: tuple[str | int, ...] = ()) -> T:
    try:
        return kind.model_validate(given)
    except ValidationError as error:
        raise InvalidRequestError(field_errors(error.errors(), given, at=at)) from None
