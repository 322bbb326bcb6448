"""Conversion of pydantic's errors to messages with JSON pointers, for the service and its clients.

Pointers are URI fragments (RFC 6901, section 6).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any, Final
from urllib.parse import quote

from pydantic_core import ErrorDetails

from scene_client import schemas
from scene_client.schemas import OBJECT_TAGS, FieldError

MAX_ERRORS: Final = 100
"""Maximum number of errors that the answer to a request lists."""

_FIELDS: Final = sorted(
    {
        name
        for value in vars(schemas).values()
        if isinstance(value, type) and issubclass(value, schemas.Request)
        for name in value.model_fields
    }
)
# These messages replace pydantic's messages, which mention Python types.
_MESSAGES: Final = {
    "extra_forbidden": "unknown field",
    "missing": "required",
    "model_attributes_type": "must be an object",
    "model_type": "must be an object",
    "dict_type": "must be an object",
    "list_type": "must be an array",
}
# A pointer contains a member name of the request only if this pattern matches the name. Otherwise
# the pointer ends at the parent. So a request cannot put arbitrary text into an error.
_PLAIN: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_MARKS: Final = frozenset({*OBJECT_TAGS, "[key]"})


def field_errors(
    errors: Sequence[ErrorDetails],
    body: Any,
    *,
    at: tuple[str | int, ...] = (),
    skip: int = 0,
) -> list[FieldError]:
    """Return the first `MAX_ERRORS` of pydantic's errors.

    Args:
        errors: validation errors in the format of pydantic.
        body: the value that pydantic has validated.
        at: location of ``body`` in the request.
        skip: number of names and indices to remove from the start of each error's location.
    """
    found = []
    # The limit also bounds the time, because suggestions for 100,000 unknown members take a minute.
    for error in errors[:MAX_ERRORS]:
        location = error["loc"][skip:]
        unknown = str(location[-1]) if error["type"] == "extra_forbidden" else ""
        found.append(
            FieldError(
                pointer=pointer(at) + pointer(location, body)[1:],
                message=_MESSAGES.get(error["type"], error["msg"]),
                suggestions=_like(unknown) if unknown else [],
            )
        )
    return found


def _like(unknown: str) -> list[str]:
    """Return names of fields of requests that are similar to an unknown name."""
    return [name for name in get_close_matches(unknown[:64], _FIELDS) if name != unknown]


def pointer(location: tuple[str | int, ...], body: Any = None) -> str:
    """Return the JSON pointer of a location in a request. ``#`` is the whole body.

    Args:
        location: field names and list indices from the root. It may contain pydantic's marks for
            members of unions and for keys.
        body: the parsed request, or None. With this value, the pointer ends at an object that is
            only a label, because a label has no members.
    """
    steps: list[str] = []
    value = body
    for step in location:
        if step in _MARKS:
            continue
        if isinstance(value, str) or not _PLAIN.fullmatch(str(step)):
            break
        steps.append(quote(str(step)))
        if isinstance(value, dict):
            value = value.get(step)
        elif isinstance(value, list) and isinstance(step, int) and step < len(value):
            value = value[step]
        else:
            value = None
    return "#" + "".join(f"/{step}" for step in steps)
