"""What the four questions answer. Objects are named by their position in `Scene.objects`.

What there are dozens of in an answer is a named tuple, which takes a third of the time to make.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

REASONS: Final = 3
"""How many objects an answer names as reasons."""

EXPLAINED: Final = 32
"""Reasons are given for so many entries of an answer at most, its first."""


class RelationAnswer(NamedTuple):
    """`subject` stands in `relation` to `object`.

    Attributes:
        probability: that the relation holds, given that both are in the scene.
        observed: the scene states it, or its poses show it.
    """

    subject: int
    relation: str
    object: int
    probability: float
    observed: bool = False


class Offset(NamedTuple):
    """From the centre of an anchor to that of a missing thing, in metres.

    Attributes:
        mean, std: along x, y and z.
        scenes: training scenes that showed the two classes so.
    """

    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    scenes: int


class Disagreement(NamedTuple):
    """Two objects that stand otherwise than the rest of the scene makes one expect.

    Attributes:
        subject, object: which two.
        observed: relations of the one to the other that were stated or observed.
        expected: the likeliest relation, judged without all that is known of the pair.
        probability: of it, as that of a `RelationAnswer`.
        observed_probability: of the likeliest observed one.
    """

    subject: int
    object: int
    observed: tuple[str, ...]
    expected: str
    probability: float
    observed_probability: float


class Placement(NamedTuple):
    """A missing thing would stand in `relation` to `object`, at `offset` from it where known."""

    relation: str
    object: int
    probability: float
    offset: Offset | None = None


class MissingAnswer(NamedTuple):
    """An absent class.

    Attributes:
        label: canonical.
        probability: that it is the one that was taken away, given that exactly one was (with a
            place: given that it stood there).
        log_odds: of its presence against its absence.
        placements: where it would stand, likeliest first.
        because: the objects that change its log-odds most, strongest first.
    """

    label: str
    probability: float
    log_odds: float
    placements: tuple[Placement, ...]
    because: tuple[Because, ...]


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
        because: the objects that make it unlikely, strongest first; of one that fits, those that
            make it likely.
        usually_with: absent classes that would make it likely, at most three; of outliers only.
    """

    object: int
    label: str
    probability: float
    log_odds: float
    is_outlier: bool
    because: tuple[Because, ...]
    usually_with: tuple[str, ...] = ()


class MisplacedAnswer(NamedTuple):
    """A relation of the scene and the probability that it is false.

    Attributes:
        is_misplaced: the probability reaches the threshold.
    """

    subject: int
    relation: str
    object: int
    probability: float
    is_misplaced: bool = False


class OutliersFound(NamedTuple):
    """What does not belong, and what stands in the wrong place.

    Attributes:
        threshold: probability from which an object is an outlier.
        outliers: every object, least fitting first.
        misplaced: every stated relation, least likely first.
    """

    threshold: float
    outliers: tuple[OutlierAnswer, ...]
    misplaced: tuple[MisplacedAnswer, ...]


@dataclass(frozen=True, slots=True)
class GeneratedScene:
    """A drawn scene.

    Attributes:
        objects: canonical labels of its classes, in the order of the vocabulary.
        relations: canonical (subject, relation, object) over labels.
        log_score: see `ConditionedChains.log_score`; comparable between scenes of one model.
        context: layer name to its active units.
    """

    objects: tuple[str, ...]
    relations: tuple[tuple[str, str, str], ...]
    log_score: float
    context: dict[str, tuple[int, ...]]


@dataclass(frozen=True, slots=True)
class ContextUnit:
    """A hidden unit by the classes that it favours.

    Attributes:
        unit: its number in the layer.
        name: for people to read.
        objects: (label, weight) of the objects it favours most.
        relations: ((subject, relation, object), weight) of the relations it favours most, beyond
            the mean over the layer.
        room_types: (room type, weight) of the room types that favour it most.
    """

    unit: int
    name: str
    objects: tuple[tuple[str, float], ...]
    relations: tuple[tuple[tuple[str, str, str], float], ...]
    room_types: tuple[tuple[str, float], ...]
