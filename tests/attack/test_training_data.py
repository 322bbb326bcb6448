"""Hostile training data: an error that names file and line, in little memory."""

import gzip
import struct
import tracemalloc
import zlib
from pathlib import Path

import pytest

from training.datasets import DatasetError, files, read_scenes, sunrgbd_mat
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
