"""What the four questions answer. Objects are named by their position in `Scene.objects`.

What there are dozens of in an answer is a named tuple, which takes a third of the time to make.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


class RelationAnswer(NamedTuple):
    """`subject` stands in `relation` to `object`; probability that an annotator would list it."""

    subject: int
    relation: str
    object: int
    probability: float


class Placement(NamedTuple):
    """A missing thing would stand in `relation` to `object`."""

    relation: str
    object: int
    probability: float


class MissingAnswer(NamedTuple):
    """An absent class.

    Attributes:
        label: canonical.
        probability: that it is the one that was taken away, given that exactly one was (with a
            place: given that it stood there).
        log_odds: of its presence against its absence.
        placements: where it would stand, likeliest first.
    """

    label: str
    probability: float
    log_odds: float
    placements: tuple[Placement, ...]


class Because(NamedTuple):
    """What the presence of one object adds to the log-odds of another; negative speaks against."""

    object: int
    log_odds_change: float


class OutlierAnswer(NamedTuple):
    """How badly an object fits.

    Attributes:
        object, label: which one; the label is canonical.
        probability: that it is an intruder, where half of the scenes are clean.
        log_odds: of its class being present given the rest of the scene.
        is_outlier: the probability reaches the threshold.
        because: the objects that change its log-odds most, strongest first.
    """

    object: int
    label: str
    probability: float
    log_odds: float
    is_outlier: bool
    because: tuple[Because, ...]


class MisplacedAnswer(NamedTuple):
    """A relation of the scene and the probability that it is false."""

    subject: int
    relation: str
    object: int
    probability: float


@dataclass(frozen=True, slots=True)
class GeneratedScene:
    """A drawn scene.

    Attributes:
        objects: canonical labels of its classes, in the order of the vocabulary.
        relations: canonical (subject, relation, object) over labels.
        log_score: see `app.reasoning.generate`; comparable between scenes of one model.
        context: layer name to its active units.
    """

    objects: tuple[str, ...]
    relations: tuple[tuple[str, str, str], ...]
    log_score: float
    context: dict[str, tuple[int, ...]]


@dataclass(frozen=True, slots=True)
class ContextUnit:
    """A hidden unit by what it stands for.

    Attributes:
        unit: its number in the layer.
        objects: (label, weight) of the objects it favours most.
        room_types: (room type, weight) of the room types that favour it most.
    """

    unit: int
    objects: tuple[tuple[str, float], ...]
    room_types: tuple[tuple[str, float], ...]
