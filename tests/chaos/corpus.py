"""Hostile requests: every wrong value at every place, and every way to write a request wrongly.

Strings and numbers that are made up hold `MARKER` or `NUMBER`, so that a refusal which repeats any
of the input shows. Everything is generated in the same order every time.
"""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, Final

MARKER: Final = "Zq7 märker"
NUMBER: Final = "73550861"

QUESTIONS: Final = ("/relations", "/missing", "/outliers", "/generate")
BATCHES: Final = ("/relations/batch", "/missing/batch", "/outliers/batch")
ALIAS: Final = "/models/aliases/candidate"

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
    headers: dict[str, str | bytes] = field(default_factory=dict)
    expected: frozenset[int] = _REFUSED | {200}


# ------------------------------------------------------------------------------ valid requests

SCENE: Final[dict[str, Any]] = {
    "objects": [
        "bed",
        {
            "id": "lamp_1",
            "label": "lamp",
            "confidence": 0.9,
            "position": {"x": 1.0, "y": 0.5, "z": 1.0},
            "size": {"x": 0.2, "y": 0.2, "z": 0.4},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            "yaw": None,
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
    "frame_id": "base_link",
    "stamp": {"sec": 1, "nanosec": 2},
    "viewpoint": {"x": 0.0, "y": 0.0, "yaw": 0.0},
    "model": "default",
    "seed": 7,
    "unknown_labels": "error",
    "scene_id": "scene 1",
    "source": "robot",
    "group": "home",
    "viewer_frame": True,
}
VALID: Final[dict[str, dict[str, Any]]] = {
    "/relations": SCENE
    | {
        "top_k": 5,
        "min_probability": 0.1,
        "pairs": [{"subject": "bed", "object": "lamp_1"}, ["desk_1", "bed"]],
        "include_opposites": True,
    },
    "/missing": SCENE
    | {
        "coverage": 0.5,
        "top_k": 3,
        "candidates": ["chair", "pillow"],
        "at": {"relation": "on-top", "object": "desk_1"},
        "detail": "scores",
    },
    "/outliers": SCENE | {"sensitivity": "high", "threshold": 0.5, "detail": "full"},
    "/generate": SCENE | {"count": 1, "steps": 2, "temperature": 1.0, "context": {"h1": [0, 1]}},
    ALIAS: {"model": "home@1.1.0", "expected": "home@1.1.0"},
}
"""One request of each kind with every field that it may have."""


# -------------------------------------------------------------------------------- wrong values

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
    "Infinity": (b"Infinity", _NOT_JSON),
    "-Infinity": (b"-Infinity", _NOT_JSON),
    "2**63": (b"%d" % 2**63, None),
    "2**64": (b"%d" % 2**64, None),
    "400 digits": (NUMBER.encode() * 50, None),
    "5000 digits": (b"9" * 5000, _NOT_JSON),
    "leading zero": (b"007", _NOT_JSON),
    "hexadecimal": (b"0x10", _NOT_JSON),
    "empty text": (b'""', None),
    "blank": (b'"   "', None),
    "text": (b'"%s"' % _TEXT, None),
    "long text": (b'"%s"' % (_TEXT * 10_000), None),
    "escaped high surrogate": (b'"\\ud800"', _NOT_JSON),
    "escaped low surrogate": (b'"\\udfff%s"' % _TEXT, _NOT_JSON),
    "raw surrogate": (b'"\xed\xa0\x80"', _NOT_JSON),
    "overlong": (b'"\xc0\xaf"', _NOT_JSON),
    "latin-1": (b'"\xe9"', _NOT_JSON),
    "escaped null": (b'"%s\\u0000"' % _TEXT, None),
    "raw control": (b'"\x01"', _NOT_JSON),
    "raw newline": (b'"\n"', _NOT_JSON),
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
    "repeated member": (b'{"x": 1, "x": 2}', _NOT_JSON),
    "nested": (_NESTED, _NOT_JSON),
    "comment": (b"/* */ 1", _NOT_JSON),
    "single quotes": (b"'x'", _NOT_JSON),
    "nothing": (b"", None),  # in a list of one, an empty list
    "python": (b"None", _NOT_JSON),
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
    whole = {"": copy.deepcopy(value)}
    parent: Any = whole
    for step in ("", *place)[:-1]:
        parent = parent[step]
    parent[("", *place)[-1]] = _SENTINEL
    return json.dumps(whole[""]).encode().replace(f'"{_SENTINEL}"'.encode(), text)


def _without(value: Any, place: Place) -> bytes:
    value = copy.deepcopy(value)
    parent = value
    for step in place[:-1]:
        parent = parent[step]
    del parent[place[-1]]
    return json.dumps(value).encode()


def _with_member(value: Any, place: Place, member: bytes) -> bytes:
    inner = value
    for step in place:
        inner = inner[step]
    text = json.dumps(inner).encode()
    return replaced(value, place, text[:1] + member + (b", " if inner else b"") + text[1:])


def wrong_values() -> Iterator[Hostile]:
    """Every wrong value at every place of every kind of request; members too few or too many."""
    for path, valid in _all_valid():
        method = "PUT" if path == ALIAS else "POST"
        for place in places(valid):
            name = f"{path} /{'/'.join(map(str, place))}"
            for what, (text, expected) in VALUES.items():
                yield Hostile(
                    f"{name} {what}",
                    path,
                    replaced(valid, place, text),
                    method,
                    expected=expected or _REFUSED | {200},
                )
            if place:
                yield Hostile(f"{name} left out", path, _without(valid, place), method)
            inner = valid
            for step in place:
                inner = inner[step]
            if isinstance(inner, dict):
                for what, member, expected in (
                    ("unknown member", b'"%s": 1' % _TEXT, _REFUSED | {200}),
                    ("surrogate member", b'"\\ud800": 1', _NOT_JSON),
                    ("member twice", b'"a": 1, "a": 1', _NOT_JSON),
                ):
                    body = _with_member(valid, place, member)
                    yield Hostile(f"{name} {what}", path, body, method, expected=expected)


def _all_valid() -> Iterator[tuple[str, Any]]:
    yield from VALID.items()
    for path in BATCHES:
        yield path, {"scenes": [VALID[path.removesuffix("/batch")]]}


# -------------------------------------------------------------------------------- whole bodies

JSON: Final = {"Content-Type": "application/json"}


def whole_bodies() -> Iterator[Hostile]:
    """Bodies that are wrong as a whole, or right and huge."""
    for path, valid in _all_valid():
        method = "PUT" if path == ALIAS else "POST"
        text = json.dumps(valid).encode()
        for name, body in {
            "empty": b"",
            "blank": b" \r\n\t ",
            "cut short": text[:-1],
            "cut in half": text[: len(text) // 2],
            "twice": text + text,
            "trailing text": text + _TEXT,
            "trailing comma": text[:-1] + b",}",
            "byte order mark": b"\xef\xbb\xbf" + text,
            "UTF-16": text.decode().encode("utf-16"),
            "UTF-16LE": text.decode().encode("utf-16-le"),
            "UTF-32": text.decode().encode("utf-32"),
            "gzip": b"\x1f\x8b\x08\x00" + text,
            "null bytes": b"\x00" * 1000,
            "noise": random.Random(0).randbytes(10_000),
            "brackets": b"[" * 100_000,
            "closed brackets": b"[" * 100_000 + b"]" * 100_000,
            "objects": b'{"a":' * 30_000 + b"1" + b"}" * 30_000,
            "XML": b"<?xml version='1.0'?><!DOCTYPE a [<!ENTITY b SYSTEM 'file:///etc/passwd'>]>",
            "form": b"objects=bed&objects=lamp",
            "long number": b"1" * 200_000,
            "lone quote": b'"' + _TEXT * 10_000,
            "backslashes": b'"' + b"\\" * 100_001,
        }.items():
            yield Hostile(f"{path} {name}", path, body, method, expected=_NOT_JSON)
        for name, body in {
            "a number": NUMBER.encode(),
            "a text": b'"%s"' % _TEXT,
            "a list": b"[]",
            "many texts": b"[" + b",".join([b'"a"'] * 50_000) + b"]",
            "many numbers": b"[" + b"0," * 100_000 + b"0]",
            "long exponent": b"1e" + b"9" * 100_000,
            "many members": b"{" + b",".join(b'"%d":0' % k for k in range(20_000)) + b"}",
        }.items():
            yield Hostile(f"{path} {name}", path, body, method, expected=frozenset({422}))
        body = b'{"objects": [' + b",".join([b'"bed"'] * 1_000_000) + b"]}"
        yield Hostile(f"{path} a million labels", path, body, method, expected=frozenset({413}))


def nonsense() -> Iterator[Hostile]:
    """Requests of the right form that make no sense."""
    labels = [f"{MARKER} {k}" for k in range(256)]
    names = ["bed", "lamp", "desk", "chair"]
    contradictions: list[list[tuple[str, str, str]]] = [
        [("bed", "left", "lamp"), ("bed", "right", "lamp")],
        [("bed", "left", "lamp"), ("lamp", "left", "bed")],
        [("bed", "on-top", "lamp"), ("bed", "under", "lamp")],
        [("bed", "above", "lamp"), ("lamp", "above", "bed")],
        [("bed", "front", "bed")],
        [("bed", "behind", "bed"), ("lamp", "left", "lamp")],
        [(name, "left", name) for name in names],
        [("bed", "left", "lamp"), ("lamp", "left", "desk"), ("lamp", "left", "bed")],
    ]
    bodies: dict[str, tuple[dict[str, Any], set[int]]] = {
        "256 unknown labels": ({"objects": labels}, {422}),
        "256 unknown labels ignored": ({"objects": labels, "unknown_labels": "ignore"}, {200, 422}),
        "257 objects": ({"objects": ["bed"] * 257}, {422}),
        "256 beds": ({"objects": ["bed"] * 256}, {200}),
        "ids taken": (
            {"objects": [{"id": f"bed_{k}", "label": "lamp"} for k in range(1, 129)] + ["bed"] * 9},
            {200},
        ),
        "one id": ({"objects": [{"id": MARKER, "label": "bed"}] * 9}, {422}),
        "unknown model": ({"objects": ["bed"], "model": MARKER}, {404}),
        "model of dots": ({"objects": ["bed"], "model": "../../etc/passwd"}, {404}),
        "unknown version": ({"objects": ["bed"], "model": f"home@{NUMBER}.0.0"}, {404}),
        "long id": ({"objects": [{"id": MARKER * 100, "label": "bed"}]}, {422}),
        "far away": (
            {
                "objects": [
                    {"label": name, "position": [sign * 1e8, sign * 1e8, 1e8]}
                    for name, sign in (("bed", 1), ("lamp", -1), ("desk", 1))
                ]
            },
            {200},
        ),
        "one place": (
            {"objects": [{"label": name, "position": [0, 0, 0]} for name in names]},
            {200},
        ),
        "flat": (
            {
                "objects": [
                    {"label": name, "position": [0, 0, 0], "size": [5e-324, 1e4, 5e-324]}
                    for name in names
                ]
            },
            {200},
        ),
        "faint": ({"objects": [{"label": name, "confidence": 5e-324} for name in names]}, {200}),
        "too many relations": (
            {"objects": names, "relations": [["bed", "left", "lamp"]] * 4097},
            {422},
        ),
        "relations of nobody": (
            {"objects": names, "relations": [[MARKER, "left", MARKER]] * 4096},
            {422},
        ),
        "relations full of what nobody knows": (
            {
                "objects": names,
                "relations": [
                    {"subject": "bed", "relation": "left", "object": "lamp"}
                    | {f"{k:x}": 0 for k in range(29)}
                ]
                * 600,
            },
            {422},
        ),
        "complete and none": ({"objects": names, "relations_complete": True}, {422}),
        "all relations": (
            {
                "objects": names,
                "relations": [
                    [s, relation, o]
                    for relation in ("left", "front", "on-top", "above")
                    for i, s in enumerate(names)
                    for o in names[i + 1 :]
                ],
                "relations_complete": True,
            },
            {200},
        ),
    }
    for number, triples in enumerate(contradictions):
        bodies[f"contradiction {number}"] = ({"objects": names, "relations": triples}, {422})
    for path in QUESTIONS:
        extra = {"steps": 2} if path == "/generate" else {}
        for name, (body, expected) in bodies.items():
            text = json.dumps(body | extra).encode()
            yield Hostile(f"{path} {name}", path, text, expected=frozenset(expected))
        if path != "/generate":
            scenes: list[Any] = [body for body, _ in bodies.values()] + [None, [], MARKER, {}]
            text = json.dumps({"scenes": scenes}).encode()
            yield Hostile(f"{path} nonsense at once", f"{path}/batch", text)
            text = json.dumps({"scenes": [{}] * 257}).encode()
            expected = {422}
            yield Hostile(f"{path} 257", f"{path}/batch", text, expected=frozenset(expected))


# ---------------------------------------------------------------------------- around the body


def media_types() -> Iterator[Hostile]:
    """Bodies that are not declared as JSON."""
    for path, valid in _all_valid():
        method = "PUT" if path == ALIAS else "POST"
        for kind in (
            "", "json", "text/json", "text/plain", "*/*", "application/*", "application/xml",
            "application/x-www-form-urlencoded", "multipart/form-data", f"a/{NUMBER}", "/", ";",
            "multipart/form-data; boundary=x", "application/jsonp", "x" * 10_000, "a/b/c; d=" * 100,
            "application/octet-stream", b"\xff\xfe", b"application/json\xe9", "application;json",
        ):  # fmt: skip
            yield Hostile(
                f"{path} {kind[:40]!r}", path, json.dumps(valid).encode(), method,
                {"Content-Type": kind}, frozenset({415}),
            )  # fmt: skip


_ADDRESSES: Final = (
    *QUESTIONS, *BATCHES, ALIAS, "/models", "/models/refresh", "/models/home",
    "/models/home/versions/1.0.0", "/models/default/vocabulary", "/models/default/contexts",
    "/health/live", "/health/ready", "/v2", "/v2/health/live", "/v2/models/default",
    "/openapi.json", "/docs", "/problems", "/static/icon.svg",
)  # fmt: skip


def methods() -> Iterator[Hostile]:
    """Methods that a route does not take, and some that nothing takes."""
    for path in _ADDRESSES:
        for method in ("GET", "PUT", "POST", "DELETE", "PATCH", "OPTIONS", "TRACE", "PROPFIND"):
            yield Hostile(
                f"{method} {path}", path, b"", method,
                expected=frozenset({200, 400, 404, 405, 415}),
            )  # fmt: skip


def addresses() -> Iterator[Hostile]:
    """Addresses of nothing."""
    names = (
        "%", "..", "../..", "%2e%2e", "%2e%2e%2f%2e%2e%2fetc%2fpasswd", "..%5c..", "%00",
        "%0d%0a", "%ff",
        "%ed%a0%80", "%c0%af", "%zz", "%F0%9F%98%80", "%E2%80%AE", "a" * 5_000, "@", "home@",
        "@1.0.0", "home@1.0.0@1.0.0", f"home@{NUMBER}.0.0", "home@" + "9" * 1000, "HOME", "home%00",
        "home/..", "home//", ";", "~", "-", "_", "con", ".lock", "aliases.json", NUMBER, "null",
        "Zq7%20m%C3%A4rker", "%3Cscript%3E", "{name}", "$%7B7*7%7D", "%25%32%65", "home%2f1.0.0",
    )  # fmt: skip
    for prefix in (
        "/", "/models/", "/models/home/versions/", "/v2/models/", "/problems/", "/static/",
        "/docs/", "/redoc/", "/relations/", "/health/", "/models/aliases/",
    ):  # fmt: skip
        for name in names:
            for suffix in ("", "/vocabulary", "/contexts", "/ready"):
                path = f"{prefix}{name}{suffix}"
                # Some of them name something after all: a folder's own page, a model's newest.
                expected = frozenset({200, 400, 404, 405})
                yield Hostile(f"GET {path[:80]}", path, b"", "GET", expected=expected)
    for name in names:
        if name == NUMBER:
            continue  # would create this alias, and errors list all aliases
        path = f"/models/aliases/{name}"
        body = b'{"model": "home@1.1.0"}'
        expected = frozenset({200, 404, 405, 409, 422})
        yield Hostile(f"PUT {path[:80]}", path, body, "PUT", expected=expected | {400})
    for query in ("?", "??", f"?{NUMBER}", "?a[]=1&a[b]=2", "?%ff=%00", "?" + "a=1&" * 5_000):
        yield Hostile(f"query {query[:20]}", f"/relations{query}", b'{"objects": ["bed"]}')


def header_fields() -> Iterator[Hostile]:
    """Values of header fields that the service reads."""
    values: tuple[str | bytes, ...] = (
        "", " ", MARKER.encode(), "x" * 129, "x" * 30_000, b"\xff", b"\xc3\x28", "0", "-1", "1e9",
        "NaN", NUMBER, "9" * 400, "null", "<script>", "\t", "a,b", '"', "Bearer", "Bearer  ",
        "Basic",
        "Bearer " + "x" * 10_000, b"Bearer \xf0\x9f\x98\x80", "${jndi:ldap://x}",
    )  # fmt: skip
    for name in (
        "X-Request-Id", "X-Request-Timeout-Ms", "X-Admin-Key", "Authorization", "Accept",
        "Accept-Encoding", "Content-Encoding", "Range", "If-None-Match", "Origin", "Cookie",
        "X-Forwarded-For", "Forwarded", "Traceparent", "X-HTTP-Method-Override",
    ):  # fmt: skip
        for value in values:
            yield Hostile(
                f"{name}: {value[:20]!r}", "/missing", b'{"objects": ["bed"]}', "POST",
                {name: value}, frozenset({200, 400, 415, 422, 504}),
            )  # fmt: skip
    for name in ("X-Admin-Key", "Authorization"):
        for value in values:
            for method, path in (("POST", "/models/refresh"), ("PUT", ALIAS)):
                yield Hostile(
                    f"{path} {name}: {value[:20]!r}", path, b'{"model": "home"}', method,
                    {"X-Admin-Key": "", name: value}, frozenset({401}),
                )  # fmt: skip


def everything() -> Iterator[Hostile]:
    """All of it."""
    return chain(
        whole_bodies(), nonsense(), media_types(), methods(), addresses(), header_fields(),
        wrong_values(),
    )  # fmt: skip
