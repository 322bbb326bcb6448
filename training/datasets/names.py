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
    """The content of `vocabularies/names.toml`."""

    base: tuple[str, ...] = ()  # common classes, in every indoor vocabulary
    household: tuple[str, ...] = ()  # rare household objects, in every indoor vocabulary
    structure: tuple[str, ...] = ()  # classes such as walls, which the service never proposes
    not_objects: tuple[str, ...] = ()  # labels that never become a class
    surroundings: tuple[str, ...] = ()  # outdoor structures such as buildings
    outdoor: tuple[str, ...] = ()  # outdoor objects
    anywhere: tuple[str, ...] = ()  # classes that belong in every room, such as pets and bags
    aliases: dict[str, tuple[str, ...]] = field(default_factory=dict)  # other names of each class
    # More specific names of each class. If a vocabulary has a class for the specific name, the
    # broader class is its parent. Otherwise the name can become an alias.
    kinds: dict[str, tuple[str, ...]] = field(default_factory=dict)
    # Other names of each room type. The key "" lists names without a room type.
    rooms: dict[str, tuple[str, ...]] = field(default_factory=dict)

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
        names = (*self.base, *self.household, *self.structure, *self.surroundings)
        return {label_key(name): name for name in names} | _by_any_name(self.aliases)

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
    """Read the curated names of `vocabularies/names.toml`."""

    def frozen(entry: Any) -> Any:
        table = isinstance(entry, dict)
        return {key: tuple(x) for key, x in entry.items()} if table else tuple(entry)

    values = tomllib.loads(NAMES_FILE.read_text(encoding="utf-8"))
    return Names(**{name: frozen(entry) for name, entry in values.items()})
