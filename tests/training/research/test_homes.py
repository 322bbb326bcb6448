"""`python -m training homes` on houses of generated rooms."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest

from tests.conftest import REPOSITORY
from tests.training.commands import invoke
from training.datasets import generate_rooms
from training.datasets.jsonl import write_jsonl


@pytest.mark.slow
def test_homes_are_measured_with_a_model_that_never_saw_them(tmp_path, monkeypatch):
    """Two houses, of twelve rooms and of one. A home has ten rooms or more."""
    monkeypatch.setattr("training.research.homes._INTRUDERS", 1)
    monkeypatch.setattr("training.research.homes.ProcessPoolExecutor", ThreadPoolExecutor)
    scenes = [
        replace(scene, scene_id=str(k), source="matterport_rooms", group=f"house-{k // 12}")
        for k, scene in enumerate(generate_rooms(13, seed=5))
    ]
    write_jsonl(scenes, tmp_path / "matterport_rooms.jsonl.gz")
    folder, store = tmp_path / "homes", REPOSITORY / "model_store"
    options = ("--scenes", 3, "--data", tmp_path, "--folder", folder, "--workers", 1)
    said = invoke("homes", "default", "--store", store, *options)
    rows = json.loads((folder / "results.json").read_text())
    assert {row["home"] for row in rows} == {"house-0"}
    assert "3 scenes, 1 homes" in said
    for row in rows:
        for name in ("alarms", "mrr", "other_rooms"):
            assert all(0 <= share <= 1 for share in row[name])
    assert "unknown" in invoke("homes", "nothing", "--store", store, *options, code=1)
