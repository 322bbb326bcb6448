"""Costly bodies are refused before they are parsed, and large answers before they are built."""

import json
import string
import threading
from collections import Counter
from itertools import cycle, islice
from pathlib import Path
from random import Random
from typing import Any

import pytest
from httpx import AsyncClient, Response
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from pydantic_core import from_json

from app.api.body import parse
from app.questions import names
from app.questions.reading import read_scene
from app.scene.vocabulary import Vocabulary
from scene_client.schemas import MAX_BATCH, MissingRequest
from scene_client.validation import MAX_ERRORS
from tests.http.stores import VOCABULARY
from tests.http.test_monitoring import samples
from tests.http.test_problems import problem
from tests.services import Replace, client_of_service, serve

JSON = {"Content-Type": "application/json"}
LEFT = ["bed", "left", "lamp"]


@pytest.mark.parametrize(
    ("path", "field", "entry", "most"),
    [
        ("missing", "objects", {}, 256),
        ("missing", "candidates", 7, 4096),
        ("relations", "pairs", [], 4096),
        ("outliers", "relations", 7, 4096),
        ("outliers/batch", "scenes", {}, 256),
        ("where", "rooms", {}, 32),
        ("where", "searched", 7, 1024),
        ("where/batch", "scenes", {}, 256),
    ],
)
async def test_entries_are_counted_before_validation(client, path, field, entry, most):
    # pydantic would report the unknown field.
    body = {"objects": ["bed"], "unknown": 1, field: [entry] * (most + 1)}
    document = problem(await client.post(f"/{path}", json=body), 422, "invalid-request")
    errors = [(error["pointer"], error["message"]) for error in document["errors"]]
    assert errors == [(f"#/{field}", f"must have at most {most} entries")]


async def test_relations_are_counted_before_validation(shared_store, monkeypatch):
    """The setting decides, in batches too: the limit of the schema would take 0.1 s."""
    validations = list[Any]()
    validate = MissingRequest.model_validate
    monkeypatch.setattr(
        MissingRequest, "model_validate", lambda value: validations.append(value) or validate(value)
    )
    few, many = ({"objects": ["bed", "lamp"], "relations": [LEFT] * most} for most in (2, 3))
    async with serve(shared_store, max_relations=2) as client:
        answer = await client.post("/missing/batch", json={"scenes": [few, many]})
        problem(await client.post("/missing", json=many), 422, "invalid-request")
    answered, refused = answer.json()["results"]
    assert (answered["status"], validations) == (200, [few])
    (error,) = refused["problem"]["errors"]
    assert error["pointer"] == "#/scenes/1/relations"
    assert error["message"] == "must have at most 2 entries"


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    lengths = list[int]()

    def counted(text: str | bytes, **options: Any) -> Any:
        lengths.append(len(text))
        return from_json(text, **options)

    monkeypatch.setattr("app.api.body.from_json", counted)
    return lengths


