"""Relations and places as short texts, such as "lamp on-top desk", for people and language models.

Each function raises a `PydanticCustomError`, which is a `ValueError`, for a text of another form.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any, Final, get_args

from pydantic_core import PydanticCustomError

from scene_client.schemas import RelationName

RELATIONS: Final[tuple[RelationName, ...]] = get_args(RelationName)

PREPOSITIONS: Final[dict[RelationName, str]] = {
    **{name: name for name in RELATIONS},
    "left": "left of", "right": "right of", "front": "in front of", "on-top": "on top of",
    "contains": "around",
}  # fmt: skip
"""The words for each relation in a sentence."""

_SPOKEN: Final[dict[str, RelationName]] = {
    **{name: name for name in RELATIONS},
    **{words: name for name, words in PREPOSITIONS.items()},
    "to the left of": "left", "to the right of": "right", "on": "on-top", "in": "inside",
}  # fmt: skip
# Longer words come first, because "on" begins "on top of".
_ANY: Final = "|".join(re.escape(words) for words in sorted(_SPOKEN, key=len, reverse=True))
# A name has at most 128 characters, so the patterns need no long searches.
_NAME: Final = r"(?:the\s+)?(\S.{0,127}?)"
_PLACE: Final = re.compile(rf"\s*({_ANY})\s+{_NAME}\s*")
_RELATION: Final = re.compile(rf"\s*{_NAME}(?:\s+(?:is|are))?\s+{_PLACE.pattern}")


def relation(text: str) -> dict[str, str]:
    """Return the subject, the relation and the object of a text such as "lamp on-top desk".

    The first relation in the text separates the labels, which may contain spaces.
    """
    match = _RELATION.fullmatch(text)
    if match is None:
        rule = 'must be a subject, a relation and an object, as in "lamp on-top desk"'
        raise _error(f"{rule}; {_names_for(text.split()[1:-1])}")
    return {"subject": match[1], "relation": _SPOKEN[match[2]], "object": match[3]}


def place(text: str) -> dict[str, str]:
    """Return the relation and the object of a text such as "on-top desk"."""
    match = _PLACE.fullmatch(text)
    if match is None:
        rule = 'must be a relation and an object, such as "on-top desk"'
        raise _error(f"{rule}; {_names_for(text.split()[:1])}")
    return {"relation": _SPOKEN[match[1]], "object": match[2]}


def search(text: str) -> dict[str, Any]:
    """Return a searched place: a text ROOM, ROOM:OBJECT or ROOM:OBJECT:SHARE.

    SHARE is the seen share of the place, from 0 to 1.
    """
    room, _, thing = text.partition(":")
    name, _, share = thing.partition(":")
    searched: dict[str, Any] = {"room": room.strip()}
    if name:
        searched["object"] = name.strip()
    try:
        return searched | {"seen_share": float(share or 1)}
    except ValueError:
        raise _error(f"must be ROOM, ROOM:OBJECT or ROOM:OBJECT:SHARE, and not {text}") from None


def _error(message: str) -> PydanticCustomError:
    return PydanticCustomError("phrase", "{message}", {"message": message})


def _names_for(words: Iterable[str]) -> str:
    """Return the names of the relations, and names that are similar to one of the words."""
    similar = [name for word in words for name in get_close_matches(word, RELATIONS, 1)]
    hint = f" (did you mean {similar[0]}?)" if similar else ""
    return f"relations: {', '.join(RELATIONS)}{hint}"
