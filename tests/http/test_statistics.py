"""Answers of /missing from counts and offsets: further instances, and placements in metres."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from app import questions
from app.registry import Counts, Store
from app.scene import Scene, SceneObject
from app.scene.geometry import viewer_axes
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


async def test_likely_further_instances_are_listed(
    client: httpx.AsyncClient, own_store: Path
) -> None:
    answer = (await ask(client, "missing", objects=LABELS))["more"]
    assert answer == computed(own_store, LABELS, None)["more"]
    (entry,) = answer
    assert [entry[name] for name in ("label", "listed_count", "low", "high")] == ["chair", 2, 2, 4]
    assert entry["probability"] == pytest.approx(0.8 / 0.9, abs=1e-3)
    # A question about a place lists none.
    place = {"relation": "on-top", "object": "bed"}
    assert (await ask(client, "missing", objects=LABELS, at=place))["more"] == []


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
