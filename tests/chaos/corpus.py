"""Hostile requests: every wrong value at every place of every kind of request. Whole bodies, header
fields and addresses that are wrong: tests/http. Strings and numbers that are made up hold `MARKER`
or `NUMBER`, so that a refusal which repeats any of the input shows. Everything is generated in the
same order every time."""

import copy
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from typing import Any, Final

from app.questions import QUESTIONS, Question
from scene_client.schemas import SceneRequest

MARKER: Final = "Zq7 märker"
NUMBER: Final = "73550861"

BATCHES: Final = tuple(f"/{question.name}/batch" for question in QUESTIONS if not question.samples)

_REFUSED: Final = frozenset({400, 404, 409, 413, 415, 422})
_NOT_JSON: Final = frozenset({400})
_SENTINEL: Final = "@@here@@"


@dataclass(frozen=True)
class Hostile:
    """One request.

    Attributes:
        expected: statuses that it may get; never one of 500 and above.
    """

    name: str
    path: str
    body: bytes = b""
    method: str = "POST"
    expected: frozenset[int] = _REFUSED | {200}


SCENE: Final[dict[str, Any]] = {
    "objects": [
        "bed",
        {
            "id": "lamp_1",
            "label": "lamp",
            "confidence": 0.9,
            "alternatives": [{"label": "pillow", "confidence": 0.05}],
            "position": {"x": 1.0, "y": 0.5, "z": 1.0},
            "size": {"x": 0.2, "y": 0.2, "z": 0.4},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            "yaw": None,
            "position_std": 0.05,
            "size_std": 0.02,
            "supported_by": "desk_1",
        },
        {"id": "desk_1", "label": "desk"},
    ],
    "relations": [
        {"subject": "lamp_1", "relation": "on-top", "object": "desk_1"},
        ["bed", "left", "desk_1"],
    ],
    "relations_complete": False,
    "room_type": "bedroom",
    "profile": "homes",
    "frame_id": "base_link",
    "up": "z",
    "units": "m",
    "extents": "full",
    "box_origin": "centre",
    "quaternion_order": "xyzw",
    "stamp": {"sec": 1, "nanosec": 2},
    "viewpoint": {"x": 0.0, "y": 0.0, "yaw": 0.0},
    "model": "default",
    "seed": 7,
    "unknown_labels": "error",
    "scene_id": "scene 1",
    "source": "robot",
    "group": "home",
    "confirmed": True,
    "viewer_frame": True,
}


# Values in place of those in the examples: few steps, and labels of the tests' vocabulary.
_VALUES: Final[dict[str, Any]] = {
    "candidates": ["chair", "table"],
    "count": 1,
    "steps": 2,
    "top_k": 5,
}


def own_fields(question: Question[Any]) -> dict[str, Any]:
    """The fields of a question beyond those of every scene, from its valid examples."""
    valid = [example.value for example in question.examples.values() if example.problem is None]
    return {
        name: _VALUES.get(name) or next(value[name] for value in valid if name in value)
        for name in question.request.model_fields
        if name not in SceneRequest.model_fields
    }


VALID: Final[dict[str, dict[str, Any]]] = {
    f"/{question.name}": {
        name: value for name, value in SCENE.items() if name in question.request.model_fields
    }
    | own_fields(question)
    for question in QUESTIONS
}
"""One request of each kind with every field that it may have."""


