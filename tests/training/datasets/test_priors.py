from __future__ import annotations

from pathlib import Path

import pytest

from training.datasets import DatasetError
from training.datasets.priors import (
    COLUMNS,
    MAX_LINE,
    SOURCE,
    Placing,
    read_placings,
    read_prior_scenes,
)

HEAD = "\t".join(COLUMNS)


def table(folder: Path, *rows: str, head: str = HEAD) -> Path:
    path = folder / "pairs.tsv"
    path.write_text("".join(f"{row}\n" for row in (head, *rows)))
    return path


def test_rows_become_scenes_of_two_objects(tmp_path: Path) -> None:
    path = table(
        tmp_path,
        "virtualhome_placing\tfood bread\ton-top\ttable\t1\tattic",
        "virtualhome_placing\tcup\tat\ttable\t1\t",
        "virtualhome_placing\tcup\tinside\tcabinet\t1\t",
        "ithor_receptacles\tcups\ton-top\tcup\t1\t",
        "ithor_receptacles\tbread\tbelow\ttable\t2\t",
    )
    scenes = read_prior_scenes(path)
    assert {scene.source for scene in scenes} == {SOURCE}
    assert [thing.label for thing in scenes[0].objects] == ["bread", "table"]
    assert [(scene.group, scene.relations) for scene in scenes] == [
        ("bread table", ((0, "on-top", 1),)),
        ("cup cabinet", ((0, "inside", 1),)),
        ("bread table", ((0, "below", 1),)),
    ]


def test_placings_are_rows_of_rooms_on_or_inside_a_receptacle(tmp_path: Path) -> None:
    """Votes of people are no training scenes."""
    path = table(
        tmp_path,
        "housekeep_votes\tcup\tinside\tcabinet\t3\tkitchen",
        "housekeep_votes\tcup\ton-top\tdesk\t5\tkitchen",
        "housekeep_votes\tcup\ton-top\ttable\t1\t",
        "housekeep_votes\tcup\tunder\ttable\t1\tkitchen",
    )
    assert read_placings(path) == [
        Placing("housekeep_votes", "cup", "cabinet", 3, "kitchen"),
        Placing("housekeep_votes", "cup", "desk", 5, "kitchen"),
    ]
    assert read_prior_scenes(path) == []


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("my_home\tcup\tinside\tcabinet\tmany\tkitchen", "line 2: count must be a whole number"),
        ("my_home\tcup\tinside\tcabinet\t-1\tkitchen", "not '-1'"),
        ("my_home\tcup\tinside\tcabinet\t1\t", "no row has a room and the relation on-top or"),
    ],
)
def test_tables_without_placings(tmp_path: Path, row: str, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        read_placings(table(tmp_path, row))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("nobody\tcup\ton-top\ttable\t1\t", "line 2: unknown source 'nobody'"),
        ("tidybot\tcup\ton-top\ttable\t1", "line 2: the row has 5 columns, not 6"),
        ("x" * MAX_LINE, f"line 2: the line is longer than {MAX_LINE} bytes"),
        ("\udcff", "line 2: is not UTF-8"),
    ],
)
def test_malformed_rows(tmp_path: Path, row: str, message: str) -> None:
    path = tmp_path / "pairs.tsv"
    path.write_bytes(f"{HEAD}\n{row}\n".encode("utf-8", "surrogateescape"))
    with pytest.raises(DatasetError, match=message):
        read_prior_scenes(path)


def test_files_that_are_no_table(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"none\.tsv\.gz: cannot be read"):
        read_prior_scenes(tmp_path / "none.tsv.gz")
    with pytest.raises(DatasetError, match="line 1: must name the columns source, subject"):
        read_prior_scenes(table(tmp_path, head="a\tb"))
