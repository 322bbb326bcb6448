"""Strict reading of JSON bodies. docs/decisions/http.md gives the reason for each rule."""

import asyncio
import json
import re
from collections import Counter
from collections.abc import Iterator, Sized
from contextlib import suppress
from email.message import Message
from functools import cache
from itertools import islice
from typing import Any, Final, TypeVar

from fastapi.routing import APIRoute
from pydantic import ValidationError
from pydantic_core import from_json
from starlette.requests import Request
from starlette.types import Receive, Scope, Send

from app import errors
from app.serving.admission import SMALL, Bodies, in_thread
from app.serving.runtime import Runtime
from scene_client.schemas import MAX_BATCH, FieldError
from scene_client.schemas import Request as Form
from scene_client.validation import MAX_ERRORS, PLAIN, field_errors, pointer

FormT = TypeVar("FormT", bound=Form)

MAX_MEMBERS: Final = 32
"""Maximum number of members of a JSON object, more than in valid requests.

Validation reports each unknown member, and a report takes a hundred times the memory of the member.
"""

# A large answer is sent in parts of this size in bytes, so that a slow client delays the next part.
_PART: Final = 64 * 1024


def validated(value: Any, form: type[FormT], *, at: errors.Location = ()) -> FormT:
    """Validate a JSON value. Refuse lists with too many entries before their validation.

    ``at`` is the location of the value in a batch request. It is empty for other requests.

    Raises:
        InvalidRequestError: the value does not match the schema.
    """
    too_long = [
        FieldError(pointer=pointer((*at, name)), message=f"must have at most {most} entries")
        for name, most in _most_entries(form).items()
        if isinstance(value, dict) and isinstance(value.get(name), list) and len(value[name]) > most
    ]
    if too_long:
        raise errors.InvalidRequestError(errors=too_long)
    try:
        return form.model_validate(value)
    except ValidationError as error:
        invalid = field_errors(error, value, form, at=at)
        raise errors.InvalidRequestError(errors=invalid) from None


@cache
def _most_entries(form: type[Form]) -> dict[str, int]:
    """Return the maximum length of each list (and text) among the fields of a schema."""
    limits = (
        (name, limit) for name, field in form.model_fields.items() for limit in field.metadata
    )
    return {name: limit.max_length for name, limit in limits if hasattr(limit, "max_length")}


def parse(body: bytes, most: int) -> Any:
    """Parse one JSON value. Refuse texts that different JSON parsers read in different ways.

    A body of more than ``most`` bytes must be an object. It is parsed value by value.

    The function refuses encodings other than UTF-8, a byte order mark, NaN and Infinity, lone
    surrogates, nesting deeper than 200 levels, integers of more than 4,300 digits, and duplicate
    names in an object.

    Raises:
        NotJSONError: the function refuses the text.
        InvalidRequestError: the body has too many arrays or objects, an object has more than
            `MAX_MEMBERS` members, or a list of a large body has more than `MAX_BATCH` entries.
    """
    _check_density(body, most)
    try:
        if len(body) > most:
            return _Pieces(body.decode(), most).read()
        # from_json() is strict, but only the decoder of the standard library finds duplicate names.
        from_json(body, allow_inf_nan=False)
        return _DECODER.decode(body.decode())
    except ValueError as error:
        not_finite = _not_finite(body)
        detail = "NaN and Infinity are not JSON. `errors` lists their places."
        if not not_finite:
            # The message of the parser contains the reason and the position, but never the input.
            detail = (
                f"The body is not valid JSON: {error}. Strings and names need double quotes. "
                "Comments, trailing commas, NaN, None and True are not JSON."
            )
        raise errors.NotJSONError(detail, errors=not_finite) from None


def _check_density(body: bytes, most: int) -> None:
    """Check that a large body has at most one array or object for every five bytes.

    The shortest sensible one is the array of a pair, such as `[1,2],`. The check applies to each
    part of ``most`` bytes.
    """
    for start in range(0, len(body), most) if len(body) > SMALL else ():
        part = body[start : start + most]
        if part.count(b"[") + part.count(b"{") > len(part) // 5:
            fewer = f"more than {len(part) // 5} arrays and objects."
            raise _invalid(f"{len(part)} bytes of the body have {fewer}")


