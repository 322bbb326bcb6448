"""Tables of another domain for the room generator: a laboratory, a workshop, a storeroom.

Nothing in a home prepares a model for them, so they stand in for whatever a user's robot sees that
the shipped models never saw. The figures are plain judgement, as those of the furnished rooms are.
"""

from __future__ import annotations

from typing import Final

from training.datasets.furniture import Beside, Piece, Rooms, Small

_STOOL = Piece("lab stool", (0.38, 0.38, 0.60), 0.8)
_GLOVES = Small("glove box", (0.25, 0.13, 0.09), 0.5)
_GOGGLES = Small("safety goggles", (0.17, 0.09, 0.08), 0.4, most=2)
_CLAMP = Small("clamp", (0.08, 0.20, 0.05), 0.5, most=2)
_SOLVENT = Small("solvent bottle", (0.10, 0.10, 0.25), 0.6, most=3)
_EXTINGUISHER = Piece("fire extinguisher", (0.18, 0.18, 0.55), 0.5)
_WASTE = Piece("waste drum", (0.45, 0.45, 0.70), 0.5)

WORKPLACES: Final[Rooms] = {
    "chemistry laboratory": (
        Piece(
            "lab bench",
            (1.80, 0.75, 0.90),
            0.95,
            most=2,
            carries=(
                Small("beaker", (0.09, 0.09, 0.12), 0.7, most=3),
                Small("hot plate", (0.20, 0.28, 0.12), 0.6),
                Small("pipette rack", (0.20, 0.12, 0.30), 0.5),
                Small("balance", (0.22, 0.32, 0.30), 0.4),
                _SOLVENT,
                _GLOVES,
                _GOGGLES,
            ),
            beside=(Beside(_STOOL, "front"),),
        ),
        Piece(
            "fume hood",
            (1.50, 0.80, 2.30),
            0.8,
        ),
        Piece(
            "centrifuge table",
            (0.80, 0.60, 0.75),
            0.5,
            carries=(Small("centrifuge", (0.35, 0.40, 0.30), 0.95),),
        ),
        Piece("eye wash station", (0.40, 0.35, 1.10), 0.6),
        Piece("solvent cabinet", (0.90, 0.50, 1.20), 0.6, carries=(_SOLVENT,)),
        _EXTINGUISHER,
        _WASTE,
    ),
    "electronics laboratory": (
        Piece(
            "electronics bench",
            (1.60, 0.80, 0.78),
            0.95,
            most=2,
            carries=(
                Small("oscilloscope", (0.38, 0.16, 0.20), 0.8),
                Small("soldering iron", (0.12, 0.20, 0.12), 0.8),
                Small("multimeter", (0.09, 0.19, 0.05), 0.7, most=2),
                Small("power supply", (0.22, 0.30, 0.16), 0.6),
                Small("wire spool", (0.08, 0.08, 0.07), 0.5, most=3),
                _CLAMP,
            ),
            beside=(Beside(_STOOL, "front"),),
        ),
        Piece(
            "component drawers",
            (0.60, 0.30, 0.90),
            0.7,
            carries=(Small("label printer", (0.15, 0.20, 0.15), 0.6),),
        ),
        Piece("server rack", (0.60, 0.80, 1.90), 0.4),
        _EXTINGUISHER,
    ),
    "workshop": (
        Piece(
            "workbench",
            (1.90, 0.75, 0.88),
            0.95,
            carries=(
                Small("vise", (0.18, 0.30, 0.20), 0.8),
                Small("hammer", (0.12, 0.32, 0.04), 0.6),
                Small("screwdriver", (0.03, 0.24, 0.03), 0.7, most=3),
                Small("cordless drill", (0.08, 0.25, 0.22), 0.6),
                _CLAMP,
                _GOGGLES,
            ),
        ),
        Piece("drill press", (0.50, 0.60, 1.70), 0.6),
        Piece("band saw", (0.60, 0.60, 1.65), 0.5),
        Piece(
            "tool chest",
            (0.75, 0.48, 1.00),
            0.7,
            carries=(Small("torque wrench", (0.05, 0.40, 0.05), 0.5),),
        ),
        Piece("pegboard", (1.20, 0.04, 0.70), 0.6, "hung"),
        Piece("air compressor", (0.60, 0.35, 0.65), 0.4),
        _EXTINGUISHER,
        _WASTE,
    ),
    "storeroom": (
        Piece(
            "pallet rack",
            (2.00, 0.90, 1.80),
            0.9,
            most=2,
            carries=(
                Small("storage crate", (0.50, 0.40, 0.32), 0.8, most=3),
                Small("wire spool", (0.20, 0.20, 0.15), 0.4),
            ),
        ),
        Piece("hand truck", (0.50, 0.45, 1.20), 0.6),
        Piece("pallet jack", (0.55, 1.20, 1.15), 0.5, "centre"),
        Piece("step ladder", (0.50, 0.30, 1.50), 0.5),
        _EXTINGUISHER,
    ),
}
"""What may be in each type of room, see `training.datasets.rooms.generate_rooms`."""
