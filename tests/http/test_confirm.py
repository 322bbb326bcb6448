"""The route `/confirm`: when it exists, and what it writes."""

import json
from pathlib import Path

import pytest

from tests.http.test_problems import problem
from tests.services import serve

KEY = "incorrect-zebra-capacitor-nail"
SCENE = {"objects": ["bed", {"label": "lamp", "confidence": 0.2}, "chair"], "room_type": "bedroom"}


@pytest.mark.parametrize("settings", [{}, {"api_key": KEY}, {"recording": "scenes.jsonl"}])
async def test_without_key_or_recording_there_is_no_route(shared_store, tmp_path, settings):
    if "recording" in settings:
        settings = {"recording": tmp_path / "scenes.jsonl"}
    async with serve(shared_store, **settings) as client:
        client.headers["X-API-Key"] = KEY
        response = await client.post("/confirm", json=SCENE)
        problem(response, 404, "not-found")
        assert "/confirm" not in (await client.get("/openapi.json")).json()["paths"]
    assert not [*tmp_path.iterdir()]


async def test_it_appends_whole_lines(shared_store: Path, tmp_path: Path) -> None:
    """Every object of a confirmed scene counts, also one of a low confidence."""
    recording = tmp_path / "scenes.jsonl"
    async with serve(shared_store, api_key=KEY, recording=recording) as client:
        problem(await client.post("/confirm", json=SCENE), 401, "unauthorized")
        client.headers["X-API-Key"] = KEY
        names = [(await client.post("/confirm", json=SCENE)).json()["scene_id"] for _ in range(3)]
        refused = await client.post("/confirm", json={"objects": ["bed", "nigthstand"]})
        problem(refused, 422, "unknown-labels")
    scenes = [json.loads(line) for line in recording.read_text("utf-8").splitlines()]
    assert [scene["scene_id"] for scene in scenes] == names
    assert len(set(names)) == 3
    for scene in scenes:
        assert scene["confirmed"] is True
        assert scene["room_type"] == "bedroom"
        assert [thing["label"] for thing in scene["objects"]] == ["bed", "lamp", "chair"]


async def test_a_failure_is_a_problem(shared_store: Path, tmp_path: Path) -> None:
    recording = tmp_path / "scenes.jsonl"
    async with serve(shared_store, api_key=KEY, recording=recording) as client:
        client.headers["X-API-Key"] = KEY
        recording.mkdir()  # a folder in place of the file
        problem(await client.post("/confirm", json=SCENE), 503, "not-recorded")
        recording.rmdir()
        assert (await client.post("/confirm", json=SCENE)).status_code == 200
    assert len(recording.read_text("utf-8").splitlines()) == 1
