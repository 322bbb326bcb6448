"""Unknown labels, long and many: few are looked up, and each look-up is cheap."""

from __future__ import annotations

import string
from random import Random
from time import process_time
from typing import Any

import httpx
import pytest

from app.scene.nearest import LONGEST
from app.scene.vocabulary import Vocabulary
from tests.http.stores import VOCABULARY

pytestmark = pytest.mark.anyio

# Labels of one request that are looked up: to suggest some like them, and to take them for others.
MAX_SUGGESTED, MAX_MAPPED = 32, 256


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


@pytest.mark.parametrize(("treatment", "most"), [("error", MAX_SUGGESTED), ("nearest", MAX_MAPPED)])
async def test_a_batch_looks_few_labels_up(
    client: httpx.AsyncClient, monkeypatch: pytest.MonkeyPatch, treatment: str, most: int
) -> None:
    looked_up: list[str] = []
    original = Vocabulary.nearest

    def nearest(self: Vocabulary, label: str, limit: int = 3) -> Any:
        looked_up.append(label)
        return original(self, label, limit)

    monkeypatch.setattr(Vocabulary, "nearest", nearest)
    labels = iter(words(64 * 20, 12))
    scenes = [
        {"objects": [next(labels) for _ in range(20)], "unknown_labels": treatment}
        for _ in range(64)
    ]
    answer = await client.post("/missing/batch", json={"scenes": scenes})
    assert {entry["status"] for entry in answer.json()["results"]} == {422}
    assert len(looked_up) == most


async def test_a_label_that_many_scenes_share_is_mapped_in_all(client: httpx.AsyncClient) -> None:
    scene = {"objects": ["bed", "nigthstand"], "unknown_labels": "nearest"}
    answer = await client.post("/missing/batch", json={"scenes": [scene] * 256})
    mapped = [entry["result"]["mapped"][0]["class"] for entry in answer.json()["results"]]
    assert mapped == ["nightstand"] * 256


@pytest.mark.parametrize("letter", ["x", "é", "\ufdfa"])
async def test_long_labels_cost_little(client: httpx.AsyncClient, letter: str) -> None:
    """One batch of 38 kB cost 1.8 s."""
    labels = [letter * 90 + f"{number:05}" for number in range(400)]
    scenes = [{"objects": labels[start : start + 10]} for start in range(0, 400, 10)]
    await client.post("/missing/batch", json={"scenes": scenes[:1]})
    began = process_time()
    answer = await client.post("/missing/batch", json={"scenes": scenes})
    assert process_time() - began < 0.4
    assert {entry["status"] for entry in answer.json()["results"]} == {422}


def test_spellings_of_ordinary_length_are_compared_and_longer_ones_are_not() -> None:
    known = "a" * (LONGEST - 1)
    vocabulary = Vocabulary([*VOCABULARY.objects, type(VOCABULARY.objects[0])(known)])
    assert vocabulary.suggest(known + "b") == (known,)
    assert vocabulary.suggest(known + "bc") == ()
    # Words are compared whatever the length: they cost little.
    assert vocabulary.suggest("very " * 15 + "special lamp") == ("lamp",)


def test_the_vocabulary_compares_a_long_name_quickly() -> None:
    """A character that folds to 18 made the name 1,800 characters long."""
    names = Vocabulary([type(VOCABULARY.objects[0])(word) for word in words(3_000, 12)])
    names.nearest("warm up")
    began = process_time()
    for number in range(20):
        names.nearest("\ufdfa" * 95 + str(number))
    assert process_time() - began < 0.1
