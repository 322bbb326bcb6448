"""Sharded scenes: every epoch sees the training part of all files, one file at a time."""

from __future__ import annotations

from collections import Counter

import fsspec
import pytest

from training.config import Config, ConfigError, source_name
from training.datasets import generate_rooms, split
from training.datasets.jsonl import write_jsonl
from training.pipeline import prepare
from training.shards import shard_files
from training.trainer import Trainer

FILES, SCENES = 3, 30


def config(source="shards/part-*.jsonl.gz", **data) -> Config:
    return Config.model_validate(
        {
            "name": "sharded",
            "data": {"sources": [source], "vocabulary": "rooms", "split": "stable", **data},
            "machine": {"variant": "triway", "form": "local", "H1": 4, "H2": 0, "K": 2},
            "objective": {"name": "composite"},
            "training": {"epochs": 2, "batch_size": 8},
        }
    )


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    (folder / "shards").mkdir()
    scenes = list(generate_rooms(FILES * SCENES, seed=3))
    for k in range(FILES):
        part = scenes[k * SCENES : (k + 1) * SCENES]
        write_jsonl(part, folder / f"shards/part-{k}.jsonl.gz")
    return folder


def test_every_epoch_sees_the_training_scenes_of_all_files_once(root, monkeypatch):
    data = prepare(config(), root).training_data()
    assert len(data.train) + len(data.validation) + len(data.test) == SCENES
    seen: Counter[str] = Counter()
    update = Trainer._update

    def counted(self, scenes, index):
        seen.update(scenes.scenes[k].scene_id for k in index.tolist())
        return update(self, scenes, index)

    monkeypatch.setattr(Trainer, "_update", counted)
    Trainer(config(), data).run()
    train = split(list(generate_rooms(FILES * SCENES, seed=3)), seed=0, protocol="stable")["train"]
    assert seen == Counter({scene.scene_id: 2 for scene in train})


def test_shards_may_be_at_a_url(root):
    memory = fsspec.filesystem("memory")
    for k in range(FILES):
        name = f"part-{k}.jsonl.gz"
        memory.put_file(str(root / "shards" / name), f"/shards/{name}")
    data = prepare(config("memory://shards/part-*.jsonl.gz"), root)
    local = prepare(config(), root)
    assert data.digests == local.digests
    parts = zip(data.training_data().shards.files, local.training_data().shards.files, strict=True)
    assert all(remote.startswith("memory://") and path.startswith("/") for remote, path in parts)


def test_a_pattern_needs_files_and_a_stable_split(root):
    with pytest.raises(ConfigError, match="no file matches"):
        shard_files("none-*.jsonl", root)
    with pytest.raises(ValueError, match="stable"):
        config(split="group")


@pytest.mark.parametrize(
    ("source", "name"), [("shards/part-*.jsonl.gz", "part"), ("shards/*.jsonl", "shards")]
)
def test_a_sharded_source_has_a_name(source, name):
    assert source_name(source) == name
