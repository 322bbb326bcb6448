"""Offsets between related objects in metres, for each relation and pair of classes.

An offset is the vector from the centre of a relation's object to the centre of its subject, in the
viewer's axes (x away from the viewer, y left, z up). The tables contain only canonical relations.
The opposite relation, with both classes exchanged, has the negative offset.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from app.inference.kernels import look_up_offsets
from app.registry.fields import TensorGroup

Table = NDArray[np.float32]
Ints = NDArray[np.integer[Any]]


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

    prefix: ClassVar[str] = "offsets."
    integers = ("relation_scenes", "pair", "pair_scenes")

    relation: Annotated[Table, "A", 6]
    relation_scenes: Annotated[Ints, "A"]
    subject: Annotated[Table, "A", "V", 6]
    object: Annotated[Table, "A", "V", 6]
    pair: Annotated[Ints, "P"]
    pair_offset: Annotated[Table, "P", 6]
    pair_scenes: Annotated[Ints, "P"]

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, NDArray[Any]], A: int, V: int) -> Self:
        """Build the offsets of a machine with A relations and V classes from stored tensors.

        Raises:
            ArtifactError: `wrong_shape` or `invalid_tensor`; see `TensorGroup.read`.
        """
        offsets = cls.read(tensors, A=A, V=V)
        offsets.require_keys("pair", A * V * V)
        is_right = (offsets.relation_scenes >= 0).all() and (offsets.pair_scenes >= 1).all()
        offsets.require(is_right, "relation_scenes must be at least 0 and pair_scenes at least 1")
        least = offsets.relation + offsets.subject.min(axis=1) + offsets.object.min(axis=1)
        variances = least[offsets.relation_scenes > 0, 3:]
        is_right = (variances > 0).all() and (offsets.pair_offset[:, 3:] > 0).all()
        offsets.require(is_right, "variances and standard deviations must be positive")
        return offsets

    def find(
        self, relation: Ints, subject: Ints, other: Ints
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the offsets of n pairs (relation, subject class, object class) of indices (n,).

        Returns:
            Offsets (n, 6): mean (3) and standard deviation (3). Then the number of training scenes
            that contain each pair, (n,). If it is 0, the offset is the sum of a term of the
            relation and one term of each class. `UNOBSERVED`: training lacks the relation.
        """
        return look_up_offsets(self.tables, relation, subject, other)

    @cached_property
    def tables(self) -> tuple[NDArray[Any], ...]:
        """The arrays in the order that `look_up_offsets` expects."""
        return tuple(self.tensors().values())
