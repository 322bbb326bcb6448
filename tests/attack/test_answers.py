"""Small requests for huge answers: refused by name before the answer is built."""

from __future__ import annotations

import string
from collections import Counter
from collections.abc import Awaitable, Callable
from itertools import cycle, islice
from random import Random
from typing import Any

import httpx
import pytest

from app.questions import names
from app.scene.vocabulary import Vocabulary
from scene_client.schemas import MAX_BATCH
from scene_client.validation import MAX_ERRORS
from tests.http.stores import VOCABULARY
from tests.http.test_problems import problem
from tests.services import client_of_service

LABELS = [entry.label for entry in VOCABULARY.objects if not entry.structure]
LIMIT = 4 * 2**20
SMALL = 2**16


limited = client_of_service(max_answer_bytes=SMALL)


def scene(objects: int, letter: str = "x", **parameters: Any) -> dict[str, Any]:
    """A scene whose ids have 128 characters."""
    ids = [f"{number}".rjust(128, letter) for number in range(objects)]
    things = [
        {"id": name, "label": label}
        for name, label in zip(ids, islice(cycle(LABELS), objects), strict=True)
    ]
    return {"objects": things, **parameters}


LARGEST = {"top_k": 4096, "include_opposites": True}
BATCH = {"scenes": [scene(23, **LARGEST)] * MAX_BATCH}


async def test_the_answer_to_a_batch_has_a_limit(client: httpx.AsyncClient) -> None:
    """It had 319 MB."""
    answer = await client.post("/relations/batch", json=BATCH)
    assert answer.status_code == 200
    assert len(answer.content) <= LIMIT
    results = answer.json()["results"]
    assert [entry["status"] for entry in results[:2]] == [200] * 2
    assert {entry["status"] for entry in results[4:]} == {422}
    last = results[-1]["problem"]
    assert last["type"] == "/problems/answer-too-large"
    assert last["errors"][0]["pointer"] == f"#/scenes/{MAX_BATCH - 1}/top_k"
    assert "Lower `top_k`" in last["errors"][0]["message"]


