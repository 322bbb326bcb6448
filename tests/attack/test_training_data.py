"""Hostile training data: an error that names file and line, in little memory."""

from __future__ import annotations

import gzip
import tracemalloc
import zlib
from pathlib import Path

import pytest

from training.datasets import DatasetError, files, read_scenes
from training.datasets.jsonl import MAX_LINE
from training.datasets.priors import read_prior_scenes

SCENE = '{"scene_id": "a", "objects": []}\n'


def bomb(path: Path, megabytes: int) -> Path:
    """A second line that unpacks to so much."""
    packer = zlib.compressobj(9, wbits=31)
    blank = b" " * 2**20
    parts = [packer.compress(SCENE.encode())]
    parts += [packer.compress(blank) for _ in range(megabytes)]
    path.write_bytes(b"".join((*parts, packer.flush())))
    return path


def test_a_line_that_unpacks_to_gigabytes_is_not_unpacked(tmp_path: Path) -> None:
    """292 kB took 1.5 GB."""
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
def test_a_text_file_has_a_limit_after_decompression(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Short lines too: 1 GB of blank lines fits into a megabyte."""
    monkeypatch.setattr(files, "MAX_BYTES", 2**20)
    path = tmp_path / name
    content = b" " * 99 + b"\n"
    content *= 2**20 // len(content) + 1
    path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)
    assert refused(path)[0] == f"{path}: is larger than 1 MiB after decompression"


@pytest.mark.parametrize(
    "coordinate", ["9" * 400, "-" + "9" * 400, "9" * 400 + ".5", "1e400", "NaN", "Infinity"]
)
@pytest.mark.parametrize("field", ["position", "size"])
def test_a_coordinate_that_no_float_holds_is_an_error_of_its_line(
    tmp_path: Path, coordinate: str, field: str
) -> None:
    """400 digits ended the program with a traceback."""
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
