"""Placements in metres: anchor.position + offset.mean is a place in the request's frame."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.scene.frames import body_pose
from tests.http.stores import V, publish
from tests.http.test_questions import ask
from tests.questions.test_offsets import known
from tests.services import serve

pytestmark = pytest.mark.anyio

VERTICAL = {"on-top", "under", "above", "below"}
LABELS = ("bed", "chair", "desk")
# Nothing is derived or stated, so that every request asks the same question of the model.
REQUEST: dict[str, Any] = {"objects": list(LABELS), "relations": [], "top_k": 11}


@pytest.fixture(scope="module")
async def client(tmp_path_factory, anyio_backend) -> AsyncIterator[httpx.AsyncClient]:
    root: Path = tmp_path_factory.mktemp("store")
    publish(root, "measured", "1.0.0", alias="default", offsets=known(V))
    publish(root, "plain", "1.0.0")
    async with serve(root) as client:
        yield client


async def places(client: httpx.AsyncClient, **request: Any) -> dict[tuple[str, ...], Any]:
    """The offset of each placement by (missing label, relation, anchor); None where it has none."""
    answer = await ask(client, "missing", **REQUEST, **request)
    return {
        (entry["label"], place["relation"], place["object"]): place.get("offset")
        for entry in answer["missing"]
        for place in entry["placements"]
    }


def point(vector: dict[str, float]) -> tuple[float, float, float]:
    return vector["x"], vector["y"], vector["z"]


async def test_every_placement_has_an_offset_with_its_spread(client: httpx.AsyncClient) -> None:
    found = await places(client)
    assert len(found) == 33
    for offset in found.values():
        assert set(offset) == {"mean", "std", "scenes"}
        assert min(point(offset["std"])) > 0
        assert offset["scenes"] >= 1


async def test_a_model_without_poses_names_none(client: httpx.AsyncClient) -> None:
    found = await places(client, model="plain")
    assert set(found.values()) == {None}
    assert "offset" not in (await client.post("/missing", json={**REQUEST, "model": "plain"})).text


async def test_a_body_frame_has_the_viewer_s_axes(client: httpx.AsyncClient) -> None:
    assert await places(client, frame_id="base_link") == await places(client)


async def test_in_a_map_the_offset_is_turned_as_the_viewer_is(client: httpx.AsyncClient) -> None:
    """Looking along y of the map: left of a thing is towards smaller x."""
    plain = await places(client)
    viewpoint = {"x": 4.0, "y": -3.0, "yaw": math.pi / 2}
    turned = await places(client, frame_id="map", viewpoint=viewpoint)
    assert plain.keys() == turned.keys()
    for name, offset in turned.items():
        x, y, z = point(plain[name]["mean"])
        assert point(offset["mean"]) == pytest.approx((-y, x, z), abs=1e-9)
        x, y, z = point(plain[name]["std"])
        assert point(offset["std"]) == pytest.approx((y, x, z), abs=1e-9)
        assert offset["scenes"] == plain[name]["scenes"]


async def test_in_a_camera_s_frame_the_offset_has_the_camera_s_axes(
    client: httpx.AsyncClient,
) -> None:
    """What is read from there as positions are is the offset in body axes."""
    plain = await places(client)
    for name, offset in (await places(client, frame_id="camera_optical_frame")).items():
        body, _, _ = body_pose(point(offset["mean"]), optical=True)
        assert body == pytest.approx(point(plain[name]["mean"]))


async def test_in_a_map_without_a_viewpoint_there_is_no_left(client: httpx.AsyncClient) -> None:
    plain, found = await places(client), await places(client, frame_id="robot_1/map")
    assert plain.keys() == found.keys()
    kinds = {relation in VERTICAL for _, relation, _ in found}
    assert kinds == {True, False}
    for name, offset in found.items():
        if name[1] not in VERTICAL:
            assert offset is None
            continue
        assert point(offset["mean"])[:2] == (0, 0)
        assert offset["mean"]["z"] == plain[name]["mean"]["z"]
        assert offset["std"]["x"] == offset["std"]["y"]


async def test_a_batch_has_the_same_offsets(client: httpx.AsyncClient) -> None:
    alone = await ask(client, "missing", **REQUEST)
    answer = (await client.post("/missing/batch", json={"scenes": [REQUEST, REQUEST]})).json()
    assert [entry["result"]["missing"] for entry in answer["results"]] == [alone["missing"]] * 2
