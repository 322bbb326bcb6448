"""What the room generator knows of rooms: which furniture stands where, and what lies on it.

The figures are plain judgement, not measurements of any data set: enough for scenes in which room
types, objects and relations hang together.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

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


_BOOKS = Small("book", (0.15, 0.22, 0.03), 0.5, most=3)
_CUP = Small("cup", (0.09, 0.09, 0.10), 0.4, most=2)
_PLANT = Small("plant", (0.18, 0.18, 0.30), 0.3)
_VASE = Small("vase", (0.14, 0.14, 0.28), 0.3)
_PHONE = Small("cell phone", (0.07, 0.14, 0.01), 0.3)
_REMOTE = Small("remote control", (0.05, 0.17, 0.02), 0.6)
_LAMP = Small("lamp", (0.25, 0.25, 0.45), 0.7)
_MONITOR = Small("monitor", (0.50, 0.15, 0.40), 0.8, most=2)
_KEYBOARD = Small("keyboard", (0.42, 0.14, 0.03), 0.8)
_MOUSE = Small("mouse", (0.06, 0.10, 0.04), 0.7)
_LAPTOP = Small("laptop", (0.34, 0.24, 0.25), 0.4)

_CHAIR = Piece("chair", (0.45, 0.45, 0.90))
_NIGHTSTAND = Piece(
    "nightstand",
    (0.45, 0.40, 0.55),
    chance=0.8,
    carries=(
        _LAMP,
        Small("alarm clock", (0.12, 0.08, 0.10), 0.5),
        _BOOKS,
        _PHONE,
    ),
)
_DESK = Piece(
    "desk",
    (1.40, 0.70, 0.75),
    carries=(
        _MONITOR,
        _KEYBOARD,
        _MOUSE,
        _LAPTOP,
        Small("desk lamp", (0.15, 0.15, 0.45), 0.4),
        Small("pen", (0.01, 0.14, 0.01), 0.4, most=2),
        _BOOKS,
        _CUP,
    ),
    beside=(Beside(Piece("chair", (0.50, 0.50, 0.95), 0.95), "front"),),
)
_BOOKSHELF = Piece("bookshelf", (0.90, 0.32, 1.80), 0.5, carries=(_VASE, _PLANT))
_WINDOW = Piece("window", (1.20, 0.10, 1.20), 0.8, "hung")
_CURTAIN = Piece("curtain", (1.60, 0.12, 1.90), 0.5, "hung")
_PICTURE = Piece("picture", (0.60, 0.04, 0.45), 0.5, "hung", most=2)
_DOOR = Piece("door", (0.90, 0.06, 2.05), 0.7)
_BIN = Piece("garbage bin", (0.28, 0.28, 0.35), 0.5)
_FLOOR_PLANT = Piece("plant", (0.40, 0.40, 1.10), 0.35)
_CEILING_LAMP = Piece("lamp", (0.40, 0.40, 0.20), 0.5, "ceiling")

Rooms = Mapping[str, tuple[Piece, ...]]

ROOMS: Final[Rooms] = {
    "bedroom": (
        Piece(
            "bed",
            (1.60, 2.05, 0.55),
            carries=(
                Small("pillow", (0.60, 0.40, 0.15), 0.85, most=2),
                Small("blanket", (1.10, 0.80, 0.10), 0.6),
                Small("teddy bear", (0.20, 0.18, 0.30), 0.15),
            ),
            beside=(Beside(_NIGHTSTAND, "left"), Beside(_NIGHTSTAND, "right")),
        ),
        Piece("wardrobe", (1.60, 0.60, 2.10), 0.7),
        Piece(
            "dresser",
            (1.00, 0.50, 0.85),
            0.5,
            carries=(
                Small("jewelry box", (0.20, 0.15, 0.12), 0.3),
                Small("tv", (0.80, 0.12, 0.50), 0.3),
                _VASE,
            ),
        ),
        Piece("mirror", (0.50, 0.05, 1.20), 0.4, "hung"),
        _WINDOW,
        _CURTAIN,
        _PICTURE,
        _DOOR,
        _CEILING_LAMP,
    ),
    "office": (
        _DESK,
        Piece(_DESK.label, _DESK.size, 0.6, carries=_DESK.carries, beside=_DESK.beside),
        _BOOKSHELF,
        Piece("filing cabinet", (0.45, 0.60, 1.00), 0.6, carries=(_PLANT,)),
        Piece(
            "table",
            (0.80, 0.50, 0.70),
            0.4,
            carries=(
                Small("printer", (0.45, 0.40, 0.28), 0.9),
                Small("paper", (0.21, 0.3, 0.02), 0.7),
            ),
        ),
        Piece("whiteboard", (1.50, 0.05, 1.00), 0.5, "hung"),
        _WINDOW,
        _DOOR,
        _BIN,
        _FLOOR_PLANT,
    ),
    "kitchen": (
        Piece(
            "counter",
            (1.80, 0.60, 0.90),
            most=2,
            chance=0.9,
            carries=(
                Small("microwave", (0.48, 0.36, 0.28), 0.5),
                Small("kettle", (0.18, 0.18, 0.24), 0.6),
                Small("toaster", (0.28, 0.18, 0.20), 0.5),
                Small("coffee machine", (0.22, 0.30, 0.35), 0.4),
                Small("knife", (0.03, 0.25, 0.02), 0.4),
                Small("plate", (0.24, 0.24, 0.03), 0.4, most=2),
                _CUP,
                Small("bottle", (0.08, 0.08, 0.28), 0.4, most=2),
                Small("fruit", (0.09, 0.09, 0.08), 0.3),
            ),
        ),
        Piece("fridge", (0.60, 0.65, 1.75), 0.95),
        Piece(
            "stove",
            (0.60, 0.60, 0.90),
            0.9,
            carries=(
                Small("pot", (0.24, 0.24, 0.18), 0.5, most=2),
                Small("pan", (0.28, 0.28, 0.06), 0.5),
            ),
        ),
        Piece("dishwasher", (0.60, 0.60, 0.85), 0.5),
        Piece("sink", (0.60, 0.55, 0.92), 0.9, carries=(Small("sponge", (0.08, 0.1, 0.04), 0.5),)),
        Piece("cabinet", (1.20, 0.35, 0.70), 0.8, "hung", most=2),
        Piece(
            "table",
            (1.10, 0.80, 0.75),
            0.4,
            "centre",
            carries=(_CUP, Small("bowl", (0.20, 0.20, 0.09), 0.4)),
            beside=(Beside(Piece("chair", _CHAIR.size, 0.6), "around"),),
        ),
        _WINDOW,
        _BIN,
        _DOOR,
    ),
    "bathroom": (
        Piece(
            "toilet",
            (0.40, 0.70, 0.75),
            carries=(Small("toilet paper", (0.11, 0.11, 0.10), 0.4),),
            beside=(Beside(Piece("toilet brush", (0.12, 0.12, 0.38), 0.5), "left"),),
        ),
        Piece(
            "sink",
            (0.60, 0.48, 0.88),
            carries=(
                Small("soap", (0.08, 0.06, 0.03), 0.6),
                Small("toothbrush", (0.02, 0.18, 0.02), 0.5, most=2),
                Small("toothpaste", (0.05, 0.16, 0.04), 0.4),
                Small("soap dispenser", (0.07, 0.07, 0.18), 0.3),
            ),
        ),
        Piece(
            "bathtub", (1.65, 0.75, 0.58), 0.6, carries=(Small("shampoo", (0.06, 0.06, 0.2), 0.5),)
        ),
        Piece("washing machine", (0.60, 0.60, 0.85), 0.4),
        Piece("mirror", (0.60, 0.04, 0.80), 0.8, "hung"),
        Piece("towel", (0.50, 0.08, 0.70), 0.7, "hung", most=2),
        Piece("laundry basket", (0.42, 0.42, 0.60), 0.4),
        Piece("garbage bin", (0.22, 0.22, 0.28), 0.5),
        _DOOR,
    ),
    "living room": (
        Piece(
            "sofa",
            (2.00, 0.90, 0.80),
            chance=0.95,
            carries=(Small("cushion", (0.40, 0.16, 0.38), 0.6, most=3),),
            beside=(
                Beside(
                    Piece(
                        "coffee table",
                        (1.10, 0.60, 0.45),
                        0.85,
                        carries=(
                            _REMOTE,
                            Small("magazine", (0.21, 0.28, 0.01), 0.5, most=2),
                            _CUP,
                            _VASE,
                        ),
                    ),
                    "front",
                ),
                Beside(Piece("floor lamp", (0.35, 0.35, 1.60), 0.5), "right"),
                Beside(
                    Piece("side table", (0.45, 0.45, 0.55), 0.3, carries=(_LAMP, _BOOKS)), "left"
                ),
            ),
        ),
        Piece(
            "tv stand",
            (1.50, 0.42, 0.50),
            0.9,
            carries=(
                Small("tv", (1.10, 0.12, 0.65), 0.95),
                Small("speaker", (0.2, 0.2, 0.35), 0.3, 2),
            ),
        ),
        Piece("armchair", (0.85, 0.85, 0.90), 0.6, most=2),
        _BOOKSHELF,
        _FLOOR_PLANT,
        _WINDOW,
        _CURTAIN,
        _PICTURE,
        _DOOR,
        _CEILING_LAMP,
    ),
    "dining room": (
        Piece(
            "dining table",
            (1.70, 0.95, 0.76),
            1.0,
            "centre",
            carries=(
                Small("plate", (0.25, 0.25, 0.03), 0.6, most=4),
                Small("glass", (0.08, 0.08, 0.13), 0.5, most=3),
                Small("fork", (0.03, 0.19, 0.02), 0.4, most=2),
                Small("candle", (0.07, 0.07, 0.18), 0.4),
                _VASE,
            ),
            beside=(Beside(Piece("chair", _CHAIR.size, 0.85), "around"),),
        ),
        Piece(
            "cabinet",
            (1.30, 0.45, 0.95),
            0.7,
            carries=(
                Small("bowl", (0.26, 0.26, 0.10), 0.4),
                Small("bottle", (0.08, 0.08, 0.3), 0.4, 2),
            ),
        ),
        Piece("chandelier", (0.60, 0.60, 0.50), 0.6, "ceiling"),
        Piece("painting", (0.90, 0.04, 0.65), 0.6, "hung"),
        _WINDOW,
        _CURTAIN,
        _FLOOR_PLANT,
        _DOOR,
    ),
}
