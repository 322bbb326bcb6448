"""Read placing priors: a table that gives the usual relation of two objects, without scenes.

The table has tab-separated columns and may be gzipped. Its first line names the columns:
``source``, ``subject``, ``relation``, ``object``, ``count``, ``room`` (empty = any room).
The reader skips relations outside the eight of the service, such as ``inside`` and ``next to``.
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

# Prefixes that one source puts before a name: "food bread", "clothes skirt".
_KINDS: Final = ("food ", "clothes ")

SOURCE: Final = "placing_priors"
"""Source name of the scenes made from the rows."""

# Sources that list where objects are placed: VirtualHome, AI2-THOR, TidyBot.
PLACES: Final = frozenset({"virtualhome_placing", "ithor_receptacles", "tidybot"})
# The other sources give locations (ConceptNet's ``at``), votes, or counts of parts.
_SOURCES: Final = PLACES | {"conceptnet_atlocation", "housekeep_votes", "vg80k_partof_counts"}


def read_prior_scenes(path: Path, *, sources: Collection[str] = PLACES) -> list[AnnotatedScene]:
    """Read each row of a table as a scene of two objects and their relation.

    All scenes have the source name `SOURCE`. Rows about the same pair of objects share a group.

    Args:
        path: the table.
        sources: the sources to read; by default the sources that list placements.

    Raises:
        DatasetError: the file is missing, malformed or too large.
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
    """Iterate over the rows: position in the file, and the column values."""
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
