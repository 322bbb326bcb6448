"""Placing priors: a table of pairs of things and their relation, without scenes.

A gzipped or plain table of tab-separated columns, with these names in the first line: ``source``,
``subject``, ``relation``, ``object``, ``count``, ``room`` (empty where any). Relations other than
the eight (``inside``, ``at``, ``next to``, ``nearby``) are left out.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Final

from app.scene import RELATIONS, label_key
from training.datasets.files import read_lines
from training.datasets.records import AnnotatedObject, AnnotatedScene, DatasetError

COLUMNS: Final = ("source", "subject", "relation", "object", "count", "room")

MAX_LINE: Final = 4096
MAX_ROWS: Final = 2_000_000

# Names of kinds that a source puts before a name: "food bread", "clothes skirt".
_KINDS: Final = ("food ", "clothes ")

SOURCE: Final = "placing_priors"
"""Name of the rows as scenes."""

# Lists of where things are placed: VirtualHome, AI2-THOR, TidyBot.
PLACES: Final = frozenset({"virtualhome_placing", "ithor_receptacles", "tidybot"})
# ConceptNet's ``at`` tells a place, not a relation; the others are votes and counts of parts.
_SOURCES: Final = PLACES | {"conceptnet_atlocation", "housekeep_votes", "vg80k_partof_counts"}


def read_prior_scenes(path: Path, *, sources: Collection[str] = PLACES) -> list[AnnotatedScene]:
    """Each row of a table as a scene of two things and their relation, under one source name.

    Rows about one pair of things share a group.

    Args:
        path: the table.
        sources: the sources to read; by default lists of where things are placed.

    Raises:
        DatasetError: the file is missing, no such table, or too large.
    """
    scenes = []
    for where, (source, subject, relation, anchor, _, _) in _rows(path):
        if source not in _SOURCES:
            raise DatasetError(path, where, f"unknown source {source!r}")
        names = [_plain(subject), _plain(anchor)]
        if source not in sources or relation not in RELATIONS:
            continue
        if not all(map(label_key, names)) or label_key(names[0]) == label_key(names[1]):
            continue
        things = tuple(AnnotatedObject(str(place), name) for place, name in enumerate(names))
        group = " ".join(names)
        listed = ((0, relation, 1),)
        scenes.append(AnnotatedScene(where, SOURCE, group, None, things, listed))
    return scenes


def _plain(label: str) -> str:
    for kind in _KINDS:
        label = label.removeprefix(kind)
    return label.strip()


def _rows(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Where each row stands, and its values."""
    for number, line in enumerate(read_lines(path, MAX_LINE), 1):
        where = f"line {number}"
        if number > MAX_ROWS:
            raise DatasetError(path, where, f"has more than {MAX_ROWS} lines")
        try:
            values = line.decode("utf-8").rstrip("\r\n").split("\t")
        except UnicodeDecodeError as error:
            raise DatasetError(path, where, f"not UTF-8: {error}") from error
        if number == 1:
            if tuple(values) != COLUMNS:
                raise DatasetError(path, where, f"must name the columns {', '.join(COLUMNS)}")
        elif len(values) != len(COLUMNS):
            raise DatasetError(path, where, f"has {len(values)} columns, not {len(COLUMNS)}")
        else:
            yield where, values
