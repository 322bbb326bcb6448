"""Placing priors: a table of pairs of things and their relation, without scenes.

A gzipped or plain table of tab-separated columns, with these names in the first line: ``source``,
``subject``, ``relation``, ``object``, ``count``, ``room`` (empty where any). Relations other than
the eight (``inside``, ``at``, ``next to``, ``nearby``) are left out, and so are pairs with a name
outside the vocabulary. ConceptNet's ``at`` tells a place, not a relation.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from app.scene import RELATIONS, Vocabulary, canonicalise, label_key
from training.datasets.lines import read_lines
from training.datasets.names import curated_names
from training.datasets.records import AnnotatedObject, AnnotatedScene, DatasetError

COLUMNS: Final = ("source", "subject", "relation", "object", "count", "room")

MAX_LINE: Final = 4096
MAX_ROWS: Final = 2_000_000

# Names of kinds that a source puts before a name: "food bread", "clothes skirt".
_KINDS: Final = ("food ", "clothes ")


@dataclass(frozen=True, slots=True)
class PriorSource:
    """Where rows of the table come from.

    Attributes:
        words: provenance and licence.
        licence: its identifier.
        share_alike: derived works must be shared under the same licence.
    """

    words: str
    licence: str
    share_alike: bool = False


PRIOR_SOURCES: Final[dict[str, PriorSource]] = {
    "virtualhome_placing": PriorSource(
        "VirtualHome (Puig et al., CVPR 2018): lists of where things are placed; MIT", "MIT"
    ),
    "ithor_receptacles": PriorSource(
        "AI2-THOR (Kolve et al., 2017): receptacles of things; Apache-2.0", "Apache-2.0"
    ),
    "conceptnet_atlocation": PriorSource(
        "ConceptNet 5 (Speer, Chin, Havasi, AAAI 2017): AtLocation; CC BY-SA 4.0",
        "CC BY-SA 4.0",
        share_alike=True,
    ),
    "housekeep_votes": PriorSource(
        "Housekeep (Kant et al., ECCV 2022): votes on where things are kept; MIT", "MIT"
    ),
    "vg80k_partof_counts": PriorSource(
        "Visual Genome (Krishna et al., IJCV 2017): counts of parts; CC BY 4.0", "CC BY 4.0"
    ),
    "tidybot": PriorSource(
        "TidyBot (Wu et al., Autonomous Robots 2023): where things are put away; MIT", "MIT"
    ),
}
SOURCE: Final = "placing_priors"
"""Name of the rows as scenes."""

PLACES: Final = frozenset({"virtualhome_placing", "ithor_receptacles", "tidybot"})
PERMISSIVE: Final = frozenset({"MIT", "Apache-2.0", "CC BY 4.0"})


@dataclass(frozen=True, slots=True)
class Prior:
    """One row: how often a source puts a class so to another class.

    Attributes:
        source: one of `PRIOR_SOURCES`.
        relation: index of the canonical relation.
        subject, anchor: class indices in its canonical direction.
        count: how often.
        room: index of the room type, -1 where any.
    """

    source: str
    relation: int
    subject: int
    anchor: int
    count: float
    room: int


def read_priors(
    path: Path,
    vocabulary: Vocabulary,
    *,
    sources: Collection[str] | None = None,
    licences: Collection[str] = PERMISSIVE,
) -> list[Prior]:
    """The rows of a table between two different classes of a vocabulary, in their order.

    Args:
        path: the table.
        vocabulary: the classes and room types.
        sources: the sources to read, by default all.
        licences: the licences to read; share-alike licences must be named.

    Raises:
        DatasetError: the file is missing, no such table, or too large.
    """
    found: list[Prior] = []
    for where, values in _rows(path):
        source, subject, relation, anchor, count, room = values
        if source not in PRIOR_SOURCES:
            raise DatasetError(path, where, f"unknown source {source!r}")
        times = _count(path, where, count)
        if sources is not None and source not in sources:
            continue
        if PRIOR_SOURCES[source].licence not in licences or relation not in RELATIONS:
            continue
        ends = _class(vocabulary, subject), _class(vocabulary, anchor)
        if ends[0] is None or ends[1] is None or ends[0] == ends[1]:
            continue
        index, first, second = canonicalise(ends[0], relation, ends[1])
        found.append(Prior(source, index, first, second, times, _room(vocabulary, room)))
    return found


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
        if source not in PRIOR_SOURCES:
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


def _count(path: Path, where: str, text: str) -> float:
    try:
        count = float(text)
    except ValueError:
        count = math.nan
    if not 0 <= count < math.inf:
        raise DatasetError(path, where, f"the count must be a number from 0, not {text[:40]!r}")
    return count


def _class(vocabulary: Vocabulary, label: str) -> int | None:
    if not label_key(label):
        return None
    index = vocabulary.index(label)
    for kind in _KINDS:
        if index is None and label.startswith(kind):
            index = vocabulary.index(label.removeprefix(kind))
    return index


def _room(vocabulary: Vocabulary, room: str) -> int:
    name = curated_names().canonical_room(room or None)
    index = None if name is None else vocabulary.room_index(name)
    return -1 if index is None else index
