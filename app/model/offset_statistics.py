"""Offsets between related objects in metres, for each relation and pair of classes.

An offset is the vector from the centre of a relation's object to the centre of its subject, in the
viewer's axes (x away from the viewer, y left, z up). The tables contain only canonical relations.
The opposite relation, with both classes exchanged, has the negative offset.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.compiling import compiled
from app.model.fields import TensorGroup
from app.scene.roles import find_row
from app.scene.spatial_relations import FRONT, LEFT

Table = NDArray[np.float32]
Ints = NDArray[np.integer[Any]]

UNOBSERVED: Final = -1
"""Number of scenes for a relation that never occurs in training, so that an offset is unknown."""
_PER_METRE: Final = 1000.0  # offsets are rounded to millimetres


@dataclass(frozen=True, eq=False)
class Offsets(TensorGroup):
    """Normal distributions of offsets, for A canonical relations, V classes and P observed pairs.

    Six numbers are three means along x, y and z, then three variances. The terms of the subject's
    and the object's class add to those of the relation, which are for any two classes.
    """

    prefix: ClassVar[str] = "offsets."
    integers = ("relation_scenes", "pair", "pair_scenes")

    relation: Annotated[Table, "A", 6]
    relation_scenes: Annotated[Ints, "A"]  # number of training scenes with each relation
    subject: Annotated[Table, "A", "V", 6]
    object: Annotated[Table, "A", "V", 6]
    pair: Annotated[Ints, "P"]  # keys (a V + subject) V + object in relation a, ascending
    pair_offset: Annotated[Table, "P", 6]  # means, then standard deviations
    pair_scenes: Annotated[Ints, "P"]  # number of training scenes with each pair in its relation

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
        self, relation: Int[Ints, "n"], subject: Int[Ints, "n"], other: Int[Ints, "n"]
    ) -> tuple[Float[NDArray[np.float64], "n 6"], Int[NDArray[np.int64], "n"]]:
        """Return the offsets of pairs of classes, and the number of training scenes of each pair.

        An offset is mean (3) and standard deviation (3). If the number is 0, it is the sum of a
        term of the relation and one term of each class. `UNOBSERVED`: training lacks the relation.
        """
        return _look_up_offsets(self.tables, relation, subject, other)

    @cached_property
    def tables(self) -> tuple[NDArray[Any], ...]:
        """The arrays in the order that `_look_up_offsets` expects."""
        return tuple(self.tensors().values())


@compiled
def rotated_offsets(
    tables: tuple[NDArray[Any], ...],  # `Offsets.tables`
    relation: Int[NDArray, " n"],
    missing: Int[NDArray, " n"],  # classes of the missing objects
    anchor: Int[NDArray, " n"],  # classes of the anchors
    outgoing: Bool[NDArray, " n"],  # whether the missing object is the relation's subject
    axes: Float[NDArray, "3 3"],  # of the viewer, in the frame of the offsets
    has_axes: bool,
) -> tuple[Float[NDArray, "n 3"], Float[NDArray, "n 3"], Int[NDArray, " n"]]:
    """Return mean and standard deviation of the offset from each anchor to its missing object.

    Lengths are in metres. The third result is the number of training scenes with the two classes in
    this relation, or `UNOBSERVED` for an unknown offset. Without axes, the viewing direction is
    unknown: left and front have no offset, and the means of other offsets are vertical.
    """
    n = len(relation)
    subject, object_ = np.empty(n, np.int64), np.empty(n, np.int64)
    for k in range(n):
        subject[k], object_[k] = missing[k], anchor[k]
        if not outgoing[k]:
            subject[k], object_[k] = anchor[k], missing[k]
    offset, scenes = _look_up_offsets(tables, relation, subject, object_)
    mean, variance, std = np.zeros((n, 3)), np.zeros((n, 3)), np.empty((n, 3))
    for k in range(n):
        if has_axes:
            for axis in range(3):
                axis_mean, axis_variance = offset[k, axis], offset[k, 3 + axis] ** 2
                for to in range(3):
                    mean[k, to] += axes[axis, to] * axis_mean
                    variance[k, to] += axes[axis, to] ** 2 * axis_variance
        else:
            if relation[k] == LEFT or relation[k] == FRONT:
                scenes[k] = UNOBSERVED
            mean[k, 2], variance[k, 2] = offset[k, 2], offset[k, 5] ** 2
            # Any horizontal direction is equally likely, so x and y share E[x²] + E[y²] equally.
            for axis in range(2):
                half = (offset[k, axis] ** 2 + offset[k, 3 + axis] ** 2) / 2
                variance[k, 0] += half
                variance[k, 1] += half
        for axis in range(3):
            value = mean[k, axis] if outgoing[k] else -mean[k, axis]
            # Adding 0.0 turns -0.0 into 0.0.
            mean[k, axis] = np.rint(value * _PER_METRE) / _PER_METRE + 0.0
            millimetres = np.rint(math.sqrt(variance[k, axis]) * _PER_METRE)
            std[k, axis] = max(millimetres, 1.0) / _PER_METRE
    return mean, std, scenes


@compiled
def _look_up_offsets(
    tables: tuple[NDArray[Any], ...],
    relation: Int[NDArray, " n"],
    subject: Int[NDArray, " n"],
    other: Int[NDArray, " n"],
) -> tuple[Float[NDArray, "n 6"], Int[NDArray, " n"]]:
    """Return the offsets and the numbers of scenes of `Offsets.find`."""
    relation_offset, relation_scenes, subjects, objects, pair, pair_offset, pair_scenes = tables
    n, V = len(relation), subjects.shape[1]
    offset, scenes = np.empty((n, 6)), np.empty(n, np.int64)
    for k in range(n):
        a, i, j = relation[k], subject[k], other[k]
        row = find_row(pair, (a * V + i) * V + j)
        if row >= 0:
            for axis in range(6):
                offset[k, axis] = pair_offset[row, axis]
            scenes[k] = pair_scenes[row]
            continue
        scenes[k] = 0 if relation_scenes[a] > 0 else UNOBSERVED
        for axis in range(6):
            value = np.float64(relation_offset[a, axis])
            value = value + subjects[a, i, axis] + objects[a, j, axis]
            offset[k, axis] = value if axis < 3 else math.sqrt(value)
    return offset, scenes
