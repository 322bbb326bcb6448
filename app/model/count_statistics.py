"""Statistics of the number of instances of a class in a scene, such as the chairs of a kitchen."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from app.inference.kernels import ROOM as ROOM
from app.model.fields import TensorGroup

Table = NDArray[np.float32]
Ints = NDArray[np.integer[Any]]


EXPONENTS: Final = 2
"""Exponents of the formula: the first raises large numbers, and the second numbers between 1 and M.
"""

_LARGEST: Final = 64.0
_MOST: Final = 256


@dataclass(frozen=True, eq=False)
class Counts(TensorGroup):
    """Counts of K of a model's V classes. `app.questions.counts` has the formula.

    Attributes:
        classes: (K,) indices of the classes with statistics, in ascending order.
        most: (K,) maximum listed number, from 1 to M - 1. Too few groups of training scenes have
            more instances.
        log_share: (K, M) log of the share of scenes with 1, 2, ... instances, of the scenes with
            the class. The last column stands for M or more instances.
        weights: (K, 2, 3 + C + V) effects of the scene on the two exponents. A class has no effect
            on itself.
    """

    prefix: ClassVar[str] = "counts."
    integers = ("classes", "most")

    classes: Annotated[Ints, "K"]
    most: Annotated[Ints, "K"]
    log_share: Annotated[Table, "K", "M"]
    weights: Annotated[Table, "K", EXPONENTS, "features"]

    def check(self, A: int, V: int, C: int) -> None:
        """Check the values for a model with V classes and C room types."""
        K, M = self.log_share.shape
        self.require(K, "there must be at least one class")
        self.require_keys("classes", V)
        self.require(2 <= M <= _MOST, f"log_share must have 2 to {_MOST} columns")
        is_right = ((self.most >= 1) & (self.most < M)).all()
        self.require(is_right, "most must be from 1 to the columns of log_share minus 1")
        is_right = ((self.log_share <= 0) & (self.log_share >= -_LARGEST)).all()
        self.require(is_right, f"log_share must be between -{_LARGEST:g} and 0")
        is_right = (np.abs(self.weights) <= _LARGEST).all()
        self.require(is_right, f"weights must be between -{_LARGEST:g} and {_LARGEST:g}")
        on_itself = self.weights[np.arange(K), :, ROOM + C + self.classes]
        self.require(not on_itself.any(), "the weight of a class on itself must be 0")
