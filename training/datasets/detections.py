"""A model of detectors: detections of a scene that are missed, mislabelled or ghosts.

Each object is missed with the probability `MISSED`. A seen object has the label of a similar class
with the probability `SWAPPED`. A scene of n seen objects has n + 1 chances of a ghost, each with
the probability `GHOSTS`. The confidence is drawn from a beta distribution:

    right label      Beta(9, 2)
    swapped label    Beta(5, 4)
    ghost            Beta(4, 4)

A swapped label is one of the `SIMILAR` classes with the most similar word vectors. The classes of
ghosts and of swapped labels are drawn in proportion to the frequency of their class in training.
Classes that are not judged, such as cat or bag, are neither swapped nor ghosts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.scene import Vocabulary
from training.datasets import EncodedScene
from training.datasets.array_types import Rng

MISSED: Final = 0.2
SWAPPED: Final = 0.1
GHOSTS: Final = 0.05
SIMILAR: Final = 5

RIGHT_LAW: Final = (9.0, 2.0)
SWAPPED_LAW: Final = (5.0, 4.0)
GHOST_LAW: Final = (4.0, 4.0)
"""Parameters of the beta distributions of confidences."""

GHOST: Final = -1
"""True class of a ghost."""

INTRUDER: Final = -2
"""True class of a real object that does not belong."""


class Detections(NamedTuple):
    """N detections of one scene."""

    classes: Int[NDArray, "N"]  # as labelled
    confidence: Float[NDArray, "N"]
    truth: Int[NDArray, "N"]  # true class, `GHOST` or `INTRUDER`
    # Another label of each detection, -1 without one: the true class, or a similar one.
    other: Int[NDArray, "N"]
    other_confidence: Float[NDArray, "N"]

    @property
    def right(self) -> Bool[NDArray, "N"]:
        """Whether object and label are right."""
        return (self.classes == self.truth) | (self.truth == INTRUDER)


@dataclass(frozen=True, eq=False)
class Detector:
    """The model of detectors for the classes of a vocabulary."""

    share: Float[NDArray, "V"]  # probability of a ghost of each class
    similar: Int[NDArray, "V k"]  # -1 in the rows of classes that are never swapped

    @classmethod
    def of(cls, vocabulary: Vocabulary, frequency: Float[NDArray, "V"]) -> Self:
        """Return the detector for classes with these frequencies; 0 for classes never seen."""
        vectors, has_vector = vocabulary.vectors
        usable = vocabulary.judged & (frequency > 0)
        share = np.where(usable, frequency, 0.0)
        rows = np.flatnonzero(usable & has_vector)
        similar = np.full((len(frequency), min(SIMILAR, max(len(rows) - 1, 1))), -1)
        if len(rows) > 1:
            cosines = vectors[rows] @ vectors[rows].T
            np.fill_diagonal(cosines, -np.inf)
            nearest = np.argsort(-cosines, axis=1, kind="stable")[:, : similar.shape[1]]
            similar[rows] = rows[nearest]
        return cls(share / share.sum(), similar)

    def draw(self, encoded: EncodedScene, structure: Sequence[bool], rng: Rng) -> Detections:
        """Draw the detections of the objects of a scene, without structure."""
        things = [c for c in encoded.instance_classes.tolist() if not structure[c]]
        seen = [c for c in things if rng.random() >= MISSED]
        rows = [self._seen(c, rng) for c in seen]
        for _ in range(len(seen) + 1):
            if rng.random() < GHOSTS:
                ghost = int(rng.choice(len(self.share), p=self.share))
                rows.append((ghost, rng.beta(*GHOST_LAW), GHOST, -1, 0.0))
        return Detections(*map(np.array, zip(*rows, strict=True))) if rows else _NOTHING

    def with_intruder(self, seen: Detections, present: Int[NDArray, "n"], rng: Rng) -> Detections:
        """Add a real object of a class that is not present, with a right label."""
        share = self.share.copy()
        share[present] = 0.0
        intruder = int(rng.choice(len(share), p=share / share.sum()))
        row = intruder, rng.beta(*RIGHT_LAW), INTRUDER, -1, 0.0
        columns = zip(seen, row, strict=True)
        return Detections(*(np.append(column, value) for column, value in columns))

    def _seen(self, c: int, rng: Rng) -> tuple[int, float, int, int, float]:
        """Return a row of `Detections` for an object of class c."""
        is_swapped = rng.random() < SWAPPED
        similar = self.similar[c]
        if similar[0] < 0:
            return c, rng.beta(*RIGHT_LAW), c, -1, 0.0
        p = self.share[similar]
        other = int(rng.choice(similar, p=p / p.sum()))
        if is_swapped:
            return other, rng.beta(*SWAPPED_LAW), c, c, rng.beta(*SWAPPED_LAW)
        return c, rng.beta(*RIGHT_LAW), c, other, rng.beta(*SWAPPED_LAW)


_NONE: Final = np.zeros(0, np.int64)
_NOTHING: Final = Detections(_NONE, _NONE.astype(float), _NONE, _NONE, _NONE.astype(float))
