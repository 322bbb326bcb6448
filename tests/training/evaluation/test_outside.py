import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from tests.training.evaluation.furnished_rooms import STRUCTURE, VOCABULARY, room_model
from training.datasets import DatasetError, annotated_classes, encode, generate_rooms
from training.datasets.batches import scene_tensors
from training.datasets.jsonl import write_jsonl
from training.evaluation.asking import artifact_model
from training.evaluation.report import ROOM_TASKS, measure, read_test
from training.evaluation.setting import Setting
from training.evaluation.tasks import TASKS


def room_file(folder: Path, scenes) -> Path:
    path = folder / "homes.jsonl"
    write_jsonl(scenes, path)
    return path


def test_files_have_the_metrics_of_all_tasks_without_training_scenes(tmp_path):
    """The figures are those of the tasks; intervals resample the groups of the file."""
    pairs = [replace(s, group=f"home {k // 2}") for k, s in enumerate(generate_rooms(12, 3))]
    test = read_test(room_file(tmp_path, pairs))
    encoded = encode([replace(s, source="homes") for s in pairs], VOCABULARY)
    scenes = scene_tensors(encoded, annotated_classes(encoded, VOCABULARY), VOCABULARY)
    setting = Setting(scenes, STRUCTURE, train=scenes, limit=None)
    outcomes = measure(artifact_model(room_model()), setting, "homes", tasks=ROOM_TASKS).outcomes
    rows = test.measure(room_model())
    assert {row.source for row in rows} == {"homes"}
    assert len(rows) == len({(row.task, row.metric) for row in rows})
    assert {row.task for row in rows} == {task for task, outcome in outcomes.items() if outcome}
    assert {"T2 missing", "T3 outliers", "T3 alarms", "T1a relations"} <= {r.task for r in rows}
    for row in rows:
        metric = outcomes[row.task].metrics[row.metric]
        figure = metric.figure()
        assert len(metric.groups) <= 6
        assert row.model_dump(include=set(asdict(figure))) == pytest.approx(asdict(figure))
        assert row.metric in TASKS[row.task].card


def test_labels_of_the_vocabulary_only(tmp_path):
    scenes = [{"objects": ["bed", "lamp", "pillow", "zeppelin"]}, {"objects": ["zeppelin"]}]
    path = tmp_path / "mine.jsonl"
    path.write_text("\n".join(map(json.dumps, scenes * 2)))
    mrr = {x.metric: x for x in read_test(path).measure(room_model()) if x.task == "T2 missing"}
    assert mrr["MRR, one removed"].n == 6  # three draws for both rooms that have known objects
    alone = tmp_path / "none.jsonl"
    alone.write_text(json.dumps(scenes[1]))
    assert read_test(alone).measure(room_model()) == []


def test_one_group_leaves_intervals_over_rooms(tmp_path):
    rooms = [replace(scene, group="home") for scene in generate_rooms(4, 3)]
    rows = read_test(room_file(tmp_path, rooms)).measure(room_model())
    assert any(row.task == "T2 missing" for row in rows)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("rooms.csv", "", r"rename the file to \*.jsonl"),
        ("rooms.jsonl", "", "rooms.jsonl: contains no scenes"),
        ("rooms.jsonl", '{"label": 1}', "line 1: objects: Field required"),
        ("rooms.jsonl", None, "no such file"),
    ],
)
def test_files_that_are_no_test(tmp_path, name, text, message):
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    with pytest.raises(DatasetError, match=message):
        read_test(path)
