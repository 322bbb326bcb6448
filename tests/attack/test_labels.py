"""Unknown labels, long and many: few are looked up, and each look-up is cheap."""

from __future__ import annotations

import string
from collections import Counter
from random import Random
from typing import Any

import httpx
import pytest

from app.questions import names
from app.scene.labels import readings
from app.scene.vocabulary import Vocabulary
from scene_client.validation import MAX_ERRORS

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


def test_a_label_has_few_readings() -> None:
    worst = ["a/" * 50, "the a_1/" * 12, "x_(" * 33, "a photo of " * 9, "a 1 " * 25, "1|" * 50]
    assert max(len(list(readings(label))) for label in worst) <= 100
