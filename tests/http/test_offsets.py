"""Placements in metres: anchor.position + offset.mean is a place in the request's frame."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from app import questions
from app.registry import Store
from app.scene import Scene, SceneObject
from app.scene.geometry import viewer_axes
from tests.http.stores import V, publish
from tests.http.test_questions import ask
from tests.questions.test_placements import offsets_of_every_pair
from tests.services import serve

LABELS = ("bed", "chair", "desk")
# Nothing is derived or stated, so that every request asks the same question of the model.
PLACE = {"x": 1.0, "y": 0.0, "z": 0.5}
REQUEST: dict[str, Any] = {
    "objects": [{"label": label, "position": PLACE} for label in LABELS],
    "relations": [],
    "top_k": 11,
}


@pytest.fixture(scope="module")
def store_of_poses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("store")
    publish(root, "measured", "1.0.0", alias="default", offsets=offsets_of_every_pair(V))
    return root


@pytest.fixture(scope="module")
async def client(store_of_poses: Path, anyio_backend: str) -> AsyncIterator[httpx.AsyncClient]:
    async with serve(store_of_poses) as client:
        yield client


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
    client: httpx.AsyncClient, store_of_poses: Path, frame: str | None, viewpoint: Any
) -> None:
    """In a map without a viewpoint, the relations left and front have no offset."""
    options = {"frame_id": frame, "viewpoint": viewpoint}
    options = {name: value for name, value in options.items() if value is not None}
    axes = viewer_axes(frame or "", None if viewpoint is None else viewpoint["yaw"])
    artifact = Store(store_of_poses).load("measured", "1.0.0")
    index, position = artifact.vocabulary.index, tuple(PLACE.values())
    objects = [SceneObject(label, label, index(label), position=position) for label in LABELS]
    expected = questions.missing(artifact, Scene(tuple(objects), ()), top_k=11, axes=axes)
    answer = await ask(client, "missing", **REQUEST, **options)
    assert answer["missing"] == expected["missing"]
    places = [place for entry in answer["missing"] for place in entry["placements"]]
    kinds = {"offset" in place for place in places}
    assert kinds == ({True, False} if axes is None else {True})


async def test_an_object_without_a_position_has_no_offset(client: httpx.AsyncClient) -> None:
    posed, *others = REQUEST["objects"]
    objects = [posed, *[thing["label"] for thing in others]]
    answer = await ask(client, "missing", **{**REQUEST, "objects": objects})
    places = [place for entry in answer["missing"] for place in entry["placements"]]
    assert {place["object"] for place in places if "offset" in place} == {"bed"}
    assert {place["object"] for place in places if "offset" not in place} == {"chair", "desk"}
