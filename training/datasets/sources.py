"""The data sources: terms of use, predicates, and the meaning of relations that are not listed.

A listed relation holds. An unlisted relation is false ("off"), false only between neighbours ("off
for neighbours"), false only if the support of its subject is listed ("off for supported"), or
unobserved. docs/decisions/relations.md gives the reason for each source.

If on-top, inside or above is listed for a pair, all its unlisted relations are false in both
directions. (1 to 10 % of such pairs also have a listed left or front.) A relation that an annotator
marked as false is false. Neighbours are close by the rule of `app.scene.scene`; without poses,
they have at least one listed relation.

`vocabularies/sources.toml` describes the sources.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict
from pydantic.dataclasses import dataclass

from app.scene import CANONICAL, RELATIONS

Unlisted = Literal["off", "off for neighbours", "off for supported", "unobserved"]


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class Meaning:
    """The meaning of relations and objects that the scenes of a data source do not list."""

    on_top: Unlisted = "off"
    inside: Unlisted = "off"
    above: Unlisted = "off"
    lateral: Unlisted = "off"  # left and front
    # Object lists are nearly complete: in the training of objects, unlisted objects are absent.
    complete_objects: bool = True
    # Maximum total weight of a group of near-duplicates of all sources; None: 1 for each scene.
    scenes_per_group: float | None = None

    @property
    def unlisted(self) -> tuple[Unlisted, ...]:
        """Meaning of an unlisted relation, for each canonical relation in order."""
        stacked = {"on-top": self.on_top, "above": self.above, "inside": self.inside}
        return tuple(stacked.get(name, self.lateral) for name in CANONICAL)


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class Source:
    """A data source of the project."""

    terms: str  # origin and licence of the data, for the model card
    research_only: bool = False  # the licence excludes commercial use
    # None means `LISTS` for scenes with listed relations, and `BOXES` for other scenes.
    meaning: Meaning | None = None
    # Relations of predicates with other names. Other predicates are skipped; None: an error.
    predicates: Mapping[str, str] | None = None
    supports: tuple[str, ...] = ()  # predicates that state the support of their subject
    left_out: tuple[str, ...] = ()  # labels whose annotation is too incomplete or biased
    # Classes that annotators mostly call by a broader name, so they are unobserved if unlisted.
    coarse: tuple[str, ...] = ()
    # Annotators used free words: an unlisted class is absent, also outside a list of labels.
    open_vocabulary: bool = False
    counts_movables: bool = False  # only movable objects are counted, others occur once in a scene
    # A scene is one camera frame, which does not show how many objects are in the room.
    of_one_view: bool = False
    # Numbers of instances are the judgements of a writer, so statistics of counts leave them out.
    written: bool = False
    of_homes: bool = False  # a group has the rooms of one home
    # A scene lists nearly all things of a room. `/generate` is compared with such scenes.
    whole_rooms: bool = False


class _File(BaseModel):
    """The content of `vocabularies/sources.toml`."""

    camera_subjects: tuple[str, ...]
    meanings: dict[str, dict[str, Any]]
    sources: dict[str, dict[str, Any]]

    def meaning(self, like: str = "lists", **entries: Any) -> Meaning:
        """Return the named meaning, with other values of some entries."""
        return Meaning(**self.meanings[like] | entries)

    def source(self, entry: dict[str, Any]) -> Source:
        """Return the source of a table; `without_camera_subjects` leaves out people and animals."""
        own = self.meaning(**entry["meaning"]) if "meaning" in entry else None
        camera_subjects = self.camera_subjects if entry.get("without_camera_subjects") else ()
        left_out = (*camera_subjects, *entry.get("left_out", ()))
        others = {name: value for name, value in entry.items() if name != "without_camera_subjects"}
        return Source(**others | {"meaning": own, "left_out": left_out})


_FILE: Final = _File.model_validate(
    tomllib.loads((Path(__file__).parent / "vocabularies" / "sources.toml").read_text("utf-8"))
)

LISTS: Final = _FILE.meaning("lists")
"""Meaning for scenes of the user with listed relations: an unlisted relation is false."""

BOXES: Final = _FILE.meaning("boxes")
"""Meaning for relations derived from boxes. Without sizes, stacked objects show no relation."""

SOURCES: Final = {name: _FILE.source(entry) for name, entry in _FILE.sources.items()}
"""The data sources of the project by name."""

_UNKNOWN: Final = Source("", whole_rooms=True)
_OWN_INVENTORY: Final = replace(SOURCES["inventories"], terms="", left_out=())


def is_inventory(name: str) -> bool:
    """Return True for the inventory of the repository, and a user's table such as "ward.csv"."""
    return name == "inventories" or name.casefold().endswith(".csv")


def source_of(name: str) -> Source:
    """Return the data source of this name. Unknown sources have the default attributes."""
    return SOURCES.get(name, _OWN_INVENTORY if is_inventory(name) else _UNKNOWN)


def meaning_of(source: str, *, listed: bool = True) -> Meaning:
    """Return the meaning of unlisted relations and objects: that of the source, or by `listed`."""
    return source_of(source).meaning or (LISTS if listed else BOXES)


def relation_of(source: str, predicate: str) -> str | None:
    """Return the relation that a predicate of a data source means, or None if it means none."""
    if predicate in RELATIONS:
        return predicate
    if (predicates := source_of(source).predicates) is None:
        raise ValueError(f"unknown relation {predicate!r}: must be one of {', '.join(RELATIONS)}")
    return predicates.get(predicate)


def relations_of(
    source: str, triples: Iterable[tuple[int, str, int]]
) -> tuple[tuple[int, str, int], ...]:
    """Translate triples (subject, predicate, object) into distinct relations of the service."""
    relations = [(i, relation_of(source, predicate), j) for i, predicate, j in triples]
    # Some image annotators relate an object to itself.
    return tuple(dict.fromkeys((i, name, j) for i, name, j in relations if name and i != j))


def supported_subjects(source: str, triples: Iterable[tuple[int, str, int]]) -> tuple[int, ...]:
    """Return the sorted subjects of triples (subject, predicate, object) that state a support."""
    supports = source_of(source).supports
    return tuple(sorted({subject for subject, predicate, _ in triples if predicate in supports}))
