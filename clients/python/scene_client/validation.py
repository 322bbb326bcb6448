"""Conversion of pydantic's errors to messages with JSON pointers, for the service and its clients.

Pointers are URI fragments (RFC 6901, section 6). The messages describe JSON values instead of
Python types.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from difflib import get_close_matches
from typing import Any, Final, get_args
from urllib.parse import quote

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from scene_client.schemas import OBJECT_TAGS, FieldError, OrArray, Request

MAX_ERRORS: Final = 32
"""Maximum number of errors that the answer to a request lists."""

# Messages for pydantic's types of errors. The names in braces are members of pydantic's context.
_MESSAGES: Final = {
    "missing": "this field is required",
    "too_long": "must have at most {max_length} entries",
    "too_short": "must not be empty",
    "string_too_long": "must have at most {max_length} characters",
    "string_too_short": "must not be empty",
    "greater_than": "must be greater than {gt}",
    "greater_than_equal": "must be at least {ge}",
    "less_than_equal": "must be at most {le}",
    "finite_number": "must be a finite number",
}
# Messages for values of a wrong type. A description of the value follows the message.
_WRONG_TYPES: Final = {
    "bool_type": "must be true or false",
    "dict_type": "must be a JSON object",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "list_type": "must be a JSON array",
    "model_type": "must be a JSON object",
    "object_kind": "must be a label or a JSON object with the field `label`",
    "string_type": "must be a string",
}
_KINDS: Final = {
    type(None): "null",
    bool: "a boolean",
    int: "a number",
    float: "a decimal number",
    str: "a string",
    list: "an array",
    tuple: "an array",
    dict: "an object",
}
# A pointer contains a member name of the request only if this pattern matches the name. Otherwise
# the pointer ends at the parent. So a request cannot put arbitrary text into an error.
PLAIN: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_MARKS: Final = frozenset({*OBJECT_TAGS, "[key]"})
# Indices of the members if an array replaces an object; see `OrArray`.
_INDICES: Final = {"subject": 0, "relation": -2, "object": -1, "x": 0, "y": 1, "z": 2, "w": 3}


def field_errors(
    error: ValidationError, body: Any, form: type[Request], *, at: tuple[str | int, ...] = ()
) -> list[FieldError]:
    """Return the errors of a request, at most `MAX_ERRORS`.

    Args:
        error: the validation error of pydantic.
        body: the value that pydantic has validated.
        form: the schema that ``body`` does not match.
        at: location of ``body`` in the request.
    """
    errors = []
    for details in _all_errors(error, body, form)[:MAX_ERRORS]:
        message, suggestions = _message(details, form)
        location = pointer(at) + pointer(details["loc"], body)[1:]
        errors.append(FieldError(pointer=location, message=message, suggestions=suggestions))
    return errors


def _all_errors(error: ValidationError, body: Any, form: type[Request]) -> list[ErrorDetails]:
    # Pydantic reports the errors of the first invalid object only. So the function replaces this
    # object by a valid one and validates the objects again, until it has `MAX_ERRORS` errors.
    errors = newest_errors = error.errors(include_url=False)
    while len(errors) < MAX_ERRORS:
        index = _invalid_object(newest_errors)
        if index is None:
            break
        objects = [*body["objects"]]
        objects[index] = "valid"
        body = {"objects": objects}
        try:
            form.model_validate(body)
            break
        except ValidationError as next_error:
            # Errors of other fields are already in the list.
            newest_errors = list(filter(_is_of_objects, next_error.errors(include_url=False)))
            errors += newest_errors
    return sorted(errors, key=_is_of_objects, reverse=True)


def _invalid_object(errors: list[ErrorDetails]) -> Any:
    # An error of the whole list has the location ("objects",), without an index.
    locations = (details["loc"] for details in filter(_is_of_objects, errors))
    return next((location[1] for location in locations if len(location) > 1), None)


def _is_of_objects(details: ErrorDetails) -> bool:
    return details["loc"][:1] == ("objects",)


def pointer(location: tuple[str | int, ...], body: Any = None) -> str:
    """Return the JSON pointer of a location in a request. ``#`` is the whole body.

    Args:
        location: field names and list indices from the root. It may contain pydantic's marks for
            members of unions and for keys.
        body: the parsed request, or None. With this value, the pointer ends at an object that is
            only a label, because a label has no members. In an array that replaces an object, the
            pointer contains indices.
    """
    steps: list[str] = []
    value = body
    for step in location:
        if step in _MARKS:
            continue
        if value and isinstance(value, list | tuple) and step in _INDICES:
            step = _INDICES[str(step)] % len(value)
        if isinstance(value, str) or not PLAIN.fullmatch(str(step)):
            break
        steps.append(quote(str(step)))
        if isinstance(value, dict):
            value = value.get(step)
        elif isinstance(value, list | tuple) and isinstance(step, int) and step < len(value):
            value = value[step]
        else:
            value = None
    return "#" + "".join(f"/{step}" for step in steps)


def listed(names: Iterable[str], last: str = "and") -> str:
    """Return names as text, such as "`x`, `y` and `z`"."""
    *others, final = [f"`{name}`" for name in names]
    return f"{', '.join(others)} {last} {final}" if others else final


def _message(details: ErrorDetails, form: type[Request]) -> tuple[str, list[str]]:
    """Return the message for an error of pydantic, and known names similar to an unknown name."""
    kind, value = details["type"], details["input"]
    if kind == "extra_forbidden":
        return _unknown_field(details["loc"], form)
    if kind == "literal_error":
        choices = re.findall(r"'([^']*)'", details["ctx"]["expected"])
        return f"must be {listed(choices, 'or')}", _similar_names(value, choices)
    if kind in _WRONG_TYPES:
        requirement = _WRONG_TYPES[kind]
        actual = _KINDS.get(type(value)) or f"a {type(value).__name__}"
        if kind == "model_type":
            fields = _required_fields(details["loc"], form)
            if isinstance(value, list) and fields.endswith("values"):
                actual += f" of {len(value)}"
            requirement += fields
        return f"{requirement}, not {actual}", []
    if kind in _MESSAGES:
        bounds = {name: _whole(bound) for name, bound in details.get("ctx", {}).items()}
        return _MESSAGES[kind].format(**bounds), []
    return details["msg"], []


def _unknown_field(location: Sequence[str | int], form: type[Request]) -> tuple[str, list[str]]:
    schema, _ = _schema_at(location[:-1], form)
    names = list(schema.model_fields) if schema is not None else []
    similar = _similar_names(location[-1], names)
    if similar or not names:
        return "unknown field", similar
    return f"unknown field; this object has the fields {listed(names)}", []


def _similar_names(value: Any, choices: Sequence[str]) -> list[str]:
    if not isinstance(value, str):
        return []
    text = value[:64].lower()
    words = set(re.findall("[a-z]+", text))
    shared = [choice for choice in choices if words & set(re.findall("[a-z]+", choice))]
    return shared[:3] or get_close_matches(text, choices, cutoff=0.7)


def _required_fields(location: Sequence[str | int], form: type[Request]) -> str:
    """Return the required fields of the object at a location, as the end of a message."""
    schema, or_array = _schema_at(location, form)
    fields = {} if schema is None else schema.model_fields
    required = [name for name, field in fields.items() if field.is_required()]
    if not required:
        return ""
    text = f" with the field{'s' * (len(required) > 1)} {listed(required)}"
    return f"{text} or an array of these {len(required)} values" if or_array else text


def _schema_at(
    location: Sequence[str | int], form: type[Request]
) -> tuple[type[Request] | None, bool]:
    """Return the schema of the object at a location, and whether an array may replace it."""
    schema: type[Request] | None = form
    or_array = False
    for step in location:
        # Other steps are indices, pydantic's marks and keys of dictionaries.
        if schema is not None and step in schema.model_fields:
            parts = list(_annotations(schema.model_fields[str(step)].annotation))
            or_array = any(isinstance(part, OrArray) for part in parts)
            classes = [part for part in parts if isinstance(part, type)]
            schema = next((kind for kind in classes if issubclass(kind, Request)), None)
    return schema, or_array


def _annotations(annotation: Any) -> Iterator[Any]:
    yield annotation
    for inner in get_args(annotation):
        yield from _annotations(inner)


def _whole(bound: Any) -> Any:
    """Return a bound without the decimal places of a whole number."""
    return int(bound) if isinstance(bound, float) and bound.is_integer() else bound
