"""What validation finds in a request, in words and with pointers; for service and clients alike."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any, Final

from pydantic_core import ErrorDetails

from scene_client import schemas
from scene_client.pointers import pointer
from scene_client.schemas import FieldError

MAX_ERRORS: Final = 100
"""How many faults of one request are listed."""

_FIELDS: Final = sorted(
    {
        name
        for value in vars(schemas).values()
        if isinstance(value, type) and issubclass(value, schemas.Request)
        for name in value.model_fields
    }
)
# Where pydantic's own words would puzzle a reader who does not write Python.
_MESSAGES: Final = {
    "extra_forbidden": "unknown field",
    "missing": "required",
    "model_attributes_type": "must be an object",
    "model_type": "must be an object",
    "dict_type": "must be an object",
    "list_type": "must be an array",
}


def field_errors(
    faults: Sequence[ErrorDetails],
    body: Any,
    *,
    at: tuple[str | int, ...] = (),
    skip: int = 0,
) -> list[FieldError]:
    """The faults that pydantic found, as they are told: at most `MAX_ERRORS`.

    Args:
        faults: what was found.
        body: what was validated.
        at: where in the request ``body`` stands.
        skip: leading steps of every location that lead to ``body``.
    """
    errors = []
    # Only of those that are listed: suggestions for 100,000 members take a minute.
    for fault in faults[:MAX_ERRORS]:
        location = fault["loc"][skip:]
        unknown = str(location[-1]) if fault["type"] == "extra_forbidden" else ""
        errors.append(
            FieldError(
                pointer=pointer(at) + pointer(location, body)[1:],
                message=_MESSAGES.get(fault["type"], fault["msg"]),
                suggestions=_like(unknown) if unknown else [],
            )
        )
    return errors


def _like(unknown: str) -> list[str]:
    """Fields of requests with such a name; one that is a field elsewhere does not mean itself."""
    return [name for name in get_close_matches(unknown[:64], _FIELDS) if name != unknown]
