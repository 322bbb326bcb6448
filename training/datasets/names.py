"""Hand-curated names: synonyms of object classes and room types, and labels to exclude."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from app.scene import head_of, label_key

NAMES_FILE = Path(__file__).resolve().parent / "vocabularies" / "names.toml"


@dataclass(frozen=True)
class Names:
    """The content of `vocabularies/names.toml`. Each attribute is a table or list of the file.

    Attributes:
        base, household: common classes, and rare household objects. Every indoor vocabulary
            contains them.
        structure: classes such as walls. The service accepts these classes in requests but never
            proposes them.
        not_objects: labels that never become a class.
        surroundings, outdoor: outdoor structures such as buildings, and outdoor objects. Indoor
            vocabularies exclude them.
        anywhere: classes whose objects belong in every room, such as pets and bags.
        aliases: maps each class to its other names.
        kinds: maps each class to more specific names. If a vocabulary has a class for the specific
            name, the broader class is its parent. Otherwise the name can become an alias.
        rooms: maps each room type to its other names. The key "" lists names without a room type.
    """

    base: tuple[str, ...] = ()
    household: tuple[str, ...] = ()
    structure: tuple[str, ...] = ()
    not_objects: tuple[str, ...] = ()
    surroundings: tuple[str, ...] = ()
    outdoor: tuple[str, ...] = ()
    anywhere: tuple[str, ...] = ()
    aliases: dict[str, tuple[str, ...]] = field(default_factory=dict)
    kinds: dict[str, tuple[str, ...]] = field(default_factory=dict)
    rooms: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        tables = {"aliases": self.aliases, "kinds": self.kinds, "rooms": self.rooms}
        for title, table in tables.items():
            owner: dict[str, str] = {}
            for name, others in table.items():
                # A kind can have kinds of its own.
                for other in others if title == "kinds" else (name, *others):
                    if other and owner.setdefault(label_key(other), name) != name:
                        first = owner[label_key(other)]
                        raise ValueError(f"{title}: {other!r} names both {first!r} and {name!r}")
        for name in (*self.base, *self.household):
            if (other := self.canonical(name)) != name:
                raise ValueError(
                    f"the base class {name!r} is an alias of {other!r}: remove it from `base`"
                )
        kinds = {"kinds": [kind for name, kinds in self.kinds.items() for kind in (name, *kinds)]}
        for title, labels in (kinds | {"anywhere": self.anywhere}).items():
            for label in labels:
                if (other := self.canonical(label)) != label:
                    raise ValueError(f"{title}: {label!r} is an alias of {other!r}")

    def canonical(self, label: str) -> str:
        """Return the curated name of a label, or the label in lower case with single spaces."""
        if (name := self._by_key.get(label_key(label))) is not None:
            return name
        if (head := head_of(label)) is not None:
            return self.canonical(head)
        return _plain(label)

    def canonical_room(self, room: str | None) -> str | None:
        """Return the canonical spelling of a room type, or None if the name means no room type."""
        if room is None:
            return None
        name = self._rooms_by_key.get(label_key(room))
        return (_plain(room) if name is None else name) or None

    @cached_property
    def broader(self) -> dict[str, str]:
        """The broader class of each kind."""
        return {kind: name for name, kinds in self.kinds.items() for kind in kinds}

    @cached_property
    def _by_key(self) -> dict[str, str]:
        keys = _by_any_name(self.aliases)
        for name in (*self.base, *self.household, *self.structure, *self.surroundings):
            keys.setdefault(label_key(name), name)
        return keys

    @cached_property
    def _rooms_by_key(self) -> dict[str, str]:
        return _by_any_name(self.rooms)


def _plain(name: str) -> str:
    return " ".join(name.casefold().replace("_", " ").split())


def _by_any_name(table: dict[str, tuple[str, ...]]) -> dict[str, str]:
    """Map the key of each name in a table, except "", to the name whose entry contains it."""
    return {
        label_key(other): name
        for name, others in table.items()
        for other in (name, *others)
        if other
    }


@cache
def curated_names() -> Names:
    """Read the curated names of `vocabularies/names.toml`.

    Raises:
        ValueError: the file gives two meanings to one name.
    """
    values: dict[str, Any] = tomllib.loads(NAMES_FILE.read_text(encoding="utf-8"))
    tables: dict[str, Any] = {
        name: {key: tuple(others) for key, others in entry.items()}
        if isinstance(entry, dict)
        else tuple(entry)
        for name, entry in values.items()
    }
    return Names(**tables)
