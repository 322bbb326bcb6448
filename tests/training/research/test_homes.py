"""`python -m training homes` on houses of generated rooms."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest

from tests.training.commands import invoke, small_config, write_config
from training.datasets import generate_rooms
from training.datasets.jsonl import write_jsonl


@pytest.mark.slow
def test_homes_are_measured_with_parents_that_never_saw_them(tmp_path, monkeypatch):
    """Three houses of twelve rooms, and two parents. A second call uses the finished trainings."""
    monkeypatch.setattr("training.research.homes._FOLDS", 2)
    monkeypatch.setattr("training.research.homes.ProcessPoolExecutor", ThreadPoolExecutor)
    scenes = [
        replace(scene, scene_id=str(k), source="matterport_rooms", group=f"house-{k // 12}")
        for k, scene in enumerate(generate_rooms(36, seed=5))
    ]
    write_jsonl(scenes, tmp_path / "matterport_rooms.jsonl.gz")
    config = small_config("houses", sources=["matterport_rooms"], vocabulary="source", rooms=0)
    file, folder = write_config(tmp_path / "houses.toml", config), tmp_path / "runs"
    command = ("homes", file, "--scenes", 20, "--data", tmp_path, "--folder", folder)
    said = invoke(*command, "--workers", 1)
    rows = json.loads((folder / "results.json").read_text())
    assert {row["home"] for row in rows} == {f"house-{k}" for k in range(3)}
    assert "20 scenes, 3 homes" in said
    for row in rows:
        for name in ("alarms", "mrr", "other_rooms"):
            assert all(0 <= share <= 1 for share in row[name])
    weights = folder / "fold-0" / "model.safetensors"
    before = weights.stat().st_mtime_ns
    assert invoke(*command, "--workers", 1) == said
    assert weights.stat().st_mtime_ns == before