def _invalid(detail: str) -> errors.InvalidRequestError:
    """Return an error about the whole body."""
    whole = FieldError(pointer="#", message=detail)
    return errors.InvalidRequestError(errors=[whole], detail=detail)


def _not_finite(body: bytes) -> list[FieldError]:
    """Return an error for each NaN and Infinity in a small body that is otherwise JSON."""
    if len(body) > SMALL or (b"NaN" not in body and b"Infinity" not in body):
        return []
    try:
        constants = islice(_constants(_LENIENT.decode(body.decode())), MAX_ERRORS)
        return [
            FieldError(pointer=pointer(at), message=f"must be a finite number, not {name}")
            for name, at in constants
        ]
    except (ValueError, RecursionError):
        return []


class _Pieces:
    """A large JSON object, parsed in short steps, because the parsers hold the interpreter.

    A step parses one member, or one entry of a list: a text, or at most ``most`` characters.
    """

    def __init__(self, text: str, most: int) -> None:
        self._text, self._most, self._at = text, most, 0

    def read(self) -> dict[str, Any]:
        """Return the object. Raise ValueError or InvalidRequestError like `parse`."""
        members: list[tuple[str, Any]] = []
        for _ in self._each("{}"):
            name = self._value()
            if not isinstance(name, str):
                raise ValueError(f"expected a name before character {self._at}")
            self._mark(":")
            members.append((name, self._entries(name) if self._peek() == "[" else self._value()))
            _check_number(members)
        if self._peek():
            raise ValueError(f"trailing characters at character {self._at}")
        return _members(members)

    def _entries(self, name: str) -> list[Any]:
        entries: list[Any] = []
        for _ in self._each("[]"):
            if len(entries) == MAX_BATCH:
                message = f"must have at most {MAX_BATCH} entries"
                too_long = FieldError(pointer=pointer((name,)), message=message)
                raise errors.InvalidRequestError(errors=[too_long])
            entries.append(self._value())
        return entries

    def _each(self, brackets: str) -> Iterator[None]:
        """Read the brackets and commas of an object or array. Yield before each of its parts."""
        closing = brackets[1]
        self._mark(brackets[0])
        mark = self._mark(closing) if self._peek() == closing else ","
        while mark != closing:
            yield
            mark = self._mark("," + closing)

    def _value(self) -> Any:
        # The parsers would read the rest of the body, so the slice bounds the step.
        is_text = self._peek() == '"'
        text, start = self._text, self._at
        if not is_text:
            text, start = text[start : start + self._most], 0
        try:
            value, end = _DECODER.raw_decode(text, start)
            from_json(text[start:end], allow_inf_nan=False)
        except (ValueError, RecursionError) as error:
            message = f"the value at character {self._at} is invalid or too long: {error}"
            raise ValueError(message) from None
        self._at += end - start
        return value

    def _peek(self) -> str:
        """Skip white space. Return the next character, or an empty text at the end."""
        self._at = _SPACE.match(self._text, self._at).end()  # type: ignore[union-attr]
        return self._text[self._at : self._at + 1]

    def _mark(self, expected: str) -> str:
        """Read one of the expected characters, and return it."""
        mark = self._peek()
        if not mark or mark not in expected:
            raise ValueError(f"expected one of {expected} at character {self._at}")
        self._at += 1
        return mark


_SPACE: Final = re.compile(r"[ \t\n\r]*")


class _Constant(str):
    """NaN, Infinity or -Infinity in a body."""


def _constants(value: Any, at: errors.Location = ()) -> Iterator[tuple[str, errors.Location]]:
    """Yield the name and the location of each constant in a value at a location."""
    if isinstance(value, _Constant):
        yield value, at
    elif isinstance(value, dict):
        for name, part in value.items():
            yield from _constants(part, (*at, name))
    elif isinstance(value, list):
        for index, part in enumerate(value):
            yield from _constants(part, (*at, index))