def crowd(objects: int, letter: str = "😀") -> dict[str, Any]:
    """Objects that all stand beside each other."""
    found = scene(objects, letter)
    for place, thing in enumerate(found["objects"]):
        thing["position"] = {"x": place % 16 * 0.02, "y": place // 16 * 0.02, "z": 0.0}
        thing["size"] = {"x": 0.5, "y": 0.5, "z": 0.01}
    return found


@pytest.mark.parametrize(
    ("question", "letter", "options", "parameter"),
    [
        ("relations", "😀", LARGEST, "top_k"),
        ("missing", "😀", {}, "top_k"),
        ("outliers", "😀", {}, "objects"),
        ("outliers", "x", {"frame_id": "f" * 256}, "objects"),
    ],
)
async def test_single_answers_have_the_same_limit(
    limited: httpx.AsyncClient,
    question: str,
    letter: str,
    options: dict[str, Any],
    parameter: str,
) -> None:
    """Whatever it is made of: the largest scene that is answered has an answer within the limit."""

    async def ask(objects: int) -> httpx.Response:
        return await limited.post(f"/{question}", json=crowd(objects, letter) | options)

    await check_the_largest(ask, 128, parameter)


async def test_drawn_scenes_have_the_same_limit(limited: httpx.AsyncClient) -> None:
    async def ask(count: int) -> httpx.Response:
        body = {"objects": LABELS[:8], "count": count, "steps": 2, "seed": 0}
        return await limited.post("/generate", json=body)

    await check_the_largest(ask, 64, "count")


async def check_the_largest(
    ask: Callable[[int], Awaitable[httpx.Response]], refused: int, parameter: str
) -> None:
    """Of a size that is answered has an answer within the limit, and not far below it."""
    document = problem(await ask(refused), 422, "answer-too-large")
    assert document["errors"][0]["pointer"] == f"#/{parameter}"
    answered, largest = 1, await ask(1)
    while refused - answered > 1:
        middle = (answered + refused) // 2
        answer = await ask(middle)
        if answer.is_success:
            answered, largest = middle, answer
        else:
            problem(answer, 422, "answer-too-large")
            assert len(answer.content) < 2**12
            refused = middle
    assert largest.is_success
    assert SMALL / 8 < len(largest.content) <= SMALL


# ----------------------------------------------------------------------------------- unknown labels


# Labels of one request that are looked up: to suggest some like them, and to take them for others.
MAX_SUGGESTED, MAX_MAPPED = 32, 256


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """The number of calls of each search."""
    found: Counter[str] = Counter()

    def count(owner: Any, name: str) -> None:
        original = getattr(owner, name)

        def counted(*values: Any, **named: Any) -> Any:
            found[name] += 1
            return original(*values, **named)

        monkeypatch.setattr(owner, name, counted)

    for name in ("index", "read", "guess", "nearest"):
        count(Vocabulary, name)
    count(names, "spelt_alike")
    return found


def words(count: int, length: int) -> list[str]:
    rng = Random(0)
    return ["".join(rng.choices(string.ascii_lowercase, k=length)) for _ in range(count)]


def suggestions(answer: httpx.Response) -> int:
    problems = [entry["problem"] for entry in answer.json()["results"] if "problem" in entry]
    errors = [error for problem in problems for error in problem["errors"]]
    return sum("suggestions" in error and bool(error["suggestions"]) for error in errors)


async def test_a_batch_has_few_suggestions(client: httpx.AsyncClient) -> None:
    misspelt = [f"lammp{letter}" for letter in string.ascii_lowercase]
    batch = {"scenes": [{"objects": misspelt}] * 64}
    assert suggestions(await client.post("/missing/batch", json=batch)) == MAX_SUGGESTED
    # The next request has its own.
    assert suggestions(await client.post("/missing/batch", json={"scenes": [batch["scenes"][0]]}))


@pytest.mark.parametrize(
    ("treatment", "guesses"),
    [("error", 0), ("nearest", MAX_MAPPED), ("nearest-or-ignore", MAX_MAPPED)],
)
async def test_a_batch_looks_few_labels_up(
    client: httpx.AsyncClient, calls: Counter[str], treatment: str, guesses: int
) -> None:
    labels = iter(words(64 * 20, 12))
    scenes = [
        {"objects": ["bed", *(next(labels) for _ in range(20))], "unknown_labels": treatment}
        for _ in range(64)
    ]
    answer = await client.post("/missing/batch", json={"scenes": scenes})
    ignores = treatment == "nearest-or-ignore"
    assert {entry["status"] for entry in answer.json()["results"]} == {200 if ignores else 422}
    assert calls["guess"] == guesses
    assert calls["nearest"] == (0 if ignores else MAX_SUGGESTED)


async def test_relations_of_unknown_objects_cost_little(
    client: httpx.AsyncClient, calls: Counter[str]
) -> None:
    """4,096 relations named 8,192 unknown objects: 74 ms, or 2 s with names of U+FDFA."""
    names = ["\ufdfa" * 3 + str(number) for number in range(8_192)]
    relations = [[names[2 * k], "left", names[2 * k + 1]] for k in range(4_096)]
    answer = await client.post("/missing", json={"objects": ["bed"], "relations": relations})
    assert answer.status_code == 422
    assert MAX_ERRORS <= len(answer.json()["errors"]) <= MAX_ERRORS + 1
    assert calls["index"] <= 1 + len(answer.json()["errors"])
    assert calls["spelt_alike"] <= MAX_SUGGESTED


async def test_a_scene_of_unknown_labels_stops_early(
    client: httpx.AsyncClient, calls: Counter[str]
) -> None:
    objects = [f"a/{'b/' * 40}{number}" for number in range(256)]
    answer = await client.post("/missing", json={"objects": objects})
    assert len(answer.json()["errors"]) == MAX_ERRORS
    assert calls["read"] == MAX_ERRORS