_NESTED: Final = b"[" * 300 + b"]" * 300
_TEXT: Final = MARKER.encode()
VALUES: Final[dict[str, tuple[bytes, frozenset[int] | None]]] = {
    "null": (b"null", None),
    "true": (b"true", None),
    "zero": (b"0", None),
    "minus zero": (b"-0", None),
    "minus zero float": (b"-0.0", None),
    "minus one": (b"-1", None),
    "number": (NUMBER.encode(), None),
    "float": (NUMBER.encode() + b".5", None),
    "tiny": (b"5e-324", None),
    "large": (b"1e308", None),
    "overflow": (b"1e999", None),
    "negative overflow": (b"-1e999", None),
    "NaN": (b"NaN", _NOT_JSON),
    "-Infinity": (b"-Infinity", _NOT_JSON),
    "2**63": (b"%d" % 2**63, None),
    "2**64": (b"%d" % 2**64, None),
    "400 digits": (NUMBER.encode() * 50, None),
    "empty text": (b'""', None),
    "blank": (b'"   "', None),
    "text": (b'"%s"' % _TEXT, None),
    "long text": (b'"%s"' % (_TEXT * 10_000), None),
    "escaped high surrogate": (b'"\\ud800"', _NOT_JSON),
    "escaped null": (b'"%s\\u0000"' % _TEXT, None),
    "raw control": (b'"\x01"', _NOT_JSON),
    "delete": (b'"\x7f%s"' % _TEXT, None),
    "right to left": (f'"\u202e\u0627\u0644{MARKER}"'.encode(), None),
    "emoji": (f'"\U0001f469\u200d\U0001f467\ufe0f{MARKER}"'.encode(), None),
    "empty list": (b"[]", None),
    "list of null": (b"[null]", None),
    "long list": (b"[" + b",".join([b"null"] * 5000) + b"]", None),
    "long list of texts": (b"[" + b",".join([b'"%s"' % _TEXT] * 5000) + b"]", None),
    "empty object": (b"{}", None),
    "unknown member": (b'{"%s": 1}' % _TEXT, None),
    "proto": (b'{"__proto__": {"%s": 1}}' % _TEXT, None),
    "nested": (_NESTED, _NOT_JSON),
    "nothing": (b"", None),  # in a list of one, an empty list
}


Place = tuple[str | int, ...]


def places(value: Any, at: Place = ()) -> Iterator[Place]:
    """Every place in a JSON value, its root first."""
    yield at
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from places(inner, (*at, name))
    elif isinstance(value, list):
        for position, inner in enumerate(value):
            yield from places(inner, (*at, position))


def replaced(value: Any, place: Place, text: bytes) -> bytes:
    """A JSON value as text, with other text at one place."""
    whole: Any = {"": copy.deepcopy(value)}
    path = ("", *place)
    reduce(getitem, path[:-1], whole)[path[-1]] = _SENTINEL
    return json.dumps(whole[""]).encode().replace(f'"{_SENTINEL}"'.encode(), text)


def _without(value: Any, place: Place) -> bytes:
    value = copy.deepcopy(value)
    del reduce(getitem, place[:-1], value)[place[-1]]
    return json.dumps(value).encode()


def _with_member(value: Any, place: Place, member: bytes) -> bytes:
    inner = reduce(getitem, place, value)
    text = json.dumps(inner).encode()
    return replaced(value, place, text[:1] + member + (b", " if inner else b"") + text[1:])


def requests() -> Iterator[Hostile]:
    """Every wrong value at every place of every kind of request; members too few or too many."""
    batches = {path: {"scenes": [VALID[path.removesuffix("/batch")]]} for path in BATCHES}
    for path, valid in (VALID | batches).items():
        for place in places(valid):
            name = f"{path} /{'/'.join(map(str, place))}"
            for what, (text, expected) in VALUES.items():
                body, allowed = replaced(valid, place, text), expected or _REFUSED | {200}
                yield Hostile(f"{name} {what}", path, body, expected=allowed)
            if place:
                yield Hostile(f"{name} left out", path, _without(valid, place))
            if isinstance(reduce(getitem, place, valid), dict):
                for what, member, expected in (
                    ("unknown member", b'"%s": 1' % _TEXT, _REFUSED | {200}),
                    ("surrogate member", b'"\\ud800": 1', _NOT_JSON),
                    ("member twice", b'"a": 1, "a": 1', _NOT_JSON),
                ):
                    body = _with_member(valid, place, member)
                    yield Hostile(f"{name} {what}", path, body, expected=expected)
