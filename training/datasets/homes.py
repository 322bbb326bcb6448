"""Questions about a thing in a home: a thing is taken away, and `/where` looks for it.

The rooms of a home are the scenes of one group of a source with homes (`Source.of_homes`), at least
`LEAST_ROOMS`. A thing is a class with one object in the home, without structure. In some cases, the
thing was never there: a class that the home lacks, drawn in proportion to the number of homes with
it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from training.datasets import EncodedScene
from training.datasets.array_types import ClassMask
from training.datasets.cases import scene_rng
from training.datasets.sources import source_of

LEAST_ROOMS: Final = 3
THINGS: Final = 12  # maximum things of a home
ABSENT: Final = 0.1
"""Share of the wanted things that are in no room: the prior of an answer "not here"."""

NOWHERE: Final = -1


@dataclass(frozen=True, eq=False)
class HomeCase:
    """A thing that was taken away from a home."""

    rooms: Sequence[EncodedScene]
    thing: int  # class
    room: int  # index of its room, or `NOWHERE`
    home: int  # number of the home


def homes_of(scenes: Sequence[EncodedScene]) -> list[list[EncodedScene]]:
    """Return the homes among the scenes of all sources."""
    rooms: dict[tuple[str, str], list[EncodedScene]] = defaultdict(list)
    for scene in scenes:
        if source_of(scene.source).of_homes:
            rooms[scene.source, scene.group].append(scene)
    return [home for home in rooms.values() if len(home) >= LEAST_ROOMS]


def home_cases(
    scenes: Sequence[EncodedScene], structure: ClassMask, seed: int = 0
) -> list[HomeCase]:
    """Return at most `THINGS` taken things of each home, and some that were never there."""
    homes = homes_of(scenes)
    counts = [_counts(home, len(structure)) * ~structure for home in homes]
    shared = np.sum([total > 0 for total in counts], axis=0, dtype=float)  # homes with each class
    cases: list[HomeCase] = []
    for number, (home, total) in enumerate(zip(homes, counts, strict=True)):
        rng = scene_rng(home[0], seed)
        things = rng.permutation(np.flatnonzero(total == 1))[:THINGS].tolist()
        lacking = np.where(total > 0, 0.0, shared)
        for thing in things:
            room = next(k for k, one in enumerate(home) if thing in one.evidence.classes)
            cases.append(HomeCase(home, thing, room, number))
            if lacking.any() and rng.random() < ABSENT / (1 - ABSENT):
                absent = int(rng.choice(len(lacking), p=lacking / lacking.sum()))
                cases.append(HomeCase(home, absent, NOWHERE, number))
    return cases


def _counts(home: Sequence[EncodedScene], V: int) -> Float[NDArray[np.float64], "V"]:
    """Return the number of objects of each class in a home."""
    classes = np.concatenate([room.instance_classes for room in home])
    return np.bincount(classes, minlength=V).astype(np.float64)
