"""Hostile files of scenes: refused in one line, in little memory, and without a wait."""

import io
import json
import os
import struct
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import Writer

from scene_client import MessageError, files, from_file, parsing, records, rooms_from_file
from tests.conftest import REPOSITORY

VALUES, RECORDS, BYTES = 4000, 500, 2**17


@pytest.fixture(autouse=True)
def limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parsing, "MAX_VALUES", VALUES)
    monkeypatch.setattr(records, "MAX_RECORDS", RECORDS)
    monkeypatch.setattr(files, "MAX_FILE", BYTES)


def refused(path: Path, read: Callable[[Path], object] = from_file) -> tuple[str, int]:
    """The refusal of a file without its name, and the memory that it took."""
    tracemalloc.start()
    try:
        with pytest.raises(MessageError) as caught:
            read(path)
        return str(caught.value).removeprefix(f"{path}: "), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


MANY_VALUES = {
    "lists.json": "[" + "[]," * 2000 + "[]]",
    "objects.json": '{"a":[' + '{"b":1},' * 2000 + "{}]}",
    "labels.json": '["' + '","'.join("a" * 4001) + '"]',
    "lines.jsonl": '{"objects": ["a"]}\n' + "[" + "[]," * 2000 + "[]]\n",
    "blank.csv": "label,x\n" + "\n" * 4000,
    "returns.csv": "label,x\n" + "\r" * 4000,
    "separators.txt": "a\n" + "\u2028" * 4000,
    "commas.txt": "a," * 4001,
    "words.txt": "0 .5 .5 .1 .1\n" * 900,
    "elements.xml": "<r>" + "<a/>" * 1000 + "</r>",
    "attributes.xml": "<r " + " ".join(f'a{n}="1"' for n in range(1001)) + "/>",
    "deep.xml": "<a>" * 1001,
    "fences.txt": "```\na\n```\n" * 400,
}
MANY_RECORDS = {
    "rows.csv": "label,score\n" + "a,1\n" * 501,
    "lines.txt": "a\n" * 501,
    "scenes.jsonl": '{"objects":["a","b"]}\n' * 501,
    "records.json": '{"found":[' + '{"label":"a","score":1},' * 500 + '{"label":"b","score":1}]}',
    "rooms.json": json.dumps({f"room {n}": ["bed"] for n in range(501)}),
}
FEW = {
    "rows.csv": "label,score\n" + "a,1\n" * 499,
    "objects.json": json.dumps([{"label": "a", "score": 1}] * 500),
    "labels.json": json.dumps(["a"] * 500),
}


@pytest.mark.parametrize("name", MANY_VALUES)
def test_a_file_with_many_values_is_refused_before_they_exist(name: str, tmp_path: Path) -> None:
    path, text = tmp_path / name, MANY_VALUES[name]
    path.write_text(text, "utf-8")
    if name == "lines.jsonl":
        path, text = Path(f"{path}:2"), text * 2
    message, memory = refused(path)
    assert "more than" in message
    assert message.endswith("values: cut out the scenes that you need")
    # The bytes and some copies of the text. A list of its values would take 200 kB more.
    assert memory < BYTES + 5 * len(text.encode()) + 2**15


@pytest.mark.parametrize("name", MANY_RECORDS)
def test_a_file_with_many_objects_is_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(MANY_RECORDS[name])
    expected = "it has more than 500 lines or objects: cut out the scenes that you need"
    assert refused(path)[0] == expected


@pytest.mark.parametrize("name", FEW)
def test_a_file_below_the_limits_is_read(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(FEW[name])
    assert from_file(tmp_path / name)["objects"]


# ---------------------------------------------------------------------------------- recordings


def recording(schema: str, *messages: bytes) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    coding = ("cdr", "ros2msg") if schema else ("json", "jsonschema")
    number = writer.register_schema("a/msg/A", coding[1], schema.encode() or b"{}")
    channel = writer.register_channel("/found", coding[0], number)
    for message in messages:
        writer.add_message(channel, 0, message, 0)
    writer.finish()
    return stream.getvalue()


TINY = "B[] found\n================\nMSG: a/B\nuint8 value\n"


def tiny(count: int) -> bytes:
    return struct.pack("<4sI", b"\0\1\0\0", count) + bytes(count)


def test_a_recording_with_many_messages_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "found.mcap"
    path.write_bytes(recording("", *[b'{"objects":["a"]}'] * 501))
    assert refused(path)[0].startswith("it has more than 500 lines or objects")


@pytest.mark.parametrize(
    ("schema", "message", "problem"),
    [
        ("", b"[" + b"[]," * 2000 + b"[]]", "it has more than 4000 values"),
        ("", b'{"a":' * 3000, "nesting is too deep"),
        (TINY, tiny(2**16), "this message has more than 65536 bytes"),
        (TINY, struct.pack("<4sI", b"\0\1\0\0", 2**32 - 1), "does not fit its schema"),
    ],
    ids=["values", "deep", "many tiny", "announced"],
)
def test_a_message_of_a_recording_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, schema: str, message: bytes, problem: str
) -> None:
    monkeypatch.setattr(files, "MAX_FILE", 2**20)
    monkeypatch.setattr(parsing, "MOST_MESSAGES", 2**21)
    monkeypatch.setattr(parsing, "MOST_MESSAGE", 2**16 if schema else 2**20)
    path = tmp_path / "found.mcap"
    path.write_bytes(recording(schema, message))
    text, memory = refused(path)
    assert problem in text
    assert memory < 8 * 2**20


# --------------------------------------------------------------------------------------- pipes


@pytest.mark.parametrize(
    "read",
    [from_file, rooms_from_file, lambda path: files.label_map_of(str(path))],
    ids=["scene", "rooms", "labels"],
)
def test_a_pipe_or_device_is_refused_at_once(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    path = tmp_path / "scene.json"
    os.mkfifo(path)
    assert refused(path, read)[0].endswith("it is not a regular file")
    assert refused(Path("/dev/zero"), read)[0].endswith("it is not a regular file")


@pytest.mark.parametrize("name", ["-", "/dev/stdin"])
def test_the_standard_input_may_be_a_slow_pipe(name: str) -> None:
    program = f"import scene_client; print(scene_client.from_file({name!r})['objects'])"
    with subprocess.Popen(
        (sys.executable, "-c", program),
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY,
    ) as process:  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        for part in ('["be', 'd"]'):
            process.stdin.write(part)
            process.stdin.flush()
        process.stdin.close()
        assert process.stdout.read() == "['bed']\n"
