"""Read placing priors: tables of the usual relations between pairs of objects, without scenes.

The table has tab-separated columns and can be gzipped. Its first line contains the column names:
``source``, ``subject``, ``relation``, ``object``, ``count`` and ``room``. An empty ``room`` means
any room. Training skips relations that the service does not have, such as ``nearby``.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from app.scene import RELATIONS, label_key
from training.datasets.files import read_lines
from training.datasets.records import AnnotatedObject, AnnotatedScene, DatasetError

COLUMNS: Final = ("source", "subject", "relation", "object", "count", "room")

MAX_LINE: Final = 4096
MAX_ROWS: Final = 2_000_000

SOURCE: Final = "placing_priors"
"""Source name of all scenes that the reader makes from rows of the table."""

# Sources whose rows become training scenes: the places of VirtualHome and AI2-THOR.
_TRAINED: Final = frozenset({"virtualhome_placing", "ithor_receptacles"})

# Other accepted values of the column ``source``: places that people prefer, tables of locations, of
# votes and of part counts.
_SOURCES: Final = _TRAINED | {
    *("tidybot", "conceptnet_atlocation", "housekeep_votes", "vg80k_partof_counts")
}


def read_prior_scenes(path: Path) -> list[AnnotatedScene]:
    """Read each row of a list of places as a scene of two objects and their relation.

    Rows of other sources are skipped. All scenes have the source name `SOURCE`. Rows about the same
    pair of objects are in one group.
    """
    scenes = []
    for where, (source, subject, relation, anchor, _, _) in _rows(path):
        if source not in _SOURCES:
            raise DatasetError(path, where, f"unknown source {source!r}")
        # One of the sources has prefixes, for example in "food bread" and "clothes skirt".
        ends = subject, anchor
        names = [end.removeprefix("food ").removeprefix("clothes ").strip() for end in ends]
        keys = set(map(label_key, names)) - {""}
        if source in _TRAINED and relation in RELATIONS and len(keys) == 2:
            things = tuple(AnnotatedObject(str(index), name) for index, name in enumerate(names))
            listed = ((0, relation, 1),)
            scenes.append(AnnotatedScene(where, SOURCE, " ".join(names), None, things, listed))
    return scenes


def _rows(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the position in the file and the column values of each row."""
    for number, line in enumerate(read_lines(path, MAX_LINE), 1):
        where = f"line {number}"
        if number > MAX_ROWS:
            raise DatasetError(path, where, f"the file has more than {MAX_ROWS} lines")
        try:
            values = line.decode("utf-8").rstrip("\r\n").split("\t")
        except UnicodeDecodeError as error:
            raise DatasetError(path, where, f"is not UTF-8: {error}") from error
        if number == 1:
            if tuple(values) != COLUMNS:
                raise DatasetError(path, where, f"must name the columns {', '.join(COLUMNS)}")
        elif (count := len(values)) != len(COLUMNS):
            raise DatasetError(path, where, f"the row has {count} columns, not {len(COLUMNS)}")
        else:
            yield where, values
