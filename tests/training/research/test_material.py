from dataclasses import replace

import numpy as np
import pytest

from tests.training.scenes import scene
from training.datasets.jsonl import write_jsonl
from training.fit.configuration import ConfigError, DataConfig
from training.runs.pipeline import read_sources, split_and_encode

LABELS = ["bed", "sink", "lamp", "oven", "sofa", "desk", "shelf", "towel", "plant", "chair"]


def write_scenes(folder, source, *, seed=0, relations=False):
    rng = np.random.default_rng(seed)
    listed = [(0, "on-top", 1)] if relations else None
    lists = (rng.choice(LABELS, size=rng.integers(3, 7), replace=False) for _ in range(140))
    scenes = [
        replace(scene(f"{source}-{k}", *labels.tolist(), relations=listed), source=source)
        for k, labels in enumerate(lists)
    ]
    write_jsonl(scenes, folder / f"{source}.jsonl.gz")


def material(folder, **settings):
    data = DataConfig(**{"sources": ("flats",), "vocabulary": "source"} | settings)
    return split_and_encode(data, read_sources(data, folder), folder)


def test_the_digest_covers_all_settings_and_scenes_of_a_training(tmp_path):
    for source in ("flats", "sheds"):
        write_scenes(tmp_path, source)
    scenes = material(tmp_path)
    assert material(tmp_path).digest == scenes.digest
    others = [
        material(tmp_path, sources=("flats", "sheds")),
        material(tmp_path, sources=("sheds",)),
        material(tmp_path, vocabulary="written"),
        material(tmp_path, split="stable"),
        material(tmp_path, split_seed=1),
        material(tmp_path, limit=40),
    ]
    write_scenes(tmp_path, "flats", seed=1)
    others.append(material(tmp_path))
    assert len({scenes.digest, *(other.digest for other in others)}) == len(others) + 1
    assert scenes.complete_data().digest == scenes.digest


def test_every_part_needs_scenes(tmp_path):
    write_scenes(tmp_path, "flats")
    scenes = material(tmp_path)
    for part in scenes.parts:
        with pytest.raises(ConfigError, match=f"the {part} part contains no scenes"):
            replace(scenes, parts=scenes.parts | {part: []}).complete_data()


def test_relations_are_needed_to_learn_from_and_to_tune_on(tmp_path):
    write_scenes(tmp_path, "flats", relations=True)
    found = material(tmp_path).complete_data()
    assert found.related
    write_scenes(tmp_path, "flats")
    bare = material(tmp_path).complete_data()
    assert not bare.related
    for part in ("train", "validation"):
        assert not replace(found, **{part: bare.train}).related
