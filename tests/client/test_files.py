"""Scenes from files of detectors, tools and simulators, and the reasons for refusals."""

import json
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer
from typer.testing import CliRunner

import scene_client
from scene_client import parsing
from scene_client.command import app
from scene_client.files import MAX_FILE, is_file, scenes_of
from scene_client.ros_fields import MessageError
from scene_client.schemas import MissingRequest
from tests.chaos.corpus import places, replaced
from tests.client.scene_files import EXAMPLES, REFUSED


def rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: rounded(part) for name, part in value.items()}
    if isinstance(value, list):
        return [rounded(part) for part in value]
    return round(value, 6) + 0.0 if isinstance(value, float) else value


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_file_is_read(name: str, tmp_path: Path) -> None:
    example = EXAMPLES[name]
    path = tmp_path / name
    path.write_text(example.text, "utf-8")
    fields = scene_client.from_file(path, example.labels, scene=example.scene)
    assert rounded(dict(fields)) == rounded(example.request)
    assert [note.reason for note in fields.notes] == [*example.notes]
    MissingRequest(**fields)
    named = f"{path}:{example.scene}" if example.scene else str(path)
    assert scene_client.from_file(named, example.labels) == fields


@pytest.mark.parametrize("name", REFUSED)
def test_a_file_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    content, words = REFUSED[name]
    path = tmp_path / name
    path.write_text(content, "utf-8")
    with pytest.raises(MessageError) as refused:
        scene_client.from_file(path)
    assert words in str(refused.value)
    assert str(path) in str(refused.value)
    done = CliRunner().invoke(app, ["missing", str(path), "--url", "http://127.0.0.1:9"])
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr == f"{refused.value}\n"
    line = str(refused.value).replace(str(path), "")
    assert "\n" not in line
    assert len(line) <= 300
    assert "Expecting" not in line


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"PK\x03\x04\0", "is compressed"),
        (b"\x1f\x8b\0", "is compressed"),
        (b"bed\xff", "no text in UTF-8"),
        (b"\x89PNG\r\n\x1a\n\0", "an image"),
        (b"#ROSBAG V2.0\n", "ROS 1"),
        (b"\x89MCAP0\r\n", "ends too early"),
        (None, "no such file"),
    ],
)
def test_other_contents_are_refused(tmp_path: Path, content: bytes | None, words: str) -> None:
    path = tmp_path / "scene.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(MessageError, match=words):
        scene_client.from_file(path)


def test_a_file_above_the_limit_is_refused_without_reading_it_whole(tmp_path: Path) -> None:
    path = tmp_path / "large.json"
    with path.open("wb") as file:
        file.truncate(MAX_FILE + 1)  # takes no space on the disk
    with pytest.raises(MessageError, match="too large"):
        scene_client.from_file(path)


WRONG = (b"null", b'""', b"{}", b"1e300", b'[{"x": [1]}, 2]')


