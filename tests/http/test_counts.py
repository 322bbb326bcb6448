"""The list `more` of /missing: the listed classes with probably more instances."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from rich.console import Console

from app import questions
from app.registry import Counts, Store
from app.scene import Scene, SceneObject
from scene_client import tables
from scene_client.schemas import MissingAnswer
from tests.http.stores import VOCABULARY, C, V, publish
from tests.http.test_questions import ask
from tests.services import serve

LABELS = ("bed", "nightstand", "chair", "chair")
CHAIR, NIGHTSTAND = VOCABULARY.index("chair"), VOCABULARY.index("nightstand")


def counts() -> Counts:
    """Usually one nightstand, and four chairs."""
    share = np.array([[0.8, 0.1, 0.05, 0.05], [0.1, 0.1, 0.1, 0.7]])
    weights = np.zeros((2, 2, 3 + C + V), np.float32)
    most = np.array([3, 3])
    return Counts(np.array([NIGHTSTAND, CHAIR]), most, np.log(share).astype("f4"), weights)


@pytest.fixture(scope="module")
def own_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("store")
    publish(root, "counted", "1.0.0", alias="default", counts=counts())
    return root


@pytest.fixture(scope="module")
async def client(own_store: Path, anyio_backend: str) -> AsyncIterator[httpx.AsyncClient]:
    async with serve(own_store) as client:
        yield client


async def more(client: httpx.AsyncClient, **request: Any) -> list[dict[str, Any]]:
    answer = await ask(client, "missing", objects=LABELS, **request)
    return list(answer["more"])


async def test_the_answer_has_the_likely_classes(
    client: httpx.AsyncClient, own_store: Path
) -> None:
    answer = await more(client)
    artifact = Store(own_store).load("counted", "1.0.0")
    things = (SceneObject(str(k), label, VOCABULARY.index(label)) for k, label in enumerate(LABELS))
    assert answer == questions.missing(artifact, Scene(tuple(things)))["more"]
    unknown = {"objects": [*LABELS, "flux capacitor"], "unknown_labels": "ignore"}
    assert (await ask(client, "missing", **unknown))["more"] == answer
    (entry,) = answer
    assert [entry[name] for name in ("label", "listed_count", "low", "high")] == ["chair", 2, 2, 4]
    assert entry["probability"] == pytest.approx(0.8 / 0.9, abs=1e-3)


async def test_candidates_name_listed_classes_too(client: httpx.AsyncClient) -> None:
    (entry,) = await more(client, candidates=["night stands", "lamp"])
    assert entry["label"] == "nightstand"
    assert entry["probability"] == pytest.approx(0.2, abs=1e-3)


async def test_a_question_about_a_place_lists_no_further_instances(
    client: httpx.AsyncClient,
) -> None:
    assert await more(client, at={"relation": "on-top", "object": "bed"}) == []


async def test_the_command_shows_them(client: httpx.AsyncClient) -> None:
    answer = MissingAnswer.model_validate(await ask(client, "missing", objects=LABELS))
    console = Console(width=100)
    with console.capture() as shown:
        console.print(tables.missing(answer))
    lines = [" ".join(line.split()) for line in shown.get().splitlines()]
    assert "chair 2 3.7 (2 to 4) 0.889" in lines
