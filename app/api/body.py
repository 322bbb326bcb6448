"""Strict reading of JSON bodies; docs/decisions says why each leniency is refused."""

from __future__ import annotations

import json
from collections.abc import Callable, Coroutine
from email.message import Message
from typing import Any, Final, NoReturn

from fastapi.routing import APIRoute
from pydantic_core import from_json
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from app.api import catalogue
from app.api.problems import ProblemError
from scene_client.schemas import FieldError

MAX_MEMBERS: Final = 32
"""No object of any request has as many fields, and every field that is unknown is a fault to tell:
a hundred times the memory of the request."""


def parse(body: bytes) -> Any:
    """One JSON value, read as every receiver would read it.

    Refused: anything but UTF-8, a byte order mark, NaN and Infinity, lone surrogates, nesting
    deeper than 200, integers of more than 4,300 digits, and a member name used twice in one object.

    Raises:
        ProblemError: of kind `catalogue.NOT_JSON`; or `catalogue.INVALID_REQUEST`, where an object
            has more than `MAX_MEMBERS`.
    """
    try:
        # The strict parser judges; the lenient one, which alone can see repeated names, reads.
        from_json(body, allow_inf_nan=False)
        return json.loads(body, object_pairs_hook=_members)
    except _TooManyMembersError:
        detail = f"An object has more than {MAX_MEMBERS} members."
        errors = [FieldError(pointer="#", message=detail)]
        raise ProblemError(catalogue.INVALID_REQUEST, detail, errors=errors) from None
    except ValueError as error:
        raise _not_json(_reason(error)) from None


class _RepeatedNameError(ValueError):
    pass


class _TooManyMembersError(ValueError):
    pass


def _members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(pairs) > MAX_MEMBERS:
        raise _TooManyMembersError
    members = dict(pairs)
    if len(members) != len(pairs):
        raise _RepeatedNameError
    return members


def _reason(error: ValueError) -> str:
    if isinstance(error, _RepeatedNameError):
        return "An object has two members of one name."
    # Of the parser's own message only the reason and the position, which hold none of the input.
    return f"The body is not valid JSON: {error}."


def _not_json(detail: str) -> ProblemError:
    return ProblemError(catalogue.NOT_JSON, detail)


def _is_json(content_type: str | None) -> bool:
    if content_type is None:
        return False
    message = Message()
    message["content-type"] = content_type
    subtype = message.get_content_subtype()
    return message.get_content_maintype() == "application" and (
        subtype == "json" or subtype.endswith("+json")
    )


class StrictRequest(Request):
    """A request whose ``json()`` is `parse`."""

    async def json(self) -> Any:
        """The body's value; see `parse`."""
        return parse(await self.body())


def _refuse_media_type() -> NoReturn:
    raise ProblemError(
        catalogue.UNSUPPORTED_MEDIA_TYPE, "The body must be sent as application/json."
    )


class JSONRoute(APIRoute):
    """A route whose body must be JSON and is read strictly."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The framework's handler behind the checks of media type and emptiness."""
        handle = super().get_route_handler()
        if self.body_field is None:
            return handle

        async def read_strictly(request: Request) -> Response:
            if not _is_json(request.headers.get("content-type")):
                _refuse_media_type()
            strict = StrictRequest(request.scope, request.receive)
            try:
                body = await strict.body()
            except ClientDisconnect:
                raise ProblemError(catalogue.BAD_REQUEST, "The body broke off.") from None
            if not body:
                raise _not_json("The body is empty.")
            return await handle(strict)

        return read_strictly
