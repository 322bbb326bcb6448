from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from app.scene import ObjectClass, Vocabulary
from app.scene.relations import ABOVE, ON_TOP
from training.datasets import DatasetError, indoor_vocabulary
from training.datasets.priors import (
    COLUMNS,
    MAX_LINE,
    PERMISSIVE,
    PRIOR_SOURCES,
    Prior,
    read_priors,
)

VOCABULARY = Vocabulary(
    [ObjectClass("cup"), ObjectClass("table", ("desk",)), ObjectClass("bread")],
    ["kitchen", "living room"],
)
CUP, TABLE, BREAD = range(3)
HEAD = "\t".join(COLUMNS)


def table(folder: Path, *rows: str, head: str = HEAD) -> Path:
    path = folder / "pairs.tsv"
    path.write_text("".join(f"{row}\n" for row in (head, *rows)))
    return path


def test_rows_become_canonical_relations_of_classes(tmp_path: Path) -> None:
    path = table(
        tmp_path,
        "housekeep_votes\tcups\ton-top\tdesk\t5\tkitchen",
        "vg80k_partof_counts\ttable\tbelow\tcup\t2.5\t",
        "virtualhome_placing\tfood bread\ton-top\ttable\t1\tattic",
        "virtualhome_placing\tcup\tinside\ttable\t1\t",
        "tidybot\tgoblet\ton-top\ttable\t1\t",
        "tidybot\ttable\ton-top\tdesk\t1\ttelevision_room",
    )
    assert read_priors(path, VOCABULARY) == [
        Prior("housekeep_votes", ON_TOP, CUP, TABLE, 5.0, 0),
        Prior("vg80k_partof_counts", ABOVE, CUP, TABLE, 2.5, -1),
        Prior("virtualhome_placing", ON_TOP, BREAD, TABLE, 1.0, -1),
    ]
    (only,) = read_priors(path, VOCABULARY, sources={"housekeep_votes"})
    assert only.source == "housekeep_votes"


def test_share_alike_sources_must_be_asked_for(tmp_path: Path) -> None:
    path = table(
        tmp_path,
        "conceptnet_atlocation\tcup\ton-top\ttable\t1\t",
        "tidybot\tcup\ton-top\ttable\t1\t",
    )
    assert [row.source for row in read_priors(path, VOCABULARY)] == ["tidybot"]
    every = {source.licence for source in PRIOR_SOURCES.values()}
    assert len(read_priors(path, VOCABULARY, licences=every)) == 2
    assert read_priors(path, VOCABULARY, licences={"Apache-2.0"}) == []
    shared = {source.licence for source in PRIOR_SOURCES.values() if source.share_alike}
    assert shared == {"CC BY-SA 4.0"} == every - PERMISSIVE


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        ("tidybot\tcup\ton-top\ttable\t1", "line 2: has 5 columns, not 6"),
        ("nobody\tcup\ton-top\ttable\t1\t", "line 2: unknown source 'nobody'"),
        ("tidybot\tcup\ton-top\ttable\tmany\t", "line 2: the count must be a number from 0"),
        ("tidybot\tcup\ton-top\ttable\tnan\t", "line 2: the count must be a number from 0"),
        (f"tidybot\tcup\ton-top\ttable\t{'9' * 400}\t", "line 2: the count must be a number"),
        (f"tidybot\t{'x' * MAX_LINE}\ton-top\ttable\t1\t", "line 2: is longer than 4096 bytes"),
    ],
)
def test_malformed_rows(tmp_path: Path, row: str, problem: str) -> None:
    with pytest.raises(DatasetError, match=rf"pairs\.tsv, {problem}"):
        read_priors(table(tmp_path, row), VOCABULARY)


def test_malformed_files(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"none\.tsv\.gz: cannot be read"):
        read_priors(tmp_path / "none.tsv.gz", VOCABULARY)
    with pytest.raises(DatasetError, match="line 1: must name the columns source, subject"):
        read_priors(table(tmp_path, head="a\tb"), VOCABULARY)
    path = tmp_path / "bomb.tsv.gz"
    path.write_bytes(gzip.compress(HEAD.encode() + b"\n" + b" " * 2**20))
    with pytest.raises(DatasetError, match=r"bomb\.tsv\.gz, line 2: is longer"):
        read_priors(path, VOCABULARY)
    path.write_bytes(path.read_bytes()[:-12])
    with pytest.raises(DatasetError, match=r"bomb\.tsv\.gz"):
        read_priors(path, VOCABULARY)
    path = table(tmp_path)
    path.write_bytes(path.read_bytes() + b"\xff\n")
    with pytest.raises(DatasetError, match="line 2: not UTF-8"):
        read_priors(path, VOCABULARY)


def test_the_real_table(repository: Path) -> None:
    path = repository.parent / "shared" / "data" / "extra" / "placing_priors.tsv.gz"
    if not path.is_file():
        pytest.skip("the table of ../shared/data is not here")
    vocabulary = indoor_vocabulary()
    rows = read_priors(path, vocabulary)
    assert len(rows) > 4000
    assert all(row.subject != row.anchor for row in rows)
    assert sum(row.room >= 0 for row in rows) > 1000
    names = {(vocabulary.labels[r.subject], vocabulary.labels[r.anchor]) for r in rows}
    assert ("kettle", "stove") in names
