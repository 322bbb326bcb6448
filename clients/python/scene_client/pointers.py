"""Locations in a request as JSON pointers in URI fragments (RFC 6901, section 6)."""

from __future__ import annotations

import re
from typing import Any, Final
from urllib.parse import quote

from scene_client.schemas import OBJECT_TAGS

# A pointer repeats member names of the request. Only short plain ones are repeated, so that nobody
# can make an error say something of their choosing; a pointer to anything else stops at its parent.
_PLAIN: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_MARKS: Final = frozenset({*OBJECT_TAGS, "[key]"})


def pointer(location: tuple[str | int, ...], body: Any = None) -> str:
    """The JSON pointer of a location, ``#`` for the whole body.

    Args:
        location: field names and list positions from the root, with pydantic's marks for members
            of unions and for keys.
        body: the parsed request, if at hand: a bare label has no members, so a location inside it
            points at the label itself.
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
