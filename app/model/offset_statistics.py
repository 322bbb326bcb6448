"""Offsets between related objects in metres, for each relation and pair of classes.

An offset is the vector from the centre of a relation's object to the centre of its subject, in the
viewer's axes (x away from the viewer, y left, z up). The tables contain only canonical relations.
The opposite relation, with both classes exchanged, has the negative offset.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from app.inference.kernels import look_up_offsets
from app.model.fields import TensorGroup

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

    def check(self, A: int, V: int, C: int) -> None:
        """Check the values for a machine with A relations and V classes."""
        self.require_keys("pair", A * V * V)
        is_right = (self.relation_scenes >= 0).all() and (self.pair_scenes >= 1).all()
        self.require(is_right, "relation_scenes must be at least 0 and pair_scenes at least 1")
        least = self.relation + self.subject.min(axis=1) + self.object.min(axis=1)
        variances = least[self.relation_scenes > 0, 3:]
        is_right = (variances > 0).all() and (self.pair_offset[:, 3:] > 0).all()
        self.require(is_right, "variances and standard deviations must be positive")

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
