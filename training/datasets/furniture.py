"""What the room generator knows of rooms: `vocabularies/rooms.toml`, read."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

# Extents in metres: along the wall (or across the front), away from it, and upwards.
Size = tuple[float, float, float]
Where = Literal["wall", "centre", "hung", "ceiling"]
Side = Literal["left", "right", "front", "around"]


@dataclass(frozen=True, slots=True)
class Small:
    """Something that lies or stands on a piece of furniture.

    Attributes:
        label: what it is.
        size: its mean extents.
        chance: probability that each of ``most`` tries puts one there.
        most: the most of them there can be.
    """

    label: str
    size: Size
    chance: float
    most: int = 1


@dataclass(frozen=True, slots=True)
class Beside:
    """A piece that belongs to another one: a chair in front of a desk, a nightstand left of a bed.

    Attributes:
        piece: what stands there, with what it carries; its own ``chance`` counts for each place.
        side: where, seen from the wall the other piece stands at; ``around`` = on all four sides.
    """

    piece: Piece
    side: Side


@dataclass(frozen=True, slots=True)
class Piece:
    """A piece of furniture.

    Attributes:
        label: what it is.
        size: its mean extents.
        chance: probability that each of ``most`` tries puts one into the room.
        where: at a wall, in the centre, hung on a wall or under the ceiling.
        most: the most of them there can be.
        carries: what is on it.
        beside: what stands by it.
    """

    label: str
    size: Size
    chance: float = 1.0
    where: Where = "wall"
    most: int = 1
    carries: tuple[Small, ...] = ()
    beside: tuple[Beside, ...] = ()


Rooms = Mapping[str, tuple[Piece, ...]]
"""What each type of room may hold."""


class _Tables:
    """The rooms of each domain; entries are tables, or names of tables read before."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.smalls: dict[str, Small] = {}
        self.pieces: dict[str, Piece] = {}
        for name, entry in values["small"].items():
            self.smalls[name] = self._small(entry)
        for name, entry in values["piece"].items():
            self.pieces[name] = self._piece(entry)
        self.rooms: dict[str, Rooms] = {
            domain: {room: tuple(map(self._piece, entries)) for room, entries in rooms.items()}
            for domain, rooms in values["rooms"].items()
        }

    def _small(self, entry: Any) -> Small:
        if isinstance(entry, str):
            return self.smalls[entry]
        return Small(**entry | {"size": tuple(entry["size"])})

    def _piece(self, entry: Any) -> Piece:
        if isinstance(entry, str):
            return self.pieces[entry]
        beside = (Beside(self._piece(e["piece"]), e["side"]) for e in entry.get("beside", ()))
        parts = {
            "size": tuple(entry["size"]),
            "carries": tuple(map(self._small, entry.get("carries", ()))),
            "beside": tuple(beside),
        }
        return Piece(**entry | parts)


_FILE = Path(__file__).resolve().parent.parent / "vocabularies" / "rooms.toml"
DOMAINS: Final = _Tables(tomllib.loads(_FILE.read_text(encoding="utf-8"))).rooms
"""``homes`` and ``workplaces``: laboratories, workshops and storerooms."""

ROOMS: Final = DOMAINS["homes"]
WORKPLACES: Final = DOMAINS["workplaces"]
