"""Costly bodies are refused before the service parses or validates them."""

import json
import threading
from pathlib import Path
from typing import Any

import pytest
from httpx import AsyncClient
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from pydantic_core import from_json

from app.api.body import parse
from app.questions.reading import read_scene
from scene_client.schemas import MissingRequest
from tests.http.test_problems import problem
from tests.services import serve

JSON = {"Content-Type": "application/json"}


@pytest.mark.parametrize(
    ("path", "field", "entry", "most"),
    [
        ("missing", "objects", {}, 256),
        ("missing", "candidates", 7, 4096),
        ("relations", "pairs", [], 4096),
        ("outliers", "relations", 7, 65536),
        ("outliers/batch", "scenes", {}, 256),
    ],
)
async def test_entries_are_counted_before_validation(client, path, field, entry, most):
    # pydantic would report the unknown field.
    body = {"objects": ["bed"], "unknown": 1, field: [entry] * (most + 1)}
    document = problem(await client.post(f"/{path}", json=body), 422, "invalid-request")
    errors = [(error["pointer"], error["message"]) for error in document["errors"]]
    assert errors == [(f"#/{field}", f"must have at most {most} entries")]


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