def batch(entry: bytes, size: int = 2**21) -> bytes:
    return b'{"scenes":[' + b",".join([entry] * (size // (len(entry) + 1) - 12)) + b"]}"


@pytest.mark.parametrize("entry", [b"[]", b"{}", b"[" * 99 + b"]" * 99])
async def test_containers_are_counted_before_parsing(client, parsed, entry):
    dense = b'{"scenes":[{"objects":["bed"],"candidates":[%b]}]}' % b",".join([entry] * 2**17)
    for body in (batch(entry), dense[: 2**21]):
        response = await client.post("/missing/batch", content=body, headers=JSON)
        assert "arrays and objects" in problem(response, 422, "invalid-request")["detail"]
    assert parsed == []


@pytest.mark.parametrize("entry", [b"1", b'""', b"9" * 4000])
async def test_a_large_batch_is_parsed_scene_by_scene(client, parsed, entry):
    response = await client.post("/missing/batch", content=batch(entry), headers=JSON)
    document = problem(response, 422, "invalid-request")
    assert document["errors"][0]["message"] == "must have at most 256 entries"
    assert len(parsed) == 257
    parsed.clear()
    scene = b'{"objects":["bed"]%b}'
    scenes = [scene % b""] * 199 + [scene % (b" " * 250_000)] * 5
    body = b' {"scenes": [ %b ] } ' % b" , ".join(scenes)
    response = await client.post("/missing/batch", content=body, headers=JSON)
    assert [entry["status"] for entry in response.json()["results"]] == [200] * 204
    assert max(parsed) < 2**18
    parsed.clear()
    body = b'{"scenes":[%b,%b]}' % (scene % b"", scene % (b" " * 2**18))
    problem(await client.post("/missing/batch", content=body, headers=JSON), 400, "not-json")
    assert parsed == [len(b'"scenes"'), len(scene % b"")]


SHORT = st.text(max_size=9)


@given(
    st.dictionaries(SHORT, st.lists(SHORT) | SHORT | st.dictionaries(SHORT, st.none(), max_size=1)),
    st.sampled_from([None, 0, "\t"]),
)
def test_a_body_in_pieces_is_the_same_body(value: dict[str, Any], indent: Any) -> None:
    body = json.dumps(value, indent=indent).encode()
    assert parse(body, 120) == json.loads(body)


async def test_the_body_of_one_scene_has_a_limit_of_its_own(client: AsyncClient) -> None:
    scene = b'{"objects":["bed"]}'
    response = await client.post("/missing", content=scene.ljust(2**18), headers=JSON)
    assert response.status_code == 200
    response = await client.post("/missing", content=scene.ljust(2**18 + 1), headers=JSON)
    problem(response, 413, "body-too-large")
    batch = b'{"scenes":[%b]}' % scene
    response = await client.post("/missing/batch", content=batch.ljust(2**21), headers=JSON)
    assert response.status_code == 200


UNKNOWN = {f"u{k}": 0 for k in range(30)}
RELATIONS = [["a", "left", "b"]] * 4096
AT = {"x": 1, "y": 0, "z": 0}


@pytest.mark.parametrize(
    ("body", "first", "last"),
    [
        ({"objects": ["bed", 7, *[{"label": "bed"} | UNKNOWN] * 200]}, "objects/1", "objects/3/u0"),
        ({"objects": ["bed"], "relations": RELATIONS}, "relations/0/0", "relations/15/2"),
    ],
)
async def test_a_request_has_at_most_32_errors(client, body, first, last):
    document = problem(await client.post("/missing", json=body), 422, "invalid-request")
    pointers = [error["pointer"] for error in document["errors"]]
    assert (len(pointers), pointers[0], pointers[-1]) == (32, f"#/{first}", f"#/{last}")
    assert "at least 32 errors" in document["detail"]
    with pytest.raises(ValidationError) as raised:
        MissingRequest.model_validate({"objects": [{"label": "bed"} | UNKNOWN] * 200})
    assert raised.value.error_count() == len(UNKNOWN)


@pytest.mark.parametrize(
    ("scene", "is_large"),
    [
        ({"objects": ["bed"] * 3}, False),
        ({"objects": [{"label": "bed", "position": AT}] * 33}, True),
        ({"objects": ["bed", "lamp"], "relations": [["bed", "left", "lamp"]] * 257}, True),
    ],
)
@pytest.mark.parametrize("question", ["outliers", "generate"])
async def test_large_scenes_leave_the_event_loop(
    shared_store, monkeypatch, question, scene, is_large
):
    threads = []

    def read(*args: Any, **options: Any) -> Any:
        threads.append(threading.current_thread())
        return read_scene(*args, **options)

    async with serve(shared_store) as client:
        monkeypatch.setattr("app.api.questions.read_scene", read)
        assert (await client.post(f"/{question}", json=scene)).status_code == 200
    assert (threads[0] is not threading.main_thread()) == is_large


async def test_one_body_may_exceed_the_share(shared_store: Path) -> None:
    # A quarter of this budget is less than the batch.
    batch = b'{"scenes":[{"objects":["bed"]}]}'.ljust(2**19)
    async with serve(shared_store, held_body_bytes=2**20) as client:
        answer = await client.post("/missing/batch", content=batch, headers=JSON)
    assert answer.status_code == 200


LABELS = [entry.label for entry in VOCABULARY.objects if not entry.structure]
LIMIT = 4 * 2**20
SMALL = 2**16

limited = client_of_service(max_answer_bytes=SMALL)


def scene(objects: int, letter: str = "x", **parameters: Any) -> dict[str, Any]:
    """A scene whose ids have 128 characters."""
    ids = [f"{number}".rjust(128, letter) for number in range(objects)]
    labelled = zip(ids, islice(cycle(LABELS), objects), strict=True)
    things = [{"id": name, "label": label} for name, label in labelled]
    return {"objects": things, **parameters}


LARGEST = {"top_k": 4096, "include_opposites": True}
BATCH = {"scenes": [scene(23, **LARGEST)] * MAX_BATCH}


async def test_the_answer_to_a_batch_has_a_limit(shared_store: Path, replace: Replace) -> None:
    """The batch stops at the first answer that is too large."""
    computed = 0

    def counted(relations: Any, *args: Any, **options: Any) -> Any:
        nonlocal computed
        computed += 1
        return relations(*args, **options)

    async with serve(shared_store) as client:
        replace("relations", counted)
        headers = {"X-Request-Timeout-Ms": "60000"}
        answer = await client.post("/relations/batch", json=BATCH, headers=headers)
        found = await samples(client)
    assert answer.status_code == 200
    assert len(answer.content) <= LIMIT
    results = answer.json()["results"]
    statuses = [entry["status"] for entry in results]
    assert statuses == [200] * (computed - 1) + [422] * (MAX_BATCH + 1 - computed)
    assert len(answer.content) > LIMIT / 2
    # The metrics of the model count only the answers that were sent.
    sent = sum(value for key, value in found.items() if key[0] == "scene_objects_total")
    assert sent == 23 * (computed - 1)
    first, second = (one["problem"]["errors"][0] for one in results[computed - 1 : computed + 1])
    assert first["pointer"] == f"#/scenes/{computed - 1}/top_k"
    assert "Lower `top_k`" in first["message"]
    assert second["pointer"] == f"#/scenes/{computed}"
    assert "another request" in second["message"]
    types = {one["problem"]["type"] for one in results[computed - 1 :]}
    assert types == {"/problems/answer-too-large"}


def crowd(objects: int, letter: str = "😀") -> dict[str, Any]:
    found = scene(objects, letter)
    for place, thing in enumerate(found["objects"]):
        thing["position"] = {"x": place % 16 * 0.02, "y": place // 16 * 0.02, "z": 0.0}
        thing["size"] = {"x": 0.5, "y": 0.5, "z": 0.01}
    return found


DRAWN = {"objects": LABELS[:8], "steps": 2, "seed": 0}


@pytest.mark.parametrize(
    ("question", "bodies", "parameter"),
    [
        ("relations", [crowd(size) | LARGEST for size in (2, 16)], "top_k"),
        ("missing", [crowd(size) for size in (2, 64)], "top_k"),
        ("outliers", [crowd(size) for size in (2, 64)], "objects"),
        ("generate", [DRAWN | {"count": count} for count in (1, 64)], "count"),
    ],
)
async def test_single_answers_have_a_limit(client, limited, question, bodies, parameter):
    small, large = [(await client.post(f"/{question}", json=body)).content for body in bodies]
    assert len(small) <= SMALL < len(large)
    assert len((await limited.post(f"/{question}", json=bodies[0])).content) == len(small)
    answer = await limited.post(f"/{question}", json=bodies[1])
    (error,) = problem(answer, 422, "answer-too-large")["errors"]
    assert error["pointer"] == f"#/{parameter}"
    assert f"more than {SMALL} bytes" in error["message"]


# Labels of one request that are looked up: to suggest some like them, and to take them for others.
MAX_SUGGESTED, MAX_MAPPED = 32, 256


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    found: Counter[str] = Counter()

    def count(owner: Any, name: str) -> None:
        original = getattr(owner, name)

        def counted(*values: Any, **named: Any) -> Any:
            found[name] += 1
            return original(*values, **named)

        monkeypatch.setattr(owner, name, counted)

    for name in ("index", "read", "guess", "nearest", "meaning"):
        count(Vocabulary, name)
    count(names, "spelt_alike")
    return found


def suggestions(answer: Response) -> int:
    problems = [entry["problem"] for entry in answer.json()["results"] if "problem" in entry]
    errors = [error for problem in problems for error in problem["errors"]]
    return sum("suggestions" in error and bool(error["suggestions"]) for error in errors)


async def test_a_batch_has_few_suggestions(client: AsyncClient) -> None:
    misspelt = [f"lammp{letter}" for letter in string.ascii_lowercase]
    batch = {"scenes": [{"objects": misspelt}] * 64}
    assert suggestions(await client.post("/missing/batch", json=batch)) == MAX_SUGGESTED
    # The next request has its own.
    assert suggestions(await client.post("/missing/batch", json={"scenes": [batch["scenes"][0]]}))


@pytest.mark.parametrize("treatment", ["error", "nearest", "nearest-or-ignore", "by-meaning"])
async def test_batch_searches(client: AsyncClient, calls: Counter[str], treatment: str) -> None:
    rng = Random(0)
    labels = ("".join(rng.choices(string.ascii_lowercase, k=12)) for _ in range(64 * 20))
    listed = [["bed", *(next(labels) for _ in range(20))] for _ in range(64)]
    scenes = [{"objects": objects, "unknown_labels": treatment} for objects in listed]
    answer = await client.post("/missing/batch", json={"scenes": scenes})
    ignores = treatment in ("nearest-or-ignore", "by-meaning")
    assert {entry["status"] for entry in answer.json()["results"]} == {200 if ignores else 422}
    assert calls["guess"] == (0 if treatment == "error" else MAX_MAPPED)
    assert calls["meaning"] == (MAX_MAPPED if treatment == "by-meaning" else 0)
    assert calls["nearest"] == (0 if ignores else MAX_SUGGESTED)


async def test_unknown_ends_cost_little(client: AsyncClient, calls: Counter[str]) -> None:
    names = ["\ufdfa" * 3 + str(number) for number in range(8_192)]
    relations = [[names[2 * k], "left", names[2 * k + 1]] for k in range(4_096)]
    answer = await client.post("/missing", json={"objects": ["bed"], "relations": relations})
    assert answer.status_code == 422
    assert MAX_ERRORS <= len(answer.json()["errors"]) <= MAX_ERRORS + 1
    assert calls["index"] <= 1 + len(answer.json()["errors"])
    assert calls["spelt_alike"] <= MAX_SUGGESTED


@pytest.mark.parametrize(
    ("question", "field", "count"),
    [("missing", "objects", 256), ("missing", "candidates", 4096), ("rooms", "candidates", 4096)],
)
async def test_unknown_labels_stop_early(client, calls, question, field, count):
    name = "a/" + "b/" * (40 if field == "objects" else 3)
    body = {"objects": ["bed"]} | {field: [f"{name}{number}" for number in range(count)]}
    document = problem(await client.post(f"/{question}", json=body), 422, "unknown-labels")
    assert len(document["errors"]) == MAX_ERRORS
    assert calls["read"] <= MAX_ERRORS + 1
