"""Hostile training data: an error that names file and line, in little memory."""

import gzip
import json
import os
import struct
import subprocess
import sys
import tracemalloc
import zlib
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from training.datasets import DatasetError, files, jsonl, read_scenes, sunrgbd_mat, tables
from training.datasets.inventories import read_inventory
from training.datasets.jsonl import MAX_LINE
from training.datasets.readers import read_prior_scenes

SCENE = '{"scene_id": "a", "objects": []}\n'


def bomb(path: Path, megabytes: int) -> Path:
    """A second line that unpacks to so much."""
    packer = zlib.compressobj(9, wbits=31)
    blank = b" " * 2**20
    parts = [packer.compress(SCENE.encode())]
    parts += [packer.compress(blank) for _ in range(megabytes)]
    path.write_bytes(b"".join((*parts, packer.flush())))
    return path


def test_a_compressed_line_has_a_limit(tmp_path: Path) -> None:
    path = bomb(tmp_path / "scenes.jsonl.gz", 300)
    assert path.stat().st_size < 320_000
    message, memory = refused(path)
    assert memory < 6 * MAX_LINE
    assert message.startswith(f"{path}, line 2: ")


def test_a_table_of_priors_has_the_same_limit(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="line "):
        read_prior_scenes(bomb(tmp_path / "priors.tsv.gz", 64))


def refused(path: Path) -> tuple[str, int]:
    """The one-line refusal of a file, and the memory that it took."""
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError) as caught:
            read_scenes(path)
        return str(caught.value), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", ["scenes.jsonl.gz", "instances.json"])
def test_text_files_are_limited(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MAX_BYTES", 2**20)
    path = tmp_path / name
    content = b" " * 99 + b"\n"
    content *= 2**20 // len(content) + 1
    path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)
    assert refused(path)[0] == f"{path}: is larger than 1 MiB after decompression"


def element(kind: int, body: bytes) -> bytes:
    return struct.pack("<II", kind, len(body)) + body + bytes(-len(body) % 8)


def array(kind: int, count: int, *parts: bytes) -> bytes:
    """A MATLAB array that announces so many entries."""
    header = element(6, struct.pack("<II", kind, 0)) + element(5, struct.pack("<ii", 1, count))
    return element(14, header + element(1, b"SUNRGBDMeta") + b"".join(parts))


FIELDS = struct.pack("<HHi", 5, 4, 8) + element(1, b"a".ljust(8, b"\0") + b"b".ljust(8, b"\0"))


def nested(depth: int) -> bytes:
    found = b""
    for _ in range(depth):
        found = array(1, 1, found)
    return found


@pytest.mark.parametrize("packed", [False, True], ids=["plain", "compressed"])
@pytest.mark.parametrize(
    ("variable", "problem"),
    [
        (lambda: array(4, 2**24, element(1, bytes(2**24))), "is larger than 16 MiB after"),
        (lambda: array(1, 2**25), "is larger than 16 MiB after"),  # 180 bytes took 4.1 GB
        (lambda: array(2, 2**23, FIELDS), "is larger than 16 MiB after"),
        (lambda: array(1, 1, array(2, 2**23, FIELDS)), "is larger than 16 MiB after"),
        (lambda: nested(2000), "the arrays are nested too deeply"),
        (lambda: b"\x0e\0\0\0\x08\0\0\0\x06\0\0\0\0\0\0\0", "is not a MATLAB 5 file"),
    ],
    ids=["text", "cells", "structs", "nested structs", "deep", "torn"],
)
def test_the_size_of_a_mat_file_is_limited(tmp_path, monkeypatch, variable, problem, packed):
    monkeypatch.setattr(sunrgbd_mat, "MAX_BYTES", 2**24)
    content = variable()
    if packed:
        content = zlib.compress(content)
        content = struct.pack("<II", 15, len(content)) + content
    path = tmp_path / "SUNRGBDMeta3DBB_v2.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + content)
    del content
    message, memory = refused(path)
    assert message.startswith(f"{path}: {problem}")
    assert memory < 3 * sunrgbd_mat.MAX_BYTES


def test_a_newer_mat_file_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "SUNRGBDMeta3DBB_v2.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM" + bytes(512))
    assert refused(path)[0] == (f"{path}: is not a MATLAB 5 file: its header names another version")


@pytest.mark.parametrize(
    "coordinate", ["9" * 400, "-" + "9" * 400, "9" * 400 + ".5", "1e400", "NaN", "Infinity"]
)
@pytest.mark.parametrize("field", ["position", "size"])
def test_coordinates_that_no_float_holds(tmp_path: Path, coordinate: str, field: str) -> None:
    path = tmp_path / "scenes.jsonl.gz"
    thing = f'{{"id": "a", "label": "bed", "{field}": [{coordinate}, 1, 1]}}'
    line = f'{{"scene_id": "b", "objects": [{thing}]}}\n'
    path.write_bytes(gzip.compress((SCENE + line).encode()))
    with pytest.raises(DatasetError) as caught:
        read_scenes(path)
    assert (caught.value.path, caught.value.where) == (path, "line 2")


