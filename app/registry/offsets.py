"""Where things stand to each other in metres, by relation and pair of classes.

An offset leads from the centre of a relation's object to that of its subject, in the viewer's axes
(x away, y left, z up). Relations are the canonical ones: what stands to the right of a thing has
the negative offset of the thing to its left.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.registry.errors import ArtifactError

Table = NDArray[np.float32]
Ints = NDArray[np.integer[Any]]

PREFIX: Final = "offsets."
"""Of the names of their tensors, which lie among the machine's."""

NOTHING: Final = -1
"""In place of a number of scenes: training saw none of the relation."""


@dataclass(frozen=True, eq=False)
class Offsets:
    """Normal offsets, axis by axis; A canonical relations, V classes, P pairs that were seen.

    Attributes:
        relation: (A, 6) mean and variance of x, y and z between two classes never seen in it.
        relation_scenes: (A,) training scenes that showed the relation.
        subject, object: (A, V, 6) what a class at this end adds to both.
        pair: (P,) the pairs that were seen, (a V + subject) V + object, ascending.
        pair_offset: (P, 6) mean and standard deviation of theirs.
        pair_scenes: (P,) training scenes that showed the pair so.
    """

    relation: Table
    relation_scenes: Ints
    subject: Table
    object: Table
    pair: Ints
    pair_offset: Table
    pair_scenes: Ints

    def tensors(self) -> dict[str, NDArray[Any]]:
        """As an artifact holds them."""
        return {f"{PREFIX}{field.name}": getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, NDArray[Any]], A: int, V: int) -> Self:
        """What `tensors` gave, for a machine of A relations and V classes.

        Raises:
            ArtifactError: `wrong_shape`, `invalid_tensor`.
        """
        shapes = {
            "relation": (A, 6),
            "relation_scenes": (A,),
            "subject": (A, V, 6),
            "object": (A, V, 6),
            "pair": (P := len(np.atleast_1d(tensors.get(f"{PREFIX}pair", ()))),),
            "pair_offset": (P, 6),
            "pair_scenes": (P,),
        }
        for name in sorted(tensors.keys() | {f"{PREFIX}{name}" for name in shapes}):
            shape = shapes.get(name.removeprefix(PREFIX))
            found = tensors[name].shape if name in tensors else None
            if found != shape:
                raise ArtifactError("wrong_shape", f"tensor '{name}' is {found}, must be {shape}")
        offsets = cls(**{name: tensors[f"{PREFIX}{name}"] for name in shapes})
        if complaint := offsets._complaint(A * V * V):
            raise ArtifactError("invalid_tensor", f"offsets: {complaint}")
        return offsets

    def _complaint(self, most: int) -> str | None:
        counted = (self.relation_scenes, self.pair, self.pair_scenes)
        if not all(np.issubdtype(array.dtype, np.integer) for array in counted):
            return "pairs and scenes must be integers"
        if (np.diff(self.pair) <= 0).any() or (self.pair[:1] < 0).any():
            return "pairs must ascend"
        if (self.pair[-1:] >= most).any():
            return "a pair is beyond the vocabulary"
        if (self.relation_scenes < 0).any() or (self.pair_scenes < 1).any():
            return "a number of scenes is too small"
        least = self.relation + self.subject.min(axis=1) + self.object.min(axis=1)
        if (least[self.relation_scenes > 0, 3:] <= 0).any() or (self.pair_offset[:, 3:] <= 0).any():
            return "spreads must be positive"
        return None

    def find(
        self, relation: Ints, subject: Ints, other: Ints
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Of n pairs of classes, each in a relation: mean and standard deviation, and scenes.

        Args:
            relation, subject, other: (n,) canonical relations and classes.

        Returns:
            (n, 6), and (n,) the training scenes that showed the pair so: 0 where the offset rests
            on what is known of the relation and of either class; `NOTHING` where it means nothing.
        """
        found: tuple[NDArray[np.float64], NDArray[np.int64]]
        found = look_up(self.tables, relation, subject, other)
        return found

    @cached_property
    def tables(self) -> tuple[NDArray[Any], ...]:
        """As `look_up` takes them."""
        return (
            *(self.relation, self.relation_scenes, self.subject, self.object),
            *(self.pair, self.pair_offset, self.pair_scenes),
        )


@compiled
def look_up(tables, relation, subject, other):
    """See `Offsets.find`."""
    usual, relation_scenes, subjects, objects, pair, pair_offset, pair_scenes = tables
    n, V = len(relation), subjects.shape[1]
    offset, scenes = np.empty((n, 6)), np.empty(n, np.int64)
    for k in range(n):
        a, i, j = relation[k], subject[k], other[k]
        wanted = (a * V + i) * V + j
        place = np.searchsorted(pair, wanted)
        if place < len(pair) and pair[place] == wanted:
            offset[k], scenes[k] = pair_offset[place], pair_scenes[place]
            continue
        scenes[k] = 0 if relation_scenes[a] > 0 else NOTHING
        for axis in range(6):
            value = np.float64(usual[a, axis]) + subjects[a, i, axis] + objects[a, j, axis]
            offset[k, axis] = value if axis < 3 else math.sqrt(value)
    return offset, scenes