def corrupted(wrong: Iterable[bytes]) -> list[tuple[str, str]]:
    """Every example in JSON with wrong values at every place, and each text cut off."""
    made = []
    for name, example in EXAMPLES.items():
        made += [(name, example.text[: len(example.text) * part // 7]) for part in range(7)]
        if name.endswith(".json") and len(example.text) < 10_000 and "NaN" not in example.text:
            value = json.loads(example.text)
            made += [
                (name, replaced(value, place, one).decode())
                for place in places(value)
                for one in wrong
            ]
    return made


@pytest.mark.slow
def test_wrong_values_are_left_out_or_refused(tmp_path: Path) -> None:
    for name, text in corrupted(WRONG):
        path = tmp_path / name
        path.write_text(text, "utf-8")
        with suppress(MessageError):
            fields = scene_client.from_file(path, EXAMPLES[name].labels)
            assert isinstance(fields["objects"], list)
            assert len(fields["objects"]) <= 256


@pytest.mark.parametrize(
    ("argument", "expected"),
    [
        ("sofa/couch/lounge", False), ("a.json", True), ("a.jsonl:3", True), ("a.xml:0", True),
        ("a.yaml", True), ("./a", True), ("-", True),
        ("Bed|-01.0|+00.0", False), ("mug, cup", False),
    ]
)  # fmt: skip
def test_labels_are_not_files(argument: str, expected: bool) -> None:
    assert is_file(argument) is expected


NAMES = {
    "names.yaml": "path: x\nnames:\n  0: lamp\n  1: 'bed'\n",
    "list.yaml": "nc: 2\nnames: ['lamp', \"bed\"]\n",
    "block.yaml": "names:\n- lamp\n- bed\n",
    "names.txt": "lamp\nbed\n",
    "list.json": '["lamp", "bed"]',
    "object.json": '{"1": "bed", "0": "lamp"}',
    "coco.json": '{"categories": [{"id": 0, "name": "lamp"}, {"id": 1, "name": "bed"}]}',
    "bom.txt": "\ufeff# classes\nlamp\nbed\n",
    "colon.txt": "0: lamp\n1: bed  # where one sleeps\n",
    "table.csv": "0,lamp\n1,bed\n",
    "comments.yaml": "names:  # of the data\n  0: lamp  # on\n  1: bed\n\ndownload: |\n  - x\n",
    "lines.yaml": "names: ['lamp',\n  'bed']\nroboflow:\n  tags:\n  - a\n",
    "node.yaml": "/detector:\n  ros__parameters:\n    rate: 3\n    class_names: [lamp, bed]\n",
    "map.pbtxt": 'item {\n id: 0\n name: "/m"\n display_name: "lamp"\n}\nitem {id: 1 name: "bed"}',
    "config.json": '{"id2label": {"0": "lamp", "1": "bed"}, "model_type": "detr"}',
    "ids.json": '{"label2id": {"lamp": 0, "bed": 1}}',
}


@pytest.mark.parametrize("name", NAMES)
def test_the_names_of_class_ids_come_from_a_file(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(NAMES[name])
    (tmp_path / "yolo.txt").write_text("1 0.5 0.5 0.2 0.2\n0 0.2 0.2 0.1 0.1\n")
    fields = scene_client.from_file(tmp_path / "yolo.txt", str(tmp_path / name))
    assert [thing["label"] for thing in fields["objects"]] == ["bed", "lamp"]


def test_the_command_prints_few_notes(url: str, tmp_path: Path) -> None:
    path = tmp_path / "thousands.json"
    seen = [{"category_id": number, "score": 0.9} for number in (62, *[12] * 40)]
    path.write_text(json.dumps(seen))
    line = ["outliers", str(path), "--label-map", "coco91", "--url", url]
    done = CliRunner().invoke(app, line)
    assert done.exit_code == 0, done.stderr
    notes = [text for text in done.stderr.splitlines() if text.startswith(str(path))]
    assert len(notes) == 11
    assert notes[-1].endswith("31 more notes of this kind")
    path.write_text(json.dumps([{"category_id": 12, "bbox": [1, 2, 3, 4]}]))
    done = CliRunner().invoke(app, line)
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr == f"{path} has no object for a request: class '12' has no label\n"


def recorded(path: Path, messages: list[tuple[str, str, dict[str, Any]]]) -> None:
    """Write messages (topic, schema, message) in JSON to a recording."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = {
            topic: writer.register_channel(topic, "json", writer.register_schema(kind, "", b""))
            for topic, kind, _ in messages
        }
        for time, (topic, _, message) in enumerate(messages):
            writer.add_message(channels[topic], time, json.dumps(message).encode(), time)
        writer.finish()


def test_a_recording_has_a_scene_for_each_message(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    entity = json.loads(EXAMPLES["foxglove.json"].text)
    transform = ("/tf", "foxglove.FrameTransform", {"translation": {"x": 1}})
    recorded(path, [transform, ("/seen", "foxglove.SceneUpdate", entity), transform])
    fields = scene_client.from_file(path)
    assert rounded(dict(fields)) == EXAMPLES["foxglove.json"].request
    depth = json.loads(EXAMPLES["detection3d.json"].text)
    recorded(path, [("/a", "x", entity), ("/b", "y", depth), ("/b", "y", depth)])
    with pytest.raises(MessageError, match=r"3 scenes \(/a:1, /b:1, /b:2\)"):
        scene_client.from_file(path)
    assert scene_client.from_file(f"{path}:/b:2")["objects"][0]["label"] == "rug"
    recorded(path, [transform])
    with pytest.raises(MessageError, match="without detections; its topics are /tf"):
        scene_client.from_file(path)


def test_a_recording_with_a_huge_chunk_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "bag.mcap"
    recorded(path, [("/a", "x", {"text": "x" * 10_000})])
    assert path.stat().st_size < 2000
    monkeypatch.setattr(parsing, "MOST_MESSAGES", 5000)
    with pytest.raises(MessageError, match="more than 5000 bytes"):
        scene_client.from_file(path)


@pytest.mark.parametrize(("name", "package"), [("echo.yaml", "yaml"), ("a.mcap", "mcap")])
def test_a_missing_package_is_named_with_the_command(
    name: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded(tmp_path / "a.mcap", [])
    (tmp_path / "echo.yaml").write_text(EXAMPLES["echo.yaml"].text)
    for module in [one for one in sys.modules if one.partition(".")[0] == package]:
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setitem(sys.modules, f"{package}.stream_reader", None)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MessageError, match=f"the package {package}: pip install 'scene-client"):
        scene_client.from_file(tmp_path / name)


def test_an_existing_file_is_a_file_whatever_its_name(tmp_path: Path) -> None:
    path = tmp_path / "seen.det"
    path.write_text(EXAMPLES["hf_batch.json"].text)
    assert is_file(str(path))
    assert is_file(f"{path}:2")
    assert scene_client.from_file(f"{path}:2")["objects"][0]["label"] == "bed"


def test_a_text_may_be_in_utf_16(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("label;x;y;z\nStuhl;1,5;2,0;0,4\n", "utf-16")
    (thing,) = scene_client.from_file(path)["objects"]
    assert (thing["label"], thing["position"]) == ("Stuhl", {"x": 1.5, "y": 2.0, "z": 0.4})


def test_a_yaml_text_has_a_scene_for_each_document(tmp_path: Path) -> None:
    path = tmp_path / "echo.yaml"
    path.write_text(EXAMPLES["echo.yaml"].text * 2)
    assert len(scenes_of(path.read_bytes())) == 2
    assert rounded(dict(scene_client.from_file(f"{path}:2"))) == EXAMPLES["echo.yaml"].request


def test_a_message_that_does_not_fit_its_schema_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("a/msg/B", "ros2msg", b"string[] detections")
        channel = writer.register_channel("/a", "cdr", schema)
        writer.add_message(channel, 0, b"\0\1\0\0\xff\xff\xff\xff", 0)
        writer.finish()
    with pytest.raises(MessageError, match=r"without detections|does not fit"):
        scene_client.from_file(path)
