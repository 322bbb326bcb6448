"""Small requests for large answers are refused before the answer is built."""

import string
from collections import Counter
from itertools import cycle, islice
from pathlib import Path
from random import Random
from typing import Any

import pytest
from httpx import AsyncClient, Response

from app.questions import names
from app.scene.vocabulary import Vocabulary
from scene_client.schemas import MAX_BATCH
from scene_client.validation import MAX_ERRORS
from tests.http.stores import VOCABULARY
from tests.http.test_monitoring import samples
from tests.http.test_problems import problem
from tests.services import Replace, client_of_service, serve

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
