"""The README's answers are those of the shipped models, and they say what a person would expect."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from app.main import create_app
from app.settings import Settings
from scripts.answers import README, ask_all, examples

EXAMPLES = list(examples(README.read_text(encoding="utf-8")))
STORE = Path(__file__).resolve().parents[2] / "model_store"


@pytest.fixture(scope="module")
def answers():
    return asyncio.run(ask_all(create_app(Settings(store=STORE)), EXAMPLES))


def close(first: Any, second: Any) -> bool:
    """Equal but for the last digits of floats, which differ between processors."""
    if isinstance(first, float) and isinstance(second, float):
        return abs(first - second) <= 1e-4 * max(1.0, abs(first))
    if isinstance(first, dict) and isinstance(second, dict):
        return first.keys() == second.keys() and all(close(first[k], second[k]) for k in first)
    if isinstance(first, list) and isinstance(second, list):
        return len(first) == len(second) and all(map(close, first, second))
    return bool(first == second)


def test_the_readme_asks_every_question():
    paths = {example.path for example in EXAMPLES}
    assert paths == {"/relations", "/missing", "/outliers", "/generate"}
    assert any("at" in example.body for example in EXAMPLES)


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_the_answer_is_the_service_s(answers, number):
    assert close(json.loads(EXAMPLES[number].answer), answers[number])


def answer(path: str, **wanted: Any) -> dict[str, Any]:
    for example in EXAMPLES:
        if example.path == path and all(example.body.get(k) == v for k, v in wanted.items()):
            found: dict[str, Any] = json.loads(example.answer)
            return found
    raise AssertionError(f"the README does not ask {path} with {wanted}")


def test_a_sink_is_missing_from_the_kitchen():
    found = answer("/missing", objects=["stove", "fridge", "cabinet", "microwave", "counter"])
    assert "sink" in [entry["label"] for entry in found["missing"][:10]]


def test_a_urinal_does_not_belong_in_a_bedroom():
    things = ["bed", "pillow", "nightstand", "lamp", "dresser", "urinal"]
    assert answer("/outliers", objects=things)["outliers"][0]["label"] == "urinal"


def test_a_monitor_stands_on_the_desk():
    found = answer("/relations", objects=["desk", "monitor", "lamp"])["relations"][:10]
    triples = [(entry["subject"], entry["relation"], entry["object"]) for entry in found]
    assert ("monitor", "on-top", "desk") in triples


def test_four_bathrooms():
    found = answer("/generate", room_type="bathroom", count=4)
    assert len(found["scenes"]) == 4
