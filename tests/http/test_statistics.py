"""Answers of /missing from counts and offsets: further instances, and placements in metres."""

from __future__ import annotations

import math
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
from app.scene.geometry import viewer_axes
from scene_client import tables
from scene_client.schemas import MissingAnswer
from tests.http.stores import VOCABULARY, C, V, publish
from tests.http.test_questions import ask
from tests.questions.test_placements import offsets_of_every_pair
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
    root, statistics = tmp_path_factory.mktemp("store"), (counts(), offsets_of_every_pair(V))
    publish(root, "measured", "1.0.0", alias="default", counts=statistics[0], offsets=statistics[1])
    return root


@pytest.fixture(scope="module")
async def client(own_store: Path, anyio_backend: str) -> AsyncIterator[httpx.AsyncClient]:
    async with serve(own_store) as client:
        yield client


def computed(
    store: Path, labels: tuple[str, ...], position: Any, *scene: Any, **options: Any
) -> Any:
    """The answer of the question itself."""
    artifact = Store(store).load("measured", "1.0.0")
    things = (
        SceneObject(str(k), label, VOCABULARY.index(label), position=position)
        for k, label in enumerate(labels)
    )
    return questions.missing(artifact, Scene(tuple(things), *scene), **options)


# ------------------------------------------------------------------------- further instances


async def more(client: httpx.AsyncClient, **request: Any) -> list[dict[str, Any]]:
    answer = await ask(client, "missing", **{"objects": LABELS, **request})
    return list(answer["more"])


async def test_likely_further_instances_are_listed(
    client: httpx.AsyncClient, own_store: Path
) -> None:
    answer = await more(client)
    assert answer == computed(own_store, LABELS, None)["more"]
    unknown = [*LABELS, "flux capacitor"]
    assert await more(client, objects=unknown, unknown_labels="ignore") == answer
    (entry,) = answer
    assert [entry[name] for name in ("label", "listed_count", "low", "high")] == ["chair", 2, 2, 4]
    assert entry["probability"] == pytest.approx(0.8 / 0.9, abs=1e-3)
    # A question about a place lists none.
    assert await more(client, at={"relation": "on-top", "object": "bed"}) == []


async def test_candidates_name_listed_classes_too(client: httpx.AsyncClient) -> None:
    (entry,) = await more(client, candidates=["night stands", "lamp"])
    assert entry["label"] == "nightstand"
    assert entry["probability"] == pytest.approx(0.2, abs=1e-3)


async def test_the_command_shows_further_instances(client: httpx.AsyncClient) -> None:
    answer = MissingAnswer.model_validate(await ask(client, "missing", objects=LABELS))
    console = Console(width=100)
    with console.capture() as shown:
        console.print(tables.missing(answer))
    lines = [" ".join(line.split()) for line in shown.get().splitlines()]
    assert "chair 2 3.7 (2 to 4) 0.889" in lines


# --------------------------------------------------------------------------- placements

# Nothing is derived or stated, so that every request asks the same question of the model.
POSED = ("bed", "chair", "desk")
PLACE = {"x": 1.0, "y": 0.0, "z": 0.5}
REQUEST: dict[str, Any] = {
    "objects": [{"id": str(k), "label": POSED[k], "position": PLACE} for k in range(3)],
    "relations": [],
    "top_k": 11,
}


@pytest.mark.parametrize(
    ("frame", "viewpoint"),
    [
        (None, None),
        ("base_link", None),
        ("map", {"x": 4.0, "y": -3.0, "yaw": math.pi / 2}),
        ("camera_optical_frame", None),
        ("robot_1/map", None),
    ],
)
async def test_placements_have_offsets_in_the_axes_of_the_frame(
    client: httpx.AsyncClient, own_store: Path, frame: str | None, viewpoint: Any
) -> None:
    """In a map without a viewpoint, the relations left and front have no offset."""
    options = {"frame_id": frame, "viewpoint": viewpoint}
    options = {name: value for name, value in options.items() if value is not None}
    axes = viewer_axes(frame or "", None if viewpoint is None else viewpoint["yaw"])
    answer = await ask(client, "missing", **REQUEST, **options)
    position = tuple(PLACE.values())
    expected = computed(own_store, POSED, position, (), top_k=11, axes=axes)
    assert answer["missing"] == expected["missing"]
    places = [place for entry in answer["missing"] for place in entry["placements"]]
    kinds = {"offset" in place for place in places}
    assert kinds == ({True, False} if axes is None else {True})


async def test_an_object_without_a_position_has_no_offset(client: httpx.AsyncClient) -> None:
    objects = [REQUEST["objects"][0], *({"id": str(k), "label": POSED[k]} for k in (1, 2))]
    answer = await ask(client, "missing", **{**REQUEST, "objects": objects})
    places = [place for entry in answer["missing"] for place in entry["placements"]]
    assert {place["object"] for place in places if "offset" in place} == {"0"}
    assert {place["object"] for place in places if "offset" not in place} == {"1", "2"}