def test_an_error_does_not_repeat_megabytes(tmp_path: Path) -> None:
    path = tmp_path / "scenes.jsonl"
    thing = '{"id": "a", "label": "bed", "position": [' + ", ".join(["1"] * 10**5) + "]}"
    path.write_text(f'{{"scene_id": "a", "objects": [{thing}]}}\n')
    with pytest.raises(DatasetError) as caught:
        read_scenes(path)
    assert len(str(caught.value)) < 1000


# ---------------------------------------------------------------------------- numbers and names


def scene_of(**fields: object) -> str:
    return json.dumps({"objects": ["bed"]} | fields) + "\n"


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ('{"objects":[' + "{}," * 10**6 + "{}]}", "objects: List should have at most 4096 items"),
        (scene_of(objects=["bed"] * 4097), "objects: List should have at most 4096 items"),
        (scene_of(relations=[["a", "left", "b"]] * 65537), "relations: List should have at most"),
        (scene_of(counts={str(n): 1 for n in range(4097)}), "counts: Dictionary should have at"),
        ('{"objects":' * 10**5, "Invalid JSON: recursion limit"),
        (scene_of(objects=["s" * 101]), "objects.0.label: String should have at most 100"),
        (scene_of(objects=["bed\x1b[2J"]), "objects.0.label: must be one line without control"),
        (scene_of(room_type="kit\u202echen"), "room_type: must be one line without control"),
        (scene_of(counts={"bed": 10**20}), "objects.0.count: Input should be less than"),
    ],
    ids=["empty", "objects", "relations", "counts", "deep", "long", "escape", "bidi", "number"],
)
def test_a_hostile_scene_is_refused(tmp_path: Path, line: str, problem: str) -> None:
    path = tmp_path / "scenes.jsonl"
    path.write_text(SCENE + line)
    message, memory = refused(path)
    assert message.startswith(f"{path}, line 2: {problem}")
    assert memory < 40 * len(line) + 2**20


def test_objects_of_one_label_take_linear_time(tmp_path: Path) -> None:
    path, calls = tmp_path / "scenes.jsonl", []
    for size in (1000, 2000):
        path.write_text(scene_of(objects=["bed"] * size))
        count = 0

        def trace(frame, event, _):
            nonlocal count
            if frame.f_code is not jsonl._objects.__code__:
                return None
            count += event == "line"
            return trace

        sys.settrace(trace)
        try:
            (scene,) = read_scenes(path)
        finally:
            sys.settrace(None)
        assert [thing.id for thing in scene.objects[:2]] == ["bed_1", "bed_2"]
        calls.append(count)
    assert 1000 < calls[1] <= 2.1 * calls[0]


def test_the_number_of_scenes_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jsonl, "MAX_SCENES", 10)
    path = tmp_path / "scenes.jsonl"
    path.write_text("\n" * 20 + scene_of() * 10)
    assert len(read_scenes(path)) == 10
    path.write_text(scene_of() * 11)
    assert refused(path)[0] == f"{path}: has more than 10 scenes"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("instances.json", '{"images":[' + "{}," * 10**6 + '{}],"categories":[],"annotations":[]}'),
        ("relationships.json", '{"scans":[' + "[]," * 10**6 + "[]]}"),
    ],
)
def test_a_file_of_a_million_faults_has_one_error(tmp_path: Path, name: str, content: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    message, memory = refused(path)
    assert len(message.removeprefix(str(path))) < 60
    assert memory < 2 * len(content) + 2**20


HEAD = "room_type,label\n"


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        ("kitchen,thing\n" * 1000, ": has more than 1000 lines"),
        (f"kitchen,{'s' * 101}\n", ", line 2, column label: has more than 100 characters"),
        ("kitchen,bed\x1b[2J\n", ", line 2, column label: must be one line without control"),
        ("kit\u202echen,bed\n", ", line 2, column room_type: must be one line without control"),
        ('kitchen,"bed\nlamp"\n', ", line 3, column label: must be one line without control"),
        ('kitchen,"' + "bed\n" * 50_000, ", line 2: is no row: field larger than"),
        (f"kitchen,{'s' * 5000}\n", ", line 2: the line is longer than 4096 bytes"),
    ],
    ids=["rows", "long", "escape", "bidi", "two lines", "open quote", "long line"],
)
def test_a_hostile_inventory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: str, problem: str
) -> None:
    monkeypatch.setattr(tables, "MAX_ROWS", 1000)
    path = tmp_path / "places.csv"
    path.write_text(HEAD + rows)
    with pytest.raises(DatasetError) as caught:
        read_inventory(path)
    assert str(caught.value).startswith(f"{path}{problem}")


@pytest.mark.parametrize("name", ["scenes.jsonl", "scenes.jsonl.gz", "instances.json"])
def test_a_pipe_is_refused_at_once(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    problem = "cannot be read: it is not a regular file"
    assert refused(tmp_path / name)[0] == f"{tmp_path / name}: {problem}"


def test_the_standard_input_may_be_a_pipe() -> None:
    program = (
        "from pathlib import Path; from training.datasets.jsonl import read_jsonl; "
        "print(len(read_jsonl(Path('/dev/stdin'))))"
    )
    done = subprocess.run(
        (sys.executable, "-c", program), input=scene_of() * 3, text=True, cwd=REPOSITORY,
        capture_output=True, check=True,
    )  # fmt: skip
    assert done.stdout == "3\n"
