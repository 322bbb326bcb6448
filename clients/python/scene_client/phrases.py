"""Relations and places as short texts, such as "lamp on-top desk", for people and language models.

Each function raises a `PydanticCustomError`, which is a `ValueError`, for a text of another form.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import Any, Final, get_args

from pydantic import TypeAdapter
from pydantic_core import PydanticCustomError

from scene_client.schemas import Detection, HomeRoom, RelationName, Spot

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
_LONGEST_FIRST: Final = sorted(_SPOKEN, key=len, reverse=True)


def relation(text: str) -> dict[str, str]:
    """Return the subject, the relation and the object of a text such as "lamp on-top desk".

    The first relation in the text separates the labels, which may contain spaces.
    """
    words = text.split()
    for start in range(1, len(words) - 1):
        name, end = _relation_at(words, start)
        if name and (thing := _name(words[end:])):
            subject = words[:start]
            if len(subject) > 1 and subject[-1] in ("is", "are"):
                subject = subject[:-1]
            return {"subject": _name(subject), "relation": name, "object": thing}
    rule = 'must be a subject, a relation and an object, as in "lamp on-top desk"'
    raise _error(f"{rule}; {_names_for(words[1:-1])}")


# Words for places without a relation of the service, and things that carry whole rooms.
_OTHER_PLACES: Final = ("beside", "next to", "near", "by", "close to", "against", "between", "at")
_STRUCTURE: Final = ("floor", "ground", "wall", "ceiling")


def is_unused(text: str) -> bool:
    """Return whether a text states a place without use for the service, as "on the floor"."""
    words = text.split()
    return words[-1:] in [[name] for name in _STRUCTURE] or any(
        f" {other} " in " ".join(words) for other in _OTHER_PLACES
    )


def place(text: str) -> dict[str, str]:
    """Return the relation and the object of a text such as "on-top desk"."""
    words = text.split()
    name, end = _relation_at(words, 0)
    if name and (thing := _name(words[end:])):
        return {"relation": name, "object": thing}
    rule = 'must be a relation and an object, such as "on-top desk"'
    raise _error(f"{rule}; {_names_for(words[:1])}")


def _relation_at(words: list[str], start: int) -> tuple[str, int]:
    """Return the relation that starts at a word and the index after it, or ("", start)."""
    for spoken in _LONGEST_FIRST:
        end = start + spoken.count(" ") + 1
        if words[start:end] == spoken.split():
            return _SPOKEN[spoken], end
    return "", start


def _name(words: list[str]) -> str:
    return " ".join(words[1:] if words[:1] == ["the"] and len(words) > 1 else words)


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


Labels = Mapping[tuple[str, str], str]
"""The labels of the objects of a home, by room and id."""


def labels_in(rooms: Iterable[Any]) -> Labels:
    """Return the labels of the objects with ids, from the `rooms` of a `where` request.

    Raises:
        ValidationError: the rooms are invalid.
    """
    found = TypeAdapter(list[HomeRoom]).validate_python(rooms)
    return {
        (room.id, one.id): one.label
        for room in found
        for one in room.objects
        if isinstance(one, Detection) and one.id is not None
    }


def spot(place: Spot, labels: Labels) -> str:
    """Return a place at an object in words, such as "on top of sink (t12)"."""
    name = place.object or ""
    label = labels.get((place.room, name), name)
    words = name if label in name else f"{label} ({name})"
    return words if place.relation is None else f"{PREPOSITIONS[place.relation]} {words}"


def _error(message: str) -> PydanticCustomError:
    return PydanticCustomError("phrase", "{message}", {"message": message})


def _names_for(words: Iterable[str]) -> str:
    """Return the names of the relations, and names that are similar to one of the words."""
    similar = [name for word in words for name in get_close_matches(word, RELATIONS, 1)]
    hint = f" (did you mean {similar[0]}?)" if similar else ""
    return f"relations: {', '.join(RELATIONS)}{hint}"
