"""Strict reading of JSON bodies. docs/decisions/http.md gives the reason for each rule."""

import asyncio
import json
import math
import re
from collections import Counter
from collections.abc import Iterator
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
from app.questions.reading import Limits
from app.serving.admission import SMALL, Bodies
from app.serving.runtime import Runtime
from scene_client.schemas import MAX_BATCH, FieldError
from scene_client.schemas import Request as Form
from scene_client.validation import MAX_ERRORS, PLAIN, field_errors, pointer

FormT = TypeVar("FormT", bound=Form)

MAX_MEMBERS: Final = 32
"""Maximum number of members of a JSON object, more than in valid requests.

Validation reports each unknown member, and a report takes a hundred times the memory of the member.
"""

_MARK: Final = re.compile(r"[ \t\n\r]*([{}\[\],:])[ \t\n\r]*")

# A large answer is sent in parts of this size in bytes, so that a slow client delays the next part.
_PART: Final = 64 * 1024


def validated(value: Any, form: type[FormT], limits: Limits, *, at: errors.Location = ()) -> FormT:
    """Validate the JSON value at a location. Refuse too long lists before their validation.

    Raises:
        InvalidRequestError: the value does not match the schema, or a scene has too many relations.
    """
    too_long = [
        _too_many(pointer((*at, name)), most)
        for name, most in _most_entries(form, limits.relations).items()
        if isinstance(value, dict) and isinstance(value.get(name), list) and len(value[name]) > most
    ]
    if too_long:
        raise errors.InvalidRequestError(errors=too_long)
    try:
        return form.model_validate(value)
    except ValidationError as error:
        invalid = field_errors(error, value, form, at=at)
        raise errors.InvalidRequestError(errors=invalid) from None


def _too_many(at: str, most: int) -> FieldError:
    return FieldError(pointer=at, message=f"must have at most {most} entries")


@cache
def _most_entries(form: type[Form], relations: int) -> dict[str, int]:
    """Return the maximum length of each list (and text) among the fields of a schema.

    The validation of 65,536 relations, the limit of the schema, would hold the interpreter for
    0.1 s. So ``relations``, the limit of the service, replaces it.
    """
    limits = (
        (name, limit) for name, field in form.model_fields.items() for limit in field.metadata
    )
    most = {name: limit.max_length for name, limit in limits if hasattr(limit, "max_length")}
    return most | {"relations": relations} if "relations" in most else most


def parse(body: bytes, most: int) -> Any:
    """Parse one JSON value. Refuse texts that different JSON parsers read in different ways.

    A body of more than ``most`` bytes must be an object. It is parsed value by value.

    Raises:
        NotJSONError: the text is not JSON in UTF-8, or nests deeper than 200 levels. Also for a
            byte order mark, NaN, Infinity, lone surrogates, integers of more than 4,300 digits, and
            duplicate names in an object.
        InvalidRequestError: the body has too many arrays or objects, an object has more than
            `MAX_MEMBERS` members, or a list of a large body has more than `MAX_BATCH` entries.
    """
    # A large body has at most one array or object, such as `[1,2],`, per 5 bytes.
    for start in range(0, len(body), most) if len(body) > SMALL else ():
        part = body[start : start + most]
        if part.count(b"[") + part.count(b"{") > len(part) // 5:
            fewer = f"more than {len(part) // 5} arrays and objects."
            raise _invalid(f"{len(part)} bytes of the body have {fewer}")
    try:
        if len(body) > most:
            return _in_pieces(body.decode(), most)
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


def _invalid(detail: str) -> errors.InvalidRequestError:
    """Return an error about the whole body."""
    whole = FieldError(pointer="#", message=detail)
    return errors.InvalidRequestError(errors=[whole], detail=detail)


def _not_finite(body: bytes) -> list[FieldError]:
    """Return an error for each NaN and Infinity in a small body that is otherwise JSON."""
    try:
        value = from_json(body) if len(body) <= SMALL else None
    except ValueError:
        return []
    return [
        FieldError(pointer=pointer(at), message=f"must be a finite number, not {name}")
        for name, at in islice(_constants(value), MAX_ERRORS)
    ]


def _in_pieces(text: str, most: int) -> dict[str, Any]:
    """Parse a large JSON object in short steps, because the parsers hold the interpreter.

    A step parses one member, or one entry of a list: a text, or at most ``most`` characters.
    """
    at = 0

    def mark(expected: str) -> str:
        """Read one of the expected characters and the spaces around it. Return the character."""
        nonlocal at
        match = _MARK.match(text, at)
        if match is None or match[1] not in expected:
            raise ValueError(f"expected one of {expected} at character {at}")
        at = match.end()
        return match[1]

    def parts(opening: str, closing: str) -> Iterator[None]:
        """Read the brackets and commas of an object or array. Yield before each of its parts."""
        mark(opening)
        last = mark(closing) if text.startswith(closing, at) else ","
        while last != closing:
            yield
            last = mark("," + closing)

    def value() -> Any:
        """Parse the value at the current position, and move the position to its end."""
        nonlocal at
        # The parsers would read the rest of the body, so the slice bounds the step.
        part, start = (text, at) if text.startswith('"', at) else (text[at : at + most], 0)
        try:
            parsed, end = _DECODER.raw_decode(part, start)
            from_json(part[start:end], allow_inf_nan=False)
        except (ValueError, RecursionError) as error:
            message = f"the value at character {at} is invalid or too long: {error}"
            raise ValueError(message) from None
        at += end - start
        return parsed

    def entries(name: str) -> list[Any]:
        """Parse the array at the current position, the value of the member ``name``."""
        items: list[Any] = []
        for _ in parts("[", "]"):
            if len(items) == MAX_BATCH:
                raise errors.InvalidRequestError(errors=[_too_many(pointer((name,)), MAX_BATCH)])
            items.append(value())
        return items

    members: list[tuple[str, Any]] = []
    for _ in parts("{", "}"):
        name = value()
        if not isinstance(name, str):
            raise ValueError(f"expected a name before character {at}")
        mark(":")
        members.append((name, entries(name) if text.startswith("[", at) else value()))
        _members(members)
    if at < len(text):
        raise ValueError(f"trailing characters at character {at}")
    return dict(members)


def _constants(value: Any, at: errors.Location = ()) -> Iterator[tuple[str, errors.Location]]:
    """Yield the name and the location of each NaN and Infinity in a value at a location."""
    if isinstance(value, float) and not math.isfinite(value):
        yield json.dumps(value), at
    elif isinstance(value, dict):
        for name, part in value.items():
            yield from _constants(part, (*at, name))
    elif isinstance(value, list):
        for index, part in enumerate(value):
            yield from _constants(part, (*at, index))


def _members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the members of a JSON object. Refuse too many members and duplicate names."""
    if len(pairs) > MAX_MEMBERS:
        raise _invalid(f"A JSON object has more than {MAX_MEMBERS} members.")
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
        ticket = scope["state"]["ticket"]

        def read(_: object) -> tuple[Any, Any]:
            value = parse(body, most)
            return value, validated(value, schema, runtime.limits)

        if len(body) <= SMALL:
            value, data = read(None)
        else:
            value, data = await runtime.admission.in_worker(ticket, read)
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
