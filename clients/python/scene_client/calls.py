"""From what a caller says to what is sent: pure functions, the same for every client."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar
from urllib.parse import quote

from pydantic import BaseModel, ValidationError

from scene_client.errors import InvalidRequestError
from scene_client.faults import field_errors
from scene_client.schemas import (
    MAX_BATCH,
    AliasAnswer,
    AliasRequest,
    Answer,
    BatchAnswer,
    ContextsAnswer,
    FieldError,
    GenerateAnswer,
    GenerateRequest,
    Health,
    MissingAnswer,
    MissingRequest,
    ModelList,
    ModelSummary,
    OutliersAnswer,
    OutliersRequest,
    RefreshAnswer,
    RelationsAnswer,
    RelationsRequest,
    SceneRequest,
    VersionDetails,
    VocabularyAnswer,
)

T = TypeVar("T", bound=BaseModel)
AnswerT = TypeVar("AnswerT", bound=Answer)
RequestT = TypeVar("RequestT", bound=SceneRequest)


@dataclass(frozen=True, slots=True)
class Question(Generic[RequestT, AnswerT]):
    """One of the four questions: its address, and the classes of its request and answer."""

    path: str
    request: type[RequestT]
    answer: type[AnswerT]
    batch: type[BatchAnswer[AnswerT]]


RELATIONS: Final = Question(
    "/relations", RelationsRequest, RelationsAnswer, BatchAnswer[RelationsAnswer]
)
MISSING: Final = Question("/missing", MissingRequest, MissingAnswer, BatchAnswer[MissingAnswer])
OUTLIERS: Final = Question(
    "/outliers", OutliersRequest, OutliersAnswer, BatchAnswer[OutliersAnswer]
)
GENERATE: Final = Question(
    "/generate", GenerateRequest, GenerateAnswer, BatchAnswer[GenerateAnswer]
)


@dataclass(frozen=True, slots=True)
class Call(Generic[T]):
    """One call of the HTTP contract.

    Attributes:
        method, path: where to, with the path as it is sent.
        answer: what is expected back.
        body: JSON, if anything is sent.
        administers: it needs the admin key.
        repeatable: asking twice does no more than asking once.
    """

    method: str
    path: str
    answer: type[T]
    body: str | None = None
    administers: bool = False
    repeatable: bool = True


def ask(
    question: Question[RequestT, AnswerT],
    scene: Any,
    fields: Mapping[str, Any],
    model: str | None = None,
) -> Call[AnswerT]:
    """One question about one scene.

    Args:
        scene: objects, a whole request, or its body as in the HTTP contract.
        fields: further fields, where ``scene`` is objects.
        model: asked where the request names none.

    Raises:
        InvalidRequestError: the service would refuse it.
    """
    request = _request(question.request, scene, fields, model)
    return Call("POST", question.path, question.answer, _json(request))


def ask_each(
    question: Question[RequestT, AnswerT], scenes: Iterable[Any], model: str | None = None
) -> Call[BatchAnswer[AnswerT]]:
    """One question about many scenes, each as in `ask`.

    Raises:
        InvalidRequestError: the service would refuse one of them.
    """
    requests = [
        _json(_request(question.request, scene, {}, model, ("scenes", place)))
        for place, scene in enumerate(scenes)
    ]
    if not 1 <= len(requests) <= MAX_BATCH:
        message = f"must hold from 1 to {MAX_BATCH} scenes"
        raise InvalidRequestError([FieldError(pointer="#/scenes", message=message)])
    body = f'{{"scenes":[{",".join(requests)}]}}'
    return Call("POST", f"{question.path}/batch", question.batch, body)


def models() -> Call[ModelList]:
    """Models, versions and aliases."""
    return Call("GET", "/models", ModelList)


def model(name: str) -> Call[ModelSummary]:
    """One model."""
    return Call("GET", f"/models/{_segment(name)}", ModelSummary)


def version(name: str, version: str) -> Call[VersionDetails]:
    """One version of a model."""
    path = f"/models/{_segment(name)}/versions/{_segment(version)}"
    return Call("GET", path, VersionDetails)


def vocabulary(name: str) -> Call[VocabularyAnswer]:
    """The words of a model."""
    return Call("GET", f"/models/{_segment(name)}/vocabulary", VocabularyAnswer)


def contexts(name: str) -> Call[ContextsAnswer]:
    """The hidden units of a model."""
    return Call("GET", f"/models/{_segment(name)}/contexts", ContextsAnswer)


def health(kind: str) -> Call[Health]:
    """``live`` or ``ready``."""
    return Call("GET", f"/health/{kind}", Health)


def refresh() -> Call[RefreshAnswer]:
    """Take over what the store holds."""
    return Call("POST", "/models/refresh", RefreshAnswer, administers=True)


def promote(alias: str, fields: Mapping[str, Any]) -> Call[AliasAnswer]:
    """Let an alias lead elsewhere.

    Raises:
        InvalidRequestError: the service would refuse it.
    """
    return Call(
        "PUT",
        f"/models/aliases/{_segment(alias)}",
        AliasAnswer,
        _json(_validated(AliasRequest, dict(fields))),
        administers=True,
        # Who expects the alias where it was would be told that it is there no more.
        repeatable=False,
    )


def _segment(name: str) -> str:
    # Dots alone would be taken for a way up the path.
    if not name or set(name) <= {"."}:
        raise InvalidRequestError([FieldError(pointer="#", message="this is no name")])
    return quote(name, safe="")


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
