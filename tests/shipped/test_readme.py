"""The README's answers say what a person would expect; tests/docs holds the service to them."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

from tests.docs.blocks import blocks

README = Path(__file__).resolve().parents[2] / "README.md"


def asked() -> list[tuple[str, dict[str, Any], dict[str, Any]]]:
    """(path, request, answer) of every question that the README puts by curl."""
    found = []
    for block in blocks(README):
        words = shlex.split(block.source.replace("\\\n", " ")) if block.language == "sh" else []
        if words[:1] == ["curl"] and block.output is not None:
            url = next(word for word in words if word.startswith("http"))
            request = json.loads(words[words.index("-d") + 1])
            found.append(("/" + url.split("/", 3)[3], request, json.loads(block.output.source)))
    return found


def answer(path: str, **wanted: Any) -> dict[str, Any]:
    for route, request, reply in asked():
        if route == path and all(request.get(k) == v for k, v in wanted.items()):
            return reply
    raise AssertionError(f"the README does not ask {path} with {wanted}")


def test_the_readme_asks_every_question():
    paths = {path for path, _, _ in asked()}
    assert {"/relations", "/missing", "/outliers", "/generate"} <= paths
    assert any("at" in request for _, request, _ in asked())


def test_a_sink_is_missing_from_the_kitchen():
    found = answer("/missing", objects=["stove", "fridge", "cabinet", "microwave", "counter"])
    assert "sink" in [entry["label"] for entry in found["missing"][:10]]


def test_a_toilet_does_not_belong_in_a_bedroom():
    things = ["bed", "pillow", "nightstand", "lamp", "dresser", "toilet"]
    first = answer("/outliers", objects=things)["outliers"][0]
    assert (first["label"], first["is_outlier"]) == ("toilet", True)


def test_a_monitor_stands_on_the_desk():
    found = answer("/relations", objects=["desk", "monitor", "lamp"])["relations"][:10]
    triples = [(entry["subject"], entry["relation"], entry["object"]) for entry in found]
    assert ("monitor", "on-top", "desk") in triples


def test_four_bathrooms():
    found = answer("/generate", room_type="bathroom", count=4)
    assert len(found["scenes"]) == 4
