"""The command `fetch`: it says what belongs where, and tells what one has."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from tests.training.domain.scenes import scene
from training.cli import app
from training.config import load_config, shipped_configs
from training.datasets import read_scenes
from training.datasets.jsonl import write_jsonl
from training.datasets.origins import ORIGINS, WORDS, file_of
from training.datasets.records import AnnotatedObject, AnnotatedScene
from training.datasets.sources import SOURCES


def fetch(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, ["fetch", *map(str, arguments)], env={"COLUMNS": "80"})
    assert result.exit_code == code, result.output
    assert max(map(len, result.output.splitlines())) <= 160  # long lines are errors or commands
    return " ".join(result.output.split())


def test_every_source_of_a_shipped_model_is_described() -> None:
    for name in shipped_configs():
        config = load_config(name)
        wanted = {*config.data.sources, *([WORDS] if config.data.words else [])}
        text = fetch(name)
        for source in wanted:
            origin = ORIGINS[source]
            assert f"FOLDER/{origin.place}" in text
            assert origin.home.split(",")[0] in text
    assert set(ORIGINS) - {WORDS} <= set(SOURCES)


def test_files_are_found_missing_or_unreadable(tmp_path) -> None:
    (tmp_path / "extra").mkdir()
    write_jsonl([scene("a", "bed", "lamp"), scene("b", "cup")], file_of("3dssg", tmp_path))
    file_of("nr3d", tmp_path).write_bytes(b"not gzip")
    text = fetch("3dssg", "nr3d", "vrd", "--data", tmp_path, code=1)
    assert "3dssg 3dssg.jsonl.gz found 2" in text
    assert "nr3d extra/nr3d.jsonl.gz unreadable" in text
    assert f"{file_of('nr3d', tmp_path)}: cannot be read: Not a gzipped file" in text
    assert "vrd vrd.jsonl.gz missing" in text
    assert "`python -m training fetch 3dssg nr3d vrd` says" in text
    fetch("3dssg", "--data", tmp_path)
    assert "the folder does not exist" in fetch("--data", tmp_path / "nowhere", code=1)


@pytest.mark.parametrize("source", ["3dssg", "vrd", "nr3d"])
def test_what_a_reader_of_official_files_writes_keeps_its_relations(tmp_path, source) -> None:
    """The readers translate the predicates of a source already."""
    things = tuple(AnnotatedObject(str(k), label) for k, label in enumerate(("cup", "table")))
    read = AnnotatedScene("s", source, "g", None, things, relations=((0, "on-top", 1),))
    write_jsonl([read], tmp_path / "scenes.jsonl")
    assert read_scenes(tmp_path / "scenes.jsonl") == [read]
