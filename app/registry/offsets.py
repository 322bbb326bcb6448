"""Offsets between related objects in metres, for each relation and pair of classes.

An offset is the vector from the centre of a relation's object to the centre of its subject, in the
viewer's axes (x away from the viewer, y left, z up). The tables contain only canonical relations.
The opposite relation, with both classes exchanged, has the negative offset.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray

from app.inference.kernels import UNOBSERVED as UNOBSERVED
from app.inference.kernels import look_up_offsets
from app.registry.errors import ArtifactError
from app.registry.fields import TensorGroup

Table = NDArray[np.float32]
Ints = NDArray[np.integer[Any]]

PREFIX: Final = "offsets."
"""Prefix of the names of offset tensors. They are in the same file as the machine's tensors."""


@dataclass(frozen=True, eq=False)
class Offsets(TensorGroup):
    """Normal distributions of offsets, for A canonical relations, V classes and P observed pairs.

    Attributes:
        relation: (A, 6) mean (3) and variance (3) of the offset along x, y and z for each relation,
            for any two classes.
        relation_scenes: (A,) number of training scenes with each relation.
        subject: (A, V, 6) terms that each class adds to `relation` if it is the subject.
        object: (A, V, 6) terms that each class adds to `relation` if it is the object.
        pair: (P,) keys of the pairs of classes in the training scenes, in ascending order. The key
            of a pair in relation a is (a V + subject) V + object.
        pair_offset: (P, 6) mean (3) and standard deviation (3) of the offset of each pair.
        pair_scenes: (P,) number of training scenes with each pair in its relation.
    """

    prefix: ClassVar[str] = PREFIX

    relation: Table
    relation_scenes: Ints
    subject: Table
    object: Table
    pair: Ints
    pair_offset: Table
    pair_scenes: Ints

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, NDArray[Any]], A: int, V: int) -> Self:
        """Build the offsets of a machine with A relations and V classes from stored tensors.

        Raises:
            ArtifactError: `wrong_shape` if a tensor is missing, unexpected or of a wrong shape;
                `invalid_tensor` if a value is invalid.
        """
        P = len(np.atleast_1d(tensors.get(f"{PREFIX}pair", ())))
        shapes = {
            "relation": (A, 6),
            "relation_scenes": (A,),
            "subject": (A, V, 6),
            "object": (A, V, 6),
            "pair": (P,),
            "pair_offset": (P, 6),
            "pair_scenes": (P,),
        }
        offsets = cls.read(tensors, shapes)
        if complaint := offsets._complaint(A * V * V):
            raise ArtifactError("invalid_tensor", f"the offset tensors are invalid: {complaint}")
        return offsets

    def _complaint(self, most: int) -> str | None:
        counted = (self.relation_scenes, self.pair, self.pair_scenes)
        if not all(np.issubdtype(array.dtype, np.integer) for array in counted):
            return "pair, pair_scenes and relation_scenes must be integers"
        if (self.pair[1:] <= self.pair[:-1]).any() or (self.pair[:1] < 0).any():
            return "the keys in the tensor 'pair' must be non-negative and in ascending order"
        if (self.pair[-1:] >= most).any():
            return "a key in the tensor 'pair' has a relation or class that the model does not have"
        if (self.relation_scenes < 0).any() or (self.pair_scenes < 1).any():
            return "relation_scenes must be at least 0 and pair_scenes at least 1"
        least = self.relation + self.subject.min(axis=1) + self.object.min(axis=1)
        if (least[self.relation_scenes > 0, 3:] <= 0).any() or (self.pair_offset[:, 3:] <= 0).any():
            return "variances and standard deviations must be positive"
        return None

    def find(
        self, relation: Ints, subject: Ints, other: Ints
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the offsets of n pairs (relation, subject class, object class) of indices (n,).

        Returns:
            Offsets (n, 6): mean (3) and standard deviation (3). Then, for each pair, the number of
            training scenes that contain it, (n,). For a pair without training scenes, the number is
            0. Its offset is then the sum of a term of the relation and one term of each class. If
            the relation never occurred in training, the number is `UNOBSERVED`.
        """
        offsets, scenes = look_up_offsets(self.tables, relation, subject, other)
        return offsets, scenes

    @cached_property
    def tables(self) -> tuple[NDArray[Any], ...]:
        """The arrays in the order that `look_up` expects."""
        by_relation = self.relation, self.relation_scenes, self.subject, self.object
        by_pair = self.pair, self.pair_offset, self.pair_scenes
        return by_relation + by_pair
