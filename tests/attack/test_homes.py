"""Hostile recordings of a home: a broken recording makes the model neither blind nor large."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.inference import Weights
from app.model import SceneModel
from app.registry import Store
from app.scene import Scene
from tests.training.scenes import request
from training.datasets.inventories import read_inventory
from training.datasets.jsonl import scan_jsonl
from training.datasets.records import AnnotatedScene
from training.domain import adaptation, home
from training.domain import true_intruders as true_intruders_module
from training.domain.adaptation import adapted
from training.domain.home import (
    MAX_ALARMS,
    MAX_CLASSES,
    Home,
    weights_of_hours,
    with_exceptions,
)
from training.domain.own_words import MAX_NEW
from training.domain.true_intruders import lost, true_intruders

BEDROOM = ["bed", "nightstand", "pillow", "wardrobe", "lamp", "curtain"]


@pytest.fixture(scope="module")
def model(repository: Path) -> SceneModel:
    store = Store(repository / "model_store")
    return store.load(*store.resolve("default")).model


def scenes(tmp_path: Path, *lines: dict[str, Any]) -> list[AnnotatedScene]:
    path = tmp_path / "scenes.jsonl"
    path.write_text(
        "".join(json.dumps({"scene_id": f"s{k}"} | x) + "\n" for k, x in enumerate(lines))
    )
    return [scene for scene in scan_jsonl(path) if isinstance(scene, AnnotatedScene)]


def test_empty_scenes_teach_nothing(model, tmp_path):
    lines = [{"objects": []}, {"objects": ["floor"]}, confirmed()]
    result = adapted(Home.of(model, scenes(tmp_path, *lines)))
    assert (result.model, result.exceptions) == (None, {})


def confirmed(*objects: str) -> dict[str, Any]:
    return {"objects": [*objects], "room_type": "bedroom", "confirmed": True}


def test_a_scene_of_a_whole_vocabulary_teaches_nothing(model, tmp_path):
    labels = [entry.label for entry in model.vocabulary.objects if not entry.structure][:760]
    found = Home.of(model, scenes(tmp_path, confirmed(*labels), confirmed(*BEDROOM)))
    assert found.too_large == ("s0",)
    assert [len(scene.classes) for scene in found.scenes] == [len(BEDROOM)]
    within = Home.of(model, scenes(tmp_path, confirmed(*labels[:MAX_CLASSES])))
    assert (within.too_large, len(within.scenes)) == ((), 1)


def test_a_confirmed_scene_with_many_alarms_counts_as_unconfirmed(model, tmp_path, monkeypatch):
    monkeypatch.setattr(home, "MAX_ALARMS", 1)
    assert MAX_ALARMS > 1
    two, one = confirmed(*BEDROOM, "toilet", "stove"), confirmed(*BEDROOM, "toilet")
    found = Home.of(model, scenes(tmp_path, two))
    assert found.doubted == ("s0",)
    assert found.confirmed == 0
    assert set(found.left_out) == {"toilet", "stove"}
    assert not adapted(found).exceptions
    assert adapted(Home.of(model, scenes(tmp_path, one))).exceptions == {"toilet": 1}


def test_a_confirmed_habit_counts_in_all_scenes_of_its_room_type(model, tmp_path):
    lines = [{"objects": [*BEDROOM[k:], "toilet"], "room_type": "bedroom"} for k in range(3)]
    lines += [{"objects": [*BEDROOM, "toilet"], "room_type": "office"}]
    open_ones = Home.of(model, scenes(tmp_path, *lines)).left_out["toilet"]
    assert {"s0", "s3"} <= set(open_ones)
    found = Home.of(model, scenes(tmp_path, *lines[1:], confirmed(*BEDROOM, "toilet")))
    assert found.left_out["toilet"] == ["s2"], "the office"
    (tmp_path / "places.csv").write_text("room_type,label\nbedroom,toilet\n")
    places = read_inventory(tmp_path / "places.csv").places
    by_table = Home.of(model, scenes(tmp_path, *lines), places)
    assert by_table.left_out["toilet"] == ["s3"]
    assert adapted(by_table).exceptions["toilet"] == 1, "also as a row alone"


def test_exceptions_of_a_home_are_limited(model, tmp_path, monkeypatch):
    monkeypatch.setattr(adaptation, "MAX_EXCEPTIONS", 1)
    habits = ("toilet", "toilet", "stove")
    lines = [confirmed(*BEDROOM[k:], x) for k, x in enumerate(habits)]
    result = adapted(Home.of(model, scenes(tmp_path, *lines)))
    assert result.exceptions == {"toilet": 2}
    assert result.refused == ("1 more classes are beyond the 1 of a home",)


def about(model: SceneModel, *labels: str) -> list[tuple[Scene, int]]:
    """Bedrooms with an intruder of each label."""
    index = model.vocabulary.index
    return [(request(model, *BEDROOM, x), index(x)) for x in labels]


def test_exceptions_that_make_the_model_blind_are_refused(model, tmp_path, monkeypatch):
    ten = [
        "toilet",
        "stove",
        "fridge",
        "dishwasher",
        "bathtub",
        "oven",
        "bed",
        "sink",
        "desk",
        "tv",
    ]
    one, two = confirmed(*BEDROOM, "toilet"), confirmed(*BEDROOM[1:], "stove")
    monkeypatch.setattr(adaptation, "true_intruders", lambda *_: about(model, *ten))

    def missed(side: SceneModel, cases: list[tuple[Scene, int]]) -> int:
        return sum(side.vocabulary.objects[c].anywhere for _, c in cases)

    monkeypatch.setattr(adaptation, "lost", missed)
    few = adapted(Home.of(model, scenes(tmp_path, one)))
    assert (few.exceptions, few.refused) == ({"toilet": 1}, ())
    many = adapted(Home.of(model, scenes(tmp_path, one, two)))
    assert not many.exceptions
    assert many.refused == ("2 of 10 true intruders would raise no alarm any more",)


def test_weights_that_make_the_model_blind_are_refused(model, tmp_path, monkeypatch):
    lines = [
        {"objects": ["bed", x, y]} for x in BEDROOM[1:] for y in ("rug", "mirror", "book", "box")
    ]
    cases = about(model, "toilet", "stove", "fridge")
    arrays = dict(model.weights.arrays) | {"b": model.weights["b"] + np.float32(9)}
    monkeypatch.setattr(adaptation, "measure", lambda *_: Quiet())
    monkeypatch.setattr(adaptation, "adapt", lambda *_, **__: Weights(model.spec, arrays))
    monkeypatch.setattr(adaptation, "true_intruders", lambda *_: cases)
    result = adapted(Home.of(model, scenes(tmp_path, *lines)))
    assert result.objections == ("3 of 3 true intruders would raise no alarm any more",)
    assert result.model is None


class Quiet:
    """A measurement without objections."""

    def objections(self) -> tuple[str, ...]:
        return ()


def test_true_intruders_are_reported_by_the_parent(model, monkeypatch):
    monkeypatch.setattr(true_intruders_module, "_CASES", 40)
    cases = true_intruders(model)
    assert len(cases) == 40
    assert len({c for _, c in cases}) > 20, "many classes"
    assert lost(model, cases) == 0
    first = cases[0][1]
    silent = with_exceptions(model, [model.vocabulary.labels[first]])
    assert lost(silent, cases) == sum(c == first for _, c in cases)


@given(st.lists(st.integers(1, 300), min_size=1, max_size=12))
def test_an_hour_has_at_most_a_quarter_of_the_weight(sizes: list[int]) -> None:
    groups = [str(hour) for hour, size in enumerate(sizes) for _ in range(size)]
    weight = weights_of_hours([*groups, None])
    assert (weight <= 1).all()
    assert weight[-1] == 1  # a written place
    for hour, size in enumerate(sizes):
        of_hour = weight[:-1][np.array(groups) == str(hour)].sum()
        assert of_hour <= max(20, weight.sum() / 4) + 1e-6
        if size <= 20:
            assert of_hour == pytest.approx(size)


def test_new_words_are_limited(model, tmp_path):
    words = [f"gadget{k:03}x" for k in range(2 * MAX_NEW)]
    lines = [{"objects": ["bed", *words[k : k + 50]]} for k in range(0, len(words), 50)]
    lines += [{"objects": ["bed", words[-1]]}]
    found = Home.of(model, scenes(tmp_path, *lines))
    assert len(found.new_classes) == MAX_NEW
    assert words[-1] in found.new_classes, "two scenes have it"
    assert set(found.unlearnt) == set(words) - set(found.new_classes)
