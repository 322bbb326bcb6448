"""Each error is a problem document with its cause, and without secrets or input."""

import json
import uuid
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from httpx import AsyncClient, Response

from app.errors import ERRORS
from app.questions import QUESTIONS
from scene_client.schemas import Problem
from tests.services import defect

NAMES = [question.name for question in QUESTIONS if question.rooms_of is None]
MARKER = "Zq7-marker"
BED = {"label": "bed"}
POINT = {"x": 1.0, "y": 1.0, "z": 1.0}


def problem(response: Response, status: int, slug: str) -> dict[str, Any]:
    """Return the problem of a response after the checks of every problem."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    document: dict[str, Any] = response.json()
    Problem.model_validate(document, extra="forbid")
    assert document["type"] == f"/problems/{slug}"
    assert document["status"] == status == ERRORS[slug].status
    assert document["title"] == ERRORS[slug].title
    assert document["request_id"] == response.headers["x-request-id"]
    assert document["instance"] == f"/problems/{slug}#{document['request_id']}"
    assert ("retry-after" in response.headers) == (status in (429, 503))
    for leak in ("Traceback", ".py", "site-packages", str(Path.cwd()), MARKER):
        assert leak not in response.text
    return document


def pointers(response: Response, slug: str = "invalid-request") -> list[str]:
    """The pointers of the errors of a response with status 422."""
    return [error["pointer"] for error in problem(response, 422, slug)["errors"]]


async def post(client: AsyncClient, body: Any, path: str = "/relations") -> Any:
    """Send bytes or text as a JSON body."""
    headers = {"Content-Type": "application/json"}
    return await client.post(path, content=body, headers=headers)


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b" ",
        b"{",
        b"{'objects': ['bed']}",
        b'{"objects": ["bed"],}',
        b'{"objects": ["bed"]} {"objects": ["bed"]}',
        b'{"objects": [{"label": "bed", "confidence": NaN}]}',
        b'{"objects": [{"label": "bed", "confidence": Infinity}]}',
        b'{"objects": [{"label": "bed", "confidence": -Infinity}]}',
        b'{"objects": ["\\ud800"]}',
        b'{"objects": ["\\udc00"]}',
        b'{"\\ud800": 1}',
        b'{"objects": ["\xff\xfe"]}',
        b'{"objects": ["\xed\xa0\x80"]}',
        b'\xef\xbb\xbf{"objects": ["bed"]}',
        '{"objects": ["bed"]}'.encode("utf-16"),
        b'{"objects": ["bed"], "objects": ["lamp"]}',
        b'{"objects": [{"label": "bed", "label": "lamp"}]}',
        b'{"objects": ["be\nd"]}',
        b'{"objects": ["bed"], "seed": ' + b"9" * 5000 + b"}",
        b"[" * 8_000 + b"]" * 8_000,
        b'{"a":' * 2_000 + b"1" + b"}" * 2_000,
        b'{"objects": ' + b"[" * 300 + b"]" * 300 + b"}",
        *(b'{"a": 1,', b'{"a": 1,}', b'{"a" 1}', b"{7: 1}", b'{"a": 1} 7', b'{"a": [[1]}'),
        *(b'{"a": [1,]}', b'{"a": [1 2]}', b'{"a": 01}', b'{"a": {"b": 1, "b": 2}}'),
    ],
    ids=lambda body: repr(body[:24]),
)
async def test_only_strict_json_is_accepted(client: AsyncClient, body: bytes) -> None:
    problem(await post(client, body), 400, "not-json")
    # A large body is parsed in parts.
    problem(await post(client, body.ljust(2**18 + 1), "/missing/batch"), 400, "not-json")


ACCEPTED_TYPES = ("application/json; charset=utf-8", "Application/JSON", "application/a+json")
REFUSED_TYPES = {
    "application/json": ("text/plain", "application/x-www-form-urlencoded", "json", "", "*/*"),
    "charset": ("application/json; charset=utf-16", "application/a+json; charset=latin-1"),
}
REFUSED_HEADERS = [
    *(({"Content-Type": kind}, name) for name, kinds in REFUSED_TYPES.items() for kind in kinds),
    ({}, "application/json"),
    ({"Content-Type": "application/json", "Content-Encoding": "gzip"}, "Content-Encoding"),
    ({"Content-Type": "application/json", "Content-Encoding": "identity, br"}, "compressed"),
]


async def test_only_plain_json_is_accepted(client: AsyncClient) -> None:
    content = b'{"objects": ["bed"]}'
    for kind in ACCEPTED_TYPES:
        headers = {"Content-Type": kind}
        assert (await client.post("/relations", content=content, headers=headers)).is_success, kind
    for headers, name in REFUSED_HEADERS:
        response = await client.post("/relations", content=content, headers=headers)
        assert name in problem(response, 415, "unsupported-media-type")["detail"], headers


LEFT = {"subject": "bed", "relation": "left", "object": "lamp"}
ON_TOP = {"subject": "lamp", "relation": "on_top", "object": "bed"}
INVALID: dict[str, list[tuple[Any, ...]]] = {
    "relations": [
        ({"objects": []}, "objects"),
        ({"objects": ["be\0d"]}, "objects/0"),
        ({"objects": ["x" * 200_000]}, "objects/0"),
        ({"objects": [{}]}, "objects/0/label"),
        ({"objects": [BED | {"id": "a"}, {"id": "a", "label": "lamp"}]}, "objects/1/id"),
        ({"objects": [BED | {"confidence": 0}]}, "objects/0/confidence"),
        ({"objects": [BED | {"confidence": 1e999}]}, "objects/0/confidence"),
        ({"objects": [BED | {"position": {"x": 1, "y": 2}}]}, "objects/0/position/z"),
        ({"objects": [BED | {"position": POINT | {"x": 10**400}}]}, "objects/0/position/x"),
        ({"objects": [BED | {"size": POINT | {"x": -1}}]}, "objects/0/size/x"),
        ({"objects": [BED | {"orientation": [0, 0, 0, 1], "yaw": 1}]}, "objects/0"),
        ({"objects": [BED | {"supported_by": "sofa"}]}, "objects/0/supported_by"),
        ({"objects": [BED | {"orientation": POINT | {"w": 2}}]}, "objects/0/orientation"),
        ({"relations": [{}]}, "relations/0/subject"),
        ({"objects": ["bed", "bed", "lamp"], "relations": [LEFT]}, "relations/0/subject"),
        ({"relations_complete": True}, "relations_complete"),
        ({"top_k": 0}, "top_k"),
        ({"min_probability": 1.1}, "min_probability"),
        ({"pairs": [{"subject": "bed", "object": "sofa"}]}, "pairs/0/object"),
        ({"stamp": {"sec": 1, "nanosec": -1}}, "stamp/nanosec"),
        ({"viewpoint": {"x": 0, "y": 0}}, "viewpoint/yaw"),
        ({"unknown_labels": "maybe"}, "unknown_labels"),
        ({"profile": "home"}, "profile", "does not have", "homes", "shops"),
    ],
    "missing": [
        ({"top_k": 17}, "top_k"),
        *(({"coverage": value}, "coverage") for value in (-0.1, 1.5, "0.5", True)),
        ({"detail": "all"}, "detail", "must be `scores` or `full`"),
        # This model has no profiles.
        ({"model": "plain", "profile": "homes"}, "profile", "does not have"),
        ({"top_k": 2.0}, "top_k", "a whole number, not a decimal number"),
        ({"topk": 3}, "topk", "unknown field", "top_k"),
        ({"x": 1.0}, "x", "unknown field"),  # a field of another part is no suggestion
        ({"at": {"relation": "in front of", "object": "bed"}}, "at/relation", "must", "front"),
        ({"at": ["ontop", "bed"]}, "at/0", "must be", "on-top"),
        ({"at": ["on-top", "desk"]}, "at/1", "no entry of `objects`"),
        ({"objects": ["bed", "qqq"], "unknown_labels": "ignore", "at": ["on-top", "qqq"]}, "at/1",
         "ignored this object"),
        ({"objects": ["bed", "floor"], "at": ["on-top", "floor"]}, "at/1"),
        ({"object": ["bed"]}, "object", "unknown field", "objects"),
        ({"objects": "bed"}, "objects", "a JSON array, not a string"),
        ({"objects": [["bed"]]}, "objects/0", "JSON object with the field `label`, not an arr"),
        ({"objects": [{"name": "bed"}]}, "objects/0/name", "`label`, `confidence`"),
        ({"objects": [BED | {"labl": 1}]}, "objects/0/labl", "unknown field", "label"),
        ({"objects": [BED | {"position": [1, 2]}]}, "objects/0/position", "`y` and `z` or an array "
         "of these 3 values, not an array of 2"),
        ({"objects": [BED | {"confidence": 92}]}, "objects/0/confidence", "at most 1"),
        ({"relations": [ON_TOP]}, "relations/0/relation", "`on-top`, `under`", "on-top"),
        ({"relations": [["lamp", "on top", "bed"]]}, "relations/0/1", "must be", "on-top"),
        ({"relations": [["lamp", "left"]]}, "relations/0", "or an array of these 3 values"),
        ({"relations": [["lamp", "left", "sofa"]]}, "relations/0/2", "no entry of `objects`"),
    ],
    "outliers": [
        ({"sensitivity": "utmost"}, "sensitivity"),
        ({"detail": "all"}, "detail", "must be `scores` or `full`"),
    ],
    "rooms": [
        ({"top_k": 0}, "top_k"),
        ({"detail": "all"}, "detail", "must be `scores` or `full`"),
    ],
    "generate": [
        ({"count": 0}, "count"),
        ({"count": 65}, "count"),
        ({"temperature": 0}, "temperature"),
        ({"seed": 2**63}, "seed"),
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("question", "case"),
    [(question, case) for question, cases in INVALID.items() for case in cases],
    ids=lambda value: value if isinstance(value, str) else value[1],
)
async def test_invalid_values(client: AsyncClient, question: str, case: tuple[Any, ...]) -> None:
    changes, pointer, words, *suggestions = case if case[2:] else (*case, "")
    # Infinity is not JSON. A number that is too large for a double is JSON.
    body = json.dumps({"objects": ["bed", "lamp"]} | changes).replace("Infinity", "1e999")
    documents = [("#", problem(await post(client, body, f"/{question}"), 422, "invalid-request"))]
    if question != "generate":
        batch = await post(client, f'{{"scenes": [{body}]}}', f"/{question}/batch")
        documents.append(("#/scenes/0", batch.json()["results"][0]["problem"]))
    for root, document in documents:
        (error,) = [e for e in document["errors"] if e["pointer"] == f"{root}/{pointer}"][:1]
        assert error["message"]
        assert words in error["message"]
        assert not words or error.get("suggestions", []) == suggestions


@pytest.mark.parametrize(("body", "pointer"), [("[]", "#"), ("{}", "#/objects")])
async def test_a_body_has_objects(client: AsyncClient, body: str, pointer: str) -> None:
    assert pointers(await post(client, body)) == [pointer]
    problem(await post(client, b"[1]".ljust(2**18 + 1), "/missing/batch"), 400, "not-json")


@pytest.mark.parametrize("question", NAMES)
async def test_validation_stops_at_the_first_relation(client: AsyncClient, question: str) -> None:
    unknown = {f"u{k}": 0 for k in range(29)}
    body = {"objects": ["bed", "lamp"], "relations": [LEFT, LEFT | unknown] * 64}
    # The errors are those of the first relation that does not fit.
    response = await client.post(f"/{question}", json=body)
    assert pointers(response) == [f"#/relations/1/{name}" for name in unknown]
    body = {"objects": [{"label": "bed"} | unknown | {f"v{k}": 0 for k in range(3)}]}
    response = await client.post(f"/{question}", json=body)
    assert pointers(response) == ["#"]
    assert "32 members" in response.json()["detail"]


@pytest.mark.parametrize("question", NAMES)
async def test_contradictions_are_refused(client: AsyncClient, question: str) -> None:
    for second in (("bed", "right", "lamp"), ("lamp", "left", "bed"), ("bed", "front", "bed")):
        body = {"objects": ["bed", "lamp"], "relations": [("bed", "left", "lamp"), second]}
        response = await client.post(f"/{question}", json=body)
        assert pointers(response, "contradictory-evidence") == ["#/relations/1"]
    circle = [("bed", "on-top", "lamp"), ("lamp", "inside", "desk"), ("desk", "on-top", "bed")]
    body = {"objects": ["bed", "lamp", "desk"], "relations": circle}
    response = await client.post(f"/{question}", json=body)
    (error,) = problem(response, 422, "contradictory-evidence")["errors"]
    assert error["pointer"] == "#/relations"
    names = error["message"].partition(": ")[2].split(" on or in ")
    assert {*pairwise(names)} == {("bed", "lamp"), ("lamp", "desk"), ("desk", "bed")}


@pytest.mark.parametrize("question", NAMES)
async def test_unknown_labels_have_suggestions(client: AsyncClient, question: str) -> None:
    body: Any = {"objects": ["nigthstand", "bed", {"label": MARKER}], "room_type": "bedrom"}
    if question == "missing":
        body["candidates"] = ["sofa", "sofe"]
    document = problem(await client.post(f"/{question}", json=body), 422, "unknown-labels")
    errors = {error["pointer"]: error["suggestions"] for error in document["errors"]}
    assert errors["#/objects/0"][0] == "nightstand"
    assert errors["#/objects/2/label"] == []
    assert errors["#/room_type"] == ["bedroom"]
    known = [error["message"] for error in document["errors"] if "room" in error["pointer"]]
    assert "bathroom, bedroom, office" in known[0]


async def test_numbers_that_are_not_json_are_pointed_at(client: AsyncClient) -> None:
    place = '{"x": %s, "y": %s, "z": 0}'
    things = [f'{{"label": "bed", "position": {place % pair}}}' for pair in
              (("0", "1"), ("NaN", "0"), ("-Infinity", "Infinity"))]  # fmt: skip
    body = f'{{"objects": [{", ".join(things)}], "top_k": %s}}'
    document = problem(await post(client, body % 3, "/missing"), 400, "not-json")
    assert [(error["pointer"], error["message"]) for error in document["errors"]] == [
        ("#/objects/1/position/x", "must be a finite number, not NaN"),
        ("#/objects/2/position/x", "must be a finite number, not -Infinity"),
        ("#/objects/2/position/y", "must be a finite number, not Infinity"),
    ]
    # With a second mistake, the text cannot be read, and the first mistake has a line and a column.
    document = problem(await post(client, body % "True", "/missing"), 400, "not-json")
    assert "line 1 column" in document["detail"]
    many = '{"objects": [' + ", ".join(["NaN"] * 1000) + "]}"
    document = problem(await post(client, many), 400, "not-json")
    assert len(document["errors"]) == 32


@pytest.mark.parametrize(
    "key", ["<script>" + MARKER, MARKER + " x", MARKER * 20, MARKER + "\u202e"]
)
async def test_pointers_leave_out_unusual_field_names(client: AsyncClient, key: str) -> None:
    assert pointers(await client.post("/relations", json={"objects": ["bed"], key: 1})) == ["#"]


@pytest.mark.parametrize("model", ["nobody", "home@9.9.9", "home@", "@", "../x", "home@1", "hoome"])
async def test_unknown_models_are_not_found(client: AsyncClient, model: str) -> None:
    body = {"objects": ["bed"], "model": model}
    document = problem(await client.post("/missing", json=body), 404, "model-not-found")
    named = "1.0.0, 1.1.0" if model.startswith("home@") else "Models: general, home, plain."
    assert named in document["detail"]
    assert ("Similar names: home." in document["detail"]) == (model == "hoome")


@pytest.mark.parametrize(
    "path",
    [
        *(f"/{MARKER}", "/relations/", "/relations/batch/", "/relations/x", "/models/", "/v3"),
        *("/static/nothing.js", "/static/../settings.py", "/static/%2e%2e/settings.py"),
        *("/docs/nothing", "/redoc/%00", "/problems/nothing", "/%F0%9F%98%80", "/%ff%fe"),
    ],
)
async def test_unknown_routes_are_not_found(client: AsyncClient, path: str) -> None:
    problem(await client.get(path), 404, "not-found")


async def test_misspelt_ids_are_answered_with_similar_ids(client: AsyncClient) -> None:
    things = [{"id": "bed_7", "label": "bed"}, {"id": f"<{MARKER}>", "label": "lamp"}]
    body = {"objects": things, "at": {"relation": "on-top", "object": "bed7"}}
    (fault,) = problem(await client.post("/missing", json=body), 422, "invalid-request")["errors"]
    assert (fault["pointer"], fault["suggestions"]) == ("#/at/object", ["bed_7"])
    # Only plain ids are repeated.
    body["at"]["object"] = f"{MARKER}>"
    (fault,) = problem(await client.post("/missing", json=body), 422, "invalid-request")["errors"]
    assert not fault.get("suggestions")
    # Only the first errors have similar ids.
    things = [{"id": f"{n}_{'ab' * 30}", "label": "bed"} for n in range(256)]
    ends = [f"{n}-{'ba' * 30}" for n in range(60)]
    body = {"objects": things, "pairs": [[end, "bed"] for end in ends]}
    errors = problem(await client.post("/relations", json=body), 422, "invalid-request")["errors"]
    assert sum(bool(fault.get("suggestions")) for fault in errors) <= 32


async def test_query_parameters_and_misspelt_paths_are_refused(client: AsyncClient) -> None:
    response = await client.post("/missing?model=home", json={"objects": ["bed"]})
    assert "JSON body" in problem(response, 400, "bad-request")["detail"]
    for path in ("/mising", "/Missing", "/missing/", "/api/missing"):
        document = problem(await client.post(path, json={"objects": ["bed"]}), 404, "not-found")
        assert "/missing, /missing/batch" in document["detail"]
    document = problem(await client.get("/health"), 404, "not-found")
    assert "/health/ready" in document["detail"]


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [
        ("GET", "/relations", {"POST"}),
        ("DELETE", "/missing", {"POST"}),
        ("POST", "/models", {"GET"}),
        ("POST", "/health/ready", {"GET"}),
        ("PATCH", "/models/default", {"GET"}),
        ("BREW", "/generate", {"POST"}),
    ],
)
async def test_methods(client: AsyncClient, method: str, path: str, allowed: set[str]) -> None:
    response = await client.request(method, path)
    document = problem(response, 405, "method-not-allowed")
    assert response.headers["allow"] in document["detail"]
    assert set(response.headers["allow"].split(", ")) == allowed


@pytest.mark.parametrize(
    ("given", "is_kept"),
    [
        *((given, True) for given in ("abc", "A-1_2.3~4:5", "x" * 128, str(uuid.UUID(int=7)))),
        *((given, False) for given in ("", "x" * 129, "a b", "<script>", "é".encode(), b"a\xff")),
    ],
)
async def test_valid_request_ids_are_kept(client: AsyncClient, given: Any, is_kept: bool) -> None:
    for path in ("/relations", "/nowhere"):
        headers = [(b"X-Request-Id", given)]
        response = await client.post(path, json={"objects": ["bed"]}, headers=headers)
        answered = response.headers["x-request-id"]
        assert response.json()["request_id"] == answered
        assert answered == given if is_kept else uuid.UUID(answered).version == 4


@pytest.mark.parametrize("question", NAMES)
async def test_a_defect_is_a_problem_without_details(client, replace, caplog, question):
    replace(question, defect)
    response = await client.post(f"/{question}", json={"objects": ["bed"]})
    document = problem(response, 500, "internal-error")
    assert "secret" not in response.text
    # The log has the error under the same id.
    (record,) = [record for record in caplog.records if record.name == "app.api"]
    assert record.exc_info is not None
    assert record.entry["request_id"] == document["request_id"]


async def test_every_problem_type_has_a_page(client: AsyncClient) -> None:
    index = (await client.get("/problems")).text
    for slug, kind in ERRORS.items():
        page = await client.get(f"/problems/{slug}")
        assert page.status_code == 200
        assert page.headers["content-type"].startswith("text/html")
        for text in (kind.title, f"status {kind.status}", kind.explanation):
            assert text
            assert escape(text) in page.text
        assert f'href="problems/{slug}"' in index
