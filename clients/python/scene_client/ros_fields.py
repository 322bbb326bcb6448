"""Reading ROS messages in either form: as JSON by rosbridge, or as Python objects.

rclpy and the readers of bags give objects with attributes, rosbridge gives dictionaries in which
NaN and infinity are null. A field that is not there, or not of its kind, is None here: what
follows from that is the reader's decision.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any


class MessageError(ValueError):
    """A message, or what was said about it, that no scene can be made of."""


def take(message: Any, *path: str) -> Any:
    """The field at the end of a path of names; None where the path breaks off."""
    for name in path:
        if message is None:
            return None
        # A message has hundreds of fields, and to ask an abstract class takes longer than a field.
        if type(message) is dict or isinstance(message, Mapping):
            message = message.get(name)
        else:
            message = getattr(message, name, None)
    return message


def has(message: Any, name: str) -> bool:
    """Whether a message has a field, be it null."""
    return name in message if isinstance(message, Mapping) else hasattr(message, name)


def items(field: Any, name: str) -> Sequence[Any]:
    """The entries of a list of messages; none where the list was left out.

    Raises:
        MessageError: it is not a list.
    """
    if field is None:
        return ()
    if not isinstance(field, list | tuple):
        raise MessageError(f"{name} must be a list")
    return field


def number(field: Any) -> float | None:
    """A finite number, or None."""
    if type(field) is not float:
        if isinstance(field, bool) or not isinstance(field, Real):
            return None
        try:
            field = float(field)
        except OverflowError:
            return None
    return field if math.isfinite(field) else None


def integer(field: Any) -> int | None:
    """A whole number, or None."""
    value = number(field)
    return int(value) if value is not None and value.is_integer() else None


def numbers(message: Any, names: str) -> tuple[float, ...] | None:
    """The fields called by the letters of ``names``, all finite; else None."""
    values = [number(take(message, name)) for name in names]
    return None if None in values else tuple(value for value in values if value is not None)


def text(field: Any) -> str:
    """Text without surrounding blanks; numbers as they are written; other values are empty."""
    if isinstance(field, str):
        return field.strip()
    whole = integer(field)
    return "" if whole is None else str(whole)


def is_plain(value: str, longest: int) -> bool:
    """Whether the service takes a text as a name or a label."""
    return 0 < len(value) <= longest and value.isprintable()