def _check_number(members: Sized) -> None:
    if len(members) > MAX_MEMBERS:
        raise _invalid(f"A JSON object has more than {MAX_MEMBERS} members.")


def _members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    _check_number(pairs)
    members = dict(pairs)
    if len(members) != len(pairs):
        name, _ = Counter(name for name, _ in pairs).most_common(1)[0]
        shown = f", `{name}`" if PLAIN.fullmatch(name) else ""
        raise errors.NotJSONError(f"A JSON object has two members with the same name{shown}.")
    return members


# Python functions read the numbers: between two of them, another thread may take the interpreter.
_DECODER: Final = json.JSONDecoder(
    object_pairs_hook=_members,
    parse_int=lambda text: int(text),
    parse_float=lambda text: float(text),
)
_LENIENT: Final = json.JSONDecoder(object_pairs_hook=_members, parse_constant=_Constant)


def _check_media(scope: Scope) -> None:
    """Raise UnsupportedMediaTypeError if the headers do not declare plain JSON in UTF-8."""
    headers, detail = scope["headers"], ""
    content_type = next((value for name, value in headers if name == b"content-type"), b"")
    codings = {value.lower() for name, value in headers if name == b"content-encoding"}
    if content_type != b"application/json":
        message = Message()
        message["content-type"] = content_type.decode("latin-1")
        kind, subtype = message.get_content_maintype(), message.get_content_subtype()
        if kind != "application" or not (subtype == "json" or subtype.endswith("+json")):
            detail = "The header Content-Type must be application/json."
        elif message.get_content_charset("utf-8") not in {"utf-8", "utf8"}:
            detail = "The charset in the header Content-Type must be utf-8."
    if codings - {b"identity"}:
        detail = "The body must not be compressed: leave the header Content-Encoding out."
    if detail:
        raise errors.UnsupportedMediaTypeError(detail)


class JSONRoute(APIRoute):
    """A route that parses and validates the JSON body, because FastAPI's parser is too lenient.

    The endpoint receives the validated body as ``data``, the HTTP request as ``http`` and the path
    parameters. It returns the answer as bytes.
    """

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, or raise ServiceError."""
        if scope["method"] not in (self.methods or ()):
            await super().handle(scope, receive, send)
            return
        http = Request(scope, receive)
        if scope["query_string"]:
            detail = "This route has no query parameters. Send all fields in the JSON body."
            raise errors.BadRequestError(detail)
        _check_media(scope)
        body: bytes = scope["state"]["body"]
        if not body:
            raise errors.NotJSONError("The body is empty.")
        runtime: Runtime = scope["app"].state.runtime
        schema: Any = self.body_field.field_info.annotation  # type: ignore[union-attr]
        most = http.app.state.settings.max_scene_bytes

        def read(_: object) -> tuple[Any, Any]:
            value = parse(body, most)
            return value, validated(value, schema)

        ticket = scope["state"]["ticket"]
        if len(body) <= SMALL:
            value, data = read(None)
        else:
            (value, data), _ = await in_thread(read, ticket, runtime.admission.worker)
        try:
            answer: bytes = await self.endpoint(data=data, http=http, **scope["path_params"])
        except errors.RequestError as error:
            error.locate(value)
            raise
        await _send(answer, runtime.bodies, ticket.client, send)


async def _send(answer: bytes, bodies: Bodies, client: str, send: Send) -> None:
    """Send an answer to a client. A large answer is sent in parts."""
    headers = [(b"content-length", b"%d" % len(answer)), (b"content-type", b"application/json")]
    start = {"type": "http.response.start", "status": 200, "headers": headers}
    if len(answer) <= _PART:
        await send(start)
        await send({"type": "http.response.body", "body": answer})
        return
    with bodies.hold(client, len(answer)):
        await send(start)
        # The server closes the connection of a client that does not read the whole answer.
        with suppress(TimeoutError):
            async with asyncio.timeout(bodies.patience):
                for at in range(0, len(answer), _PART):
                    part, more = answer[at : at + _PART], at + _PART < len(answer)
                    await send({"type": "http.response.body", "body": part, "more_body": more})
